//! The report of `cif batch --json`.

use cif_batch::Batch;
use cif_batch::record::{Kept, Record, Spent, State};
use serde::Serialize;

use super::inputs::Inputs;
use crate::report::JsonReport;

/// Jobs of a batch.
#[derive(Serialize)]
pub(super) struct BatchReport {
    /// The page over all scenes.
    page: std::path::PathBuf,
    /// Every job.
    jobs: Vec<JobState>,
}

/// A job.
#[derive(Clone, Serialize)]
pub(super) struct JobState {
    /// Name.
    pub(super) id: String,
    /// `to do`, `waits` for others, `begun`, `done`, or `failed` and `to do again` with the reason.
    pub(super) state: String,
    /// Resources that it took; 0 for what is not known.
    pub(super) spent: Spent,
    /// Number of jobs that it needs.
    needs: usize,
}

impl JobState {
    /// All jobs of a batch.
    pub(super) fn of_all(batch: &Batch, inputs: &Inputs<'_>) -> Vec<Self> {
        (0..batch.jobs.len()).map(|index| Self::of(batch, index, inputs)).collect()
    }

    fn of(batch: &Batch, index: usize, inputs: &Inputs<'_>) -> Self {
        let job = &batch.jobs[index];
        let (state, record) = match inputs.made_from(index) {
            Err(_) => ("waits".to_owned(), Record::read(batch, job)),
            Ok(now) => match Kept::of(batch, job, &now) {
                Kept::Missing => ("to do".to_owned(), None),
                Kept::Good(record) => ("done".to_owned(), Some(record)),
                Kept::Unfinished(record) => ("begun".to_owned(), Some(record)),
                Kept::Void(record, why) if record.state == State::Failed => {
                    (format!("failed: {}", record.error.clone().unwrap_or(why)), Some(record))
                }
                Kept::Void(record, why) => (format!("to do again: {why}"), Some(record)),
            },
        };
        let spent = record.map_or(Spent::default(), |record| record.spent);
        Self { id: job.id.clone(), state, spent, needs: job.needs.len() }
    }
}

impl BatchReport {
    pub(super) fn new(batch: &Batch, jobs: Vec<JobState>) -> Self {
        Self { page: batch.place(&batch.output).join("index.html"), jobs }
    }
}

impl JsonReport for BatchReport {
    const COMMANDS: &'static [&'static str] = &["cif batch", "cif batch --list"];
}
