//! Prims by label.

use std::collections::BTreeMap;
use std::path::Path;

use cif_scene::{LabelMatch, LabelPattern, LabelQuery};
use pyo3::prelude::*;

use super::labels::{DirectLabels, all_prims};
use super::open::{Instances, open_for_labels};
use crate::pxr::{self, Pxr, reason};
use crate::{ReadOptions, UsdError, conventions, tokens};

/// Boxes are those that models give of themselves, where they do: of what can be seen.
pub(crate) const USE_EXTENTS_HINTS: bool = true;

pub(crate) fn query(
    path: &Path,
    query: &LabelQuery,
    options: ReadOptions,
) -> Result<Vec<LabelMatch>, UsdError> {
    let matcher = query.matcher();
    pxr::with(|pxr| {
        let (stage, instances) = open_for_labels(pxr, path, options)?;
        let (found, known) = search(pxr, &stage, instances, query, &matcher)
            .map_err(|error| UsdError::Unusable { path: path.to_owned(), reason: reason(pxr.py, &error) })?;
        if found.is_empty() {
            return Err(query.unknown(&path.display().to_string(), known).into());
        }
        Ok(found)
    })
}

/// Matching prims, and all labels of the stage.
fn search<'py>(
    pxr: &Pxr<'py>,
    stage: &Bound<'py, PyAny>,
    instances: Instances,
    query: &LabelQuery,
    matcher: &LabelPattern,
) -> PyResult<(Vec<LabelMatch>, Vec<String>)> {
    let time = pxr.time_code(query.time_code)?;
    let labels_api = pxr.usd_semantics.getattr("LabelsAPI")?;
    let transforms = pxr.usd_geom.getattr("XformCache")?.call1((&time,))?;
    let boxes = pxr.usd_geom.getattr("BBoxCache")?.call1((&time, drawn(pxr)?, USE_EXTENTS_HINTS))?;
    let labels = DirectLabels::new(pxr, time.clone())?;
    let (mut found, mut known) = (Vec::new(), Vec::new());
    for prim in all_prims(pxr, stage, instances)? {
        let prim = prim?;
        let by_taxonomy = labels.of(&prim)?;
        if by_taxonomy.values().flatten().any(|label| matcher.matches(label)) {
            found.push(describe(&prim, &by_taxonomy, &time, &labels_api, &transforms, &boxes)?);
        }
        known.extend(by_taxonomy.into_values().flatten());
    }
    Ok((found, known))
}

/// The purposes that renderers draw.
pub(crate) fn drawn<'py>(pxr: &Pxr<'py>) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let tokens = pxr.usd_geom.getattr("Tokens")?;
    ["default_", "render"].into_iter().map(|purpose| tokens.getattr(purpose)).collect()
}

fn describe<'py>(
    prim: &Bound<'py, PyAny>,
    by_taxonomy: &BTreeMap<String, Vec<String>>,
    time: &Bound<'py, PyAny>,
    labels_api: &Bound<'py, PyAny>,
    transforms: &Bound<'py, PyAny>,
    boxes: &Bound<'py, PyAny>,
) -> PyResult<LabelMatch> {
    let first = |taxonomy: &str| {
        by_taxonomy.get(taxonomy).and_then(|labels| labels.first()).cloned().unwrap_or_default()
    };
    // The class stands first in the attribute, before the human label; the query itself gives a set.
    let authored = labels_api
        .call_method1("Get", (prim, tokens::TAXONOMY_CLASS))?
        .call_method0("GetLabelsAttr")?
        .call_method1("Get", (time,));
    let class = match authored {
        Ok(labels) if labels.is_truthy()? => labels.get_item(0)?.str()?.extract()?,
        _ => first(tokens::TAXONOMY_CLASS),
    };
    let attribute = prim.call_method1("GetAttribute", (tokens::USER_LABEL,))?;
    let label = if attribute.is_truthy()? {
        attribute.call_method1("Get", (time,))?.extract::<Option<String>>()?
    } else {
        None
    };
    let matrix = transforms.call_method1("GetLocalToWorldTransform", (prim,))?;
    let mut rows = [[0.0; 4]; 4];
    for (index, row) in rows.iter_mut().enumerate() {
        *row = numbers(&matrix.call_method1("GetRow", (index,))?)?;
    }
    let range = boxes.call_method1("ComputeWorldBound", (prim,))?.call_method0("ComputeAlignedRange")?;
    let (low, high) = if range.call_method0("IsEmpty")?.is_truthy()? {
        (None, None)
    } else {
        (Some(numbers(&range.call_method0("GetMin")?)?), Some(numbers(&range.call_method0("GetMax")?)?))
    };
    Ok(LabelMatch {
        path: prim.call_method0("GetPath")?.str()?.extract()?,
        label: label.unwrap_or_else(|| class.clone()),
        class,
        instance: first(tokens::TAXONOMY_INSTANCE),
        transform: conventions::column_vector_matrix(rows),
        low,
        high,
    })
}

fn numbers<const N: usize>(vector: &Bound<'_, PyAny>) -> PyResult<[f64; N]> {
    let mut values = [0.0; N];
    for (index, value) in values.iter_mut().enumerate() {
        *value = vector.get_item(index)?.extract()?;
    }
    Ok(values)
}
