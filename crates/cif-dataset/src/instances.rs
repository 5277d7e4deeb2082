//! Labels of instances: `instances.json` or `class_mapping.json`, completed from the masks.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::Error;
use crate::files::{json, listing};

/// An instance named by the capture, or found only in its masks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InstanceLabel {
    /// Value in the masks, 1 to 65 535.
    pub id: u16,
    /// Human name; `instance_12` when the capture names none.
    pub label: String,
    /// Class, where given; else equal to `label`.
    pub category: String,
    /// Names of its class in vocabularies of others by taxonomy, e.g. `wikidata_qcode` and `Q81727`; see
    /// [`cif_output::check_taxonomy`].
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub taxonomies: BTreeMap<String, String>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum InstancesFile {
    List(Vec<Entry>),
    Object { instances: Vec<Entry> },
}

#[derive(Deserialize)]
struct Entry {
    id: i64,
    #[serde(default)]
    label: Option<String>,
    #[serde(default)]
    category: Option<String>,
    #[serde(default)]
    taxonomies: BTreeMap<String, String>,
}

/// A map of ids to names, `{"1": "red mug"}`, as generators of synthetic captures write it next to their masks.
const CLASS_MAPPING: &str = "class_mapping.json";

/// Labels named by a file, ascending id.
///
/// # Errors
/// When the file does not parse, an id is outside 1 to 65 535 (0 is left out with a warning), or twice.
pub(crate) fn read(path: &Path, warnings: &mut Vec<String>) -> Result<BTreeMap<u16, InstanceLabel>, Error> {
    // Syntax first: the message of an untagged enum has no line.
    let mut value: serde_json::Value = json::read(path)?;
    if path.ends_with(CLASS_MAPPING) {
        value = as_list(path, &value)?;
    }
    let file: InstancesFile = serde_json::from_value(value).map_err(|_| {
        Error::invalid(
            path,
            "a list of {\"id\": 1, \"label\": \"red mug\", \"category\": \"mug\"} is expected, or {\"instances\": [...]}; \
             taxonomies are texts by name: {\"wikidata_qcode\": \"Q81727\"}",
        )
    })?;
    let (InstancesFile::List(entries) | InstancesFile::Object { instances: entries }) = file;
    let mut labels = BTreeMap::new();
    for entry in entries {
        if entry.id == 0 {
            warnings.push(format!(
                "{}: id 0 is the unlabelled part of a mask; its entry is not used",
                path.display()
            ));
            continue;
        }
        let id = u16::try_from(entry.id).map_err(|_| {
            Error::invalid(
                path,
                format!("id {} is outside 1 to 65535; give the instance a smaller id", entry.id),
            )
        })?;
        let text = |text: Option<String>| text.filter(|text| !text.trim().is_empty());
        let label = text(entry.label).unwrap_or_else(|| default_label(id));
        let category = text(entry.category).unwrap_or_else(|| label.clone());
        if [&label, &category].iter().any(|text| text.contains('\0')) {
            return Err(Error::invalid(
                path,
                format!("the label or category of id {id} holds a NUL character; leave it out"),
            ));
        }
        for (taxonomy, name) in &entry.taxonomies {
            cif_output::check_taxonomy(taxonomy).map_err(|problem| {
                Error::invalid(path, format!("the taxonomy {taxonomy:?} of id {id} {problem}"))
            })?;
            if name.trim().is_empty() || name.contains('\0') {
                return Err(Error::invalid(
                    path,
                    format!(
                        "the taxonomy {taxonomy:?} of id {id} has no name, or one with a NUL character; name it"
                    ),
                ));
            }
        }
        let taxonomies = entry.taxonomies;
        if labels.insert(id, InstanceLabel { id, label, category, taxonomies }).is_some() {
            return Err(Error::invalid(path, format!("id {id} is listed twice; keep one entry")));
        }
    }
    Ok(labels)
}

