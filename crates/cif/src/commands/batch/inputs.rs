//! What the jobs of a batch are made from, captures by their content.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use cif_batch::record::{MadeFrom, Record, State};
use cif_batch::steps::COLLECT;
use cif_batch::{Batch, Job};
use clap::Parser;

use crate::commands::shared::CaptureOptions;
use crate::output;

/// Inputs of jobs; the content of each capture is found out once.
pub(super) struct Inputs<'a> {
    batch: &'a Batch,
    captures: Mutex<HashMap<PathBuf, String>>,
}

/// The options of a plan that say which capture is read.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    capture: CaptureOptions,
}

impl<'a> Inputs<'a> {
    pub(super) fn new(batch: &'a Batch) -> Self {
        Self { batch, captures: Mutex::default() }
    }

    /// What a job would be made from now.
    ///
    /// # Errors
    /// With the id of a job that it needs and that is not done.
    pub(super) fn made_from(&self, index: usize) -> Result<MadeFrom, String> {
        let job = &self.batch.jobs[index];
        let needs = job.needs.iter().map(|need| {
            let needed = &self.batch.jobs[*need];
            match Record::read(self.batch, needed) {
                Some(record) if record.state == State::Done => Ok(record.mark),
                // The page over all lists what failed or is missing.
                other if job.id == COLLECT => {
                    Ok(other.map_or_else(String::new, |record| format!("{:?} {}", record.state, record.mark)))
                }
                _ => Err(needed.id.clone()),
            }
        });
        let mut needs = needs.collect::<Result<Vec<_>, _>>()?;
        if needs.len() > MANY {
            needs = vec![digest(&needs)];
        }
        Ok(MadeFrom {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            command: job.words.clone(),
            capture: job.capture.as_deref().map_or_else(String::new, |capture| self.content(job, capture)),
            needs,
        })
    }

    /// Content of a capture, as a digest; empty where it cannot be read, which the job itself reports.
    fn content(&self, job: &Job, capture: &Path) -> String {
        let mut captures = self.captures.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = captures.get(capture) {
            return known.clone();
        }
        let found = self.read(job, capture).unwrap_or_default();
        captures.insert(capture.to_owned(), found.clone());
        found
    }

    fn read(&self, job: &Job, capture: &Path) -> Option<String> {
        let words = std::iter::once("cif").chain(self.batch.capture_options.iter().map(String::as_str));
        let options = Options::try_parse_from(words).ok()?.capture.options();
        let dataset = cif_dataset::Dataset::open(self.batch.place(capture), &options).ok()?;
        let name = job.id.split('/').nth(1).unwrap_or_default();
        let file = self.batch.place(&self.batch.records()).join(format!(".captures/{name}.json"));
        let text = std::fs::read_to_string(&file).unwrap_or_default();
        let known: Option<cif_dataset::MadeFrom> = serde_json::from_str(&text).ok();
        let mut made_from = cif_dataset::MadeFrom::new();
        made_from.capture(&dataset, known.as_ref());
        let now = serde_json::to_string(&made_from).ok()?;
        // Spares others reading the files of the capture; without it they are read.
        if now != text && std::fs::create_dir_all(file.parent()?).is_ok() {
            let _ = output::write_file(&file, now.as_bytes());
        }
        Some(made_from.digest())
    }
}

/// Marks that a record holds one by one, at most.
const MANY: usize = 16;

fn digest(marks: &[String]) -> String {
    cif_dataset::MadeFrom::new().value("marks", marks).digest()
}
