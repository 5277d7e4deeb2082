//! Opening a stage, after a look at every layer that it is made of.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_scene::files::FileError;
use pyo3::prelude::*;

pub(crate) use super::expansion::Instances;
use super::expansion::{LayerSpec, MAX_LEVELS, MAX_PRIMS, expand};
use super::layer_spec::{Clip, Described, describe};
use super::nesting;
use crate::pxr::{Pxr, reason};
use crate::{ReadOptions, UsdError};

/// Refuses what is no regular file: usd-core would wait for the end of a pipe.
pub(crate) fn check_file(path: &Path) -> Result<(), UsdError> {
    cif_input::check(path).map(drop).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => UsdError::NotFound { path: path.to_owned() },
        _ => FileError::Read { path: path.to_owned(), source }.into(),
    })
}

/// A stage of which instances are not looked into, after the look at its layers that [`open_with_layers`] takes.
pub(crate) fn open<'py>(
    pxr: &Pxr<'py>,
    path: &Path,
    options: ReadOptions,
) -> Result<Bound<'py, PyAny>, UsdError> {
    open_with_layers(pxr, path, options, Instances::Once).map(|(stage, _)| stage)
}

/// A stage whose labels are looked for, after the same look, and whether also inside of instances: where these hold more
/// prims than usd-core can take, each as often as it is placed, they are not looked into.
pub(crate) fn open_for_labels<'py>(
    pxr: &Pxr<'py>,
    path: &Path,
    options: ReadOptions,
) -> Result<(Bound<'py, PyAny>, Instances), UsdError> {
    let mut walk = Walk::new(pxr, path, options)?;
    let layers = walk.visit(&path.to_string_lossy())?;
    let instances = walk.check_labels()?;
    let stage = open_unchecked(pxr, path)?;
    drop(layers);
    Ok((stage, instances))
}

/// As [`open_for_labels`], without opening; layers may lie anywhere, or not exist.
pub(crate) fn check_size(pxr: &Pxr<'_>, path: &Path) -> Result<Instances, UsdError> {
    let mut walk = Walk::new(pxr, path, ReadOptions { follow_external: true })?;
    walk.skip_missing = true;
    walk.visit(&path.to_string_lossy())?;
    walk.check_labels()
}

/// A stage, whatever it is made of.
fn open_unchecked<'py>(pxr: &Pxr<'py>, path: &Path) -> Result<Bound<'py, PyAny>, UsdError> {
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

/// A stage whose layers all exist and, unless others are allowed, lie in its folder, and whose prims are no more, and
/// nested no deeper, than usd-core can take; and the size of its files.
pub(crate) fn open_with_layers<'py>(
    pxr: &Pxr<'py>,
    path: &Path,
    options: ReadOptions,
    instances: Instances,
) -> Result<(Bound<'py, PyAny>, u64), UsdError> {
    let mut walk = Walk::new(pxr, path, options)?;
    // Layers stay open until the stage holds them, so that each is parsed once.
    let layers = walk.visit(&path.to_string_lossy())?;
    walk.check_size(instances)?;
    let bytes = walk.bytes;
    let stage = open_unchecked(pxr, path)?;
    drop(layers);
    Ok((stage, bytes))
}

struct Walk<'a, 'py> {
    pxr: &'a Pxr<'py>,
    path: &'a Path,
    folder: PathBuf,
    follow_external: bool,
    /// Layers that do not exist are no error.
    skip_missing: bool,
    /// Files met, and their size.
    files: BTreeSet<String>,
    bytes: u64,
    /// Layers met, by identifier, and the root among them.
    specs: BTreeMap<String, LayerSpec>,
    root: String,
}

impl<'a, 'py> Walk<'a, 'py> {
    fn new(pxr: &'a Pxr<'py>, path: &'a Path, options: ReadOptions) -> Result<Self, UsdError> {
        check_file(path)?;
        let unreadable = |reason: String| UsdError::Unreadable { path: path.to_owned(), reason };
        let file = path.canonicalize().map_err(|error| unreadable(error.to_string()))?;
        Ok(Self {
            pxr,
            path,
            folder: file.parent().map(Path::to_owned).unwrap_or_default(),
            follow_external: options.follow_external,
            skip_missing: false,
            files: BTreeSet::new(),
            bytes: 0,
            specs: BTreeMap::new(),
            root: String::new(),
        })
    }

