//! Weighted draws. Source: methods reference 6.2 and 7 (rows 30 and 31).

use rand::{Rng, RngExt};

/// A uniform number in (0, 1].
fn positive_unit(rng: &mut impl Rng) -> f64 {
    1.0 - rng.random::<f64>()
}

/// `count` distinct positions (all, when there are fewer), drawn one after the other in proportion to the
/// weights of those left: the smallest of the exponential keys `-ln(u) / weight`. Ascending.
#[must_use]
pub fn draw_without_replacement(weights: &[f64], count: usize, rng: &mut impl Rng) -> Vec<usize> {
    if count == 0 {
        return Vec::new();
    }
    let mut keyed: Vec<(f64, usize)> =
        weights.iter().enumerate().map(|(k, weight)| (-positive_unit(rng).ln() / weight, k)).collect();
    let count = count.min(keyed.len());
    let order = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    if count < keyed.len() {
        keyed.select_nth_unstable_by(count, order);
        keyed.truncate(count);
    }
    let mut drawn: Vec<usize> = keyed.into_iter().map(|(_, k)| k).collect();
    drawn.sort_unstable();
    drawn
}

/// `count` positions, each drawn in proportion to the weights, by prefix sums in double precision.
///
/// # Panics
/// When there are no weights.
#[must_use]
pub fn draw_with_replacement(weights: &[f64], count: usize, rng: &mut impl Rng) -> Vec<usize> {
    assert!(!weights.is_empty(), "nothing to draw from");
    let mut total = 0.0;
    let prefix: Vec<f64> = weights
        .iter()
        .map(|weight| {
            total += weight;
            total
        })
        .collect();
    (0..count)
        .map(|_| {
            let at = rng.random::<f64>() * total;
            prefix.partition_point(|sum| *sum <= at).min(weights.len() - 1)
        })
        .collect()
}

/// Shares `budget` out in proportion to the weights, by largest remainder; the first of equals goes first.
#[must_use]
pub fn shares(budget: usize, weights: &[f64]) -> Vec<usize> {
    let total: f64 = weights.iter().sum();
    if total <= 0.0 {
        return vec![0; weights.len()];
    }
    let exact: Vec<f64> = weights.iter().map(|weight| budget as f64 * weight / total).collect();
    let mut shares: Vec<usize> = exact.iter().map(|share| share.floor() as usize).collect();
    let mut order: Vec<usize> = (0..weights.len()).filter(|k| weights[*k] > 0.0).collect();
    order.sort_by(|a, b| exact[*b].fract().total_cmp(&exact[*a].fract()).then(a.cmp(b)));
    let left = budget.saturating_sub(shares.iter().sum());
    for k in order.into_iter().cycle().take(left) {
        shares[k] += 1;
    }
    shares
}

