//! Jobs, and how they are named on a command line.

use std::ops::Range;
use std::path::{Path, PathBuf};

use cif_system::Error;

use crate::plan::{EngineOptions, Resources};

/// An expanded plan.
#[derive(Clone, Debug)]
pub struct Batch {
    /// Name: that of the file of the plan, without its ending.
    pub name: String,
    /// The file of the plan.
    pub plan: PathBuf,
    /// Folder that jobs run in, and that their paths are relative to: that of the plan.
    pub folder: PathBuf,
    /// Folder of all results, relative to [`Self::folder`].
    pub output: PathBuf,
    /// Steps, each after those that it needs.
    pub steps: Vec<Step>,
    /// Jobs, those of a step in a row.
    pub jobs: Vec<Job>,
    /// Options of the engines of farms.
    pub engines: EngineOptions,
}

/// Jobs of one kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// Name.
    pub name: String,
    /// Its jobs.
    pub jobs: Range<usize>,
    /// Steps whose jobs its own need.
    pub needs: Vec<usize>,
    /// Share of a machine that a job takes.
    pub resources: Resources,
}

/// One command.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Name: that of the step, then that of what it works on, as in `train/table/draft.seed1`.
    pub id: String,
    /// Step.
    pub step: usize,
    /// The command of cif without its first word.
    pub words: Vec<String>,
    /// Jobs that come first.
    pub needs: Vec<usize>,
    /// Files and folders that it makes.
    pub makes: Vec<PathBuf>,
    /// Capture that it reads.
    pub capture: Option<PathBuf>,
    /// True for a training, which goes on from what an interrupted one has saved.
    pub goes_on: bool,
}

impl Batch {
    /// Folder of the records and the logs of jobs, relative to [`Self::folder`].
    #[must_use]
    pub fn records(&self) -> PathBuf {
        self.output.join("jobs")
    }

    /// A file that belongs to a job, `jobs/ID.EXTENSION`, from where this process is.
    #[must_use]
    pub fn file_of(&self, job: &Job, extension: &str) -> PathBuf {
        self.folder.join(self.records()).join(format!("{}.{extension}", job.id))
    }

    /// A path of the plan, from where this process is.
    #[must_use]
    pub fn place(&self, path: &Path) -> PathBuf {
        self.folder.join(path)
    }

    /// Jobs that a text names: an id, `STEP` for all of a step, or `STEP:N` and `STEP:N-M` by number from 0.
    ///
    /// # Errors
    /// When there are none of that name.
    pub fn named(&self, text: &str) -> Result<Range<usize>, Error> {
        if let Some(job) = self.jobs.iter().position(|job| job.id == text) {
            return Ok(job..job + 1);
        }
        let (name, numbers) =
            text.split_once(':').map_or((text, None), |(name, numbers)| (name, Some(numbers)));
        let found = self.steps.iter().find(|step| step.name == name).and_then(|step| {
            let Some(numbers) = numbers else { return Some(step.jobs.clone()) };
            let (first, last) = numbers.split_once('-').unwrap_or((numbers, numbers));
            let (first, last): (usize, usize) = (first.parse().ok()?, last.parse().ok()?);
            // The last of an array may have fewer.
            let end = step.jobs.end.min(step.jobs.start.checked_add(last)?.checked_add(1)?);
            let begin = step.jobs.start.checked_add(first)?;
            (begin < end).then_some(begin..end)
        });
        found.ok_or_else(|| {
            let steps: Vec<String> =
                self.steps.iter().map(|step| format!("{} ({})", step.name, step.jobs.len())).collect();
            Error::refused(
                format!("{} has no job `{text}`", self.plan.display()),
                format!("name an id of --list, or a step and numbers from 0 as in train:0-9; steps and their jobs: {}", steps.join(", ")),
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jobs_are_named_by_id_step_or_number() {
        let job = |id: &str, step| Job {
            id: id.to_owned(),
            step,
            words: Vec::new(),
            needs: Vec::new(),
            makes: Vec::new(),
            capture: None,
            goes_on: false,
        };
        let step = |name: &str, jobs| Step {
            name: name.to_owned(),
            jobs,
            needs: Vec::new(),
            resources: Resources::default(),
        };
        let batch = Batch {
            name: "plan".to_owned(),
            plan: "plan.toml".into(),
            folder: ".".into(),
            output: "results".into(),
            steps: vec![step("train", 0..3), step("eval", 3..4)],
            jobs: vec![job("train/a", 0), job("train/b", 0), job("train/c", 0), job("eval/a", 1)],
            engines: EngineOptions::default(),
        };
        for (text, jobs) in
            [("train/b", 1..2), ("train", 0..3), ("train:2", 2..3), ("train:1-9", 1..3), ("eval:0", 3..4)]
        {
            assert_eq!(batch.named(text).unwrap(), jobs, "{text}");
        }
        for text in ["train:3", "train:2-1", "train:x", "traim", "", "train:18446744073709551615"] {
            let error = batch.named(text).unwrap_err().to_string();
            assert!(error.contains("has no job"), "{error}");
        }
    }
}
