//! One prim per instance: labels, our schema, variants, and where its arrays are kept.

use cif_geometry::Bounds;
use cif_scene::{Motion, Node, NodeKind, extent};
use pyo3::prelude::*;

use super::context::{Scene, UNIFORM, VARYING};
use super::levels::{LEVELS, Level};
use super::{hulls, levels, metadata, physics, proxies, splats, transforms};
use crate::layer::{Layer, Prim, child};
use crate::tokens::{self, instance, variants};

pub(super) fn author(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>, node: &Node) -> PyResult<()> {
    let pxr = scene.pxr;
    let prim = layer.define(&format!("{}/{}", tokens::WORLD, node.name), "Xform")?;
    prim.info("kind", tokens::KIND_COMPONENT)?;
    prim.info("displayName", &node.label)?;
    let taxonomy = |name: &str| format!("{}:{name}", tokens::LABELS_API);
    let mut schemas = vec![taxonomy(tokens::TAXONOMY_CLASS), taxonomy(tokens::TAXONOMY_INSTANCE)];
    schemas.extend(node.taxonomies.keys().map(|name| taxonomy(name)));
    schemas.extend([tokens::GEOM_MODEL_API, tokens::INSTANCE_API].map(str::to_owned));
    prim.apply(&schemas.iter().map(String::as_str).collect::<Vec<_>>())?;
    // Both words find the object: the class ("mug") and what a person calls it ("red mug").
    let mut class = vec![node.category.as_str()];
    if node.label != node.category {
        class.push(&node.label);
    }
    let ours = [(tokens::TAXONOMY_CLASS, class), (tokens::TAXONOMY_INSTANCE, vec![node.name.as_str()])];
    let others = node.taxonomies.iter().map(|(taxonomy, label)| (taxonomy.as_str(), vec![label.as_str()]));
    for (taxonomy, labels) in ours.into_iter().chain(others) {
        let labels = pxr.vt.call_method1("TokenArray", (labels,))?;
        prim.set(&format!("{}:{taxonomy}", tokens::LABELS), "TokenArray", VARYING, labels)?;
    }
    prim.set_custom(tokens::USER_LABEL, "String", &node.label)?;
    if let Some(embedding) = &node.embedding {
        prim.set_custom(tokens::EMBEDDING, "FloatArray", pxr.float_array(&embedding.direction)?)?;
        prim.set_custom(tokens::EMBEDDING_MODEL, "String", &embedding.model)?;
    }
    properties(scene, &prim, node)?;
    visibility(&prim, node)?;
    extents_hint(scene, &prim, node)?;
    transforms::order(pxr, &prim)?;
    for (index, part) in node.motion.parts().map_or(&[][..], |motion| &motion.parts).iter().enumerate() {
        let inside = layer.define(&child(prim.path(), &part.name), "Xform")?;
        transforms::order(pxr, &inside)?;
        // Composition orders children as it likes.
        inside.set_custom(tokens::PART_INDEX, "Int", i32::try_from(index).unwrap_or(i32::MAX))?;
        inside.set_custom(tokens::PART_PIVOT, "Double3", pxr.vec3d(part.pivot)?)?;
    }
    physics::author(scene, layer, &prim, node)?;
    contents(scene, &prim, layer, node)
}

/// Authors the properties that no standard schema holds.
fn properties(scene: &Scene<'_, '_>, prim: &Prim<'_, '_, '_>, node: &Node) -> PyResult<()> {
    let (pxr, report) = (scene.pxr, &node.report);
    let int = |value: usize| i32::try_from(value).unwrap_or(i32::MAX);
    let kind = match node.kind {
        NodeKind::Instance { id, index } => {
            prim.set(instance::ID, "Int", UNIFORM, i32::from(id))?;
            prim.set(instance::INDEX, "Int", UNIFORM, int(index))?;
            instance::KIND_INSTANCE
        }
        NodeKind::Background => instance::KIND_BACKGROUND,
    };
    prim.set(instance::KIND, "Token", UNIFORM, kind)?;
    prim.set(instance::LABEL, "String", UNIFORM, &node.label)?;
    prim.set(instance::CATEGORY, "String", UNIFORM, &node.category)?;
    prim.set(instance::PIVOT, "Double3", UNIFORM, pxr.vec3d(node.pivot)?)?;
    let (first, last) = node.source_frames;
    let frames = pxr.gf.call_method1("Vec2i", (int(first), int(last)))?;
    prim.set(instance::SOURCE_FRAMES, "Int2", UNIFORM, frames)?;
    prim.set(instance::MEAN_OCCUPANCY, "Float", UNIFORM, node.mean_occupancy)?;
    prim.set(instance::MODEL, "Token", UNIFORM, report.model.to_string())?;
    if let Some(rotation) = report.rotation {
        prim.set(instance::ROTATION, "Token", UNIFORM, rotation.to_string())?;
    }
    for (name, value) in [
        (instance::TOLERANCE, report.tolerance),
        (instance::SIZE, report.size),
        (instance::RESIDUAL_RMS, report.residual.rms),
        (instance::RESIDUAL_DECISIVE, report.residual.decisive),
        (instance::RESIDUAL_MAX, report.residual.max),
        (instance::OUTLIER_SHARE, report.residual.outlier_share),
    ] {
        prim.set(name, "Double", UNIFORM, value)?;
    }
    prim.set(instance::SAMPLES, "Int", UNIFORM, int(report.samples))?;
    let report = serde_json::to_string(report)
        .map_err(|error| pyo3::exceptions::PyValueError::new_err(error.to_string()))?;
    prim.set(instance::REPORT, "String", UNIFORM, report)?;
    Ok(())
}

