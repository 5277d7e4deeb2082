//! Boxes of nodes over time.

use cif_geometry::{Bounds, RigidTransform};

use crate::graph::{Motion, Node, NodeKind, Part, pose_at};
use crate::placement;
use crate::shape::body::Cloud;
use crate::shape::extent;

impl Node {
    /// Boxes of what can be seen of the node at any time.
    #[must_use]
    pub fn boxes(&self) -> NodeBoxes<'_> {
        let importance = self.splats.importance();
        let of = |range| Cloud::of(&self.splats, &importance, range).body_box();
        let at_rest = match (&self.kind, &self.motion) {
            (NodeKind::Background, _) | (_, Motion::Dense(_)) => Vec::new(),
            (_, Motion::Parts(motion)) => motion.parts.iter().map(|part| of(part.splats.clone())).collect(),
            _ => vec![of(0..self.splats.len())],
        };
        NodeBoxes { node: self, importance, at_rest }
    }
}

/// Boxes of a node over time. Those of instances hold their body (see [`crate::shape::body`]), without the strays that
/// training leaves about; a background has no body, and its boxes hold the 3-sigma ellipsoids.
#[derive(Clone, Debug)]
pub struct NodeBoxes<'a> {
    node: &'a Node,
    importance: Vec<f64>,
    /// Of the parts, each in its frame, or of the whole; empty where boxes are made anew for each time.
    at_rest: Vec<Bounds>,
}

impl NodeBoxes<'_> {
    /// In the local frame of the node at a time code.
    #[must_use]
    pub fn local(&self, time_code: f64) -> Bounds {
        let node = self.node;
        match &node.motion {
            Motion::Dense(dense) => {
                let placed = placement::local_splats_at(dense, &node.splats.scales, time_code);
                let means: Vec<[f32; 3]> =
                    placed.means.iter().map(|mean| mean.as_vec3().to_array()).collect();
                let orientations: Vec<[f32; 4]> =
                    placed.orientations.iter().map(|q| q.map(|component| component as f32)).collect();
                if node.kind == NodeKind::Background {
                    let local = RigidTransform::IDENTITY;
                    return extent::ellipsoid_bounds(&local, &means, &orientations, &placed.scales);
                }
                let cloud = Cloud {
                    means: &means,
                    orientations: &orientations,
                    scales: &placed.scales,
                    opacities: &node.splats.opacities,
                    importance: &self.importance,
                };
                cloud.body_box()
            }
            _ if node.kind == NodeKind::Background => node.extent,
            Motion::Parts(motion) => {
                let of_part = |(part, bounds): (&Part, &Bounds)| {
                    bounds.transformed(&pose_at(&part.track, part.pivot, time_code).transform())
                };
                motion.parts.iter().zip(&self.at_rest).map(of_part).fold(Bounds::EMPTY, Bounds::union)
            }
            Motion::Static | Motion::Rigid(_) => self.at_rest.first().copied().unwrap_or(Bounds::EMPTY),
        }
    }

    /// In the world at a time code.
    #[must_use]
    pub fn world(&self, time_code: f64) -> Bounds {
        self.local(time_code).transformed(&self.node.world_transform(time_code))
    }
}
