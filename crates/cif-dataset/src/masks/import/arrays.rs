//! NumPy arrays of ids: a file per frame (`[height, width]`), or one for all (`[frames, height, width]`). Grounded SAM 2
//! writes them in `mask_data`, and the classes of ids in JSON files of the same names in `json_data` next to it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;

use super::files_below::files_below;
use super::picture::{Content, Listing, Picture, Place};
use crate::Error;
use crate::files::{json, listing, npy};

/// Endings of arrays.
pub(super) const ENDINGS: [&str; 2] = ["npy", "npz"];

/// More values are not taken at once.
const MAX_VALUES: usize = 1 << 27;

/// Name, place, size and values of a picture.
type Ids = (String, Place, (u32, u32), Vec<u16>);

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let files: BTreeMap<String, PathBuf> = if source.is_dir() {
        files_below(source, &ENDINGS)?
    } else {
        BTreeMap::from([(listing::stem(source), source.to_owned())])
    };
    let alone = files.len() == 1;
    let mut classes = BTreeMap::new();
    for path in files.values() {
        add_classes(path, &mut classes)?;
    }
    let (mut pictures, mut values) = (Vec::new(), 0);
    for (name, path) in files {
        let found = read(&path, name, alone)?;
        values += found.iter().map(|(.., ids)| ids.len()).sum::<usize>();
        if values > MAX_VALUES {
            return Err(Error::invalid(
                &path,
                format!("more than {MAX_VALUES} ids at once; save the masks as PNG files, one per frame"),
            ));
        }
        pictures.extend(found);
    }
    let mut table: Vec<Option<usize>> = vec![None; 1 << 16];
    let mut result = Listing::default();
    for (.., ids) in &pictures {
        for run in ids.chunk_by(|a, b| a == b) {
            table[usize::from(run[0])] = Some(0);
        }
    }
    for id in 1..=u16::MAX {
        if table[usize::from(id)].is_some() {
            let class = classes.get(&id).map(String::as_str);
            let object =
                result.objects.enter_id(id, class).map_err(|problem| Error::invalid(source, problem))?;
            table[usize::from(id)] = Some(object);
        }
    }
    table[0] = None;
    let table = Arc::new(table);
    result.pictures = pictures
        .into_iter()
        .map(|(name, place, size, ids)| {
            let content = Content::Ids(Arc::clone(&table), ids);
            Picture { name, place, size: Some(size), content }
        })
        .collect();
    Ok(result)
}

/// Description of the ids of an array by Grounded SAM 2.
#[derive(Deserialize)]
struct Described {
    #[serde(default)]
    labels: BTreeMap<String, Class>,
}

#[derive(Deserialize)]
struct Class {
    instance_id: u16,
    class_name: String,
}

/// Adds the classes that are given for the ids of an array, where they are; the first of an id counts.
fn add_classes(array: &Path, classes: &mut BTreeMap<u16, String>) -> Result<(), Error> {
    let Some(folder) = array.parent().filter(|folder| folder.ends_with("mask_data")) else { return Ok(()) };
    let path = folder.with_file_name("json_data").join(format!("{}.json", listing::stem(array)));
    if listing::is_there(&path) {
        for Class { instance_id, class_name } in json::read::<Described>(&path)?.labels.into_values() {
            if !class_name.trim().is_empty() {
                classes.entry(instance_id).or_insert(class_name);
            }
        }
    }
    Ok(())
}

/// Pictures of a file.
fn read(path: &Path, name: String, alone: bool) -> Result<Vec<Ids>, Error> {
    let npy::Array { shape, values: ids } = npy::read_ids(path)?;
    let side = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
    match *shape {
        [height, width] => Ok(vec![(name, Place::file(path), (side(width), side(height)), ids)]),
        [_, height, width] if alone && height * width > 0 => {
            let picture = |(k, ids): (usize, &[u16])| {
                (
                    k.to_string(),
                    Place::entry(path, format!("frame {k}")),
                    (side(width), side(height)),
                    ids.to_vec(),
                )
            };
            Ok(ids.chunks_exact(height * width).enumerate().map(picture).collect())
        }
        _ => Err(Error::invalid(
            path,
            format!(
                "shape {:?}; ids as [height, width] in a file per frame, or [frames, height, width] in one file, are \
                 expected",
                shape
            ),
        )),
    }
}
