//! Opening a stage, after a look at every layer that it is made of.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use pyo3::prelude::*;

use crate::UsdError;
use crate::pxr::{Pxr, reason};

/// A stage.
pub(crate) fn open<'py>(pxr: &Pxr<'py>, path: &Path) -> Result<Bound<'py, PyAny>, UsdError> {
    if !path.is_file() {
        return Err(UsdError::NotFound { path: path.to_owned() });
    }
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
    if !path.is_file() {
        return Err(UsdError::NotFound { path: path.to_owned() });
    }
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
            let (identifier, real, assets) = described(&layer).map_err(|error| self.unreadable(&error))?;
            if !self.seen.insert(identifier.clone()) {
                continue;
            }
            // Layers in one package share its file.
            let file = outer(&real);
            if self.seen.insert(format!("file {file}")) {
                self.bytes += std::fs::metadata(file).map_or(0, |data| data.len());
            }
            // A reference to another prim of the same stage names no file.
            for asset in assets.into_iter().filter(|asset| !asset.is_empty()) {
                let resolved = self.resolve(&layer, &asset).map_err(|error| self.unreadable(&error))?;
                let layer_name = identifier.clone();
                if resolved.is_empty() {
                    let path = self.path.to_owned();
                    return Err(UsdError::MissingAsset { path, layer: layer_name, asset });
                }
                let inside = Path::new(outer(&resolved))
                    .canonicalize()
                    .is_ok_and(|file| file.starts_with(&self.folder));
                if !inside && !self.follow_external {
                    let path = self.path.to_owned();
                    return Err(UsdError::ExternalAsset { path, layer: layer_name, asset });
                }
                open.push(self.layer(&resolved)?);
            }
        }
        Ok(())
    }

    fn resolve(&self, layer: &Bound<'py, PyAny>, asset: &str) -> PyResult<String> {
        let path = self.pxr.sdf.getattr("ComputeAssetPathRelativeToLayer")?.call1((layer, asset))?;
        let resolver = self.pxr.ar.call_method0("GetResolver")?;
        resolver.call_method1("Resolve", (path,))?.str()?.extract()
    }
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
