//! Opening a stage, after a look at every layer that it is made of.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use cif_scene::files::FileError;
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::UsdError;
use crate::pxr::{Pxr, reason};

/// Refuses what is no regular file: usd-core would wait for the end of a pipe.
pub(crate) fn check_file(path: &Path) -> Result<(), UsdError> {
    cif_input::check(path).map(drop).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => UsdError::NotFound { path: path.to_owned() },
        _ => FileError::Read { path: path.to_owned(), source }.into(),
    })
}

/// A stage.
pub(crate) fn open<'py>(pxr: &Pxr<'py>, path: &Path) -> Result<Bound<'py, PyAny>, UsdError> {
    check_file(path)?;
    pxr.usd
        .getattr("Stage")
        .and_then(|class| class.call_method1("Open", (path.as_os_str(),)))
        .map_err(|error| UsdError::Unreadable { path: path.to_owned(), reason: reason(pxr.py, &error) })
}

/// A stage whose time codes per second are set from outside.
pub(super) fn open_at_rate<'py>(
    pxr: &Pxr<'py>,
    path: &Path,
    rate: f64,
) -> Result<Bound<'py, PyAny>, UsdError> {
    let open = || -> PyResult<Bound<'py, PyAny>> {
        let layers = pxr.sdf.getattr("Layer")?;
        let session = layers.call_method1("CreateAnonymous", (".usda",))?;
        session.setattr("timeCodesPerSecond", rate)?;
        let root = layers.call_method1("FindOrOpen", (path.as_os_str(),))?;
        pxr.usd.getattr("Stage")?.call_method1("Open", (root, session))
    };
    open().map_err(|error| UsdError::Unreadable { path: path.to_owned(), reason: reason(pxr.py, &error) })
}

/// A stage whose layers all exist and, unless others are allowed, lie in its folder; and the size of their files.
pub(crate) fn open_with_layers<'py>(
    pxr: &Pxr<'py>,
    path: &Path,
    follow_external: bool,
) -> Result<(Bound<'py, PyAny>, u64), UsdError> {
    check_file(path)?;
    let unreadable = |reason: String| UsdError::Unreadable { path: path.to_owned(), reason };
    let file = path.canonicalize().map_err(|error| unreadable(error.to_string()))?;
    let mut walk = Walk {
        pxr,
        path,
        folder: file.parent().map(Path::to_owned).unwrap_or_default(),
        follow_external,
        seen: BTreeSet::new(),
        bytes: 0,
    };
    let root = walk.layer(&path.to_string_lossy())?;
    walk.visit(&root)?;
    let bytes = walk.bytes;
    Ok((open(pxr, path)?, bytes))
}

struct Walk<'a, 'py> {
    pxr: &'a Pxr<'py>,
    path: &'a Path,
    folder: PathBuf,
    follow_external: bool,
    seen: BTreeSet<String>,
    bytes: u64,
}

