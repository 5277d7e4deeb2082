//! Inputs that a product was made from: content of files, and settings. One notion for every product that is kept, be it a step
//! of `cif make`, a run that goes on, or a measurement: it is good for as long as nothing that it was made from differs.
//!
//! Files are known by their content (XXH3, 128 bits), which is read only where size or times differ from those that were
//! seen with it, so that asking again is cheap. That distinguishes files that were changed or mixed up, not files that were
//! forged.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::Metadata;
use std::io::Read;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use xxhash_rust::xxh3::{Xxh3, xxh3_128};

use crate::files::listing;
use crate::{Dataset, Frame, PointSource};

/// Bytes that are read at a time.
const PIECE: usize = 1 << 18;

/// Longest value that is printed, characters.
const LONGEST_VALUE: usize = 60;

/// Inputs that a product was made from.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct MadeFrom {
    /// Files and parts of captures by what they are, as a subject of a sentence: `the mask of frame 000003`.
    inputs: BTreeMap<String, Stamp>,
    /// Settings and the like by name.
    #[serde(flatten)]
    values: Map<String, Value>,
}

/// Content of an input.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Stamp {
    /// Hexadecimal digits of its hash; empty for a file that cannot be read.
    content: String,
    /// The file when this was its content.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    seen: Option<Seen>,
}

/// Size and times of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Seen {
    /// Bytes.
    bytes: u64,
    /// Times of modification and, where the system has one, of change of the entry, nanoseconds since 1970.
    times: [i64; 2],
}

impl MadeFrom {
    /// Nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds files, each by what it is. Those that are as `known` has seen them are not read.
    pub fn files(
        &mut self,
        files: impl IntoIterator<Item = (String, PathBuf)>,
        known: Option<&Self>,
    ) -> &mut Self {
        let files: Vec<(String, PathBuf)> = files.into_iter().collect();
        let stamps = files.into_par_iter().map(|(name, path)| {
            let stamp = Stamp::of(&path, known.and_then(|known| known.inputs.get(&name)));
            (name, stamp)
        });
        self.inputs.extend(stamps.collect::<Vec<_>>());
        self
    }

    /// Adds the files of a folder and below, by their names behind `kind`; hidden ones, such as caches, do not count.
    pub fn folder(&mut self, kind: &str, folder: &Path, known: Option<&Self>) -> &mut Self {
        // Whoever needs a folder that cannot be read refuses it.
        let found = listing::below(folder).unwrap_or_default();
        let named = |path: PathBuf| {
            let name = path.strip_prefix(folder).unwrap_or(&path).display().to_string();
            (format!("{kind} {name}"), path)
        };
        self.files(found.into_iter().map(named), known)
    }

    /// Adds a value.
    pub fn value(&mut self, name: &str, value: impl Serialize) -> &mut Self {
        // Settings are plain data.
        self.values.insert(name.to_owned(), serde_json::to_value(value).unwrap_or_default());
        self
    }

    /// Adds a capture: images, masks and their confidence, cameras, times and splits, points, labels.
    pub fn capture(&mut self, dataset: &Dataset, known: Option<&Self>) -> &mut Self {
        let mut files = Vec::new();
        for frame in &dataset.frames {
            let name = &frame.name;
            let camera =
                (&frame.camera, &frame.lens, frame.time, frame.split, &frame.group, &frame.camera_name);
            self.part(format!("the camera, time or split of frame {name}"), &camera);
            files.push((image_of(frame), frame.image.clone()));
            files.extend(frame.mask.clone().map(|mask| (format!("the mask of frame {name}"), mask)));
            let confidence = frame.confidence.clone();
            files
                .extend(confidence.map(|file| (format!("the confidence of the mask of frame {name}"), file)));
        }
        if let PointSource::File(path) = &dataset.points.source {
            files.push(("the file of initial points".to_owned(), path.clone()));
        }
        for instance in &dataset.instances {
            self.part(format!("the label of instance {}", instance.id), instance);
        }
        self.files(files, known)
    }

    /// Adds everything that something else was made from; the names of its inputs end in `qualifier`.
    pub fn extend(&mut self, other: &Self, qualifier: &str) -> &mut Self {
        let named = |(name, stamp): (&String, &Stamp)| (format!("{name}{qualifier}"), stamp.clone());
        self.inputs.extend(other.inputs.iter().map(named));
        self.values.extend(other.values.clone());
        self
    }

    /// The same without sizes and times of files: for products that are compared byte by byte.
    #[must_use]
    pub fn by_content(&self) -> Self {
        let bare = |stamp: &Stamp| Stamp { content: stamp.content.clone(), seen: None };
        let inputs = self.inputs.iter().map(|(name, stamp)| (name.clone(), bare(stamp))).collect();
        Self { inputs, values: self.values.clone() }
    }

    /// Hexadecimal digits that are the same for the same content and values.
    #[must_use]
    pub fn digest(&self) -> String {
        let text = serde_json::to_vec(&self.by_content()).unwrap_or_default();
        format!("{:032x}", xxh3_128(&text))
    }

    /// The inputs whose names are `requested`, and no values.
    pub(crate) fn only(&self, requested: impl Fn(&str) -> bool) -> Self {
        let inputs = self.inputs.iter().filter(|(name, _)| requested(name));
        let inputs = inputs.map(|(name, stamp)| (name.clone(), stamp.clone())).collect();
        Self { inputs, values: Map::new() }
    }

    fn part(&mut self, name: String, value: &impl Serialize) {
        let text = serde_json::to_vec(value).unwrap_or_default();
        self.inputs.insert(name, Stamp { content: format!("{:032x}", xxh3_128(&text)), seen: None });
    }

