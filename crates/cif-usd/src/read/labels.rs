//! Names, labels, recorded identity and visibility of prims.

use std::cell::RefCell;
use std::collections::BTreeMap;

use cif_field::{Embedding, RotationEvidence};
use cif_scene::{MotionModel, VisibilitySample, naming};
use pyo3::prelude::*;
use pyo3::types::PyIterator;

use super::open::Instances;
use super::values::{attribute, plain, samples, text, value};
use crate::pxr::Pxr;
use crate::tokens::{self, instance};

/// Properties of our schema on a prim.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Recorded {
    pub(super) background: bool,
    pub(super) id: Option<u16>,
    pub(super) index: Option<usize>,
    pub(super) label: Option<String>,
    pub(super) category: Option<String>,
    pub(super) model: Option<MotionModel>,
    pub(super) source_frames: Option<(usize, usize)>,
    pub(super) mean_occupancy: Option<f32>,
    pub(super) pivot: Option<glam::DVec3>,
    pub(super) rotation: Option<RotationEvidence>,
    pub(super) report: Option<String>,
}

/// Our properties, where they are authored: by name, so that the schema need not be installed.
pub(super) fn recorded<'py>(pxr: &Pxr<'py>, prim: &Bound<'py, PyAny>) -> PyResult<Option<Recorded>> {
    let time = pxr.earliest()?;
    let Some(kind) = plain::<String>(prim, instance::KIND, &time)? else { return Ok(None) };
    let int = |name: &str| plain::<i64>(prim, name, &time);
    let pivot = value(prim, instance::PIVOT, &time)?.and_then(|value| super::values::vec3(&value).ok());
    let frames = value(prim, instance::SOURCE_FRAMES, &time)?
        .and_then(|value| super::values::vector::<2>(&value).ok())
        .map(|[first, last]| (first.max(0.0) as usize, last.max(0.0) as usize));
    let token =
        |name: &str| plain::<String>(prim, name, &time).map(|token| token.map(serde_json::Value::String));
    let (model, rotation) = (token(instance::MODEL)?, token(instance::ROTATION)?);
    Ok(Some(Recorded {
        background: kind == instance::KIND_BACKGROUND,
        id: int(instance::ID)?.and_then(|id| u16::try_from(id).ok()).filter(|&id| id > 0),
        index: int(instance::INDEX)?.and_then(|index| usize::try_from(index).ok()),
        label: plain(prim, instance::LABEL, &time)?,
        category: plain(prim, instance::CATEGORY, &time)?,
        model: model.and_then(|model| serde_json::from_value(model).ok()),
        source_frames: frames,
        mean_occupancy: plain(prim, instance::MEAN_OCCUPANCY, &time)?,
        pivot: pivot.filter(|pivot| pivot.is_finite()),
        rotation: rotation.and_then(|rotation| serde_json::from_value(rotation).ok()),
        report: plain(prim, instance::REPORT, &time)?,
    }))
}

/// Recorded appearance of a prim.
pub(crate) fn embedding<'py>(pxr: &Pxr<'py>, prim: &Bound<'py, PyAny>) -> PyResult<Option<Embedding>> {
    let time = pxr.earliest()?;
    let (Some(model), Some(values)) =
        (plain::<String>(prim, tokens::EMBEDDING_MODEL, &time)?, value(prim, tokens::EMBEDDING, &time)?)
    else {
        return Ok(None);
    };
    let numbers = values.try_iter().and_then(|values| values.map(|value| value?.extract::<f32>()).collect());
    let embedding = numbers.ok().map(|direction| Embedding { model, direction });
    Ok(embedding.filter(Embedding::is_valid))
}

/// Semantic labels of prims by taxonomy, at a time code or over an interval: those of `SemanticsLabelsAPI`, and of the
/// `SemanticsAPI` that came before it.
pub(crate) struct DirectLabels<'a, 'py> {
    pxr: &'a Pxr<'py>,
    api: Bound<'py, PyAny>,
    /// Time code, or interval.
    span: Bound<'py, PyAny>,
    /// A label query caches what it has seen: one per taxonomy.
    queries: RefCell<BTreeMap<String, Bound<'py, PyAny>>>,
}

impl<'a, 'py> DirectLabels<'a, 'py> {
    pub(crate) fn new(pxr: &'a Pxr<'py>, span: Bound<'py, PyAny>) -> PyResult<Self> {
        let api = pxr.usd_semantics.getattr("LabelsAPI")?;
        Ok(Self { pxr, api, span, queries: RefCell::default() })
    }

