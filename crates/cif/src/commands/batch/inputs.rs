//! Inputs of the jobs of a batch, captures by their content.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use cif_batch::record::{MadeFrom, Record, State};
use cif_batch::steps::COLLECT;
use cif_batch::{Batch, Job};
use clap::{CommandFactory, Parser};

use crate::commands::shared::CaptureOptions;
use crate::output;

/// Inputs of jobs; the content of each capture is found out once.
pub(super) struct Inputs<'a> {
    batch: &'a Batch,
    /// By capture and the options that say how it is read.
    captures: Mutex<HashMap<(PathBuf, Vec<String>), String>>,
}

/// Options that say how a capture is read.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    capture: CaptureOptions,
}

impl<'a> Inputs<'a> {
    pub(super) fn new(batch: &'a Batch) -> Self {
        Self { batch, captures: Mutex::default() }
    }

    /// Inputs that a job would be made from now.
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
        let options = capture_options(&job.words);
        let key = (capture.to_owned(), options);
        let mut captures = self.captures.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = captures.get(&key) {
            return known.clone();
        }
        let found = self.read(capture, &key.1).unwrap_or_default();
        captures.insert(key, found.clone());
        found
    }

    fn read(&self, capture: &Path, options: &[String]) -> Option<String> {
        let words = std::iter::once("cif").chain(options.iter().map(String::as_str));
        let parsed = Options::try_parse_from(words).ok()?.capture.options();
        let dataset = cif_dataset::Dataset::open(self.batch.place(capture), &parsed).ok()?;
        let name = capture.file_name().unwrap_or_default().to_string_lossy();
        let name = if options.is_empty() { name.into_owned() } else { format!("{name}-{}", digest(options)) };
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

/// The options of a command that say how its capture is read; they are the same for all commands.
fn capture_options(words: &[String]) -> Vec<String> {
    let command = Options::command();
    let mut found = Vec::new();
    let mut words = words.iter();
    while let Some(word) = words.next() {
        let Some(flag) = word.strip_prefix("--") else { continue };
        let (name, value) = flag.split_once('=').map_or((flag, None), |(name, value)| (name, Some(value)));
        let Some(argument) = command.get_arguments().find(|argument| argument.get_long() == Some(name))
        else {
            continue;
        };
        found.push(word.clone());
        if argument.get_action().takes_values() && value.is_none() {
            found.extend(words.next().cloned());
        }
    }
    found
}

/// Marks that a record holds one by one, at most.
const MANY: usize = 16;

fn digest(marks: &[String]) -> String {
    cif_dataset::MadeFrom::new().value("marks", marks).digest()
}

#[cfg(test)]
mod tests {
    use super::capture_options;

    #[test]
    fn options_of_captures_are_found_among_others() {
        let line = "train table -o --masks tracked --set a=b --no-masks --downscale=2 --preset draft --help";
        let words: Vec<String> = line.split(' ').map(str::to_owned).collect();
        assert_eq!(capture_options(&words), ["--masks", "tracked", "--no-masks", "--downscale=2"]);
    }
}