    fn unreadable(&self, error: &PyErr) -> UsdError {
        UsdError::Unreadable { path: self.path.to_owned(), reason: reason(self.pxr.py, error) }
    }

    /// Opens a layer; one of text is looked through first, since usd-core parses it by recursion.
    fn layer(&self, name: &str) -> Result<Bound<'py, PyAny>, UsdError> {
        let levels = nesting::deepest(Path::new(outer(name))).map_err(|error| UsdError::Unreadable {
            path: self.path.to_owned(),
            reason: format!("{name}: {error}"),
        })?;
        if levels > MAX_LEVELS as usize {
            return Err(self.too_deep(name, format!("its brackets are nested {levels} deep")));
        }
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

    fn too_deep(&self, layer: &str, what: String) -> UsdError {
        UsdError::TooDeep { path: self.path.to_owned(), layer: layer.to_owned(), what, limit: MAX_LEVELS }
    }

    fn check_labels(&self) -> Result<Instances, UsdError> {
        match self.check_size(Instances::Each) {
            Ok(()) => Ok(Instances::Each),
            Err(_) => self.check_size(Instances::Once).map(|()| Instances::Once),
        }
    }

    /// Refuses what usd-core would be busy with for hours, or end the process over.
    fn check_size(&self, instances: Instances) -> Result<(), UsdError> {
        let expansion = expand(&self.specs, &self.root, instances);
        if expansion.levels > MAX_LEVELS {
            let what = format!("its prims are nested {} deep, references included", expansion.levels);
            return Err(self.too_deep(&self.root, what));
        }
        if expansion.prims > MAX_PRIMS {
            let (largest, of_largest) = expansion.largest.unwrap_or_default();
            return Err(UsdError::TooManyPrims {
                path: self.path.to_owned(),
                written: expansion.written,
                prims: expansion.prims,
                largest,
                of_largest,
                limit: MAX_PRIMS,
            });
        }
        Ok(())
    }

    /// Opens a layer and all that it needs, and checks each.
    fn visit(&mut self, root: &str) -> Result<Vec<Bound<'py, PyAny>>, UsdError> {
        let root = self.layer(root)?;
        let identifier = |layer: &Bound<'py, PyAny>| layer.getattr("identifier")?.extract::<String>();
        self.root = identifier(&root).map_err(|error| self.unreadable(&error))?;
        let (mut open, mut met) = (vec![root], Vec::new());
        while let Some(layer) = open.pop() {
            let name = identifier(&layer).map_err(|error| self.unreadable(&error))?;
            if self.specs.contains_key(&name) {
                continue;
            }
            let described = describe(&layer).map_err(|error| self.unreadable(&error))?;
            let Described { identifier: layer_name, file, mut assets, clips, mut spec, too_deep } = described;
            if let Some(prim) = too_deep {
                let start: String = prim.chars().take(40).collect();
                let what = format!("{start}... is nested more than {MAX_LEVELS} deep");
                return Err(self.too_deep(&layer_name, what));
            }
            // Layers in one package share its file.
            let file = outer(&file);
            if self.files.insert(file.to_owned()) {
                self.bytes += std::fs::metadata(file).map_or(0, |data| data.len());
            }
            for clip in clips {
                match clip {
                    Clip::Asset(asset) => assets.push(asset),
                    Clip::Template(template) => {
                        assets.extend(self.numbered(&layer, &layer_name, &template)?)
                    }
                }
            }
            // A reference to another prim of the same stage names no file.
            for asset in assets.into_iter().filter(|asset| !asset.is_empty()) {
                let resolved = self.resolve(&layer, &asset).map_err(|error| self.unreadable(&error))?;
                let layer_name = layer_name.clone();
                if resolved.is_empty() && self.skip_missing {
                    continue;
                }
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
                let target = self.layer(&resolved)?;
                let target_name = identifier(&target).map_err(|error| self.unreadable(&error))?;
                spec.targets.insert(asset, target_name);
                open.push(target);
            }
            self.specs.insert(layer_name, spec);
            met.push(layer);
        }
        Ok(met)
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

/// The file of a path that may point into a package, `a.usdz[b.usdc]`.
fn outer(path: &str) -> &str {
    path.split_once('[').map_or(path, |(outer, _)| outer)
}
