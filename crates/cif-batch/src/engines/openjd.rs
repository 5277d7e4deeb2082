//! Job templates of OpenJD, specification 2023-09, which AWS Deadline Cloud and `openjd run` execute.
//!
//! Source: Open Job Description specification, "Template Schemas", `jobtemplate-2023-09`.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::{plan_file, program};
use crate::job::{Batch, Step};

/// Most characters of the name of a job or step.
const LONGEST_NAME: usize = 64;

/// The template for a file, as JSON. A step has a task per job, and waits for the steps that it needs.
#[must_use]
pub fn template(batch: &Batch, file: &Path) -> Value {
    // Defaults of paths are relative to the template.
    let [from, to] = [file.parent().unwrap_or(Path::new("")), &batch.folder].map(absolute);
    let folder = relative(&from, &to);
    json!({
        "specificationVersion": "jobtemplate-2023-09",
        "name": name(&format!("cif {}", batch.name)),
        "parameterDefinitions": [
            {
                "name": "Folder",
                "type": "PATH",
                "objectType": "DIRECTORY",
                "dataFlow": "INOUT",
                "default": folder,
                "description": "Folder of the plan, which all workers share",
            },
            {
                "name": "Plan",
                "type": "STRING",
                "default": plan_file(batch),
                "description": "The plan, a file in that folder",
            },
        ],
        "steps": batch.steps.iter().map(|one| step(batch, one)).collect::<Vec<_>>(),
    })
}

fn absolute(path: &Path) -> PathBuf {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_owned())
}

/// The path from a folder to another, both absolute.
fn relative(from: &Path, to: &Path) -> String {
    let shared = from.components().zip(to.components()).take_while(|(from, to)| from == to).count();
    let up = from.components().skip(shared).map(|_| "..".to_owned());
    let down = to.components().skip(shared).map(|part| part.as_os_str().to_string_lossy().into_owned());
    let parts: Vec<String> = up.chain(down).collect();
    if parts.is_empty() { ".".to_owned() } else { parts.join("/") }
}

fn name(text: &str) -> String {
    text.chars().take(LONGEST_NAME).collect()
}

fn step(batch: &Batch, step: &Step) -> Value {
    let mut words = program(batch);
    let command = words.remove(0);
    let file = "{{Param.Folder}}/{{Param.Plan}}".to_owned();
    words.extend([
        "batch".to_owned(),
        file,
        "--job".to_owned(),
        format!("{}:{{{{Task.Param.Job}}}}", step.name),
    ]);
    words.push("--keep-going".to_owned());
    let mut run = json!({ "command": command, "args": words });
    if let Some(time) = step.resources.time {
        run["timeout"] = json!(time.as_secs().max(1));
    }
    // Cancelled workers save what they have.
    run["cancelation"] = json!({ "mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": 120 });
    let mut value = json!({
        "name": name(&step.name),
        "parameterSpace": {
            "taskParameterDefinitions": [
                { "name": "Job", "type": "INT", "range": format!("0-{}", step.jobs.len() - 1) },
            ],
        },
        "script": { "actions": { "onRun": run } },
    });
    if !step.needs.is_empty() {
        let needs = step.needs.iter().map(|need| json!({ "dependsOn": name(&batch.steps[*need].name) }));
        value["dependencies"] = needs.collect();
    }
    let mut amounts = Vec::new();
    if let Some(threads) = step.resources.threads {
        amounts.push(json!({ "name": "amount.worker.vcpu", "min": threads }));
    }
    if let Some(memory) = step.resources.memory_gib {
        amounts.push(json!({ "name": "amount.worker.memory", "min": (1024.0 * memory).ceil() }));
    }
    if !amounts.is_empty() {
        value["hostRequirements"] = json!({ "amounts": amounts });
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_are_named_from_the_template() {
        for (from, to, path) in [
            ("/a/b", "/a/b", "."),
            ("/a/b", "/a/c/d", "../c/d"),
            ("/a", "/a/b", "b"),
            ("/a/b/c", "/a", "../.."),
        ] {
            assert_eq!(relative(Path::new(from), Path::new(to)), path);
        }
    }
}