    /// Labels of a prim itself, sorted.
    pub(crate) fn of(&self, prim: &Bound<'py, PyAny>) -> PyResult<BTreeMap<String, Vec<String>>> {
        let mut by_taxonomy = BTreeMap::new();
        for taxonomy in self.api.call_method1("GetDirectTaxonomies", (prim,))?.try_iter()? {
            let taxonomy = text(&taxonomy?)?;
            let known = self.queries.borrow().get(&taxonomy).cloned();
            let query = match known {
                Some(query) => query,
                None => {
                    let class = self.pxr.usd_semantics.getattr("LabelsQuery")?;
                    let query = class.call1((&taxonomy, &self.span))?;
                    self.queries.borrow_mut().insert(taxonomy.clone(), query.clone());
                    query
                }
            };
            let labels = query.call_method1("ComputeUniqueDirectLabels", (prim,))?;
            let labels: Vec<String> =
                labels.try_iter()?.map(|label| text(&label?)).collect::<PyResult<_>>()?;
            by_taxonomy.insert(taxonomy, labels);
        }
        for Older { taxonomy, label, .. } in older(prim)? {
            by_taxonomy.entry(taxonomy).or_default().push(label);
        }
        for labels in by_taxonomy.values_mut() {
            labels.sort();
            labels.dedup();
        }
        Ok(by_taxonomy)
    }
}

/// A label of the schema `SemanticsAPI` of earlier tools, of which a prim may have several:
/// `semantic:NAME:params:semanticType` is the taxonomy, `semanticData` or `semanticLabel` next to it the label.
pub(crate) struct Older<'py> {
    pub(crate) taxonomy: String,
    pub(crate) label: String,
    /// Attribute that holds the label.
    pub(crate) attribute: Bound<'py, PyAny>,
}

/// Labels of a prim by the schema of earlier tools, in the order of their names.
pub(crate) fn older<'py>(prim: &Bound<'py, PyAny>) -> PyResult<Vec<Older<'py>>> {
    let mut found = Vec::new();
    for property in
        prim.call_method1("GetAuthoredPropertiesInNamespace", (tokens::OLDER_LABELS,))?.try_iter()?
    {
        let property = property?;
        let name = text(&property.call_method0("GetName")?)?;
        let ends = tokens::OLDER_LABEL.iter().find_map(|end| name.strip_suffix(end));
        let Some(attribute) = ends.map(|_| prim.call_method1("GetAttribute", (&name,))).transpose()? else {
            continue;
        };
        let value = attribute.call_method0("Get")?;
        if value.is_none() {
            continue;
        }
        let label = text(&value)?;
        let kind = format!("{}{}", ends.unwrap_or_default(), tokens::OLDER_TAXONOMY);
        let kind = prim.call_method1("GetAttribute", (kind,))?;
        let kind = if kind.is_truthy()? { kind.call_method0("Get")? } else { kind };
        let taxonomy = if kind.is_truthy()? { text(&kind)? } else { tokens::TAXONOMY_CLASS.to_owned() };
        if !label.is_empty() {
            found.push(Older { taxonomy, label, attribute });
        }
    }
    Ok(found)
}

/// Prims of a stage; those inside of instances too where these count each time.
pub(crate) fn all_prims<'py>(
    pxr: &Pxr<'py>,
    stage: &Bound<'py, PyAny>,
    instances: Instances,
) -> PyResult<Bound<'py, PyIterator>> {
    match instances {
        Instances::Once => stage.call_method0("Traverse")?.try_iter(),
        Instances::Each => {
            let predicate = pxr.usd.call_method1("TraverseInstanceProxies", ())?;
            stage.call_method1("Traverse", (predicate,))?.try_iter()
        }
    }
}

/// Semantic labels of a prim in a taxonomy.
pub(crate) fn in_taxonomy<'py>(
    pxr: &Pxr<'py>,
    prim: &Bound<'py, PyAny>,
    taxonomy: &str,
) -> PyResult<Vec<String>> {
    let name = format!("{}:{taxonomy}", tokens::LABELS);
    let labels = value(prim, &name, &pxr.earliest()?)?;
    if let Some(Ok(labels)) = labels.map(|labels| labels.try_iter()) {
        return labels.map(|label| text(&label?)).collect();
    }
    let older = older(prim)?.into_iter().filter(|older| older.taxonomy == taxonomy);
    Ok(older.map(|older| older.label).collect())
}

/// Taxonomies that a prim has labels in, in order of their names.
pub(crate) fn taxonomies(prim: &Bound<'_, PyAny>) -> PyResult<Vec<String>> {
    let properties = prim.call_method1("GetAuthoredPropertiesInNamespace", (tokens::LABELS,))?;
    let mut taxonomies = Vec::new();
    for property in properties.try_iter()? {
        let name = text(&property?.call_method0("GetName")?)?;
        taxonomies.extend(
            name.strip_prefix(tokens::LABELS).and_then(|rest| rest.strip_prefix(':')).map(str::to_owned),
        );
    }
    taxonomies.extend(older(prim)?.into_iter().map(|older| older.taxonomy));
    taxonomies.sort();
    taxonomies.dedup();
    Ok(taxonomies)
}