fn visibility(prim: &Prim<'_, '_, '_>, node: &Node) -> PyResult<()> {
    let token = |visible: bool| if visible { tokens::INHERITED } else { tokens::INVISIBLE };
    let Some(first) = node.visibility.first() else { return Ok(()) };
    let attribute = prim.set("visibility", "Token", VARYING, token(first.visible))?;
    for sample in &node.visibility {
        attribute.sample(sample.time_code, token(sample.visible))?;
    }
    Ok(())
}

/// Box of what can be seen of an instance, without strays, whose own prims hold all their splats. A viewer frames it, and
/// boxes are asked for without loading payloads.
fn extents_hint(scene: &Scene<'_, '_>, prim: &Prim<'_, '_, '_>, node: &Node) -> PyResult<()> {
    if node.kind == NodeKind::Background {
        return Ok(());
    }
    let of_windows = scene.graph.windows.iter().flat_map(|window| {
        let node = window.nodes.iter().find(|of_window| of_window.name == node.name);
        node.map_or_else(Vec::new, |node| boxes_in_time(node, Some(window.start)))
    });
    let mut boxes: Vec<(f64, Bounds)> = of_windows.collect();
    if boxes.is_empty() {
        boxes = boxes_in_time(node, None);
    }
    let corners = |bounds: &Bounds| scene.pxr.vec3f_array(&extent::outward(bounds));
    let at_rest = match boxes.first() {
        Some((_, bounds)) => corners(bounds)?,
        None => corners(&node.boxes().local(0.0))?,
    };
    let hint = prim.set(tokens::EXTENTS_HINT, "Float3Array", VARYING, at_rest)?;
    boxes.iter().try_for_each(|(code, bounds)| hint.sample(*code, corners(bounds)?))
}

/// Boxes of a node at the times at which its splats change, and from `start` on.
fn boxes_in_time(node: &Node, start: Option<f64>) -> Vec<(f64, Bounds)> {
    let boxes = node.boxes();
    let mut codes: Vec<f64> = match &node.motion {
        Motion::Static | Motion::Rigid(_) => Vec::new(),
        Motion::Parts(motion) => {
            motion.parts.iter().flat_map(|part| &part.track).map(|sample| sample.time_code).collect()
        }
        Motion::Dense(dense) => dense.samples.iter().map(|sample| sample.time_code).collect(),
    };
    codes.extend(start);
    codes.sort_unstable_by(f64::total_cmp);
    codes.dedup();
    codes.into_iter().map(|code| (code, boxes.local(code))).collect()
}

/// Splats, proxies and colliders: in the root layer or in a payload; splats once per level of detail.
fn contents(
    scene: &Scene<'_, '_>,
    prim: &Prim<'_, '_, '_>,
    layer: &Layer<'_, '_>,
    node: &Node,
) -> PyResult<()> {
    let levels = if scene.storage.levels { &LEVELS[..] } else { &LEVELS[..1] };
    if scene.storage.levels {
        prim.select(variants::LOD, variants::FULL)?;
    }
    let Some((folder, called)) = scene.storage.payloads else {
        shared(scene, layer, prim.path(), node)?;
        for level in levels {
            let place = if scene.storage.levels {
                prim.variant(variants::LOD, level.name)?.path().to_owned()
            } else {
                prim.path().to_owned()
            };
            splats_of(scene, layer, &place, node, level)?;
        }
        return Ok(());
    };
    let file = format!("{}.usdc", node.name);
    let asset = format!("./{called}/{file}");
    let payload = Layer::create(scene.pxr, &folder.join(&file))?;
    metadata::author(scene, &payload, tokens::ROLE_PAYLOAD, LEVELS[0].prim)?;
    payload.define(tokens::COMMON, "Xform")?;
    shared(scene, &payload, tokens::COMMON, node)?;
    prim.payload(&asset, tokens::COMMON)?;
    for level in levels {
        payload.define(level.prim, "Xform")?;
        splats_of(scene, &payload, level.prim, node, level)?;
        if scene.storage.levels {
            prim.variant(variants::LOD, level.name)?.payload(&asset, level.prim)?;
        } else {
            prim.payload(&asset, level.prim)?;
        }
    }
    payload.save()
}

/// Authors the prims that all levels of detail share: proxies and colliders.
fn shared(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>, place: &str, node: &Node) -> PyResult<()> {
    proxies::author(scene, layer, place, node)?;
    hulls::author(scene, layer, place, node)
}

pub(super) fn splats_of(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    place: &str,
    node: &Node,
    level: &Level,
) -> PyResult<()> {
    let kept = levels::kept(node, level);
    let some = |part| levels::selection(node, part, level, kept.as_deref());
    match node.motion.parts() {
        None => splats::author(scene, layer, place, &node.name, &some(None)),
        Some(motion) => motion.parts.iter().enumerate().try_for_each(|(index, part)| {
            let name = format!("{}_{}", node.name, part.name);
            splats::author(scene, layer, &child(place, &part.name), &name, &some(Some(index)))
        }),
    }
}
