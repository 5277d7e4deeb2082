//! Prim specs of a layer, read without composing anything.

use std::collections::HashMap;

use pyo3::prelude::*;
use pyo3::types::PyList;

use super::expansion::{Arc, LayerSpec, MAX_LEVELS, PrimSpec};

/// Arcs whose items name an asset and a prim, and arcs whose items are paths of prims.
const ASSET_ARCS: [&str; 2] = ["references", "payload"];
const PATH_ARCS: [&str; 2] = ["inheritPaths", "specializes"];

/// File that a value clip of a prim names: an asset, or a template of asset paths.
pub(super) enum Clip {
    Asset(String),
    Template(String),
}

/// A layer, read.
pub(super) struct Described {
    pub(super) identifier: String,
    /// Its file; for a layer in a package, `a.usdz[b.usdc]`.
    pub(super) file: String,
    /// Assets that its composition needs, as written.
    pub(super) assets: Vec<String>,
    /// Files of value clips, which composition does not count among what it needs.
    pub(super) clips: Vec<Clip>,
    pub(super) spec: LayerSpec,
    /// Path of a prim that is nested deeper than [`MAX_LEVELS`], where there is one; what is below is not read.
    pub(super) too_deep: Option<String>,
}

/// Reads a layer.
pub(super) fn describe(layer: &Bound<'_, PyAny>) -> PyResult<Described> {
    let strings = |values: Bound<'_, PyAny>| -> PyResult<Vec<String>> {
        values.try_iter()?.map(|value| value?.extract()).collect()
    };
    let default_prim: String = layer.getattr("defaultPrim")?.extract()?;
    let mut described = Described {
        identifier: layer.getattr("identifier")?.extract()?,
        file: layer.getattr("realPath")?.extract()?,
        assets: strings(layer.call_method0("GetCompositionAssetDependencies")?)?,
        clips: Vec::new(),
        spec: LayerSpec {
            default_prim: match default_prim.as_str() {
                "" => String::new(),
                path if path.starts_with('/') => path.to_owned(),
                name => format!("/{name}"),
            },
            sublayers: strings(layer.getattr("subLayerPaths")?)?,
            ..LayerSpec::default()
        },
        too_deep: None,
    };
    let paths = PyList::empty(layer.py());
    let root = layer.getattr("pseudoRoot")?.getattr("path")?;
    layer.call_method1("Traverse", (root, paths.getattr("append")?))?;
    let mut prims: HashMap<String, PrimSpec> = HashMap::new();
    for path in paths {
        let is_prim = path.call_method0("IsPrimPath")?.is_truthy()?
            || path.call_method0("IsPrimVariantSelectionPath")?.is_truthy()?;
        if !is_prim {
            continue;
        }
        let levels: u32 = path.getattr("pathElementCount")?.extract()?;
        let text: String = path.getattr("pathString")?.extract()?;
        if levels > MAX_LEVELS {
            described.too_deep = Some(text);
            break;
        }
        let prim = layer.call_method1("GetPrimAtPath", (&path,))?;
        // The path of a variant set without a variant names no prim.
        if prim.is_none() {
            continue;
        }
        let (parent, set) = above(&text);
        let parent = prims.entry(parent.to_owned()).or_default();
        match set {
            Some(set) => parent.variants.entry(set.to_owned()).or_default().push(text.clone()),
            None => parent.children.push(text.clone()),
        }
        metadata(&prim, prims.entry(text).or_default(), &mut described.clips)?;
    }
    described.spec.prims = prims;
    Ok(described)
}

/// The path above that of a prim or a variant, `/A{lod=full}B` or `/A{lod=full}`, and the set of a variant.
fn above(path: &str) -> (&str, Option<&str>) {
    if let Some((parent, selection)) = path.strip_suffix('}').and_then(|path| path.rsplit_once('{')) {
        return (parent, Some(selection.split('=').next().unwrap_or_default()));
    }
    match path.rfind(['/', '}']) {
        Some(0) | None => ("/", None),
        Some(end) if path.as_bytes()[end] == b'/' => (&path[..end], None),
        Some(end) => (&path[..=end], None),
    }
}

/// Arcs, clips and switches of a prim.
fn metadata(prim: &Bound<'_, PyAny>, spec: &mut PrimSpec, clips: &mut Vec<Clip>) -> PyResult<()> {
    let names: Vec<String> = prim.call_method0("ListInfoKeys")?.extract()?;
    for name in &names {
        let name = name.as_str();
        let get = || prim.call_method1("GetInfo", (name,));
        let items = || get()?.call_method0("GetAddedOrExplicitItems");
        if ASSET_ARCS.contains(&name) {
            for item in items()?.try_iter()? {
                let item = item?;
                let prim = item.getattr("primPath")?.str()?.extract()?;
                spec.arcs.push(Arc { asset: item.getattr("assetPath")?.extract()?, prim });
            }
        } else if PATH_ARCS.contains(&name) {
            for item in items()?.try_iter()? {
                spec.arcs.push(Arc { asset: String::new(), prim: item?.str()?.extract()? });
            }
        } else {
            match name {
                "instanceable" => spec.instanceable = Some(get()?.is_truthy()?),
                "active" => spec.active = Some(get()?.is_truthy()?),
                "clips" => of_clips(&get()?, clips)?,
                _ => {}
            }
        }
    }
    Ok(())
}

/// Files of the value clips of a prim.
fn of_clips(sets: &Bound<'_, PyAny>, clips: &mut Vec<Clip>) -> PyResult<()> {
    for set in sets.call_method0("values")?.try_iter()? {
        let set = set?;
        let get = |key: &str| set.call_method1("get", (key,));
        let files = get("assetPaths")?;
        let manifest = get("manifestAssetPath")?;
        let files: Vec<Bound<'_, PyAny>> =
            if files.is_none() { Vec::new() } else { files.try_iter()?.collect::<PyResult<_>>()? };
        for file in files.into_iter().chain((!manifest.is_none()).then_some(manifest)) {
            clips.push(Clip::Asset(file.getattr("path")?.extract()?));
        }
        let template = get("templateAssetPath")?;
        if !template.is_none() {
            clips.push(Clip::Template(template.extract()?));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::above;

    #[test]
    fn paths_tell_what_is_above_them() {
        for (path, parent, set) in [
            ("/A", "/", None),
            ("/A/B", "/A", None),
            ("/A{lod=full}", "/A", Some("lod")),
            ("/A{lod=full}B", "/A{lod=full}", None),
            ("/A{lod=full}B/C", "/A{lod=full}B", None),
            ("/A{lod=full}{look=new}", "/A{lod=full}", Some("look")),
        ] {
            assert_eq!(above(path), (parent, set), "{path}");
        }
    }
}
