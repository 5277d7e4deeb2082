//! Boxes of splats: those that hold the 3-sigma ellipsoids, by which formats cull, and those of what can be seen.

use cif_geometry::{Bounds, RigidTransform, quaternion};
use glam::{DMat3, DVec3};
use std::ops::Range;

use crate::graph::{Motion, Part, Splats};
use crate::motion::placement::PlacedSplats;
use crate::motion::procrustes::weighted_quantile;

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
        let half = SIGMAS * deviation(&rotation, DVec3::from_array(scale.map(f64::from)));
        let centre = target_from_local.apply(DVec3::from_array(mean.map(f64::from)));
        bounds = bounds.including(centre - half).including(centre + half);
    }
    bounds
}

/// Standard deviations along the axes of a splat that is turned.
fn deviation(rotation: &DMat3, scale: DVec3) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|axis| (rotation.row(axis) * scale).length()))
}

/// As [`ellipsoid_bounds`], of a range of splats.
#[must_use]
pub fn splat_bounds(target_from_local: &RigidTransform, splats: &Splats, range: Range<usize>) -> Bounds {
    let (means, orientations) = (&splats.means[range.clone()], &splats.orientations[range.clone()]);
    ellipsoid_bounds(target_from_local, means, orientations, &splats.scales[range])
}

/// As [`ellipsoid_bounds`], of the splats of a node; `node_from_part` tells where its parts are.
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

/// Share of what splats show that lies outside the box of what can be seen, on each side of each axis: an object has some
/// faint or stray splats around it, which would double its size.
const UNSEEN: f64 = 0.01;

/// A splat as its picture is spread along the axes.
struct Shown {
    centre: DVec3,
    /// Standard deviation along each axis.
    deviation: DVec3,
    /// Opacity times area, that of the side from which it is largest.
    weight: f64,
}

/// Box of what can be seen of splats: all but the outermost hundredth of what they show, on each side of each axis.
pub(crate) fn seen_bounds(splats: &PlacedSplats, opacities: &[f32]) -> Bounds {
    let shown: Vec<Shown> = (0..opacities.len()).map(|k| Shown::of(splats, k, opacities[k])).collect();
    if shown.iter().map(|shown| shown.weight).sum::<f64>() <= 0.0 {
        return Bounds::EMPTY;
    }
    let [mut low, mut high] = [DVec3::ZERO; 2];
    for axis in 0..3 {
        // The nodes and weights of Gauss and Hermite, which have the mean and the variance of a splat.
        let nodes = |shown: &Shown| {
            let apart = 3.0_f64.sqrt() * shown.deviation[axis];
            [(-apart, 1.0 / 6.0), (0.0, 2.0 / 3.0), (apart, 1.0 / 6.0)]
                .map(|(offset, share)| (shown.centre[axis] + offset, share * shown.weight))
        };
        let (values, weights): (Vec<f64>, Vec<f64>) = shown.iter().flat_map(nodes).unzip();
        low[axis] = weighted_quantile(&values, &weights, UNSEEN);
        high[axis] = weighted_quantile(&values, &weights, 1.0 - UNSEEN).max(low[axis]);
    }
    Bounds { low, high }
}

impl Shown {
    fn of(splats: &PlacedSplats, k: usize, opacity: f32) -> Self {
        let mut scales = splats.scales[k].map(f64::from);
        let rotation =
            DMat3::from_cols_array_2d(&quaternion::to_rotation(splats.orientations[k])).transpose();
        let deviation = deviation(&rotation, DVec3::from_array(scales));
        scales.sort_by(f64::total_cmp);
        Self { centre: splats.means[k], deviation, weight: f64::from(opacity) * scales[1] * scales[2] }
    }
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
    fn strays_and_haze_do_not_enlarge_what_is_seen() {
        // A cube of 0.2 of small opaque splats, and around it faint large ones and a few that lie far off.
        let mut splats = PlacedSplats::default();
        let mut opacities = Vec::new();
        let mut add = |centre: DVec3, scale: f32, opacity: f32| {
            splats.means.push(centre);
            splats.orientations.push([1.0, 0.0, 0.0, 0.0]);
            splats.scales.push([scale; 3]);
            opacities.push(opacity);
        };
        for k in 0..1000 {
            let at = |k: usize| 0.2 * (k as f64 + 0.5) / 10.0 - 0.1;
            add(DVec3::new(at(k % 10), at(k / 10 % 10), at(k / 100)), 0.004, 0.9);
        }
        for k in 0..6 {
            let way = DVec3::from_array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]][k % 3]);
            add(if k < 3 { way } else { -way }, 0.004, 0.9);
            add(0.1 * way, 0.03, 0.01);
        }
        let seen = seen_bounds(&splats, &opacities);
        assert!((seen.size() - 0.2).abs().max_element() < 0.03, "{:?}", seen.size());
        let means: Vec<[f32; 3]> = splats.means.iter().map(|mean| mean.as_vec3().to_array()).collect();
        let turns = vec![[1.0, 0.0, 0.0, 0.0]; means.len()];
        let all = ellipsoid_bounds(&RigidTransform::IDENTITY, &means, &turns, &splats.scales);
        assert!(all.size().min_element() > 1.9);
        assert!(seen_bounds(&splats, &vec![0.0; opacities.len()]).is_empty(), "nothing is seen");
        // One splat is seen as far as its picture reaches.
        let one = PlacedSplats {
            means: vec![DVec3::X],
            orientations: vec![[1.0, 0.0, 0.0, 0.0]],
            scales: vec![[0.1, 0.2, 0.3]],
        };
        let seen = seen_bounds(&one, &[1.0]);
        assert!(
            (seen.size() / (2.0 * 3.0_f64.sqrt()) - DVec3::new(0.1, 0.2, 0.3)).length() < 1e-6,
            "{seen:?}"
        );
    }

    #[test]
    fn rounding_never_cuts() {
        let bounds = Bounds { low: DVec3::splat(0.1), high: DVec3::splat(0.3) };
        let [low, high] = outward(&bounds);
        assert!(f64::from(low[0]) <= 0.1 && f64::from(high[0]) >= 0.3);
        assert!((f64::from(low[0]) - 0.1).abs() < 1e-7);
    }
}
