//! A job file of HyperQueue, which runs many small tasks on Slurm, PBS or bare machines: `hq job submit-file FILE`.
//!
//! Source: HyperQueue documentation, "Job Definition File".

use std::fmt::Write;

use super::{plan_file, program};
use crate::job::Batch;

/// The file, TOML: a task per job, each after those that it needs.
#[must_use]
pub fn job_file(batch: &Batch) -> String {
    let folder = std::path::absolute(&batch.folder).unwrap_or_else(|_| batch.folder.clone());
    let text = |text: &str| toml::Value::String(text.to_owned()).to_string();
    let mut file = format!("name = {}\n", text(&format!("cif {}", batch.name)));
    for (k, job) in batch.jobs.iter().enumerate() {
        let step = &batch.steps[job.step];
        let mut words = program(batch);
        words.extend([
            "batch".to_owned(),
            plan_file(batch),
            "--job".to_owned(),
            job.id.clone(),
            "--keep-going".to_owned(),
        ]);
        let words: Vec<String> = words.iter().map(|word| text(word)).collect();
        let _ = write!(
            file,
            "\n[[task]]\nid = {k}\ncommand = [{}]\ncwd = {}\n",
            words.join(", "),
            text(&folder.display().to_string())
        );
        if !job.needs.is_empty() {
            let needs: Vec<String> = job.needs.iter().map(usize::to_string).collect();
            let _ = writeln!(file, "deps = [{}]", needs.join(", "));
        }
        // A worker that is lost does not count as a failure.
        let _ = writeln!(file, "crash_limit = 5");
        if let Some(time) = step.resources.time {
            let _ = writeln!(file, "time_limit = \"{} s\"", time.as_secs().max(1));
        }
        let _ = write!(
            file,
            "[[task.request]]\nresources = {{ \"cpus\" = {}",
            step.resources.threads.unwrap_or(1)
        );
        if let Some(memory) = step.resources.memory_gib {
            let _ = write!(file, ", \"mem\" = {}", (1024.0 * memory).ceil());
        }
        file.push_str(" }\n");
    }
    file
}
