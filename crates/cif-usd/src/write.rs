//! File kinds, atomic replacement, and what may be replaced.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use cif_output::Scratch;
use cif_scene::SceneGraph;
use cif_scene::files::{FileError, existing_folder, folder_of, target_of};
use pyo3::prelude::*;

use crate::author::{self, Scene, Storage};
use crate::pxr::{self, Pxr, reason};
use crate::{ExportOptions, ExportSummary, Payloads, UsdError, tokens};

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

/// Folder of the payloads of a stage: `out.payloads` next to `out.usda`, `out.usdc.payloads` next to `out.usdc`, so
/// that stages with one name and several endings do not share it.
fn payloads_of(path: &Path) -> PathBuf {
    if kind_of(path).is_ok_and(|kind| kind == Kind::Text) {
        return path.with_extension(tokens::PAYLOADS);
    }
    let mut name = path.file_name().map(OsString::from).unwrap_or_default();
    name.push(".");
    name.push(tokens::PAYLOADS);
    path.with_file_name(name)
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

/// True when a folder holds nothing but layers of ours.
fn is_folder_of_ours(pxr: &Pxr<'_>, folder: &Path) -> bool {
    by_writer(pxr, folder).is_ok_and(|[_, others]| others.is_empty())
}

pub(crate) fn check_target(path: &Path, options: ExportOptions) -> Result<(), UsdError> {
    pxr::with(|pxr| checked(pxr, path, options).map(|_| ()))
}

/// File to write, its kind, and the place of its arrays.
struct Target {
    /// The file, where links lead.
    path: PathBuf,
    kind: Kind,
    /// True when arrays go to payloads.
    split: bool,
}

fn checked(pxr: &Pxr<'_>, path: &Path, options: ExportOptions) -> Result<Target, UsdError> {
    let kind = kind_of(path)?;
    let split = match (options.payloads, kind) {
        (Payloads::Separate, Kind::Package) => {
            return Err(UsdError::PayloadsInPackage { path: path.to_owned() });
        }
        (Payloads::Separate, _) | (Payloads::ByKind, Kind::Text) => true,
        (Payloads::SingleFile, _) | (Payloads::ByKind, _) => false,
    };
    if !(options.density.is_finite() && options.density > 0.0) {
        let reason = format!("a density of {} kg/m^3 is given; give one above 0", options.density);
        return Err(UsdError::Write { path: path.to_owned(), reason });
    }
    existing_folder(path)?;
    if path.is_dir() {
        return Err(UsdError::IsFolder { path: path.to_owned() });
    }
    if path.exists() && !options.force && !is_ours(pxr, path) {
        return Err(FileError::Foreign { path: path.to_owned() }.into());
    }
    let target = target_of(path, split)?;
    let payloads = payloads_of(&target);
    if payloads.is_symlink() {
        return Err(UsdError::Write {
            path: path.to_owned(),
            reason: format!("{} is a link, which would be replaced; choose another name", payloads.display()),
        });
    }
    if split && payloads.exists() && !payloads.is_dir() {
        return Err(UsdError::Write {
            path: path.to_owned(),
            reason: format!("{} is a file, where a folder is to be; choose another name", payloads.display()),
        });
    }
    if split && payloads.exists() && !options.force && !is_folder_of_ours(pxr, &payloads) {
        return Err(FileError::Foreign { path: payloads }.into());
    }
    Ok(Target { path: target, kind, split })
}

pub(crate) fn export(
    graph: &SceneGraph,
    path: &Path,
    options: ExportOptions,
) -> Result<ExportSummary, UsdError> {
    pxr::with(|pxr| {
        let mut options = options;
        if !graph.windows.is_empty() {
            options = with_windows(path, options)?;
        }
        let target = checked(pxr, path, options)?;
        let failed = |reason: String| UsdError::Write { path: path.to_owned(), reason };
        let system = |error: std::io::Error| failed(error.to_string());
        // A folder of our own on the same disk: renaming is atomic, and a failure leaves nothing behind.
        let scratch = Scratch::inside(&folder_of(&target.path)).map_err(system)?;
        let folder = scratch.folder().map_err(system)?;
        let written =
            write(pxr, graph, &target, options, &folder).map_err(|error| failed(reason(pxr.py, &error)))?;
        let bytes = written.sync().map_err(system)?;
        let place = payloads_of(&target.path);
        let (unneeded, kept) = match &written.payloads {
            Some(payloads) => (Vec::new(), keep_foreign(pxr, &place, payloads).map_err(system)?),
            None => unneeded(pxr, &place).map_err(system)?.into(),
        };
        let mut moves: Vec<(PathBuf, PathBuf)> = Vec::new();
        moves.extend(written.payloads.map(|payloads| (payloads, place.clone())));
        moves.push((written.root, target.path));
        scratch.replace(&moves, &unneeded).map_err(system)?;
        Ok(ExportSummary {
            path: path.to_owned(),
            files: vec![path.to_owned()],
            bytes,
            nodes: graph.nodes.len(),
            splats: graph.nodes.iter().map(|node| node.splats.len()).sum(),
            samples: graph.time_codes.samples.len(),
            library: Some(format!("usd-core {}", pxr.version)),
            kept,
            ..ExportSummary::default()
        })
    })
}

/// Options for a stage whose splats change from window to window: these are files of their own, and have one level of
/// detail.
fn with_windows(path: &Path, options: ExportOptions) -> Result<ExportOptions, UsdError> {
    if options.payloads == Payloads::SingleFile || kind_of(path)? == Kind::Package {
        return Err(UsdError::WindowsInOneFile { path: path.to_owned() });
    }
    Ok(ExportOptions { payloads: Payloads::Separate, levels_of_detail: false, ..options })
}

/// Takes what is not ours of an old folder of payloads over into the new one, before that takes its place; where it was.
///
/// # Errors
/// When the file system refuses, or a new file has the name of such a file.
fn keep_foreign(pxr: &Pxr<'_>, old: &Path, new: &Path) -> std::io::Result<Vec<PathBuf>> {
    let [_, kept] = by_writer(pxr, old)?;
    for from in &kept {
        let to = new.join(from.file_name().unwrap_or_default());
        if to.exists() {
            return Err(std::io::Error::other(format!(
                "{} was not written by cif and has the name of a file of the scene; move it, or choose another name",
                from.display()
            )));
        }
        take_over(from, &to)?;
    }
    Ok(kept)
}

/// Files that go with an old folder of payloads that the new stage does without, and what stays: the folder, or where
/// it holds files of others, ours among them.
fn unneeded(pxr: &Pxr<'_>, old: &Path) -> std::io::Result<[Vec<PathBuf>; 2]> {
    Ok(match by_writer(pxr, old)? {
        [ours, others] if !ours.is_empty() && others.is_empty() => [vec![old.to_owned()], others],
        [ours, others] if !ours.is_empty() => [ours, others],
        // Nothing of ours was ever there.
        _ => Default::default(),
    })
}

/// Files of a folder of payloads that cif wrote, and everything else in it; none where there is no such folder.
fn by_writer(pxr: &Pxr<'_>, folder: &Path) -> std::io::Result<[Vec<PathBuf>; 2]> {
    let [mut ours, mut others] = [Vec::new(), Vec::new()];
    if !folder.is_dir() {
        return Ok([ours, others]);
    }
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let is_layer = path.extension().is_some_and(|extension| extension == "usdc");
        let side =
            if is_layer && !path.is_symlink() && is_ours(pxr, &path) { &mut ours } else { &mut others };
        side.push(path);
    }
    ours.sort();
    others.sort();
    Ok([ours, others])
}

