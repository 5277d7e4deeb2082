//! The jobs of a batch for the engines of farms.
//!
//! Every task of an engine is `cif batch PLAN --job STEP:N --keep-going`: the plan is expanded where the job runs, so that
//! what is handed over stays small, and a job that another worker has done is not done again. A job that fails is recorded and
//! does not stop the batch; the collecting job, which comes last, ends with an error where one has failed. Steps wait for the
//! steps that they need.

pub mod hyperqueue;
pub mod openjd;
pub mod slurm;

use crate::job::Batch;

/// Command that starts cif on a worker.
fn program(batch: &Batch) -> Vec<String> {
    match batch.engines.command.0.as_slice() {
        [] => vec!["cif".to_owned()],
        words => words.to_vec(),
    }
}

/// File name of the plan; tasks run in its folder.
fn plan_file(batch: &Batch) -> String {
    batch.plan.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Words as a line for `sh`.
fn shell(words: &[String]) -> String {
    // Arguments hold no NUL character, the only one that no shell takes.
    shlex::Quoter::new().allow_nul(true).join(words.iter().map(String::as_str)).unwrap_or_default()
}
