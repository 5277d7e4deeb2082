//! Boxes that hold the 3-sigma ellipsoids.

use cif_geometry::{Bounds, RigidTransform, quaternion};
use glam::{DMat3, DVec3};
use std::ops::Range;

use crate::graph::{Motion, Part, Splats};

/// Standard deviations that a box holds on each side; the splat formats cut the kernel there.
pub const SIGMAS: f64 = 3.0;

/// Tight box of all 3-sigma ellipsoids after `target_from_local`: per axis `p +- 3 sqrt(R^2 s^2)`, where
/// `R^2 s^2` is the diagonal of the covariance. `orientations` are unit (w, x, y, z).
#[must_use]
pub fn ellipsoid_bounds(
    target_from_local: &RigidTransform,
    means: &[[f32; 3]],
    orientations: &[[f32; 4]],
    scales: &[[f32; 3]],
) -> Bounds {
    let mut bounds = Bounds::EMPTY;
    for ((mean, orientation), scale) in means.iter().zip(orientations).zip(scales) {
        let rows = quaternion::to_rotation(orientation.map(f64::from));
        let rotation = target_from_local.rotation * DMat3::from_cols_array_2d(&rows).transpose();
        let scale = DVec3::from_array(scale.map(f64::from));
        let variance = DVec3::from_array(std::array::from_fn(|axis| {
            let weighted = rotation.row(axis) * scale;
            weighted.length_squared()
        }));
        let half = SIGMAS * variance.map(f64::sqrt);
        let centre = target_from_local.apply(DVec3::from_array(mean.map(f64::from)));
        bounds = bounds.including(centre - half).including(centre + half);
    }
    bounds
}

/// As [`ellipsoid_bounds`], of a range of splats.
#[must_use]
pub fn splat_bounds(target_from_local: &RigidTransform, splats: &Splats, range: Range<usize>) -> Bounds {
    let (means, orientations) = (&splats.means[range.clone()], &splats.orientations[range.clone()]);
    ellipsoid_bounds(target_from_local, means, orientations, &splats.scales[range])
}

/// As [`ellipsoid_bounds`], of the splats of a node; `node_from_part` gives where its parts are.
#[must_use]
pub fn node_bounds(
    target_from_local: &RigidTransform,
    splats: &Splats,
    motion: &Motion,
    node_from_part: impl Fn(&Part) -> RigidTransform,
) -> Bounds {
    let Motion::Parts(motion) = motion else {
        return splat_bounds(target_from_local, splats, 0..splats.len());
    };
    let of_part = |part: &Part| {
        splat_bounds(&target_from_local.compose(&node_from_part(part)), splats, part.splats.clone())
    };
    motion.parts.iter().map(of_part).fold(Bounds::EMPTY, Bounds::union)
}

/// The box in single precision, rounded outwards: `[low, high]`.
#[must_use]
pub fn outward(bounds: &Bounds) -> [[f32; 3]; 2] {
    let down = |value: f64| {
        let rounded = value as f32;
        if f64::from(rounded) > value { rounded.next_down() } else { rounded }
    };
    let up = |value: f64| {
        let rounded = value as f32;
        if f64::from(rounded) < value { rounded.next_up() } else { rounded }
    };
    [bounds.low.to_array().map(down), bounds.high.to_array().map(up)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turned_ellipsoid_is_held_exactly() {
        // Axis lengths 3, 2, 1 turned by 30 degrees around z.
        let half = (15.0_f64).to_radians();
        let orientation = [half.cos() as f32, 0.0, 0.0, half.sin() as f32];
        let bounds = ellipsoid_bounds(
            &RigidTransform::IDENTITY,
            &[[1.0, 2.0, 3.0]],
            &[orientation],
            &[[3.0, 2.0, 1.0]],
        );
        let (c, s) = (30.0_f64.to_radians().cos(), 30.0_f64.to_radians().sin());
        let expected =
            DVec3::new((9.0 * c * c + 4.0 * s * s).sqrt(), (9.0 * s * s + 4.0 * c * c).sqrt(), 1.0);
        assert!((bounds.high - (DVec3::new(1.0, 2.0, 3.0) + 3.0 * expected)).length() < 1e-5, "{bounds:?}");
        assert!((bounds.low - (DVec3::new(1.0, 2.0, 3.0) - 3.0 * expected)).length() < 1e-5, "{bounds:?}");
    }

    #[test]
    fn rounding_never_cuts() {
        let bounds = Bounds { low: DVec3::splat(0.1), high: DVec3::splat(0.3) };
        let [low, high] = outward(&bounds);
        assert!(f64::from(low[0]) <= 0.1 && f64::from(high[0]) >= 0.3);
        assert!((f64::from(low[0]) - 0.1).abs() < 1e-7);
    }
}
