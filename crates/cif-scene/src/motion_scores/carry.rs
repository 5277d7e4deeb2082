//! Points that are carried by the splats near them.

use cif_geometry::Bounds;
use glam::{DQuat, DVec3};

use super::opacity_box;
use crate::{Node, SceneGraph};

/// Splats that carry a point.
const NEIGHBOURS: usize = 4;

/// Splats of a node in the world of the capture at a time, metres.
pub(super) struct Placed {
    means: Vec<DVec3>,
    turns: Vec<DQuat>,
    /// Standard deviations along the axes of the splats.
    scales: Vec<DVec3>,
    opacities: Vec<f32>,
}

impl Placed {
    /// Splats of a node at a time code.
    pub(super) fn of(graph: &SceneGraph, node: &Node, time_code: f64) -> Self {
        let placed = node.splats_at(time_code);
        let metres = graph.meters_per_unit;
        let world = |mean: &DVec3| metres * graph.frame.capture_from_dataset(*mean);
        let scale = |scale: &[f32; 3]| DVec3::from(scale.map(f64::from)) * (metres / graph.frame.scale);
        let opacities = node.appearance.opacities_at(time_code);
        Self {
            means: placed.means.iter().map(world).collect(),
            turns: placed
                .orientations
                .iter()
                .map(|[w, x, y, z]| DQuat::from_xyzw(*x, *y, *z, *w).normalize())
                .collect(),
            scales: placed.scales.iter().map(scale).collect(),
            opacities: opacities.unwrap_or_else(|| node.splats.opacities.clone()),
        }
    }

    /// Box of most of the opacity; see [`opacity_box::around`].
    pub(super) fn opacity_box(&self) -> Bounds {
        let reaches =
            self.turns.iter().zip(&self.scales).map(|(turn, scale)| opacity_box::reach(*turn, *scale));
        opacity_box::around(&self.means, &reaches.collect::<Vec<_>>(), &self.opacities)
    }
}

/// A point in the frame of a splat.
#[derive(Clone, Copy)]
struct Anchor {
    splat: usize,
    /// Axes of the splat.
    offset: DVec3,
}

/// Points tied to the splats that are nearest at a time.
pub(super) struct Anchored {
    /// Anchors of every point, nearest first.
    anchors: Vec<Vec<Anchor>>,
}

impl Anchored {
    /// Ties world points to splats at the same time.
    pub(super) fn new(placed: &Placed, points: &[DVec3]) -> Self {
        let anchors = |point: &DVec3| {
            let mut order: Vec<(f64, usize)> = placed
                .means
                .iter()
                .enumerate()
                .map(|(splat, mean)| (mean.distance_squared(*point), splat))
                .collect();
            let nearer = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
            if order.len() > NEIGHBOURS {
                order.select_nth_unstable_by(NEIGHBOURS - 1, nearer);
                order.truncate(NEIGHBOURS);
            }
            order.sort_unstable_by(nearer);
            let anchor = |(_, splat): (f64, usize)| Anchor {
                splat,
                offset: placed.turns[splat].inverse() * (*point - placed.means[splat]),
            };
            order.into_iter().map(anchor).collect()
        };
        Self { anchors: points.iter().map(anchors).collect() }
    }

    /// The points at another time: means over where their splats take them.
    pub(super) fn carried(&self, placed: &Placed) -> Vec<DVec3> {
        let carried =
            |anchor: &Anchor| placed.means[anchor.splat] + placed.turns[anchor.splat] * anchor.offset;
        let mean = |anchors: &Vec<Anchor>| anchors.iter().map(carried).sum::<DVec3>() / anchors.len() as f64;
        self.anchors.iter().map(mean).collect()
    }
}
