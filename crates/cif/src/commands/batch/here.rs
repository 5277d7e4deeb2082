//! The engine of this machine: jobs side by side, within its threads and its memory.

use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use cif_batch::Batch;
use cif_batch::record::{Record, State};
use cif_batch::schedule::{Limits, Next, Schedule, Standing};

use super::board::{Board, duration};
use super::inputs::Inputs;
use super::one::{self, Job, Outcome};
use super::report;
use crate::error::Error;
use crate::interrupt;
use crate::report::Report;

/// Time between two looks at what runs.
const LOOK: Duration = Duration::from_millis(500);

/// Time after which a job that another process has is tried again.
const AGAIN: Duration = Duration::from_secs(5);

/// Runs all jobs of a batch that are not done.
///
/// # Errors
/// When a job failed, the user stopped it, or a record cannot be written.
pub(super) fn run(batch: &Batch, limits: Limits, report: &Report) -> Result<(), Error> {
    interrupt::watch_and_save();
    let inputs = Inputs::new(batch);
    let begun = Instant::now();
    let ended = share_out(batch, limits, &inputs)?;
    if ended.interrupted {
        return Err(Error::Interrupted {
            message: format!(
                "interrupted; {} of {} jobs are done",
                ended.done + ended.kept,
                batch.jobs.len()
            ),
            help: Some("run the same command again to continue".to_owned()),
        });
    }
    crate::messages::outcome!(
        "{} jobs in {}: {} done, {} kept, {} failed, {} left out",
        batch.jobs.len(),
        duration(begun.elapsed().as_secs_f64()),
        ended.done,
        ended.kept,
        ended.failed,
        ended.left_out
    );
    crate::messages::outcome!("all scenes: {}", batch.place(&batch.output).join("index.html").display());
    let states = || report::JobState::of_all(batch, &inputs);
    report.give(|| report::BatchReport::new(batch, states()), || ())?;
    verdict(batch)
}

/// Ends with an error where a job of a batch has failed, so that whoever waits for it notices.
///
/// # Errors
/// When one has.
pub(super) fn verdict(batch: &Batch) -> Result<(), Error> {
    let failed =
        |job: &&cif_batch::Job| Record::read(batch, job).is_some_and(|record| record.state == State::Failed);
    let failed: Vec<String> = batch
        .jobs
        .iter()
        .filter(failed)
        .map(|job| format!("{}: {}", job.id, batch.file_of(job, "log").display()))
        .collect();
    match failed.as_slice() {
        [] => Ok(()),
        failed => Err(Error::failed(
            format!(
                "{} of {} jobs failed; their logs:\n{}",
                failed.len(),
                batch.jobs.len(),
                failed.join("\n")
            ),
            "mend what they say and run the same command again: what is done is kept",
        )),
    }
}

/// How the jobs ended.
#[derive(Default)]
struct Ended {
    done: usize,
    kept: usize,
    failed: usize,
    left_out: usize,
    interrupted: bool,
}

fn share_out(batch: &Batch, limits: Limits, inputs: &Inputs<'_>) -> Result<Ended, Error> {
    let mut schedule = Schedule::new(batch, limits, |_| true);
    for (index, job) in batch.jobs.iter().enumerate() {
        if let Some(record) = Record::read(batch, job) {
            schedule.saw(index, record.spent.peak_bytes);
        }
    }
    let mut board = Board::new(batch);
    let mut ended = Ended::default();
    let mut aside: Vec<(usize, Instant)> = Vec::new();
    let (sender, receiver) = channel();
    let mut first_error = None;
    std::thread::scope(|scope| {
        loop {
            let stops = interrupt::requested() || first_error.is_some();
            ended.interrupted |= interrupt::requested();
            aside.retain(|(job, since)| {
                let waits = since.elapsed() < AGAIN;
                if !waits {
                    schedule.give_back(*job);
                }
                waits
            });
            while !stops && let Some(Next { job: index, threads }) = schedule.begin_next() {
                board.begins(index, threads);
                let sender = sender.clone();
                scope.spawn(move || {
                    let job = Job { batch, index, threads: Some(threads), wait: false };
                    // It is heard for as long as jobs run.
                    let _ = sender.send((index, one::run(&job, inputs)));
                });
            }
            if schedule.running() == 0 && (stops || aside.is_empty()) {
                break;
            }
            match receiver.recv_timeout(LOOK) {
                Ok((index, Ok(outcome))) => {
                    take(batch, index, &outcome, &mut schedule, &mut board, &mut ended);
                    if outcome == Outcome::Elsewhere {
                        aside.push((index, Instant::now()));
                    }
                }
                Ok((index, Err(error))) => {
                    schedule.put_aside(index);
                    board.pauses(index);
                    first_error.get_or_insert(error);
                }
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => board.refresh(limits.jobs),
            }
        }
    });
    board.close();
    first_error.map_or(Ok(ended), Err)
}

fn take(
    batch: &Batch,
    index: usize,
    outcome: &Outcome,
    schedule: &mut Schedule<'_>,
    board: &mut Board<'_>,
    ended: &mut Ended,
) {
    match outcome {
        Outcome::Done(spent) => {
            schedule.saw(index, spent.peak_bytes);
            ended.done += 1;
        }
        Outcome::Kept => ended.kept += 1,
        Outcome::Failed(_) => ended.failed += 1,
        Outcome::Elsewhere => {
            schedule.put_aside(index);
            board.pauses(index);
            return;
        }
        Outcome::Interrupted => {
            schedule.put_aside(index);
            board.pauses(index);
            ended.interrupted = true;
            return;
        }
    }
    board.ends(index, outcome);
    let well = !matches!(outcome, Outcome::Failed(_));
    for left_out in schedule.ended(index, well) {
        debug_assert_eq!(schedule.standing(left_out), Standing::LeftOut, "{}", batch.jobs[left_out].id);
        board.leaves_out(left_out, index);
        ended.left_out += 1;
    }
}
