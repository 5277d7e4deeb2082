//! Records of jobs that ran, by which their results hold or do not.

use std::path::Path;

use cif_system::Error;
use serde::{Deserialize, Serialize};

use crate::job::{Batch, Job};

/// How far a job is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// It was begun; whoever ran it may be gone.
    Begun,
    /// It ended well.
    Done,
    /// It ended with an error.
    Failed,
}

/// A job that was begun.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// How far it is.
    pub state: State,
    /// Everything that it was made from.
    pub made_from: MadeFrom,
    /// Mark of this making: another one each time that it is done, so that what was made from its results is made anew.
    pub mark: String,
    /// Machine.
    pub host: String,
    /// Times that it was begun.
    pub attempts: u32,
    /// When it was begun last, RFC 3339.
    pub begun: String,
    /// Resources that it took; of a job that was interrupted, all its attempts together.
    pub spent: Spent,
    /// Last line of its log, where it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// Inputs that a job was made from.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MadeFrom {
    /// Version of cif.
    pub version: String,
    /// The command.
    pub command: Vec<String>,
    /// Content of its capture; empty without one.
    pub capture: String,
    /// Marks of the jobs that it needs.
    pub needs: Vec<String>,
}

impl MadeFrom {
    /// The difference, as a clause; `None` where nothing does.
    #[must_use]
    pub fn difference(&self, now: &Self) -> Option<&'static str> {
        if self.version != now.version {
            Some("another version of cif made it")
        } else if self.command != now.command {
            Some("its command has changed")
        } else if self.capture != now.capture {
            Some("its capture has changed")
        } else if self.needs != now.needs {
            Some("what it needs was made again")
        } else {
            None
        }
    }
}

/// Resources that a job took. Where the system does not say, a value is 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spent {
    /// Time that passed, seconds.
    pub wall_s: f64,
    /// Time of processors, all threads together, seconds.
    pub cpu_s: f64,
    /// Largest resident memory, bytes.
    pub peak_bytes: u64,
    /// Bytes that it read from files, out of caches too.
    pub read_bytes: u64,
    /// Bytes that it wrote to files.
    pub written_bytes: u64,
}

impl Spent {
    /// Both together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            wall_s: self.wall_s + other.wall_s,
            cpu_s: self.cpu_s + other.cpu_s,
            peak_bytes: self.peak_bytes.max(other.peak_bytes),
            read_bytes: self.read_bytes + other.read_bytes,
            written_bytes: self.written_bytes + other.written_bytes,
        }
    }
}

/// Results of a job.
#[derive(Clone, Debug, PartialEq)]
pub enum Kept {
    /// It was not begun, or its files are gone.
    Missing,
    /// They hold.
    Good(Record),
    /// It was begun from what there is now, and not ended.
    Unfinished(Record),
    /// It was begun from something else, or failed; why it is done again.
    Void(Record, String),
}

impl Record {
    /// Reads the record of a job; `None` where there is none that can be read.
    #[must_use]
    pub fn read(batch: &Batch, job: &Job) -> Option<Self> {
        let text = std::fs::read_to_string(batch.file_of(job, "json")).ok()?;
        serde_json::from_str(&text).ok()
    }

    /// The record as it is written.
    ///
    /// # Errors
    /// Never; records are plain data.
    pub fn text(&self) -> Result<String, Error> {
        serde_json::to_string_pretty(self).map_err(|error| {
            Error::refused(format!("a record cannot be JSON: {error}"), "this is a fault of cif")
        })
    }
}

impl Kept {
    /// Results of a job that would be made from `now`.
    #[must_use]
    pub fn of(batch: &Batch, job: &Job, now: &MadeFrom) -> Self {
        let Some(record) = Record::read(batch, job) else { return Self::Missing };
        if let Some(why) = record.made_from.difference(now) {
            return Self::Void(record, why.to_owned());
        }
        match record.state {
            State::Begun => Self::Unfinished(record),
            State::Failed => Self::Void(record, "it had failed".to_owned()),
            State::Done if job.makes.iter().all(|made| batch.place(made).exists()) => Self::Good(record),
            State::Done => Self::Missing,
        }
    }
}

/// Beginning of the line of a log that shows the command.
pub const COMMAND: &str = "$ ";

/// Last line of a log that says anything: the error, where there is one.
#[must_use]
pub fn last_words(log: &Path) -> Option<String> {
    let text = String::from_utf8_lossy(&std::fs::read(log).ok()?).into_owned();
    let says = |line: &&str| !line.trim().is_empty() && !line.starts_with(COMMAND);
    let error = text.lines().rfind(|line| line.starts_with("Error")).or_else(|| text.lines().rfind(says))?;
    let line = error.trim_start_matches("Error:").trim().trim_start_matches(['×', 'x']).trim();
    Some(line.chars().take(300).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::EngineOptions;

    #[test]
    fn results_hold_until_what_they_were_made_from_changes() {
        let folder = tempfile::tempdir().unwrap();
        let job = Job {
            id: "train/a".to_owned(),
            step: 0,
            words: vec!["train".to_owned()],
            needs: Vec::new(),
            makes: vec!["a.cif".into()],
            capture: None,
            goes_on: true,
        };
        let batch = Batch {
            name: "plan".to_owned(),
            plan: folder.path().join("plan.toml"),
            folder: folder.path().to_owned(),
            output: "results".into(),
            steps: Vec::new(),
            jobs: vec![job.clone()],
            engines: EngineOptions::default(),
        };
        let now = MadeFrom { version: "1".to_owned(), command: job.words.clone(), ..MadeFrom::default() };
        assert_eq!(Kept::of(&batch, &job, &now), Kept::Missing);
        let mut record = Record {
            state: State::Begun,
            made_from: now.clone(),
            mark: "m".to_owned(),
            host: String::new(),
            attempts: 1,
            begun: String::new(),
            spent: Spent::default(),
            error: None,
        };
        let path = batch.file_of(&job, "json");
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let keep = |record: &Record| std::fs::write(&path, record.text().unwrap()).unwrap();
        keep(&record);
        assert_eq!(Kept::of(&batch, &job, &now), Kept::Unfinished(record.clone()));
        record.state = State::Done;
        keep(&record);
        assert_eq!(Kept::of(&batch, &job, &now), Kept::Missing, "its file is not there");
        std::fs::write(folder.path().join("a.cif"), "").unwrap();
        assert_eq!(Kept::of(&batch, &job, &now), Kept::Good(record.clone()));
        for (other, why) in [
            (MadeFrom { version: "2".to_owned(), ..now.clone() }, "another version"),
            (MadeFrom { command: Vec::new(), ..now.clone() }, "command"),
            (MadeFrom { capture: "other".to_owned(), ..now.clone() }, "capture"),
            (MadeFrom { needs: vec!["n".to_owned()], ..now.clone() }, "made again"),
        ] {
            let Kept::Void(_, said) = Kept::of(&batch, &job, &other) else { panic!("{why}") };
            assert!(said.contains(why), "{said}");
        }
        std::fs::write(&path, "{").unwrap();
        assert_eq!(Kept::of(&batch, &job, &now), Kept::Missing);
    }

    #[test]
    fn errors_of_logs_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        for (text, found) in [
            ("step 1\nError:  × a.png: damaged\n  help: replace it\n", Some("a.png: damaged")),
            ("$ cif train a\nkilled\n\n", Some("killed")),
            ("$ cif train a\n", None),
            ("\n", None),
        ] {
            std::fs::write(&log, text).unwrap();
            assert_eq!(last_words(&log).as_deref(), found);
        }
    }
}
