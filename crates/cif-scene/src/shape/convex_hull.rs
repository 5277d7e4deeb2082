//! Convex hulls of points, with few corners.
//!
//! The hulls come from parry; here stand what it does not do: flat and thin sets are thickened, the number of
//! corners is bounded, and no set of points makes it stop.

use std::collections::BTreeSet;

use cif_geometry::stats::weighted_quantile;
use glam::DVec3;
use nalgebra::Matrix3;
use parry3d_f64::math::Vector;
use parry3d_f64::transformation::try_convex_hull;

use crate::graph::ConvexHull;

/// Most corners of a hull; what simulators and USD physics accept.
pub const MAX_CORNERS: usize = 64;
/// Thickness of a flat set of points, over its largest extent.
const MIN_THICKNESS: f64 = 0.01;
/// Points are moved by up to this share of the extent: exact hulls of points on common planes are ill-posed.
const JITTER: f64 = 1e-6;
/// Points that are nearer to each other, relative to the extent, count once: jitter would make needles of them.
const SAME: f64 = 1e-5;
/// Largest distance from a hull, relative to the extent, at which a point counts as held.
const MISSED: f64 = 1e-3;
/// Times that a hull which misses points is tried again, with ten times the jitter each.
const TRIES: i32 = 3;

/// A closed convex mesh in double precision.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HullMesh {
    /// Corners.
    pub points: Vec<DVec3>,
    /// Triangles, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// A half space that a hull lies in: `normal . x <= offset`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: DVec3,
    offset: f64,
}

impl HullMesh {
    /// Enclosed volume.
    #[must_use]
    pub fn volume(&self) -> f64 {
        let Some(origin) = self.points.first() else { return 0.0 };
        let corner = |index: u32| self.points[index as usize] - *origin;
        self.triangles.iter().map(|&[a, b, c]| corner(a).dot(corner(b).cross(corner(c))) / 6.0).sum()
    }

    /// Mean of the corners, which lies inside.
    #[must_use]
    pub fn middle(&self) -> DVec3 {
        self.points.iter().sum::<DVec3>() / self.points.len().max(1) as f64
    }

    /// Lower bound of the distance of a point from the hull; 0 or less inside.
    #[must_use]
    pub fn outside(&self, point: DVec3) -> f64 {
        furthest_outside(&self.planes(), point)
    }

    fn planes(&self) -> Vec<Plane> {
        self.triangles
            .iter()
            .filter_map(|&[a, b, c]| {
                let [a, b, c] = [a, b, c].map(|index| self.points[index as usize]);
                let normal = (b - a).cross(c - a).try_normalize()?;
                Some(Plane { normal, offset: normal.dot(a) })
            })
            .collect()
    }

    /// Grows the hull about its middle until points with at least `share` of the weight are inside.
    pub fn grow_to_hold(&mut self, points: &[DVec3], weights: &[f64], share: f64) {
        let middle = self.middle();
        let planes = self.planes();
        // Factor at which a point would lie on the surface.
        let factors: Vec<f64> = points
            .iter()
            .map(|point| {
                planes
                    .iter()
                    .map(|plane| {
                        let reach = plane.offset - plane.normal.dot(middle);
                        if reach > 0.0 { plane.normal.dot(*point - middle) / reach } else { 0.0 }
                    })
                    .fold(0.0, f64::max)
            })
            .collect();
        let needed = weighted_quantile(&factors, weights, share);
        if needed > 1.0 {
            let factor = needed * (1.0 + 1e-6);
            for point in &mut self.points {
                *point = middle + factor * (*point - middle);
            }
        }
    }
}

fn furthest_outside(planes: &[Plane], point: DVec3) -> f64 {
    planes.iter().map(|plane| plane.normal.dot(point) - plane.offset).fold(f64::NEG_INFINITY, f64::max)
}

/// The hull of points with at most [`MAX_CORNERS`] corners, a subset of the points up to a jitter of
/// 1e-6 of their extent; inside the exact hull, and as near to it as adding the furthest corner first gets.
///
/// Points on a plane, on a line, or all in one place within `1e-9`, are thickened to 1 % of their extent.
/// `None` without points, or when they have no extent at all, or are not finite.
#[must_use]
pub fn convex_hull(points: &[DVec3]) -> Option<HullMesh> {
    let (normalized, middle, size) = normalize(points)?;
    // Now and then parry loses a corner of points on common lines; others are in the way after another jitter.
    let all = (0..TRIES)
        .filter_map(|attempt| exact(&jittered(&normalized, JITTER * 10.0_f64.powi(attempt))))
        .find(|mesh| {
            let planes = mesh.planes();
            normalized.iter().all(|point| furthest_outside(&planes, *point) < MISSED)
        })?;
    let mut mesh = if all.points.len() > MAX_CORNERS { few_corners(&all.points)? } else { all };
    for point in &mut mesh.points {
        *point = middle + *point * size;
    }
    Some(mesh)
}

