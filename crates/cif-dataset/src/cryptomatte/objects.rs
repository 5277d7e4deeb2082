//! Which instance an object of a manifest is.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::files::{json, listing};
use crate::{Error, InstanceLabel};

/// Mask value by object id; 0 for what belongs to no instance.
pub type ObjectIds = BTreeMap<u32, u16>;

/// Name of the object that holds whatever belongs to no instance.
pub const BACKGROUND: &str = "background";

/// File next to Cryptomatte masks that says which mask value each object has: `{"name": id}`, 0 for none.
const OBJECTS_FILE: &str = "objects.json";

/// The mask values that the folder itself gives to objects.
///
/// # Errors
/// When the file does not hold names with ids from 0 to 65 535.
pub(crate) fn explicit(folder: Option<&Path>) -> Result<BTreeMap<String, u16>, Error> {
    let Some(path) = folder.map(|folder| folder.join(OBJECTS_FILE)).filter(|path| listing::is_there(path))
    else {
        return Ok(BTreeMap::new());
    };
    let value: serde_json::Value = json::read(&path)?;
    serde_json::from_value(value).map_err(|_| {
        Error::invalid(
            &path,
            "names of objects with their instance ids are expected, {\"red_mug\": 1}, 0 for none",
        )
    })
}

/// Gives every object of the manifests a mask value: from `explicit`; else that of the instance of `named` whose
/// label it carries; else, where there are no labels at all, numbers in the order of the names, which are
/// added to `named`.
///
/// # Errors
/// When there are labels and no object carries any of them, or there are more objects than mask values.
pub(crate) fn assign(
    manifests: &BTreeMap<String, u32>,
    explicit: &BTreeMap<String, u16>,
    named: &mut BTreeMap<u16, InstanceLabel>,
    place: &Path,
    warnings: &mut Vec<String>,
) -> Result<ObjectIds, Error> {
    let mut ids = ObjectIds::new();
    if named.is_empty() && explicit.is_empty() {
        for (name, object) in manifests.iter().filter(|(name, _)| name.as_str() != BACKGROUND) {
            let id = u16::try_from(named.len() + 1)
                .map_err(|_| Error::invalid(place, "the Cryptomatte names more than 65535 objects"))?;
            named.insert(
                id,
                InstanceLabel {
                    id,
                    label: name.clone(),
                    category: base(name).to_owned(),
                    taxonomies: BTreeMap::new(),
                },
            );
            ids.insert(*object, id);
        }
        return Ok(ids);
    }
    let labels_absent = named.is_empty();
    let mut strangers = Vec::new();
    for (name, object) in manifests {
        let id = explicit.get(name).copied().or_else(|| instance_of(name, named));
        match id {
            Some(id) => {
                ids.insert(*object, id);
                if labels_absent && id != 0 {
                    let label = base(name).to_owned();
                    let category = label.clone();
                    named.entry(id).or_insert(InstanceLabel {
                        id,
                        label,
                        category,
                        taxonomies: BTreeMap::new(),
                    });
                }
            }
            None if name == BACKGROUND => {}
            None => strangers.push(name.as_str()),
        }
    }
    if ids.values().all(|id| *id == 0) {
        let labels: BTreeSet<&str> = named.values().map(|instance| instance.label.as_str()).collect();
        return Err(Error::invalid(
            place,
            format!(
                "no object of the Cryptomatte is an instance of instances.json; objects: {}; labels: {}; rename \
                 one or the other, or say which is which in {OBJECTS_FILE} beside the files: {{\"object\": id}}",
                some(manifests.keys().map(String::as_str)),
                some(labels.into_iter())
            ),
        ));
    }
    if !strangers.is_empty() {
        warnings.push(format!(
            "{}: objects that are no instance of instances.json count as unlabelled: {}",
            place.display(),
            some(strangers.into_iter())
        ));
    }
    Ok(ids)
}

fn some<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: Vec<&str> = names.collect();
    match names.len() {
        0 => "none".to_owned(),
        1..=12 => names.join(", "),
        count => format!("{} and {} more", names[..12].join(", "), count - 12),
    }
}

/// The instance whose label an object carries: as it is, with what stands behind a dot left out (copies and parts
/// in Blender: `mug.001`), or as a unique name of label and id (`red_mug_003`). Case, spaces and punctuation do
/// not matter; a label of several instances names none of them.
fn instance_of(name: &str, named: &BTreeMap<u16, InstanceLabel>) -> Option<u16> {
    let by_label = |name: &str| {
        let requested = plain(name);
        let mut found = named.values().filter(|instance| plain(&instance.label) == requested);
        found.next().map(|instance| instance.id).filter(|_| found.next().is_none())
    };
    let by_unique_name = |name: &str| {
        let (label, id) = name.rsplit_once('_')?;
        let instance = named.get(&id.parse().ok()?)?;
        (plain(&instance.label) == plain(label)).then_some(instance.id)
    };
    [name, base(name)].into_iter().find_map(|name| by_label(name).or_else(|| by_unique_name(name)))
}

/// The name without what stands behind its first dot.
fn base(name: &str) -> &str {
    name.split_once('.').map_or(name, |(base, _)| base)
}

fn plain(name: &str) -> String {
    let words = name.split(|letter: char| !letter.is_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_lowercase).collect::<Vec<_>>().join(" ")
}
