//! New labels for an object of a stage.

use std::path::Path;

use cif_output::Scratch;
use cif_scene::files::{folder_of, target_of};
use pyo3::BoundObject;
use pyo3::prelude::*;

use crate::pxr::{self, Pxr, reason};
use crate::read::labels;
use crate::read::open::Instances;
use crate::{Relabelled, UsdError, tokens};

/// Mask value of an instance.
const INSTANCE_ID: &str = "cif:id";

/// Layers that are edited as they are; a package would have to be unpacked.
const EXTENSIONS: [&str; 3] = ["usda", "usdc", "usd"];

pub(crate) fn relabel(
    path: &Path,
    output: &Path,
    object: &str,
    label: &str,
    category: Option<&str>,
) -> Result<Relabelled, UsdError> {
    let extension =
        path.extension().map(|extension| extension.to_string_lossy().to_lowercase()).unwrap_or_default();
    let refused = |problem: String| UsdError::Relabel { path: path.to_owned(), problem };
    crate::read::open::check_file(path)?;
    if !EXTENSIONS.contains(&extension.as_str()) {
        return Err(refused(
            "labels are edited in .usda, .usdc and .usd; label the scene it was exported from, or unpack the \
             package first"
                .to_owned(),
        ));
    }
    if output.extension() != path.extension() {
        return Err(refused(format!("{} has another ending; keep .{extension}", output.display())));
    }
    let target = target_of(output, false)?;
    let folder = folder_of(&target);
    let original = std::fs::canonicalize(path).map(|path| folder_of(&path));
    let moved = std::fs::canonicalize(&folder).ok() != original.ok();
    let unwritable =
        |source: std::io::Error| UsdError::Write { path: output.to_owned(), reason: source.to_string() };
    // Beside the output, where the copy finds the files that it names.
    let scratch = Scratch::inside(&folder).map_err(unwritable)?;
    let copy = scratch.file(&extension);
    std::fs::copy(path, &copy).map_err(unwritable)?;
    let done = pxr::with(|pxr| {
        let python =
            |error: PyErr| UsdError::Unusable { path: path.to_owned(), reason: reason(pxr.py, &error) };
        let instances = crate::read::open::check_size(pxr, path)?;
        let stage = pxr
            .usd
            .getattr("Stage")
            .and_then(|class| class.call_method1("Open", (copy.as_os_str(),)))
            .map_err(|error| UsdError::Unreadable {
                path: path.to_owned(),
                reason: reason(pxr.py, &error),
            })?;
        let layer = stage.call_method0("GetRootLayer").map_err(python)?;
        if moved && has_references(&layer).map_err(python)? {
            return Err(refused(format!(
                "it names other files next to it, which {} would not find; write into the same folder",
                output.display()
            )));
        }
        let (prims, known) = find(pxr, &stage, instances, object).map_err(python)?;
        let [prim] = prims.as_slice() else {
            return Err(refused(match prims.len() {
                0 => {
                    format!("no object is '{object}'; {}", cif_scene::known_names(object, "objects", &known))
                }
                count => format!("{count} prims are '{object}'; give the path of the one that is meant"),
            }));
        };
        let done = edit(pxr, prim, label, category).map_err(python)?;
        if !layer.call_method0("Save").and_then(|saved| saved.is_truthy()).map_err(python)? {
            return Err(refused("usd-core could not save it".to_owned()));
        }
        Ok(done)
    })?;
    scratch.replace(&[(copy, target)], &[]).map_err(unwritable)?;
    Ok(done)
}

/// True when a layer names other files.
fn has_references(layer: &Bound<'_, PyAny>) -> PyResult<bool> {
    let dependencies = layer.call_method0("GetCompositionAssetDependencies")?;
    let external = layer.call_method0("GetExternalAssetDependencies")?;
    Ok(dependencies.len()? + external.len()? > 0)
}

