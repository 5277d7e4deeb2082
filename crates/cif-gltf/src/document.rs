//! The few objects of glTF 2.0 that are written, as serde structures.
//!
//! The types of `gltf-json` cannot hold attribute names with a colon, as `KHR_gaussian_splatting` has them.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

use crate::extras::Extras;
use crate::rotation_keys::SamplerExtras;

/// `componentType` float.
pub(crate) const FLOAT: u32 = 5126;
/// `componentType` unsigned byte.
pub(crate) const UNSIGNED_BYTE: u32 = 5121;
/// `componentType` unsigned short.
pub(crate) const UNSIGNED_SHORT: u32 = 5123;
/// `target` of buffer views that hold vertex attributes.
pub(crate) const ARRAY_BUFFER: u32 = 34_962;
/// `mode` of primitives that are points.
pub(crate) const POINTS: u32 = 0;

#[derive(Default, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Document {
    pub(crate) asset: Asset,
    pub(crate) extensions_used: Vec<&'static str>,
    pub(crate) scene: usize,
    pub(crate) scenes: Vec<Scene>,
    pub(crate) nodes: Vec<Node>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) meshes: Vec<Mesh>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) cameras: Vec<Camera>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) animations: Vec<Animation>,
    pub(crate) accessors: Vec<Accessor>,
    pub(crate) buffer_views: Vec<BufferView>,
    pub(crate) buffers: Vec<Buffer>,
}

#[derive(Default, Serialize)]
pub(crate) struct Asset {
    pub(crate) version: &'static str,
    pub(crate) generator: String,
}

#[derive(Serialize)]
pub(crate) struct Scene {
    pub(crate) nodes: Vec<usize>,
}

#[derive(Default, Serialize)]
pub(crate) struct Node {
    pub(crate) name: String,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) children: Vec<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) mesh: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) camera: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) translation: Option<Translation>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) rotation: Option<[f32; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) scale: Option<[f32; 3]>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) extensions: BTreeMap<&'static str, Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) extras: Option<Extras>,
}

/// Numbers as short as their precision.
#[derive(Clone, Copy, Serialize)]
#[serde(untagged)]
pub(crate) enum Translation {
    Single([f32; 3]),
    /// Of the root of a scene far from the origin.
    Double([f64; 3]),
}

impl Translation {
    pub(crate) fn is_finite(&self) -> bool {
        match self {
            Self::Single(values) => values.iter().all(|value| value.is_finite()),
            Self::Double(values) => values.iter().all(|value| value.is_finite()),
        }
    }
}

#[derive(Serialize)]
pub(crate) struct Mesh {
    pub(crate) name: String,
    pub(crate) primitives: Vec<Primitive>,
}

#[derive(Serialize)]
pub(crate) struct Primitive {
    pub(crate) mode: u32,
    pub(crate) attributes: BTreeMap<String, usize>,
    pub(crate) extensions: BTreeMap<&'static str, Value>,
}

#[derive(Serialize)]
pub(crate) struct Camera {
    pub(crate) name: String,
    pub(crate) r#type: &'static str,
    pub(crate) perspective: Perspective,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Perspective {
    pub(crate) yfov: f64,
    pub(crate) aspect_ratio: f64,
    pub(crate) znear: f64,
}

#[derive(Serialize)]
pub(crate) struct Animation {
    pub(crate) name: &'static str,
    pub(crate) channels: Vec<Channel>,
    pub(crate) samplers: Vec<Sampler>,
}

#[derive(Serialize)]
pub(crate) struct Channel {
    pub(crate) sampler: usize,
    pub(crate) target: Target,
}

#[derive(Serialize)]
pub(crate) struct Target {
    /// `None` for a target that an extension points to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) node: Option<usize>,
    pub(crate) path: &'static str,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) extensions: BTreeMap<&'static str, Value>,
}

#[derive(Serialize)]
pub(crate) struct Sampler {
    pub(crate) input: usize,
    pub(crate) output: usize,
    pub(crate) interpolation: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) extras: Option<SamplerExtras>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Accessor {
    pub(crate) buffer_view: usize,
    pub(crate) component_type: u32,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(crate) normalized: bool,
    pub(crate) count: usize,
    pub(crate) r#type: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) min: Option<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) max: Option<Vec<f64>>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct BufferView {
    pub(crate) buffer: usize,
    pub(crate) byte_offset: u64,
    pub(crate) byte_length: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) target: Option<u32>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Buffer {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uri: Option<String>,
    pub(crate) byte_length: u64,
}
