//! Existence and identity at any place and time.
//!
//! At time t, Gaussian i has the centre x_i, the covariance Sigma_i, the occupancy pi_i (constant in time)
//! and the identity distribution p_i. Its density weight at a point x is the unit-peak footprint
//!
//! `P_i(x) = exp(-(x - x_i)^T Sigma_i^-1 (x - x_i) / 2)`, and 0 below 1/255 (beyond 3.33 standard deviations),
//!
//! the cut-off of the renderer. Then, with products and sums over all Gaussians,
//!
//! - existence: `e(x, t) = 1 - prod_i (1 - pi_i P_i(x))`, the probability that at least one of independently
//!   existing Gaussians is there;
//! - identity: `p^k(x, t) = sum_i pi_i P_i(x) p_i^k / sum_i pi_i P_i(x)`, given that something is there;
//! - field: `gamma(x, t, k) = e(x, t) p^k(x, t)`.
//!
//! Unlike a rendered pixel, a place has no order and no occlusion. Sums run in f64 in ascending order of i.
//! Gaussians without a rotation (quaternion norm below 1e-6) are nowhere, as in the renderer. Source: methods
//! reference 0 and 4.1.

use std::collections::BTreeMap;

use cif_geometry::quaternion;
use cif_geometry::scalar::sigmoid;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use rstar::primitives::{GeomWithData, Rectangle};
use rstar::{AABB, RTree};

use crate::gaussians::LOG_SCALE_RANGE;
use crate::{Field, Gaussians, Identities};

/// Smallest density weight that counts: one step of an 8-bit image.
pub const MIN_DENSITY: f64 = 1.0 / 255.0;

/// Existence and instances at one place and time.
#[derive(Clone, Debug, PartialEq)]
pub struct QueryResult {
    /// Probability that something is there, in [0, 1].
    pub existence: f64,
    /// Distribution over instances (index into [`Field::instances`], probability), ascending by index, given
    /// that something is there; its probabilities sum to 1. Empty where nothing is, and without identities.
    pub identity: Vec<(u16, f64)>,
    /// Number of Gaussians whose footprint covers the place.
    pub gaussians: u32,
}

impl QueryResult {
    /// Most probable instance, the lowest index of equals; `None` where there is no identity.
    #[must_use]
    pub fn instance(&self) -> Option<u16> {
        let mut best: Option<(u16, f64)> = None;
        for &(label, probability) in &self.identity {
            if best.is_none_or(|(_, highest)| probability > highest) {
                best = Some((label, probability));
            }
        }
        best.map(|(label, _)| label)
    }

    /// gamma(x, t, k): probability that something is there and is instance `instance`.
    #[must_use]
    pub fn gamma(&self, instance: u16) -> f64 {
        let found = self.identity.binary_search_by_key(&instance, |(label, _)| *label);
        found.map_or(0.0, |at| self.existence * self.identity[at].1)
    }
}

/// A field at one time, indexed for any number of queries.
pub struct FieldAtTime {
    footprints: Vec<Footprint>,
    /// Boxes of the footprints, with their place in `footprints`.
    boxes: RTree<GeomWithData<Rectangle<[f64; 3]>, u32>>,
    /// Identity rows and the probabilities of their entries.
    identities: Option<(Identities, Vec<f32>)>,
    deformed: Gaussians,
}

/// A Gaussian as queries see it.
struct Footprint {
    row: u32,
    mean: DVec3,
    /// `diag(1 / scale) R^T`: maps offsets to standard deviations, so that no covariance is inverted.
    whitening: DMat3,
    occupancy: f64,
}

impl Footprint {
    /// P(x), 0 below [`MIN_DENSITY`].
    fn density(&self, point: DVec3) -> f64 {
        let density = (-0.5 * (self.whitening * (point - self.mean)).length_squared()).exp();
        if density >= MIN_DENSITY { density } else { 0.0 }
    }
}

impl FieldAtTime {
    /// Deforms and indexes a field at a normalised time in [0, 1].
    #[must_use]
    pub fn new(field: &Field, time: f64) -> Self {
        let deformed = field.deformed(time);
        // -2 ln(1/255) in squared standard deviations; a little more, so that rounding loses nobody.
        let radius = (-2.0 * MIN_DENSITY.ln()).sqrt() * (1.0 + 1e-9);
        let with_boxes: Vec<(Footprint, DVec3)> =
            (0..deformed.len()).into_par_iter().filter_map(|row| footprint(&deformed, row, radius)).collect();
        let boxes = with_boxes
            .iter()
            .enumerate()
            .map(|(index, (footprint, half))| {
                let (low, high) = (footprint.mean - *half, footprint.mean + *half);
                GeomWithData::new(Rectangle::from_corners(low.to_array(), high.to_array()), index as u32)
            })
            .collect();
        Self {
            footprints: with_boxes.into_iter().map(|(footprint, _)| footprint).collect(),
            boxes: RTree::bulk_load(boxes),
            identities: field.identities.as_ref().map(|rows| (rows.clone(), rows.probabilities())),
            deformed,
        }
    }