/// A second name of a file, or of all files of a folder; copies where the file system has no links.
fn take_over(from: &Path, to: &Path) -> std::io::Result<()> {
    if from.is_dir() && !from.is_symlink() {
        fs::create_dir(to)?;
        return fs::read_dir(from)?.try_for_each(|entry| {
            let entry = entry?;
            take_over(&entry.path(), &to.join(entry.file_name()))
        });
    }
    fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(drop))
}

/// A finished stage in the scratch folder.
struct Written {
    root: PathBuf,
    payloads: Option<PathBuf>,
}

impl Written {
    /// Puts everything on the disk; the bytes.
    fn sync(&self) -> std::io::Result<u64> {
        let sync = |path: &Path| -> std::io::Result<u64> {
            let file = fs::File::open(path)?;
            file.sync_all()?;
            Ok(file.metadata()?.len())
        };
        let mut bytes = sync(&self.root)?;
        if let Some(folder) = &self.payloads {
            for entry in fs::read_dir(folder)? {
                bytes += sync(&entry?.path())?;
            }
        }
        Ok(bytes)
    }
}

/// Writes the stage into a folder.
fn write(
    pxr: &Pxr<'_>,
    graph: &SceneGraph,
    target: &Target,
    options: ExportOptions,
    folder: &Path,
) -> PyResult<Written> {
    let root = folder.join(if target.kind == Kind::Text { "scene.usda" } else { "scene.usdc" });
    let payloads = target.split.then(|| folder.join("payloads"));
    let name = payloads_of(&target.path).file_name().map(OsString::from).unwrap_or_default();
    let Some(name) = name.to_str().filter(|name| !name.contains('@')) else {
        return Err(pyo3::exceptions::PyOSError::new_err(
            "USD cannot refer to files whose name is not Unicode or has an @ in it; choose another name",
        ));
    };
    if let Some(payloads) = &payloads {
        fs::create_dir(payloads)?;
    }
    let storage = Storage {
        payloads: payloads.as_deref().map(|folder| (folder, name)),
        levels: options.levels_of_detail,
    };
    author::author(&Scene { pxr, graph, storage, options: &options }, &root)?;
    if target.kind != Kind::Package {
        return Ok(Written { root, payloads });
    }
    let package = folder.join("scene.usdz");
    let asset = pxr.sdf.call_method1("AssetPath", (root.as_os_str(),))?;
    let zipped = pxr.usd_utils.call_method1("CreateNewUsdzPackage", (asset, package.as_os_str()))?;
    if zipped.is_truthy()? {
        Ok(Written { root: package, payloads: None })
    } else {
        Err(pyo3::exceptions::PyOSError::new_err("the package could not be written"))
    }
}