impl<'py> Walk<'_, 'py> {
    fn unreadable(&self, error: &PyErr) -> UsdError {
        UsdError::Unreadable { path: self.path.to_owned(), reason: reason(self.pxr.py, error) }
    }

    fn layer(&self, name: &str) -> Result<Bound<'py, PyAny>, UsdError> {
        let layer = self
            .pxr
            .sdf
            .getattr("Layer")
            .and_then(|class| class.call_method1("FindOrOpen", (name,)))
            .map_err(|error| self.unreadable(&error))?;
        if layer.is_none() {
            let reason = format!("{name} is no layer");
            return Err(UsdError::Unreadable { path: self.path.to_owned(), reason });
        }
        Ok(layer)
    }

    /// Checks what a layer needs, and so on.
    fn visit(&mut self, root: &Bound<'py, PyAny>) -> Result<(), UsdError> {
        let mut open = vec![root.clone()];
        while let Some(layer) = open.pop() {
            let (identifier, real, mut assets) =
                described(&layer).map_err(|error| self.unreadable(&error))?;
            if !self.seen.insert(identifier.clone()) {
                continue;
            }
            // Layers in one package share its file.
            let file = outer(&real);
            if self.seen.insert(format!("file {file}")) {
                self.bytes += std::fs::metadata(file).map_or(0, |data| data.len());
            }
            for clip in clips(self.pxr, &layer).map_err(|error| self.unreadable(&error))? {
                match clip {
                    Clip::Asset(asset) => assets.push(asset),
                    Clip::Template(template) => {
                        assets.extend(self.numbered(&layer, &identifier, &template)?)
                    }
                }
            }
            // A reference to another prim of the same stage names no file.
            for asset in assets.into_iter().filter(|asset| !asset.is_empty()) {
                let resolved = self.resolve(&layer, &asset).map_err(|error| self.unreadable(&error))?;
                let layer_name = identifier.clone();
                if resolved.is_empty() {
                    let path = self.path.to_owned();
                    return Err(UsdError::MissingAsset { path, layer: layer_name, asset });
                }
                if !self.is_allowed(Path::new(outer(&resolved))) {
                    let path = self.path.to_owned();
                    return Err(UsdError::ExternalAsset { path, layer: layer_name, asset });
                }
                if let Err(error) = cif_input::check(outer(&resolved)) {
                    let reason = format!("{resolved}, which {layer_name} names, cannot be read: {error}");
                    return Err(UsdError::Unreadable { path: self.path.to_owned(), reason });
                }
                open.push(self.layer(&resolved)?);
            }
        }
        Ok(())
    }

    fn is_allowed(&self, file: &Path) -> bool {
        self.follow_external || file.canonicalize().is_ok_and(|file| file.starts_with(&self.folder))
    }

    /// Files that a template of value clips, `./clip.###.usdc`, stands for; none where its folder has none.
    fn numbered(
        &self,
        layer: &Bound<'py, PyAny>,
        layer_name: &str,
        template: &str,
    ) -> Result<Vec<String>, UsdError> {
        let anchored = self
            .pxr
            .sdf
            .getattr("ComputeAssetPathRelativeToLayer")
            .and_then(|anchor| anchor.call1((layer, template))?.extract::<String>())
            .map_err(|error| self.unreadable(&error))?;
        let anchored = Path::new(&anchored);
        let (Some(folder), Some(name)) = (anchored.parent(), anchored.file_name()) else {
            return Ok(Vec::new());
        };
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        if folder.is_dir() && !self.is_allowed(folder) {
            let (path, layer) = (self.path.to_owned(), layer_name.to_owned());
            return Err(UsdError::ExternalAsset { path, layer, asset: template.to_owned() });
        }
        let name = name.to_string_lossy();
        let before = name.split('#').next().unwrap_or_default();
        let after = name.rsplit('#').next().unwrap_or_default();
        let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
        let mut files: Vec<String> = entries
            .map(|entry| (entry.file_name().to_string_lossy().into_owned(), entry.path()))
            .filter(|(file, _)| {
                let middle = file.strip_prefix(before).and_then(|rest| rest.strip_suffix(after));
                middle.is_some_and(|number| {
                    number.bytes().any(|byte| byte.is_ascii_digit())
                        && number.bytes().all(|byte| byte.is_ascii_digit() || b".-".contains(&byte))
                })
            })
            .map(|(_, path)| path.to_string_lossy().into_owned())
            .collect();
        files.sort();
        Ok(files)
    }

    fn resolve(&self, layer: &Bound<'py, PyAny>, asset: &str) -> PyResult<String> {
        let path = self.pxr.sdf.getattr("ComputeAssetPathRelativeToLayer")?.call1((layer, asset))?;
        let resolver = self.pxr.ar.call_method0("GetResolver")?;
        resolver.call_method1("Resolve", (path,))?.str()?.extract()
    }
}

/// What the value clips of a prim name.
enum Clip {
    Asset(String),
    Template(String),
}

/// Files of the value clips of a layer: composition does not count them among what it needs.
fn clips<'py>(pxr: &Pxr<'py>, layer: &Bound<'py, PyAny>) -> PyResult<Vec<Clip>> {
    let mut clips = Vec::new();
    let paths = PyList::empty(pxr.py);
    let root = pxr.sdf.getattr("Path")?.getattr("absoluteRootPath")?;
    layer.call_method1("Traverse", (root, paths.getattr("append")?))?;
    for path in paths {
        let is_prim = path.call_method0("IsPrimPath")?.is_truthy()?
            || path.call_method0("IsPrimVariantSelectionPath")?.is_truthy()?;
        if !is_prim {
            continue;
        }
        let spec = layer.call_method1("GetPrimAtPath", (&path,))?;
        if spec.is_none() || !spec.call_method1("HasInfo", ("clips",))?.is_truthy()? {
            continue;
        }
        let sets = spec.call_method1("GetInfo", ("clips",))?;
        for set in sets.call_method0("values")?.try_iter()? {
            let set = set?;
            let get = |key: &str| set.call_method1("get", (key,));
            let files = get("assetPaths")?;
            let manifest = get("manifestAssetPath")?;
            let files =
                if files.is_none() { Vec::new() } else { files.try_iter()?.collect::<PyResult<_>>()? };
            for file in files.into_iter().chain((!manifest.is_none()).then_some(manifest)) {
                clips.push(Clip::Asset(file.getattr("path")?.extract()?));
            }
            let template = get("templateAssetPath")?;
            if !template.is_none() {
                clips.push(Clip::Template(template.extract()?));
            }
        }
    }
    Ok(clips)
}

/// Identifier, file and needed assets of a layer.
fn described(layer: &Bound<'_, PyAny>) -> PyResult<(String, String, Vec<String>)> {
    let assets = layer.call_method0("GetCompositionAssetDependencies")?;
    Ok((
        layer.getattr("identifier")?.extract()?,
        layer.getattr("realPath")?.extract()?,
        assets.try_iter()?.map(|asset| asset?.extract()).collect::<PyResult<_>>()?,
    ))
}

/// The file of a path that may point into a package, `a.usdz[b.usdc]`.
fn outer(path: &str) -> &str {
    path.split_once('[').map_or(path, |(outer, _)| outer)
}