    /// The Gaussians at this time.
    #[must_use]
    pub fn gaussians(&self) -> &Gaussians {
        &self.deformed
    }

    /// Existence and instances at each point (world, metres). A point that is not finite is nowhere.
    #[must_use]
    pub fn query(&self, points: &[DVec3]) -> Vec<QueryResult> {
        points.par_iter().map(|point| self.query_one(*point)).collect()
    }

    /// Rows of the Gaussians whose footprint covers a point, ascending, with their density weights.
    #[must_use]
    pub fn covering(&self, point: DVec3) -> Vec<(u32, f64)> {
        self.covering_footprints(point).map(|(footprint, density)| (footprint.row, density)).collect()
    }

    fn covering_footprints(&self, point: DVec3) -> impl Iterator<Item = (&Footprint, f64)> {
        let mut candidates: Vec<u32> = if point.is_finite() {
            let at = AABB::from_point(point.to_array());
            self.boxes.locate_in_envelope_intersecting(at).map(|found| found.data).collect()
        } else {
            Vec::new()
        };
        candidates.sort_unstable();
        candidates.into_iter().filter_map(move |index| {
            let footprint = &self.footprints[index as usize];
            let density = footprint.density(point);
            (density > 0.0).then_some((footprint, density))
        })
    }

    fn query_one(&self, point: DVec3) -> QueryResult {
        let mut nothing = 1.0;
        let mut gaussians = 0;
        let mut total = 0.0;
        let mut shares: BTreeMap<u16, f64> = BTreeMap::new();
        for (footprint, density) in self.covering_footprints(point) {
            gaussians += 1;
            let weight = footprint.occupancy * density;
            nothing *= 1.0 - weight;
            total += weight;
            if let Some((rows, probabilities)) = &self.identities {
                for entry in rows.range(footprint.row as usize) {
                    *shares.entry(rows.labels[entry]).or_default() +=
                        weight * f64::from(probabilities[entry]);
                }
            }
        }
        let identity = if total > 0.0 {
            // Divided by the sum of the shares, which is `total` but for the rounding of the rows.
            let sum: f64 = shares.values().sum();
            shares.into_iter().map(|(label, share)| (label, share / sum)).collect()
        } else {
            Vec::new()
        };
        QueryResult { existence: 1.0 - nothing, identity, gaussians }
    }
}

/// The footprint of a row and half the size of the box around its `radius` standard deviations.
fn footprint(gaussians: &Gaussians, row: usize, radius: f64) -> Option<(Footprint, DVec3)> {
    let unit = quaternion::try_normalize(gaussians.quaternions[row].map(f64::from))?;
    let rotation = quaternion::to_rotation(unit);
    let (lowest, highest) = (f64::from(LOG_SCALE_RANGE.0), f64::from(LOG_SCALE_RANGE.1));
    let scale = gaussians.log_scales[row].map(|s| f64::from(s).clamp(lowest, highest).exp());
    let mean = DVec3::from_array(gaussians.means[row].map(f64::from));
    let occupancy = sigmoid(f64::from(gaussians.occupancy_logits[row]));
    if !(mean.is_finite() && scale.iter().all(|value| value.is_finite()) && occupancy.is_finite()) {
        return None;
    }
    // Column c of the whitening matrix is row c of R, divided by the scales.
    let column = |c: usize| DVec3::from_array(std::array::from_fn(|k| rotation[c][k] / scale[k]));
    let half = DVec3::from_array(std::array::from_fn(|axis| {
        radius * (0..3).map(|k| (rotation[axis][k] * scale[k]).powi(2)).sum::<f64>().sqrt()
    }));
    let whitening = DMat3::from_cols(column(0), column(1), column(2));
    Some((Footprint { row: row as u32, mean, whitening, occupancy }, half))
}

impl Field {
    /// Existence and instances at each point (world, metres) at a normalised time in [0, 1]; see [`crate::query`] for
    /// the definition. For several calls at one time, keep a [`FieldAtTime`].
    #[must_use]
    pub fn query(&self, points: &[DVec3], time: f64) -> Vec<QueryResult> {
        FieldAtTime::new(self, time).query(points)
    }
}

#[cfg(test)]
mod tests;
