//! Boxes of most of the opacity of splats.

use cif_geometry::Bounds;
use glam::{DMat3, DQuat, DVec3};

/// Share of the opacity that is left out on each side.
const TRIM: f64 = 0.02;

/// Opacity of a splat at least, so that the sum is above 0.
const LEAST_OPACITY: f64 = 1e-6;

/// Half sides of the box around an ellipsoid of one standard deviation, world axes.
pub(super) fn reach(turn: DQuat, scale: DVec3) -> DVec3 {
    let axes = DMat3::from_quat(turn) * DMat3::from_diagonal(scale);
    // Along a world axis: the norm of the row of the matrix.
    DVec3::new(axes.row(0).length(), axes.row(1).length(), axes.row(2).length())
}

/// Box around splats that reach so far along each axis, without the outermost 2 % of the opacity on each side. At
/// least one splat.
pub(super) fn around(means: &[DVec3], reaches: &[DVec3], opacities: &[f32]) -> Bounds {
    let weights: Vec<f64> = opacities.iter().map(|opacity| f64::from(*opacity).max(LEAST_OPACITY)).collect();
    let side =
        |value: &dyn Fn(usize) -> f64| trimmed_minimum((0..means.len()).map(value).collect(), &weights);
    let low = |axis: usize| side(&|splat| means[splat][axis] - reaches[splat][axis]);
    let high = |axis: usize| -side(&|splat| -(means[splat][axis] + reaches[splat][axis]));
    Bounds { low: DVec3::new(low(0), low(1), low(2)), high: DVec3::new(high(0), high(1), high(2)) }
}

/// Smallest value below or at which 2 % of the weight lie.
fn trimmed_minimum(values: Vec<f64>, weights: &[f64]) -> f64 {
    let mut order: Vec<(f64, f64)> = values.into_iter().zip(weights.iter().copied()).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = weights.iter().sum();
    let mut sum = 0.0;
    for (value, weight) in &order {
        sum += weight;
        if sum / total >= TRIM {
            return *value;
        }
    }
    order.last().map_or(f64::NAN, |(value, _)| *value)
}

/// Intersection over union of two boxes, 0 to 1.
pub(super) fn overlap(a: &Bounds, b: &Bounds) -> f64 {
    let volume = |size: DVec3| size.x * size.y * size.z;
    let inner = volume((a.high.min(b.high) - a.low.max(b.low)).max(DVec3::ZERO));
    let union = volume(a.high - a.low) + volume(b.high - b.low) - inner;
    inner / union.max(1e-12)
}