    /// The difference from `now`, as a sentence without a full stop that names it; `None` where nothing does.
    #[must_use]
    pub fn difference(&self, now: &Self) -> Option<String> {
        let mut found = Vec::new();
        let names: BTreeSet<&String> = self.inputs.keys().chain(now.inputs.keys()).collect();
        for name in names {
            match (self.inputs.get(name), now.inputs.get(name)) {
                (Some(before), Some(now)) if before.content == now.content => {}
                (Some(_), Some(_)) => found.push(format!("{name} has changed")),
                (Some(_), None) => found.push(format!("{name} is gone")),
                (None, _) => found.push(format!("{name} is new")),
            }
        }
        let [before, now] = [self, now].map(|of| Value::Object(of.values.clone()));
        compare("", &before, &now, &mut found);
        let first = found.first()?;
        Some(match found.len() - 1 {
            0 => first.clone(),
            1 => format!("{first}, and {}", found[1]),
            more => format!("{first}, and {more} other things differ"),
        })
    }
}

impl PartialEq for MadeFrom {
    /// By content alone.
    fn eq(&self, other: &Self) -> bool {
        self.difference(other).is_none()
    }
}

/// The name of the image of a frame among inputs.
pub(crate) fn image_of(frame: &Frame) -> String {
    format!("the image of frame {}", frame.name)
}

/// Adds the values that differ, each by its keys.
fn compare(place: &str, before: &Value, now: &Value, found: &mut Vec<String>) {
    if let (Value::Object(old), Value::Object(new)) = (before, now) {
        let keys: BTreeSet<&String> = old.keys().chain(new.keys()).collect();
        for key in keys {
            let place = if place.is_empty() { key.clone() } else { format!("{place}.{key}") };
            let at = |of: &Map<String, Value>| of.get(key).cloned().unwrap_or_default();
            compare(&place, &at(old), &at(new), found);
        }
    } else if before != now {
        let shown = [before, now].map(|value| match value {
            Value::Null => "nothing".to_owned(),
            value => value.to_string(),
        });
        found.push(match shown.iter().all(|value| value.chars().count() <= LONGEST_VALUE) {
            true => format!("{place} was {} and is {}", shown[0], shown[1]),
            false => format!("{place} has changed"),
        });
    }
}

impl Stamp {
    fn of(path: &Path, known: Option<&Self>) -> Self {
        let seen = std::fs::metadata(path).ok().map(|found| Seen::of(&found));
        if let Some(known) = known.filter(|known| seen.is_some() && known.seen == seen) {
            return known.clone();
        }
        // Whoever needs what cannot be read reports it.
        Self { content: content(path).unwrap_or_default(), seen }
    }
}

impl Seen {
    fn of(found: &Metadata) -> Self {
        #[cfg(unix)]
        let times = {
            use std::os::unix::fs::MetadataExt;
            let nanoseconds =
                |seconds: i64, rest: i64| seconds.saturating_mul(1_000_000_000).saturating_add(rest);
            [nanoseconds(found.mtime(), found.mtime_nsec()), nanoseconds(found.ctime(), found.ctime_nsec())]
        };
        #[cfg(not(unix))]
        let times = {
            let modified = found.modified().ok().and_then(|at| at.duration_since(std::time::UNIX_EPOCH).ok());
            [modified.map_or(0, |since| i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)), 0]
        };
        Self { bytes: found.len(), times }
    }
}

fn content(path: &Path) -> std::io::Result<String> {
    let mut file = cif_input::open(path)?;
    let mut hash = Xxh3::new();
    let mut piece = vec![0; PIECE];
    loop {
        match file.read(&mut piece)? {
            0 => return Ok(format!("{:032x}", hash.digest128())),
            read => hash.update(&piece[..read]),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_difference_names_what_differs() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        let now = |seed: u32, known: Option<&MadeFrom>| {
            let mut made = MadeFrom::new();
            made.folder("keyframe", folder.path(), known).value("settings", json!({ "a": { "seed": seed } }));
            made
        };
        write("1.png", "one");
        write("2.png", "two");
        write(".cache", "x");
        let before = now(0, None);
        assert_eq!(before.difference(&now(0, Some(&before))), None);
        assert_eq!(before.difference(&now(5, None)).unwrap(), "settings.a.seed was 0 and is 5");
        // Of the same size.
        write("2.png", "owt");
        assert_eq!(before.difference(&now(0, Some(&before))).unwrap(), "keyframe 2.png has changed");
        // Written again with the same content, by another name, and read back.
        write("2.png", "two");
        let text = serde_json::to_string(&before).unwrap();
        let before: MadeFrom = serde_json::from_str(&text).unwrap();
        assert_eq!(before, now(0, Some(&before)));
        assert_eq!(before.by_content(), now(0, None));
        assert_eq!(before.digest(), now(0, None).digest());
        assert_ne!(before.digest(), now(1, None).digest());
        std::fs::rename(folder.path().join("2.png"), folder.path().join("3.png")).unwrap();
        let message = before.difference(&now(0, None)).unwrap();
        assert_eq!(message, "keyframe 2.png is gone, and keyframe 3.png is new");
    }

    #[test]
    fn files_are_read_again_only_where_size_or_times_differ() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, "one").unwrap();
        let of = |known: Option<&MadeFrom>| {
            let mut made = MadeFrom::new();
            made.files([("a".to_owned(), path.clone())], known);
            made
        };
        let mut known = of(None);
        known.inputs.get_mut("a").unwrap().content = "not read".to_owned();
        assert_eq!(of(Some(&known)).inputs["a"].content, "not read");
        std::fs::write(&path, "four").unwrap();
        assert_ne!(of(Some(&known)).inputs["a"].content, "not read");
    }
}
