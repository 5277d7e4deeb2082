//! Objects of a source, and the ids and labels that they get.

use std::collections::{BTreeMap, BTreeSet};

use crate::InstanceLabel;
use crate::instances::default_label;

/// Objects in the order in which the source names them.
#[derive(Default)]
pub(super) struct Objects {
    by_key: BTreeMap<String, usize>,
    list: Vec<Object>,
}

struct Object {
    /// Name of the object in the source: a track, a colour, a file.
    key: String,
    /// Its own name, where the source has one.
    label: Option<String>,
    category: Option<String>,
    /// Id that it has to keep.
    id: Option<u16>,
}

impl Objects {
    /// The object of a key, entered at its first occurrence.
    ///
    /// # Errors
    /// When it has another category than before.
    pub(super) fn enter(&mut self, key: &str, category: Option<&str>) -> Result<usize, String> {
        let index = *self.by_key.entry(key.to_owned()).or_insert(self.list.len());
        if index == self.list.len() {
            self.list.push(Object { key: key.to_owned(), label: None, category: None, id: None });
        }
        let known = &mut self.list[index].category;
        match (known.as_deref(), category) {
            (Some(known), Some(category)) if known != category => Err(format!(
                "object {key} is a {category:?} here and a {known:?} elsewhere; give it one category"
            )),
            (None, Some(category)) => {
                *known = Some(category.to_owned());
                Ok(index)
            }
            _ => Ok(index),
        }
    }

    /// Enters an object whose id is known.
    ///
    /// # Errors
    /// As [`Self::enter`].
    pub(super) fn enter_id(&mut self, id: u16, category: Option<&str>) -> Result<usize, String> {
        let index = self.enter(&id.to_string(), category)?;
        self.list[index].id = Some(id);
        Ok(index)
    }

    /// Gives an object a name of its own.
    pub(super) fn name(&mut self, object: usize, label: &str) {
        self.list[object].label = Some(label.to_owned());
    }

    /// Ids of all objects in order of entry, and the table of instances, ascending id.
    ///
    /// Keys that are numbers from 1 to 65 535 throughout are ids; else objects are numbered from 1 in order of entry.
    /// Labels are those of the source, else categories, numbered where several objects share one.
    ///
    /// # Errors
    /// When there are more objects than ids.
    pub(super) fn finish(self) -> Result<(Vec<u16>, Vec<InstanceLabel>), String> {
        let own = |object: &Object| object.id.or_else(|| object.key.parse().ok().filter(|id| *id != 0));
        let kept: BTreeSet<u16> = self.list.iter().filter_map(own).collect();
        let keep = kept.len() == self.list.len();
        let mut shared: BTreeMap<&str, usize> = BTreeMap::new();
        for category in self.list.iter().filter_map(|object| object.category.as_deref()) {
            *shared.entry(category).or_default() += 1;
        }
        let mut counted: BTreeMap<&str, usize> = BTreeMap::new();
        let mut ids = Vec::new();
        let mut instances = BTreeMap::new();
        for (place, object) in self.list.iter().enumerate() {
            let numbered = u16::try_from(place + 1).map_err(|_| {
                format!("{} objects, but masks hold ids up to 65535; leave some out", self.list.len())
            })?;
            let id = if keep { own(object).unwrap_or(numbered) } else { numbered };
            let is_number = object.key.bytes().all(|byte| byte.is_ascii_digit());
            let label = match (&object.label, object.category.as_deref()) {
                (Some(label), _) => label.clone(),
                (None, Some(category)) if shared[category] > 1 => {
                    let number = counted.entry(category).or_default();
                    *number += 1;
                    format!("{category} {number}")
                }
                (None, Some(category)) => category.to_owned(),
                (None, None) if is_number => default_label(id),
                (None, None) => object.key.clone(),
            };
            let category = object.category.clone().unwrap_or_else(|| label.clone());
            if label.contains('\0') || category.contains('\0') {
                return Err(format!("the name {label:?} holds a NUL character; leave it out"));
            }
            ids.push(id);
            instances.insert(id, InstanceLabel { id, label, category, taxonomies: BTreeMap::new() });
        }
        Ok((ids, instances.into_values().collect()))
    }
}
