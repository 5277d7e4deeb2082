//! A script that hands a batch to Slurm: an array per step, each after those that it needs.

use std::fmt::Write;

use super::{plan_file, program, shell};
use crate::job::{Batch, Step};

/// Tasks of an array, at most: Slurm's `MaxArraySize` is 1001 unless a site raises it.
const LARGEST_ARRAY: usize = 1_000;

/// The script, for `sh`, run where `sbatch` is: it prints the numbers of the arrays.
#[must_use]
pub fn script(batch: &Batch) -> String {
    let folder = std::path::absolute(&batch.folder).unwrap_or_else(|_| batch.folder.clone());
    let folder = shell(&[folder.display().to_string()]);
    let mut script = format!(
        "#!/bin/sh\n# Hands the jobs of {plan} to Slurm: sh THIS_FILE. An array per step; a task that has more than one job does \
         them one after the other.\nset -eu\ncd {folder}\nmkdir -p {logs}\n",
        plan = plan_file(batch),
        logs = logs(batch),
    );
    for (k, step) in batch.steps.iter().enumerate() {
        array(&mut script, batch, k, step);
    }
    let last = batch.steps.len().saturating_sub(1);
    let _ = writeln!(script, "echo \"submitted; the last is $STEP_{last}: squeue -j $STEP_{last}\"");
    script
}

fn logs(batch: &Batch) -> String {
    shell(&[batch.records().join("slurm").display().to_string()])
}

fn array(script: &mut String, batch: &Batch, index: usize, step: &Step) {
    let count = step.jobs.len();
    let chunk = count.div_ceil(LARGEST_ARRAY);
    let tasks = count.div_ceil(chunk);
    let mut words = vec!["sbatch".to_owned(), "--parsable".to_owned()];
    words.push(format!("--job-name=cif-{}", step.name));
    words.push(format!("--array=0-{}", tasks - 1));
    words.push(format!("--output={}", batch.records().join("slurm/%x-%A-%a.log").display()));
    // Time to save before a job is ended, and another try of one whose node is lost.
    words.extend(["--signal=B:TERM@120", "--requeue"].map(str::to_owned));
    words.extend(step.resources.threads.map(|threads| format!("--cpus-per-task={threads}")));
    words.extend(step.resources.memory_gib.map(|memory| format!("--mem={}M", (1024.0 * memory).ceil())));
    words.extend(step.resources.time.map(|time| format!("--time={}", time.as_secs().div_ceil(60).max(1))));
    words.extend(batch.engines.slurm.0.iter().cloned());
    let mut line = shell(&words);
    if !step.needs.is_empty() {
        let needs: Vec<String> = step.needs.iter().map(|need| format!("$STEP_{need}")).collect();
        let _ = write!(line, " --dependency=\"afterany:{}\"", needs.join(":"));
    }
    let mut run = program(batch);
    run.extend(["batch".to_owned(), plan_file(batch), "--keep-going".to_owned()]);
    let first = "$((SLURM_ARRAY_TASK_ID * CHUNK))";
    let last = "$((SLURM_ARRAY_TASK_ID * CHUNK + CHUNK - 1))";
    let _ = write!(
        script,
        "\n# {name}: {count} jobs\nSTEP_{index}=$({line} <<'END'\n#!/bin/sh\nCHUNK={chunk}\nexec {run} --job {step}:{first}-{last}\nEND\n)\n\
         STEP_{index}=${{STEP_{index}%%;*}}\n",
        name = step.name,
        run = shell(&run),
        step = shell(std::slice::from_ref(&step.name)),
    );
}
