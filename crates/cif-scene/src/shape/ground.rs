//! Height of the surface that the objects of a scene stand on.

use cif_geometry::RigidTransform;
use glam::DVec3;

use crate::{Motion, Node, NodeKind, SceneGraph, UpAxis};
use cif_geometry::stats::weighted_quantile;

/// Thickness of the layer of the background that is taken for a surface, over the size of what stands on it.
const LAYER: f64 = 0.05;
/// Steps by which layers are tried, per layer.
const STEPS: f64 = 4.0;

/// Height, along the up axis of the graph, of the surface that its instances stand on at its first time: where the
/// background is densest around and below their colliders, else the lowest corner of these; `None` without any.
#[must_use]
pub fn ground_height(graph: &SceneGraph) -> Option<f64> {
    let up = match graph.up_axis {
        UpAxis::Y => DVec3::Y,
        UpAxis::Z => DVec3::Z,
    };
    let start = graph.time_codes.start();
    let instances = graph.nodes.iter().filter(|node| matches!(node.kind, NodeKind::Instance { .. }));
    let corners: Vec<DVec3> = instances.flat_map(|node| corners(node, start)).collect();
    let (low, high) =
        (corners.iter().copied().reduce(DVec3::min)?, corners.iter().copied().reduce(DVec3::max)?);
    let size = (high - low).max_element();
    let (across, reach_low, reach_high) = (DVec3::ONE - up, low - size, high + size);
    let mut heights: Vec<(f64, f64)> = Vec::new();
    for node in graph.nodes.iter().filter(|node| node.kind == NodeKind::Background) {
        let placed = node.splats_at(start);
        let near = placed.means.iter().zip(node.splats.importance());
        let near = near.filter(|(mean, weight)| {
            let around = ((*mean - reach_low) * across).cmpge(DVec3::ZERO).all()
                && ((reach_high - *mean) * across).cmpge(DVec3::ZERO).all();
            around && mean.dot(up) < high.dot(up) && *weight > 0.0
        });
        heights.extend(near.map(|(mean, weight)| (mean.dot(up), weight)));
    }
    if heights.is_empty() || size <= 0.0 {
        return Some(low.dot(up));
    }
    heights.sort_by(|a, b| a.0.total_cmp(&b.0));
    Some(densest(&heights, LAYER * size))
}

/// Middle of the layer of this thickness that holds most of the weight; heights ascend.
fn densest(heights: &[(f64, f64)], layer: f64) -> f64 {
    let place = |height: f64| heights.partition_point(|(other, _)| *other < height);
    let held = |low: f64| &heights[place(low)..place(low + layer)];
    let weight = |low: f64| held(low).iter().map(|(_, weight)| weight).sum::<f64>();
    // Sums start anew at every height with a splat, so that far outliers cost no steps.
    let step = layer / STEPS;
    let mut starts: Vec<f64> = heights.iter().map(|(height, _)| (height / step).floor() * step).collect();
    starts.dedup();
    let best = starts
        .into_iter()
        .map(|low| (low, weight(low)))
        .fold((heights[0].0, f64::NEG_INFINITY), |best, other| if other.1 > best.1 { other } else { best });
    let (values, weights): (Vec<f64>, Vec<f64>) = held(best.0).iter().copied().unzip();
    if values.is_empty() { best.0 } else { weighted_quantile(&values, &weights, 0.5) }
}

/// Corners of the colliders of a node at a time code, world.
fn corners(node: &Node, time_code: f64) -> impl Iterator<Item = DVec3> {
    let world_from_node = node.world_transform(time_code);
    node.colliders.iter().flat_map(move |hull| {
        let place: RigidTransform = match (&node.motion, hull.part) {
            (Motion::Parts(motion), Some(part)) => {
                motion.parts.get(part).map(|part| part.node_transform(time_code))
            }
            _ => None,
        }
        .map_or(world_from_node, |node_from_part| world_from_node.compose(&node_from_part));
        hull.points.iter().map(move |point| place.apply(DVec3::from_array(point.map(f64::from))))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{graph_of, node_of};

    /// A cube of 0.2 whose middle is at the origin, and a floor of the background at -0.15 along an axis, with strays.
    fn scene(up_axis: UpAxis, floor: bool) -> SceneGraph {
        let turned = |place: DVec3| match up_axis {
            UpAxis::Z => place,
            UpAxis::Y => DVec3::new(place.x, place.z, -place.y),
        };
        let spread = |k: usize| (DVec3::new(0.819, 0.671, 0.550) * k as f64).fract() - 0.5;
        let cube: Vec<DVec3> = (0..300).map(|k| turned(0.2 * spread(k))).collect();
        let mut node = node_of(&cube, [1e-4; 3]);
        node.colliders = crate::shape::colliders::colliders(&node, 1);
        let flat = |k: usize| turned(spread(k) * DVec3::new(2.0, 2.0, 0.004) - DVec3::Z * 0.15);
        let stray = |k: usize| turned(spread(k) * DVec3::new(2.0, 2.0, 40.0));
        let places: Vec<DVec3> = (0..800).map(flat).chain((0..200).map(stray)).collect();
        let mut background = node_of(&places, [0.02; 3]);
        background.kind = NodeKind::Background;
        let nodes = if floor { vec![node, background] } else { vec![node] };
        SceneGraph { up_axis, ..graph_of(nodes) }
    }

    #[test]
    fn objects_stand_where_the_background_is_densest() {
        for up_axis in [UpAxis::Z, UpAxis::Y] {
            let height = ground_height(&scene(up_axis, true)).unwrap();
            assert!((height + 0.15).abs() < 0.003, "{height}");
            let height = ground_height(&scene(up_axis, false)).unwrap();
            assert!((height + 0.1).abs() < 0.01, "{height}");
        }
        let mut bare = scene(UpAxis::Z, true);
        bare.nodes[0].colliders.clear();
        assert_eq!(ground_height(&bare), None);
    }
}