/// Shares as [`shares`] gives them, but none above its limit: what is beyond goes to the others in proportion to their
/// weights, as long as there is room.
#[must_use]
pub fn limited_shares(budget: usize, weights: &[f64], limits: &[usize]) -> Vec<usize> {
    let mut given = vec![0; weights.len()];
    let mut open = weights.to_vec();
    let mut left = budget;
    while left > 0 && open.iter().any(|weight| *weight > 0.0) {
        for (k, more) in shares(left, &open).into_iter().enumerate() {
            let taken = more.min(limits[k] - given[k]);
            given[k] += taken;
            left -= taken;
            if given[k] == limits[k] {
                open[k] = 0.0;
            }
        }
    }
    given
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;

    /// Chi-square statistic of observed counts against expected probabilities.
    fn chi_square(observed: &[usize], probabilities: &[f64]) -> f64 {
        let total: usize = observed.iter().sum();
        observed
            .iter()
            .zip(probabilities)
            .map(|(o, p)| {
                let expected = total as f64 * p;
                (*o as f64 - expected).powi(2) / expected
            })
            .sum()
    }

    #[test]
    fn row_30_weak_draws_follow_inverse_gamma() {
        // Row 30: gammas down to the floor; 9 degrees of freedom, 27.9 is the 0.1 % quantile.
        let gamma: [f64; 10] = [1e-9, 1e-3, 0.002, 0.01, 0.05, 0.1, 0.2, 0.5, 0.9, 1.0];
        let weights: Vec<f64> = gamma.iter().map(|g| 1.0 / g.clamp(1e-3, 1.0)).collect();
        let total: f64 = weights.iter().sum();
        let probabilities: Vec<f64> = weights.iter().map(|w| w / total).collect();
        let mut rng = Pcg64::seed_from_u64(11);
        let mut observed = [0; 10];
        for _ in 0..200_000 {
            observed[draw_without_replacement(&weights, 1, &mut rng)[0]] += 1;
        }
        let statistic = chi_square(&observed, &probabilities);
        crate::measured::worst(30, "f64", "chi-square of 9 degrees of freedom", statistic, 27.9);
    }

    #[test]
    fn draws_without_replacement_are_distinct_and_follow_the_sequential_law() {
        let weights = [1.0, 2.0, 3.0, 4.0];
        let mut rng = Pcg64::seed_from_u64(2);
        let mut pairs = std::collections::BTreeMap::<Vec<usize>, usize>::new();
        for _ in 0..100_000 {
            *pairs.entry(draw_without_replacement(&weights, 2, &mut rng)).or_default() += 1;
        }
        assert_eq!(pairs.len(), 6);
        let first_then = |a: usize, b: usize| weights[a] / 10.0 * weights[b] / (10.0 - weights[a]);
        let probabilities: Vec<f64> =
            pairs.keys().map(|p| first_then(p[0], p[1]) + first_then(p[1], p[0])).collect();
        let observed: Vec<usize> = pairs.values().copied().collect();
        let statistic = chi_square(&observed, &probabilities);
        assert!(statistic < 20.5, "{statistic}");
        assert_eq!(draw_without_replacement(&weights, 9, &mut rng), [0, 1, 2, 3]);
    }

    #[test]
    fn row_31_the_tail_of_a_million_weights_is_drawn_in_proportion() {
        // Row 31: the head holds nearly all of the mass.
        let mut weights = vec![1.0; 1_000_000];
        weights[0] = 1e6 * 99.0;
        let mut rng = Pcg64::seed_from_u64(3);
        let drawn = draw_with_replacement(&weights, 2_000_000, &mut rng);
        let tail = drawn.iter().filter(|k| **k >= 990_000).count();
        // 200 expected, standard deviation 14.
        let deviation = (tail as f64 / 200.0 - 1.0).abs();
        crate::measured::worst(31, "f64", "share of the last hundredth", deviation, 0.25);
    }

    #[test]
    fn strong_draws_follow_gamma() {
        let weights = [1e-3, 0.01, 0.1, 0.4, 1.0];
        let mut rng = Pcg64::seed_from_u64(4);
        let mut observed = [0; 5];
        for k in draw_with_replacement(&weights, 300_000, &mut rng) {
            observed[k] += 1;
        }
        let total: f64 = weights.iter().sum();
        let statistic = chi_square(&observed, &weights.map(|w| w / total));
        assert!(statistic < 18.5, "{statistic} {observed:?}");
    }

    #[test]
    fn shares_add_up() {
        assert_eq!(shares(10, &[1.0, 1.0, 1.0]), [4, 3, 3]);
        assert_eq!(shares(10, &[1.0, 0.0, 1.0, 1.0]), [4, 0, 3, 3]);
        assert_eq!(shares(2, &[1.0, 1.0, 1.0]), [1, 1, 0]);
        assert_eq!(shares(7, &[0.0, 0.0]), [0, 0]);
        assert_eq!(shares(100, &[70.0, 29.6, 0.4]), [70, 30, 0]);
    }

    #[test]
    fn shares_beyond_a_limit_go_to_the_others() {
        assert_eq!(limited_shares(10, &[1.0, 1.0, 1.0], &[9, 9, 9]), shares(10, &[1.0, 1.0, 1.0]));
        assert_eq!(limited_shares(12, &[1.0, 1.0, 2.0], &[1, 9, 9]), [1, 4, 7]);
        assert_eq!(limited_shares(12, &[1.0, 0.0, 1.0], &[2, 9, 3]), [2, 0, 3]);
        assert_eq!(limited_shares(7, &[0.0, 0.0], &[5, 5]), [0, 0]);
        assert_eq!(limited_shares(3, &[1.0, 1.0], &[0, 9]), [0, 3]);
    }
}
