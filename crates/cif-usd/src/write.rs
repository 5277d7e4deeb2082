//! File kinds, atomic replacement, and what may be replaced.

use std::fs;
use std::path::{Path, PathBuf};

use cif_scene::SceneGraph;
use pyo3::prelude::*;

use crate::pxr::{self, Pxr, reason};
use crate::{ExportOptions, ExportSummary, UsdError, author, tokens};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Text,
    Binary,
    Package,
}

fn kind_of(path: &Path) -> Result<Kind, UsdError> {
    let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
    match extension.as_deref().and_then(|extension| extension.to_str()) {
        Some("usda") => Ok(Kind::Text),
        Some("usdc") => Ok(Kind::Binary),
        Some("usdz") => Ok(Kind::Package),
        _ => Err(UsdError::Extension { path: path.to_owned() }),
    }
}

/// Folder of an output; `.` for a bare name.
fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
        _ => PathBuf::from("."),
    }
}

/// The root layer of a file, kept apart from layers that are open under the same name.
fn is_ours(pxr: &Pxr<'_>, path: &Path) -> bool {
    let opened = pxr
        .sdf
        .getattr("Layer")
        .and_then(|layer| layer.call_method1("OpenAsAnonymous", (path.as_os_str(), true)));
    opened
        .and_then(|layer| layer.getattr("customLayerData")?.contains(tokens::CIF))
        // What USD cannot read was not written by us.
        .unwrap_or(false)
}

pub(crate) fn check_target(path: &Path, options: ExportOptions) -> Result<(), UsdError> {
    pxr::with(|pxr| checked_kind(pxr, path, options).map(|_| ()))
}

fn checked_kind(pxr: &Pxr<'_>, path: &Path, options: ExportOptions) -> Result<Kind, UsdError> {
    let kind = kind_of(path)?;
    let folder = folder_of(path);
    if !folder.is_dir() {
        return Err(UsdError::NoFolder { folder, path: path.to_owned() });
    }
    if path.is_dir() {
        return Err(UsdError::IsFolder { path: path.to_owned() });
    }
    if path.exists() && !options.force && !is_ours(pxr, path) {
        return Err(UsdError::Foreign { path: path.to_owned() });
    }
    Ok(kind)
}

pub(crate) fn export(
    graph: &SceneGraph,
    path: &Path,
    options: ExportOptions,
) -> Result<ExportSummary, UsdError> {
    pxr::with(|pxr| {
        let kind = checked_kind(pxr, path, options)?;
        let failed = |reason: String| UsdError::Write { path: path.to_owned(), reason };
        let system = |error: std::io::Error| failed(error.to_string());
        // A folder of our own on the same disk: renaming is atomic, and a failure leaves nothing behind.
        let scratch =
            tempfile::Builder::new().prefix(".cif-export-").tempdir_in(folder_of(path)).map_err(system)?;
        let written =
            write(pxr, graph, kind, scratch.path()).map_err(|error| failed(reason(pxr.py, &error)))?;
        let file = fs::File::open(&written).map_err(system)?;
        file.sync_all().map_err(system)?;
        let bytes = file.metadata().map_err(system)?.len();
        fs::rename(&written, path).map_err(system)?;
        Ok(ExportSummary {
            path: path.to_owned(),
            bytes,
            nodes: graph.nodes.len(),
            splats: graph.nodes.iter().map(|node| node.splats.len()).sum(),
            samples: graph.time_codes.samples.len(),
            usd_version: pxr.version.clone(),
        })
    })
}

/// Writes the stage into a folder; the path of the finished file.
fn write(pxr: &Pxr<'_>, graph: &SceneGraph, kind: Kind, folder: &Path) -> PyResult<PathBuf> {
    let layer = folder.join(if kind == Kind::Text { "scene.usda" } else { "scene.usdc" });
    let stage = pxr.usd.getattr("Stage")?.call_method1("CreateNew", (layer.as_os_str(),))?;
    author::author(pxr, &stage, graph)?;
    let saved = stage.call_method0("GetRootLayer")?.call_method0("Save")?;
    let failure = |what: &str| Err(pyo3::exceptions::PyOSError::new_err(what.to_owned()));
    if !saved.is_truthy()? {
        return failure("the layer could not be saved");
    }
    drop(stage);
    if kind != Kind::Package {
        return Ok(layer);
    }
    let package = folder.join("scene.usdz");
    let asset = pxr.sdf.call_method1("AssetPath", (layer.as_os_str(),))?;
    let zipped = pxr.usd_utils.call_method1("CreateNewUsdzPackage", (asset, package.as_os_str()))?;
    if zipped.is_truthy()? { Ok(package) } else { failure("the package could not be written") }
}