/// Points about the origin with a largest extent of 1, thick in all directions, each once.
fn normalize(points: &[DVec3]) -> Option<(Vec<DVec3>, DVec3, f64)> {
    let low = points.iter().copied().reduce(DVec3::min)?;
    let high = points.iter().copied().reduce(DVec3::max)?;
    let (middle, size) = ((low + high) / 2.0, (high - low).max_element());
    let relative = middle.abs().max_element() * 1e-9;
    if !(points.iter().all(|point| point.is_finite()) && size.is_finite() && size > relative.max(1e-12)) {
        return None;
    }
    let mut normalized: Vec<DVec3> = points.iter().map(|point| (*point - middle) / size).collect();
    let mut seen = BTreeSet::new();
    normalized.retain(|point| seen.insert((*point / SAME).round().as_i64vec3().to_array()));
    thicken(&mut normalized);
    Some((normalized, middle, size))
}

/// Points in general position.
fn jittered(points: &[DVec3], most: f64) -> Vec<DVec3> {
    // Kronecker sequence: spread out, and the same every time.
    let step = DVec3::new(0.819_172_513_396_164, 0.671_043_606_703_789, 0.549_700_477_901_970);
    let noise = |index: usize| most * ((step * (index + 1) as f64).fract() - 0.5);
    points.iter().enumerate().map(|(index, point)| *point + noise(index)).collect()
}

/// Doubles points along the axes in which the set is thinner than [`MIN_THICKNESS`].
fn thicken(points: &mut Vec<DVec3>) {
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let mut covariance = Matrix3::zeros();
    for point in points.iter() {
        let d = nalgebra::Vector3::from((*point - mean).to_array());
        covariance += d * d.transpose();
    }
    let axes = covariance.symmetric_eigen().eigenvectors;
    for axis in axes.column_iter() {
        let axis = DVec3::new(axis[0], axis[1], axis[2]);
        let along = points.iter().map(|point| axis.dot(*point));
        let (low, high) =
            along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if high - low < MIN_THICKNESS {
            let half = (MIN_THICKNESS - (high - low)) / 2.0;
            let shifted: Vec<DVec3> = points.iter().map(|point| *point + half * axis).collect();
            for point in points.iter_mut() {
                *point -= half * axis;
            }
            points.extend(shifted);
        }
    }
}

/// Hull of points; `None` where parry finds none.
fn exact(points: &[DVec3]) -> Option<HullMesh> {
    let input: Vec<Vector> = points.iter().map(|point| Vector::from_array(point.to_array())).collect();
    let (points, triangles) = try_convex_hull(&input).ok()?;
    let points = points.iter().map(|point| DVec3::from_array(point.to_array())).collect();
    Some(HullMesh { points, triangles })
}

/// Starts from the extremes along the axes and adds the corner furthest outside until there are enough.
fn few_corners(corners: &[DVec3]) -> Option<HullMesh> {
    let mut chosen: Vec<usize> = Vec::new();
    for axis in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE, DVec3::new(1.0, -1.0, 0.5)] {
        for direction in [axis, -axis] {
            let extreme = (0..corners.len()).max_by(|&a, &b| {
                corners[a].dot(direction).total_cmp(&corners[b].dot(direction)).then(b.cmp(&a))
            })?;
            if !chosen.contains(&extreme) {
                chosen.push(extreme);
            }
        }
    }
    loop {
        let points: Vec<DVec3> = chosen.iter().map(|&index| corners[index]).collect();
        let mesh = exact(&points)?;
        if chosen.len() >= MAX_CORNERS {
            return Some(mesh);
        }
        let planes = mesh.planes();
        let (furthest, distance) = (0..corners.len())
            .filter(|index| !chosen.contains(index))
            .map(|index| (index, furthest_outside(&planes, corners[index])))
            .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))?;
        if distance <= JITTER {
            return Some(mesh);
        }
        chosen.push(furthest);
    }
}