/// First label of a prim in every taxonomy but ours.
pub(super) fn others<'py>(pxr: &Pxr<'py>, prim: &Bound<'py, PyAny>) -> PyResult<BTreeMap<String, String>> {
    let mut found = BTreeMap::new();
    for taxonomy in taxonomies(prim)? {
        // Names with colons would be namespaces, which labels do not have.
        if cif_output::check_taxonomy(&taxonomy).is_ok()
            && let Some(label) =
                in_taxonomy(pxr, prim, &taxonomy)?.into_iter().find(|label| !label.is_empty())
        {
            found.insert(taxonomy, label);
        }
    }
    Ok(found)
}

/// Human label and class of a prim.
pub(super) fn names<'py>(
    pxr: &Pxr<'py>,
    prim: &Bound<'py, PyAny>,
    recorded: &Recorded,
) -> PyResult<(String, String)> {
    let name = text(&prim.call_method0("GetName")?)?;
    let display: String = text(&prim.call_method0("GetDisplayName")?)?;
    let user: Option<String> = plain(prim, tokens::USER_LABEL, &pxr.earliest()?)?;
    let mut class = in_taxonomy(pxr, prim, tokens::TAXONOMY_CLASS)?;
    if class.is_empty() {
        for taxonomy in taxonomies(prim)? {
            if taxonomy != tokens::TAXONOMY_INSTANCE && class.is_empty() {
                class = in_taxonomy(pxr, prim, &taxonomy)?;
            }
        }
    }
    let human = class.get(1).or(class.first()).cloned();
    let spoken = [user, Some(display), human].map(|text| text.filter(|text| !text.trim().is_empty()));
    let label = match &recorded.label {
        // Ours says the same everywhere: what differs was changed.
        Some(before) => {
            spoken.into_iter().flatten().find(|text| text != before).unwrap_or_else(|| before.clone())
        }
        None => {
            let instance = in_taxonomy(pxr, prim, tokens::TAXONOMY_INSTANCE)?.into_iter().next();
            spoken.into_iter().flatten().next().or(instance).unwrap_or_else(|| name.clone())
        }
    };
    let category = match (class.first(), &recorded.category) {
        (Some(class), _) => class.clone(),
        (None, Some(before)) => before.clone(),
        (None, None) => label.clone(),
    };
    Ok((label, category))
}

/// True when a prim of ours is still called as its `instance` label says.
pub(super) fn is_original<'py>(pxr: &Pxr<'py>, prim: &Bound<'py, PyAny>) -> PyResult<bool> {
    let name = text(&prim.call_method0("GetName")?)?;
    Ok(in_taxonomy(pxr, prim, tokens::TAXONOMY_INSTANCE)?.contains(&name))
}

/// Name of a node for a prim: its own, made usable.
pub(super) fn node_name(prim: &Bound<'_, PyAny>) -> PyResult<String> {
    let name = text(&prim.call_method0("GetName")?)?;
    let usable = name.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
        && name.chars().all(|character| character.is_ascii_alphanumeric() || character == '_');
    Ok(if usable { name } else { naming::identifier(&name, "instance") })
}

/// Changes of visibility of a prim, through its own attribute and those of its ancestors.
pub(super) fn visibility<'py>(
    pxr: &Pxr<'py>,
    prim: &Bound<'py, PyAny>,
    start: f64,
) -> PyResult<Vec<VisibilitySample>> {
    let mut attributes = Vec::new();
    let mut at = prim.clone();
    while at.is_truthy()? && !at.call_method0("IsPseudoRoot")?.is_truthy()? {
        attributes.extend(attribute(&at, "visibility")?);
        at = at.call_method0("GetParent")?;
    }
    let mut times = Vec::new();
    for attribute in &attributes {
        times.extend(samples(attribute)?);
    }
    times.sort_by(f64::total_cmp);
    times.dedup();
    let visible = |time: &Bound<'py, PyAny>| -> PyResult<bool> {
        for attribute in &attributes {
            let value = attribute.call_method1("Get", (time,))?;
            if !value.is_none() && text(&value)? == tokens::INVISIBLE {
                return Ok(false);
            }
        }
        Ok(true)
    };
    if times.is_empty() {
        let visible = visible(&pxr.earliest()?)?;
        return Ok(if visible { Vec::new() } else { vec![VisibilitySample { time_code: start, visible }] });
    }
    times
        .into_iter()
        .map(|time_code| {
            Ok(VisibilitySample { time_code, visible: visible(&pxr.time_code(Some(time_code))?)? })
        })
        .collect()
}
