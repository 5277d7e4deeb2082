//! Value clips: what `/World` shows window by window, where a long capture was trained so.
//!
//! A layer per window next to the payloads holds the arrays of its splats as time samples, from its first time code on, and
//! a manifest names all that change. Payloads keep those of the first window, which show where no time is asked for: what
//! a layer says itself is stronger than its clips, and payloads are weaker.

use std::path::Path;

use pyo3::IntoPyObjectExt;
use pyo3::prelude::*;
use pyo3::types::IntoPyDict;

use super::context::Scene;
use super::levels::LEVELS;
use super::{instance, metadata, proxies};
use crate::layer::{Layer, Prim, child};
use crate::tokens;

/// Name of the layer of a window. No node is called so: names of nodes hold no hyphen.
fn file_of(index: usize) -> String {
    format!("window-{:03}.usdc", index + 1)
}

/// Writes the layers, and gives `world` its clips.
pub(super) fn author(scene: &Scene<'_, '_>, world: &Prim<'_, '_, '_>) -> PyResult<()> {
    let (pxr, windows) = (scene.pxr, &scene.graph.windows);
    let Some((folder, called)) = scene.storage.payloads.filter(|_| !windows.is_empty()) else {
        return Ok(());
    };
    let mut handles = Vec::with_capacity(windows.len());
    for (index, window) in windows.iter().enumerate() {
        let layer = Layer::create_clip(pxr, &folder.join(file_of(index)), window.start)?;
        metadata::author(scene, &layer, tokens::ROLE_PAYLOAD, tokens::WORLD)?;
        for node in &window.nodes {
            let place = child(tokens::WORLD, &node.name);
            instance::splats_of(scene, &layer, &place, node, &LEVELS[0])?;
            proxies::author(scene, &layer, &place, node)?;
        }
        layer.save()?;
        handles.push(layer.handle().clone());
    }
    manifest(scene, &folder.join(tokens::MANIFEST), handles)?;
    let asset = |file: &str| pxr.sdf.call_method1("AssetPath", (format!("./{called}/{file}"),));
    let assets = (0..windows.len()).map(|index| asset(&file_of(index))).collect::<PyResult<Vec<_>>>()?;
    let begins = windows.iter().enumerate().map(|(index, window)| (window.start, index as f64));
    let begins = begins.map(|pair| pxr.gf.call_method1("Vec2d", pair)).collect::<PyResult<Vec<_>>>()?;
    let clips = [
        ("active", pxr.vt.call_method1("Vec2dArray", (begins,))?),
        ("assetPaths", pxr.sdf.call_method1("AssetPathArray", (assets,))?),
        ("manifestAssetPath", asset(tokens::MANIFEST)?),
        ("primPath", tokens::WORLD.into_bound_py_any(pxr.py)?),
    ];
    world.info("clips", [("default", clips.into_py_dict(pxr.py)?)].into_py_dict(pxr.py)?)
}

/// Names the attributes that any of the layers holds.
fn manifest<'py>(scene: &Scene<'_, 'py>, file: &Path, layers: Vec<Bound<'py, PyAny>>) -> PyResult<()> {
    let pxr = scene.pxr;
    let found = pxr
        .usd
        .getattr("ClipsAPI")?
        .call_method1("GenerateClipManifestFromLayers", (layers, tokens::WORLD))?;
    let layer = Layer::create(pxr, file)?;
    layer.handle().call_method1("TransferContent", (found,))?;
    metadata::author(scene, &layer, tokens::ROLE_PAYLOAD, tokens::WORLD)?;
    layer.save()
}
