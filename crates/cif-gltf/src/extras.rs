//! Data that glTF has no place for: the object `cif` in the `extras` of our nodes.
//!
//! The root node says how the file was made, a node per instance says what it is, parts and cameras say which
//! ones they are. Whatever glTF itself holds (transforms, keys, splats) is read from there, so that edits count.

use std::collections::BTreeMap;

use cif_field::SortMetric;
use cif_scene::{CaptureFrame, MotionModel, MotionReport, PartJoint, SceneOptions, UpAxis};
use serde::{Deserialize, Serialize};

/// Version of what stands here.
pub(crate) const LAYOUT: u32 = 1;

/// `extras` of a node.
#[derive(Serialize, Deserialize)]
pub(crate) struct Extras {
    pub(crate) cif: Cif,
}

/// Role of a node in the scene, with the data that glTF does not hold.
#[derive(Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub(crate) enum Cif {
    World(Box<World>),
    Instance(Box<Instance>),
    Background(Box<Object>),
    Part(Part),
    Camera(Camera),
}

/// The scene.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct World {
    pub(crate) generator: String,
    pub(crate) layout: u32,
    pub(crate) up_axis: UpAxis,
    pub(crate) meters_per_unit: f64,
    /// Where the scene lies in the world of its capture; the root node is there.
    #[serde(default, skip_serializing_if = "CaptureFrame::is_identity")]
    pub(crate) frame: CaptureFrame,
    pub(crate) frames_per_second: f64,
    /// Time code at 0 seconds.
    pub(crate) first_time_code: f64,
    pub(crate) time_codes: Vec<f64>,
    /// Normalised times of `time_codes`.
    pub(crate) times: Vec<f64>,
    pub(crate) background_color: [f32; 3],
    pub(crate) sort_metric: SortMetric,
    /// True when the splats are drawn antialiased.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) antialiased: Option<bool>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) omitted: Vec<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) warnings: Vec<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) field_fingerprint: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) options: Option<SceneOptions>,
}

impl Cif {
    /// True of an object each of whose splats has a path of its own.
    pub(crate) fn moves_by_splat(&self) -> bool {
        let object = match self {
            Self::Instance(instance) => &instance.object,
            Self::Background(object) => object.as_ref(),
            Self::World(_) | Self::Part(_) | Self::Camera(_) => return false,
        };
        object.motion.model == MotionModel::Dense
    }
}

/// An instance.
#[derive(Serialize, Deserialize)]
pub(crate) struct Instance {
    pub(crate) id: u16,
    pub(crate) index: usize,
    #[serde(flatten)]
    pub(crate) object: Object,
}

/// An instance or the background.
#[derive(Serialize, Deserialize)]
pub(crate) struct Object {
    /// Name in the scene graph, which is also the node's name when it is written.
    pub(crate) name: String,
    pub(crate) label: String,
    pub(crate) category: String,
    /// Names of its class in vocabularies of others, by taxonomy.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) taxonomies: BTreeMap<String, String>,
    /// Its appearance, for questions in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) embedding: Option<cif_field::Embedding>,
    /// World units; glTF itself holds single precision only.
    pub(crate) pivot: [f64; 3],
    /// Motion model, residuals, samples.
    pub(crate) motion: MotionReport,
    pub(crate) source_frames: (usize, usize),
    pub(crate) mean_occupancy: f32,
}

/// A rigid part of an instance.
#[derive(Serialize, Deserialize)]
pub(crate) struct Part {
    /// Name within the instance.
    pub(crate) name: String,
    /// Position among the parts.
    pub(crate) part: usize,
    pub(crate) pivot: [f64; 3],
    /// Joint to another part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) joint: Option<PartJoint>,
    /// Range of its values from the first pose on: radians, or world units.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) range: Option<[f64; 2]>,
}

/// A recorded camera.
#[derive(Serialize, Deserialize)]
pub(crate) struct Camera {
    /// Name in the scene graph.
    pub(crate) name: String,
    /// Name in the capture.
    pub(crate) label: String,
    /// When it was recorded.
    pub(crate) time_codes: Vec<f64>,
    /// One for all time codes, or one for each.
    pub(crate) views: Vec<View>,
}

/// Intrinsics of a view.
#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct View {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) focal_px: [f64; 2],
    pub(crate) principal_px: [f64; 2],
}