/// The entries of a class mapping as those of `instances.json`; 0 is the background and not an instance.
fn as_list(path: &Path, value: &serde_json::Value) -> Result<serde_json::Value, Error> {
    let entry = |(id, label): (&String, &serde_json::Value)| {
        let entry = (id.trim().parse::<i64>().ok()?, label.as_str()?);
        Some((entry.0 != 0).then(|| serde_json::json!({ "id": entry.0, "label": entry.1 })))
    };
    let entries: Option<Vec<Option<serde_json::Value>>> =
        value.as_object().and_then(|classes| classes.iter().map(entry).collect());
    let entries = entries.ok_or_else(|| {
        Error::invalid(
            path,
            "a name per id is expected: {\"1\": \"red mug\", \"2\": \"blue ball\"}; correct it, or give \
             instances.json beside it, which goes first",
        )
    })?;
    Ok(entries.into_iter().flatten().collect())
}

/// Name of an instance that nobody named.
pub(crate) fn default_label(id: u16) -> String {
    format!("instance_{id}")
}

/// Value of masks that only say where something is.
pub(crate) const WHITE: u16 = 255;

/// The instance of masks that have one value apart from 0.
pub(crate) fn foreground(id: u16) -> InstanceLabel {
    let label = "foreground".to_owned();
    InstanceLabel { id, category: label.clone(), label, taxonomies: BTreeMap::new() }
}

/// The file of labels for a capture's masks: in the mask folder, else in the nearest folder of the capture above it.
pub(crate) fn file_for(root: &Path, mask_folder: Option<&Path>) -> Option<PathBuf> {
    let above = |folder: &Path| {
        let below = folder.strip_prefix(root).unwrap_or(Path::new(""));
        let leaves = below.components().any(|part| !matches!(part, Component::Normal(_)));
        let inside = if leaves { 0 } else { below.components().count() };
        folder.ancestors().take(inside.max(1)).map(Path::to_owned).collect::<Vec<_>>()
    };
    mask_folder
        .into_iter()
        .flat_map(above)
        .chain([root.to_owned()])
        .flat_map(|folder| ["instances.json", CLASS_MAPPING].map(|name| folder.join(name)))
        .find(|path| listing::is_there(path))
}

/// The instances that occur in the masks, ascending id, named by the file where it names them.
pub(crate) fn complete(
    found: &BTreeSet<u16>,
    largest_id: u16,
    mut named: BTreeMap<u16, InstanceLabel>,
    file: Option<&Path>,
    warnings: &mut Vec<String>,
) -> Vec<InstanceLabel> {
    let list = |ids: Vec<u16>| {
        let shown = ids.iter().take(10).map(u16::to_string).collect::<Vec<_>>().join(", ");
        if ids.len() > 10 { format!("{shown} and {} more", ids.len() - 10) } else { shown }
    };
    let unnamed: Vec<u16> = found.iter().copied().filter(|id| !named.contains_key(id)).collect();
    if let Some(file) = file {
        if !unnamed.is_empty() {
            warnings.push(format!(
                "{}: the masks hold ids it does not name, called instance_<id> here: {}",
                file.display(),
                list(unnamed)
            ));
        }
        let (too_large, absent): (Vec<u16>, Vec<u16>) =
            named.keys().copied().filter(|id| !found.contains(id)).partition(|id| *id > largest_id);
        if !too_large.is_empty() {
            warnings.push(format!(
                "{}: the masks are 8-bit or less and cannot hold ids above {largest_id}: {}; export them as \
                 16-bit grey PNG",
                file.display(),
                list(too_large)
            ));
        }
        if !absent.is_empty() {
            warnings.push(format!("{}: no mask shows: {}", file.display(), list(absent)));
        }
    }
    found
        .iter()
        .map(|id| {
            named.remove(id).unwrap_or_else(|| InstanceLabel {
                id: *id,
                label: default_label(*id),
                category: default_label(*id),
                taxonomies: BTreeMap::new(),
            })
        })
        .collect()
}