/// The prims that an object is, by mask value, unique name or path; and what could be meant.
fn find<'py>(
    pxr: &Pxr<'py>,
    stage: &Bound<'py, PyAny>,
    instances: Instances,
    object: &str,
) -> PyResult<(Vec<Bound<'py, PyAny>>, Vec<String>)> {
    let (mut found, mut known) = (Vec::new(), Vec::new());
    for prim in labels::all_prims(pxr, stage, instances)? {
        let prim = prim?;
        let path: String = prim.call_method0("GetPath")?.str()?.extract()?;
        if labels::taxonomies(&prim)?.is_empty() && path != object {
            continue;
        }
        let name: String = prim.call_method0("GetName")?.extract()?;
        let attribute = prim.call_method1("GetAttribute", (INSTANCE_ID,))?;
        let id: Option<i64> = if attribute.is_truthy()? {
            attribute.call_method0("Get")?.extract().ok()
        } else {
            // Stages of earlier layouts: the id ends the unique name.
            name.rsplit_once('_').and_then(|(_, digits)| digits.parse().ok())
        };
        if path == object || name == object || id.is_some_and(|id| object.parse() == Ok(id)) {
            found.push(prim);
        }
        known.push(path);
    }
    Ok((found, known))
}

/// The prim where its own opinions count: instances that hold it become copies of their own.
fn outside_of_instances<'py>(prim: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let is = |prim: &Bound<'py, PyAny>, what: &str| prim.call_method0(what).and_then(|is| is.is_truthy());
    let (stage, path) = (prim.call_method0("GetStage")?, prim.call_method0("GetPath")?);
    let mut prim = prim.clone();
    while is(&prim, "IsInstanceProxy")? {
        let mut above = prim.call_method0("GetParent")?;
        while is(&above, "IsInstanceProxy")? {
            above = above.call_method0("GetParent")?;
        }
        above.call_method1("SetInstanceable", (false,))?;
        prim = stage.call_method1("GetPrimAtPath", (&path,))?;
    }
    Ok(prim)
}

/// Writes label and class wherever a stage of ours has them.
fn edit<'py>(
    pxr: &Pxr<'py>,
    prim: &Bound<'py, PyAny>,
    label: &str,
    category: Option<&str>,
) -> PyResult<Relabelled> {
    let prim = &outside_of_instances(prim)?;
    let old = labels::in_taxonomy(pxr, prim, tokens::TAXONOMY_CLASS)?;
    let labels_api = pxr.usd_semantics.getattr("LabelsAPI")?;
    let class = labels_api.call_method1("Apply", (prim, tokens::TAXONOMY_CLASS))?;
    let attribute = class.call_method0("CreateLabelsAttr")?;
    let user = prim.call_method1("GetAttribute", (tokens::USER_LABEL,))?;
    let old_label = if user.is_truthy()? {
        user.call_method0("Get")?.extract::<Option<String>>()?
    } else {
        old.last().cloned()
    };
    // The category stands first; an object that had none is its own.
    let old_category = old.first().cloned().unwrap_or_default();
    let own = old_category.is_empty() || old_label.as_deref() == Some(old_category.as_str());
    let category = match category {
        Some(category) => category.to_owned(),
        None if own => label.to_owned(),
        None => old_category,
    };
    let mut labels = vec![category.clone()];
    if category != label {
        labels.push(label.to_owned());
    }
    set(&attribute, labels)?;
    for older in labels::older(prim)?.into_iter().filter(|older| older.taxonomy == tokens::TAXONOMY_CLASS) {
        set(&older.attribute, category.as_str())?;
    }
    let string = pxr.sdf.getattr("ValueTypeNames")?.getattr("String")?;
    let user = prim.call_method1("CreateAttribute", (tokens::USER_LABEL, string, true))?;
    set(&user, label)?;
    prim.call_method1("SetDisplayName", (label,))?;
    Ok(Relabelled {
        object: prim.call_method0("GetPath")?.str()?.extract()?,
        before: old_label.unwrap_or_default(),
        label: label.to_owned(),
        category,
    })
}

/// `attribute.Set(value)`; an attribute that refuses is an error, not a missing value.
fn set<'py>(attribute: &Bound<'py, PyAny>, value: impl pyo3::IntoPyObject<'py>) -> PyResult<()> {
    let value = value.into_pyobject(attribute.py()).map_err(Into::into)?.into_any().unbind();
    if attribute.call_method1("Set", (value,))?.is_truthy()? {
        return Ok(());
    }
    let name: String = attribute.call_method0("GetName")?.extract()?;
    Err(pyo3::exceptions::PyRuntimeError::new_err(format!("{name} does not take its value")))
}
