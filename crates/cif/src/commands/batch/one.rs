//! One job: locked, run as a process of its own, and recorded.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use cif_batch::Batch;
use cif_batch::process;
use cif_batch::record::{COMMAND, Kept, MadeFrom, Record, Spent, State, last_words};

use super::inputs::Inputs;
use crate::commands::shared::command_line;
use crate::error::Error;
use crate::lock::{Attempt, Lock};
use crate::{interrupt, output, program};

/// Exit code of a command that was interrupted and has saved.
const INTERRUPTED: i32 = 130;

/// A job to run.
#[derive(Clone, Copy)]
pub(super) struct Job<'a> {
    pub(super) batch: &'a Batch,
    /// The job.
    pub(super) index: usize,
    /// Threads; all where it is `None`.
    pub(super) threads: Option<u32>,
    /// True to wait while another process runs it.
    pub(super) wait: bool,
}

/// How it went.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Outcome {
    /// Its results were there, and hold.
    Kept,
    Done(Spent),
    /// Why.
    Failed(String),
    /// Another process has it.
    Elsewhere,
    Interrupted,
}

/// Runs a job unless its results hold.
///
/// # Errors
/// When its record or its log cannot be written.
pub(super) fn run(job: &Job<'_>, inputs: &Inputs<'_>) -> Result<Outcome, Error> {
    let now = match inputs.made_from(job.index) {
        Ok(now) => now,
        Err(needed) => return Ok(Outcome::Failed(format!("it needs {needed}, which is not done"))),
    };
    let (batch, of) = (job.batch, &job.batch.jobs[job.index]);
    if let Kept::Good(_) = Kept::of(batch, of, &now) {
        return Ok(Outcome::Kept);
    }
    let record = batch.file_of(of, "json");
    if let Some(folder) = record.parent() {
        std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    }
    let _lock = loop {
        match Lock::attempt_once(&record)? {
            Attempt::Taken(lock) => break lock,
            Attempt::Held if !job.wait => return Ok(Outcome::Elsewhere),
            Attempt::Held if interrupt::requested() => return Ok(Outcome::Interrupted),
            Attempt::Held => std::thread::sleep(std::time::Duration::from_secs(1)),
        }
    };
    // Another may have done it meanwhile.
    let kept = Kept::of(batch, of, &now);
    if let Kept::Good(_) = kept {
        return Ok(Outcome::Kept);
    }
    begin(job, now, kept, &record)
}

fn begin(job: &Job<'_>, made_from: MadeFrom, kept: Kept, path: &Path) -> Result<Outcome, Error> {
    let of = &job.batch.jobs[job.index];
    let unfinished = match kept {
        Kept::Unfinished(record) if of.goes_on => Some(record),
        _ => None,
    };
    let goes_on = unfinished.is_some();
    let begun = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let mut record = match unfinished {
        Some(record) => {
            Record { attempts: record.attempts + 1, begun, host: cif_system::host::host(), ..record }
        }
        None => Record {
            state: State::Begun,
            made_from,
            mark: mark(),
            host: cif_system::host::host(),
            attempts: 1,
            begun,
            spent: Spent::default(),
            error: None,
        },
    };
    write(path, &record)?;
    for made in &of.makes {
        if let Some(folder) = job.batch.place(made).parent() {
            std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        }
    }
    let log = job.batch.file_of(of, "log");
    let (status, spent) = start(job, goes_on, &log)?;
    record.spent = record.spent.and(spent);
    let outcome = if status.success() {
        record.state = State::Done;
        Outcome::Done(record.spent)
    } else if status.code() == Some(INTERRUPTED) || interrupt::requested() {
        Outcome::Interrupted
    } else {
        let why = last_words(&log);
        let why = match status.code() {
            Some(_) => why.unwrap_or_else(|| "it says nothing".to_owned()),
            None => format!("{status}; a system that is out of memory ends processes so"),
        };
        (record.state, record.error) = (State::Failed, Some(why.clone()));
        Outcome::Failed(why)
    };
    write(path, &record)?;
    Ok(outcome)
}

/// Runs the command, with what it prints in its log.
fn start(job: &Job<'_>, goes_on: bool, log: &Path) -> Result<(std::process::ExitStatus, Spent), Error> {
    let of = &job.batch.jobs[job.index];
    let opened: File =
        if goes_on { OpenOptions::new().append(true).create(true).open(log) } else { File::create(log) }
            .map_err(Error::io("write", log))?;
    let mut words = of.words.clone();
    words.extend(goes_on.then(|| "--resume-if-begun".to_owned()));
    words.extend(job.threads.iter().flat_map(|threads| ["--threads".to_owned(), threads.to_string()]));
    // As it can be run by hand, in the folder of the plan.
    writeln!(&opened, "{COMMAND}{}", command_line(&words)).map_err(Error::io("write", log))?;
    let errors = opened.try_clone().map_err(Error::io("write", log))?;
    let mut command = program::command();
    command.current_dir(&job.batch.folder).args(&words);
    command.stdin(std::process::Stdio::null()).stdout(opened).stderr(errors);
    process::run(&mut command, &interrupt::requested)
        .map_err(Error::io("run", &PathBuf::from(command.get_program())))
}

fn write(path: &Path, record: &Record) -> Result<(), Error> {
    output::write_file(path, record.text()?.as_bytes())
}

/// A mark that no other making has.
fn mark() -> String {
    format!("{:016x}", rand::random::<u64>())
}