/// Volume inside closed meshes of outward triangles; 0 without any.
#[must_use]
pub fn hull_volume(hulls: &[ConvexHull]) -> f64 {
    let corner = |hull: &ConvexHull, index: u32| -> Option<DVec3> {
        hull.points.get(index as usize).map(|p| DVec3::from_array(p.map(f64::from)))
    };
    hulls
        .iter()
        .map(|hull| {
            let signed = hull.triangles.iter().filter_map(|[a, b, c]| {
                Some(corner(hull, *a)?.dot(corner(hull, *b)?.cross(corner(hull, *c)?)) / 6.0)
            });
            signed.sum::<f64>().abs()
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn cloud(count: usize) -> Vec<DVec3> {
        let steps = DVec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5);
        (1..=count).map(|k| (steps * k as f64).fract() - 0.5).collect()
    }

    /// Every edge is shared by two triangles, and normals point outwards.
    fn assert_closed(mesh: &HullMesh) {
        let mut edges: Vec<(u32, u32)> =
            mesh.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
        let count = edges.len();
        edges.sort_unstable();
        edges.dedup();
        assert_eq!(edges.len(), count, "an edge is used twice in one direction");
        assert!(edges.iter().all(|&(a, b)| edges.binary_search(&(b, a)).is_ok()), "a hole");
        assert!(mesh.volume() > 0.0, "inside out");
        assert!(mesh.points.len() <= MAX_CORNERS);
    }

    #[test]
    fn a_ball_keeps_most_of_its_volume_with_few_corners() {
        let ball: Vec<DVec3> = cloud(4000)
            .into_iter()
            .filter_map(|point| point.try_normalize())
            .map(|p| 3.0 * p + 7.0)
            .collect();
        let mesh = convex_hull(&ball).unwrap();
        assert_closed(&mesh);
        assert_eq!(mesh.points.len(), MAX_CORNERS);
        let share = mesh.volume() / (4.0 / 3.0 * std::f64::consts::PI * 27.0);
        assert!((0.85..1.0).contains(&share), "{share}");
    }

    #[test]
    fn a_box_is_its_eight_corners() {
        let mut points = cloud(500);
        points.extend(
            (0..8)
                .map(|k| DVec3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2)) * 2.0 - 1.0),
        );
        let mesh = convex_hull(&points).unwrap();
        assert_closed(&mesh);
        assert_eq!((mesh.points.len(), mesh.triangles.len()), (8, 12));
        assert!((mesh.volume() - 8.0).abs() < 1e-4);
        assert!(points.iter().all(|point| mesh.outside(*point) < 1e-5));
        assert!((mesh.outside(DVec3::new(2.0, 0.0, 0.0)) - 1.0).abs() < 1e-4);
    }

    #[test]
    fn flat_thin_and_tiny_sets_are_thickened() {
        let square = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::X + DVec3::Y];
        let mesh = convex_hull(&square).unwrap();
        assert_closed(&mesh);
        assert!((mesh.volume() - MIN_THICKNESS).abs() < 1e-4, "{}", mesh.volume());
        let line: Vec<DVec3> = (0..20).map(|k| DVec3::ONE * f64::from(k) * 1e-3 + 5.0).collect();
        assert_closed(&convex_hull(&line).unwrap());
        assert_closed(&convex_hull(&line[..2]).unwrap());
        let mut doubled = cloud(30);
        doubled.extend(cloud(30));
        assert_closed(&convex_hull(&doubled).unwrap());
    }

    #[test]
    fn many_points_in_few_places_of_a_line_do_not_lose_its_ends() {
        // Few distinct places, each taken many times, in no order.
        let places =
            [0, 0, 4, 1, 0, 1, 1, 0, 0, 0, 1, 0, 0, 1, 0, 2, 2, 0, 0, 0, 3, 2, 4, 1, 2, 4, 3, 3, 4, 1];
        let points: Vec<DVec3> =
            (0..200).map(|k| DVec3::new(3.0, f64::from(places[k * 7 % 30]), 3.0)).collect();
        let mesh = convex_hull(&points).unwrap();
        assert_closed(&mesh);
        assert!(points.iter().all(|point| mesh.outside(*point) < 1e-2));
    }

    #[test]
    fn nothing_and_points_without_extent_have_no_hull() {
        assert!(convex_hull(&[]).is_none());
        assert!(convex_hull(&[DVec3::ONE; 9]).is_none());
        assert!(convex_hull(&[DVec3::ONE, DVec3::NAN]).is_none());
        assert!(convex_hull(&[DVec3::ZERO, DVec3::X * f64::INFINITY]).is_none());
    }

    #[test]
    fn a_grown_hull_holds_the_share_asked_for() {
        let points = cloud(1000);
        let mut mesh = convex_hull(&points[..40]).unwrap();
        let inside = |mesh: &HullMesh| points.iter().filter(|point| mesh.outside(**point) <= 1e-9).count();
        assert!(inside(&mesh) < 900);
        mesh.grow_to_hold(&points, &[1.0; 1000], 0.99);
        assert!((990..1000).contains(&inside(&mesh)), "{}", inside(&mesh));
        assert_closed(&mesh);
        // What weighs nothing stays out.
        let mut mesh = convex_hull(&points[..40]).unwrap();
        let weights: Vec<f64> = points.iter().map(|point| f64::from(mesh.outside(*point) <= 1e-9)).collect();
        let before = mesh.clone();
        mesh.grow_to_hold(&points, &weights, 1.0);
        assert_eq!(mesh, before);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]
        /// Points on coarse grids: coplanar, collinear and doubled ones in plenty.
        #[test]
        fn any_grid_of_points_has_a_closed_hull_around_it(
            points in prop::collection::vec(prop::array::uniform3(0_i32..5), 2..200),
            flat in 0_usize..8,
        ) {
            let points: Vec<DVec3> = points
                .iter()
                .map(|p| DVec3::from_array(std::array::from_fn(|axis| {
                    if flat >> axis & 1 == 1 { 3.0 } else { f64::from(p[axis]) }
                })))
                .collect();
            match convex_hull(&points) {
                Some(mesh) => {
                    assert_closed(&mesh);
                    prop_assert!(points.iter().all(|point| mesh.outside(*point) < 0.2));
                }
                None => prop_assert!(points.iter().all(|point| *point == points[0])),
            }
        }
    }
}
