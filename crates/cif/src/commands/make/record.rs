//! Inputs that the steps of `cif make` were made from, in `made.json` next to their results.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_dataset::MadeFrom;
use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::lock::Lock;
use crate::output;

/// Name of the file.
const NAME: &str = "made.json";

/// The steps so far.
#[derive(Debug)]
pub(super) struct Record {
    path: PathBuf,
    steps: BTreeMap<String, Step>,
    /// From before it is read; once the folder is there.
    lock: Option<Lock>,
}

/// A step that was begun.
#[derive(Debug, Serialize, Deserialize)]
struct Step {
    made_from: MadeFrom,
    /// Content of the place of its result when it began.
    before: MadeFrom,
    /// The result as the step left it; `None` until it has ended.
    result: Option<MadeFrom>,
}

/// State of the result of a step.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum State {
    Missing,
    Good,
    /// Something that it was made from has changed, as the sentence says; the result is as the step left it.
    Stale(String),
}

impl Record {
    /// Reads the record of an output folder, where there is one.
    ///
    /// # Errors
    /// When it is there and cannot be read.
    pub(super) fn read(folder: &Path) -> Result<Self, Error> {
        let path = folder.join(NAME);
        let lock = if folder.is_dir() { Some(Lock::take(&path)?) } else { None };
        if !path.exists() {
            return Ok(Self { path, steps: BTreeMap::new(), lock });
        }
        let text = cif_input::read_to_string(&path).map_err(Error::io("read", &path))?;
        let steps = serde_json::from_str(&text).map_err(|error| {
            Error::failed(
                format!("{}: it is not as cif make writes it: {error}", path.display()),
                "remove it; results that are there are taken as they are then",
            )
        })?;
        Ok(Self { path, steps, lock })
    }

    /// Inputs that a step was made from, of which files that have not changed need not be read again.
    pub(super) fn known(&self, step: &str) -> Option<&MadeFrom> {
        self.steps.get(step).map(|step| &step.made_from)
    }

    /// State of the result of a step that would be made from `now`. A result that was made or changed by hand is good
    /// unless it is older than the files `of` which it was made: it is never replaced.
    ///
    /// # Errors
    /// When it is older.
    pub(super) fn state(
        &self,
        step: &str,
        result: &Path,
        now: &MadeFrom,
        of: &[&Path],
    ) -> Result<State, Error> {
        let changed = |path: &Path| std::fs::metadata(path).and_then(|data| data.modified()).ok();
        let Some(made) = changed(result) else { return Ok(State::Missing) };
        let is_as_left =
            |step: &&Step| step.result.as_ref().is_none_or(|left| *left == content(result, Some(left)));
        let is_old =
            |step: &Step| step.result.is_none() && step.before == content(result, Some(&step.before));
        if let Some(step) = self.steps.get(step).filter(is_as_left) {
            let interrupted = || is_old(step).then(|| "making it was interrupted".to_owned());
            let why = step.made_from.difference(now).or_else(interrupted);
            return Ok(why.map_or(State::Good, State::Stale));
        }
        let newer = of.iter().find(|path| changed(path).is_some_and(|changed| changed > made));
        newer.map_or(Ok(State::Good), |newer| {
            Err(Error::failed(
                format!("{} is older than {}, of which it was made", result.display(), newer.display()),
                format!(
                    "it is not as cif make left it, so it is kept; remove it to make it again: {}",
                    result.display()
                ),
            ))
        })
    }

    /// Records that a step begins to make a result.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub(super) fn begin(&mut self, step: &str, result: &Path, made_from: MadeFrom) -> Result<(), Error> {
        self.put(step, Step { made_from, before: content(result, None), result: None })
    }

    /// Records that a step goes on with a result that was begun, be it by hand.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub(super) fn go_on(&mut self, step: &str, made_from: MadeFrom) -> Result<(), Error> {
        self.put(step, Step { made_from, before: MadeFrom::new(), result: None })
    }

    fn put(&mut self, name: &str, step: Step) -> Result<(), Error> {
        if self.lock.is_none() {
            self.lock = Some(Lock::take(&self.path)?);
        }
        self.steps.insert(name.to_owned(), step);
        self.write()
    }

    /// Records that a step that was begun has ended with a result.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub(super) fn end(&mut self, step: &str, result: &Path) -> Result<(), Error> {
        if let Some(step) = self.steps.get_mut(step).filter(|step| step.result.is_none()) {
            step.result = Some(content(result, None));
        }
        self.write()
    }

    fn write(&self) -> Result<(), Error> {
        let text = serde_json::to_vec(&self.steps).expect("plain data");
        output::write_file(&self.path, &text)
    }
}

/// Content of a result, a file or a folder.
fn content(result: &Path, known: Option<&MadeFrom>) -> MadeFrom {
    let mut content = MadeFrom::new();
    if !result.exists() {
        return content;
    }
    match result.is_dir() {
        true => content.folder("the file", result, known),
        false => content.files([("the file".to_owned(), result.to_owned())], known),
    };
    content
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_stale_by_content_and_those_made_by_hand_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let [input, result] = ["input", "result"].map(|name| folder.path().join(name));
        let now = |preset: &str| {
            let mut made = MadeFrom::new();
            made.files([("the input".to_owned(), input.clone())], None).value("preset", preset);
            made
        };
        std::fs::write(&input, "a").unwrap();
        let mut record = Record::read(folder.path()).unwrap();
        let state = |record: &Record, preset: &str| record.state("step", &result, &now(preset), &[&input]);
        assert_eq!(state(&record, "draft").unwrap(), State::Missing);
        record.begin("step", &result, now("draft")).unwrap();
        std::fs::write(&result, "made").unwrap();
        record.end("step", &result).unwrap();
        drop(record);
        let mut record = Record::read(folder.path()).unwrap();
        assert_eq!(state(&record, "draft").unwrap(), State::Good);
        let why = "preset was \"draft\" and is \"standard\"";
        assert_eq!(state(&record, "standard").unwrap(), State::Stale(why.to_owned()));
        std::fs::write(&input, "b").unwrap();
        assert_eq!(state(&record, "draft").unwrap(), State::Stale("the input has changed".to_owned()));
        // By hand.
        std::fs::write(&result, "edited").unwrap();
        assert_eq!(state(&record, "draft").unwrap(), State::Good);
        let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
        std::fs::File::options().write(true).open(&input).unwrap().set_modified(later).unwrap();
        assert!(state(&record, "draft").unwrap_err().to_string().contains("is older than"));
        // Interrupted before and after it had saved something.
        record.begin("step", &result, now("draft")).unwrap();
        let why = State::Stale("making it was interrupted".to_owned());
        assert_eq!(state(&record, "draft").unwrap(), why);
        std::fs::write(&result, "half").unwrap();
        assert_eq!(state(&record, "draft").unwrap(), State::Good);
    }
}
