//! Objects of a scene.

use std::collections::BTreeMap;

use cif_field::Embedding;
use cif_geometry::{Bounds, RigidTransform};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::appearance::{Appearance, VisibilitySample, is_visible_at};
use super::motion::{Motion, MotionModel};
use super::pose::{PoseSample, pose_at};
use super::report::MotionReport;
use super::shape::{ConvexHull, PointProxy};
use super::splats::Splats;

/// Kind of a node: an instance, or everything else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NodeKind {
    /// An instance of the field's table; `id` is its mask value and `index` its dense index.
    Instance {
        /// Mask value, 1 to 65 535.
        id: u16,
        /// Position in the instance table.
        index: usize,
    },
    /// Everything that belongs to no instance.
    Background,
}

/// One object of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    /// Instance or background.
    pub kind: NodeKind,
    /// Unique name, `[A-Za-z0-9_]`, e.g. `red_mug_001`.
    pub name: String,
    /// Human name, e.g. `red mug`.
    pub label: String,
    /// Class, e.g. `mug`.
    pub category: String,
    /// Names of its class in vocabularies of others, by taxonomy.
    pub taxonomies: BTreeMap<String, String>,
    /// Its appearance, for questions in words.
    pub embedding: Option<Embedding>,
    /// Origin of the local frame at the reference time, world.
    pub pivot: DVec3,
    /// Motion of the node.
    pub motion: Motion,
    /// Splats in the local frame.
    pub splats: Splats,
    /// Changes of opacities and colours of the splats over time.
    pub appearance: Appearance,
    /// Light stand-in for the splats; `None` when proxies were not asked for.
    pub proxy: Option<PointProxy>,
    /// Convex hulls of the opaque splats, for simulators; empty when not asked for, which for the background
    /// is the default.
    pub colliders: Vec<ConvexHull>,
    /// Changes of visibility, ascending time codes; empty where the node is always visible.
    pub visibility: Vec<VisibilitySample>,
    /// Box of the 3-sigma ellipsoids of `splats`, local frame.
    pub extent: Bounds,
    /// Captured frames over which the node exists, first and last.
    pub source_frames: (usize, usize),
    /// Opacity-weighted mean occupancy of its Gaussians.
    pub mean_occupancy: f32,
    /// Which motion model was chosen, and what it misses.
    pub report: MotionReport,
}

impl Node {
    /// Path of the local frame: samples by ascending time code, or none where it stays at the pivot. Not every
    /// sampled time code needs one; see [`pose_at`].
    #[must_use]
    pub fn track(&self) -> &[PoseSample] {
        match &self.motion {
            Motion::Static => &[],
            Motion::Rigid(track) => track,
            Motion::Parts(parts) => &parts.track,
            Motion::Dense(dense) => &dense.track,
        }
    }

    /// Chosen motion model.
    #[must_use]
    pub fn model(&self) -> MotionModel {
        self.motion.model()
    }

    /// `world_from_local` at a time code: linear in translation, spherical in rotation between samples, held
    /// outside them.
    #[must_use]
    pub fn world_transform(&self, time_code: f64) -> RigidTransform {
        pose_at(self.track(), self.pivot, time_code).transform()
    }

    /// True when the node can be seen at a time code.
    #[must_use]
    pub fn is_visible(&self, time_code: f64) -> bool {
        is_visible_at(&self.visibility, time_code)
    }
}
