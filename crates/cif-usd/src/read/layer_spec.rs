//! What a layer says about its prims, read without composing anything.

use pyo3::prelude::*;

use super::expansion::{Arc, LayerSpec, MAX_LEVELS, PrimSpec};

/// Arcs whose items name an asset and a prim, and arcs whose items are paths of prims.
const ASSET_ARCS: [&str; 2] = ["references", "payload"];
const PATH_ARCS: [&str; 2] = ["inheritPaths", "specializes"];

/// What the value clips of a prim name.
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
    // Prims to be read, with their depths: usd-core would walk them by recursion.
    let mut open = vec![(layer.getattr("pseudoRoot")?, 0)];
    while let Some((prim, depth)) = open.pop() {
        let path = path_of(&prim)?;
        if depth > MAX_LEVELS {
            described.too_deep = Some(path);
            break;
        }
        let mut spec = PrimSpec::default();
        for child in prim.getattr("nameChildren")?.try_iter()? {
            let child = child?;
            spec.children.push(path_of(&child)?);
            open.push((child, depth + 1));
        }
        if depth > 0 {
            for set in prim.getattr("variantSets")?.call_method0("values")?.try_iter()? {
                let mut variants = Vec::new();
                for variant in set?.getattr("variants")?.call_method0("values")?.try_iter()? {
                    let inside = variant?.getattr("primSpec")?;
                    variants.push(path_of(&inside)?);
                    open.push((inside, depth + 1));
                }
                spec.variants.push(variants);
            }
            metadata(&prim, &mut spec, &mut described.clips)?;
        }
        described.spec.prims.insert(path, spec);
    }
    Ok(described)
}

fn path_of(prim: &Bound<'_, PyAny>) -> PyResult<String> {
    prim.getattr("path")?.str()?.extract()
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
