//! Residuals of motion models against the trained motion.

use cif_geometry::quaternion;
use cif_geometry::stats::weighted_quantile;

use crate::field_motion::frames::Frame;
use crate::graph::{ResidualStatistics, TimeResidual};
use crate::vectors::{dot, vector};

/// Residuals, gathered time by time.
#[derive(Clone, Debug, Default)]
pub struct ResidualSum {
    /// Residual at every time, in the order in which they were added.
    pub times: Vec<TimeResidual>,
    statistics: ResidualStatistics,
    squares: f64,
    turn_squares: f64,
    weight: f64,
    turn_weight: f64,
}

impl ResidualSum {
    /// Adds the residuals of one time.
    pub fn add(&mut self, distances: &[f64], weights: &[f64], trim: f64, tolerance: f64) {
        let total: f64 = weights.iter().sum();
        if total <= 0.0 {
            self.times.push(TimeResidual::default());
            return;
        }
        let (decisive, inlier_share) = trimmed_rms(distances, weights, trim);
        self.times.push(TimeResidual { decisive, inlier_share });
        let mut outliers = 0.0;
        for (distance, weight) in distances.iter().zip(weights) {
            self.squares += weight * distance * distance;
            if *distance > tolerance {
                outliers += weight;
            }
            self.statistics.max = self.statistics.max.max(*distance);
        }
        self.weight += total;
        let worst = &mut self.statistics;
        worst.decisive = worst.decisive.max(decisive);
        worst.percentile_95 = worst.percentile_95.max(weighted_quantile(distances, weights, 0.95));
        worst.outlier_share = worst.outlier_share.max(outliers / total);
    }

    fn add_turn(&mut self, degrees: f64, weight: f64) {
        self.turn_squares += weight * degrees * degrees;
        self.turn_weight += weight;
    }

    /// The statistics of everything added.
    #[must_use]
    pub fn statistics(&self) -> ResidualStatistics {
        let root = |squares: f64, weight: f64| if weight > 0.0 { (squares / weight).sqrt() } else { 0.0 };
        ResidualStatistics {
            rms: root(self.squares, self.weight),
            orientation_rms_degrees: root(self.turn_squares, self.turn_weight),
            ..self.statistics
        }
    }
}

/// Weighted RMS without the outlying share of the weight that has the largest values, and the share of the
/// weight that it is taken over; zero without weight.
///
/// The value at the edge counts with the part of its weight that is inside, so that smaller values never give
/// a larger RMS, and the triangle inequality holds (see [`crate::motion::keys`]).
pub(crate) fn trimmed_rms(distances: &[f64], weights: &[f64], trim: f64) -> (f64, f64) {
    let total: f64 = weights.iter().sum();
    if total <= 0.0 {
        return (0.0, 0.0);
    }
    let mut order: Vec<u32> = (0..distances.len() as u32).collect();
    if trim > 0.0 {
        order.sort_unstable_by(|&a, &b| {
            distances[a as usize].total_cmp(&distances[b as usize]).then(a.cmp(&b))
        });
    }
    let inside = (1.0 - trim) * total;
    let (mut squares, mut left) = (0.0, inside);
    for index in order {
        let (distance, weight) = (distances[index as usize], weights[index as usize].min(left));
        if weight > 0.0 {
            squares += weight * distance * distance;
            left -= weight;
        }
    }
    ((squares / inside).sqrt(), 1.0 - trim)
}

/// Adds the turns between predicted and trained orientations; a Gaussian counts by how far from round it is.
pub(crate) fn add_turns_between(
    sum: &mut ResidualSum,
    predicted: &[[f64; 4]],
    rows: &[u32],
    weights: &[f64],
    gaussians: &Frame,
) {
    for ((&row, predicted), weight) in rows.iter().zip(predicted).zip(weights) {
        let trained = gaussians.quaternions[row as usize].map(f64::from);
        let Some(trained) = quaternion::try_normalize(trained) else { continue };
        let cosine = dot(*predicted, trained).abs().min(1.0);
        let scales = vector(gaussians.log_scales[row as usize]);
        let flatness = 1.0 - (scales.min_element() - scales.max_element()).exp();
        sum.add_turn(2.0 * cosine.acos().to_degrees(), weight * flatness);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_value_at_the_edge_counts_in_part() {
        let (rms, share) = trimmed_rms(&[3.0, 1.0, 2.0], &[10.0, 75.0, 15.0], 0.05);
        assert!((rms - ((75.0 + 15.0 * 4.0 + 5.0 * 9.0) / 95.0_f64).sqrt()).abs() < 1e-12, "{rms}");
        assert!((share - 0.95).abs() < 1e-15);
        assert_eq!(trimmed_rms(&[3.0, 4.0], &[1.0, 1.0], 0.0), (12.5_f64.sqrt(), 1.0));
        assert_eq!(trimmed_rms(&[3.0], &[0.0], 0.05), (0.0, 0.0));
    }

    proptest! {
        /// Properties that the error bounds rest on: smaller distances never give a larger value, and sums stay below
        /// the sum of the first value and the RMS of what is added, over all weight.
        #[test]
        fn trimmed_rms_is_monotone_and_obeys_the_triangle_inequality(
            values in prop::collection::vec((0.0_f64..1.0, 0.0_f64..1.0, 0.01_f64..5.0), 1..30),
        ) {
            let pick = |f: &dyn Fn(&(f64, f64, f64)) -> f64| values.iter().map(f).collect::<Vec<_>>();
            let (small, sum, weights) = (pick(&|v| v.0), pick(&|v| v.0 + v.1), pick(&|v| v.2));
            let added = pick(&|v| v.1);
            let (a, share) = trimmed_rms(&small, &weights, 0.05);
            let (both, _) = trimmed_rms(&sum, &weights, 0.05);
            prop_assert!(a <= both + 1e-12, "{} {}", a, both);
            let total = trimmed_rms(&added, &weights, 0.0).0;
            prop_assert!(both <= a + total / share.sqrt() + 1e-12, "{} {} {}", both, a, total);
        }
    }
}
