//! Authoring of a stage from a scene graph.

mod camera_prims;
mod ground;
mod hulls;
mod instance;
mod joints;
mod levels;
mod physics;
mod proxies;
mod splats;
mod transforms;

use std::path::Path;

use cif_scene::{ExportOptions, SceneGraph};
use pyo3::prelude::*;

use crate::layer::{Layer, Variability};
use crate::pxr::Pxr;
use crate::{conventions, tokens};

/// Storage of the arrays of instances: payloads or root layer, and levels of detail.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Storage<'a> {
    /// Folder for one layer per instance, and how the root layer calls it; `None` keeps all in the root layer.
    pub(crate) payloads: Option<(&'a Path, &'a str)>,
    /// True when coarser levels of detail are written too.
    pub(crate) levels: bool,
}

/// Context that all parts of the writer share.
pub(crate) struct Scene<'a, 'py> {
    pub(crate) pxr: &'a Pxr<'py>,
    pub(crate) graph: &'a SceneGraph,
    pub(crate) storage: Storage<'a>,
    pub(crate) options: &'a ExportOptions,
}

/// Writes the stage whose root layer is the file `root`, which does not exist yet.
pub(crate) fn author(scene: &Scene<'_, '_>, root: &Path) -> PyResult<()> {
    let layer = Layer::create(scene.pxr, root)?;
    let graph = scene.graph;
    metadata(scene, &layer, tokens::ROLE_ROOT, tokens::WORLD)?;
    let world = layer.define(tokens::WORLD, "Xform")?;
    world.info("kind", tokens::KIND_ASSEMBLY)?;
    transforms::world(scene.pxr, &world, &graph.frame)?;
    for node in &graph.nodes {
        instance::author(scene, &layer, node)?;
    }
    if !graph.cameras.is_empty() {
        layer.define(tokens::CAMERAS, "Scope")?;
        for track in &graph.cameras {
            camera_prims::author(scene.pxr, &layer, track, graph.meters_per_unit)?;
        }
    }
    let ground = ground::height(graph, scene.options.ground);
    if ground.is_some() || graph.nodes.iter().any(|node| !node.colliders.is_empty()) {
        physics::gravity(scene, &layer)?;
    }
    if let Some(height) = ground {
        ground::author(scene, &layer, height)?;
    }
    layer.save()
}

/// Units, time and our mark; the same in the root layer and in payloads, so that nothing is rescaled between them.
fn metadata(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>, role: &str, default_prim: &str) -> PyResult<()> {
    let (pxr, graph, codes) = (scene.pxr, scene.graph, &scene.graph.time_codes);
    layer.info("defaultPrim", default_prim.trim_start_matches('/'))?;
    layer.info("upAxis", conventions::up_axis_token(graph.up_axis))?;
    layer.info("metersPerUnit", graph.meters_per_unit)?;
    layer.info("kilogramsPerUnit", 1.0)?;
    layer.info("timeCodesPerSecond", codes.frames_per_second)?;
    layer.info("framesPerSecond", codes.frames_per_second)?;
    layer.info("startTimeCode", codes.start())?;
    layer.info("endTimeCode", codes.end())?;
    let ours = pxr.dictionary();
    ours.set_item(tokens::GENERATOR, concat!("cif ", env!("CARGO_PKG_VERSION")))?;
    ours.set_item(tokens::LAYOUT, tokens::LAYOUT_VERSION)?;
    ours.set_item(tokens::ROLE, role)?;
    if role == tokens::ROLE_ROOT {
        let [red, green, blue] = graph.background_color;
        ours.set_item(tokens::BACKGROUND_COLOR, pxr.gf.call_method1("Vec3f", (red, green, blue))?)?;
        for (key, values) in [(tokens::SAMPLE_TIMES, &codes.times), (tokens::SAMPLE_CODES, &codes.samples)] {
            ours.set_item(key, pxr.vt.call_method1("DoubleArray", (values.clone(),))?)?;
        }
        for (key, values) in [(tokens::OMITTED, &graph.omitted), (tokens::WARNINGS, &graph.warnings)] {
            ours.set_item(key, pxr.vt.call_method1("StringArray", (values.clone(),))?)?;
        }
        ours.set_item(tokens::SORT, splats::sorting(graph.sort_metric))?;
        if let Some(antialiased) = graph.antialiased {
            ours.set_item(tokens::ANTIALIASED, antialiased)?;
        }
        if !graph.frame.is_identity() {
            ours.set_item(tokens::CAPTURE_OFFSET, pxr.vec3d(graph.frame.offset.into())?)?;
            ours.set_item(tokens::CAPTURE_SCALE, graph.frame.scale)?;
        }
        if let Some(fingerprint) = &graph.origin.field_fingerprint {
            ours.set_item(tokens::FIELD_FINGERPRINT, fingerprint)?;
        }
        if let Some(options) = &graph.origin.options {
            let text = serde_json::to_string(options)
                .map_err(|error| pyo3::exceptions::PyValueError::new_err(error.to_string()))?;
            ours.set_item(tokens::OPTIONS, text)?;
        }
    }
    layer.mark(ours)
}

/// `uniform` attributes read better by name.
const UNIFORM: Variability = Variability::Uniform;
/// As [`UNIFORM`].
const VARYING: Variability = Variability::Varying;
