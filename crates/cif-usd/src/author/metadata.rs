//! Metadata of layers.

use pyo3::prelude::*;

use super::context::Scene;
use super::splats;
use crate::layer::Layer;
use crate::{conventions, tokens};

/// Units, time and our mark; the same in the root layer and in payloads, so that nothing is rescaled between them.
pub(super) fn author(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    role: &str,
    default_prim: &str,
) -> PyResult<()> {
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
        if !graph.windows.is_empty() {
            ours.set_item(tokens::WINDOWS, graph.windows.len())?;
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
