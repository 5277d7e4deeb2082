//! The page over all scenes of a batch.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_batch::record::{Record, State};
use cif_batch::steps::{COLLECT, TRAIN};
use cif_batch::{Batch, Job, WINDOW};
use cif_bench::batch::{self, Scene, Undone};
use serde_json::Value;

use crate::commands::shared::command_line;
use crate::error::Error;

/// Pages that benches write.
const PAGES: [&str; 2] = ["compare.html", "report.html"];

/// Writes the page from what the jobs of a batch have left.
///
/// # Errors
/// When a file cannot be written.
pub(super) fn collect(plan: &Batch) -> Result<(), Error> {
    let folder = plan.place(&plan.output);
    std::fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
    let mut of_scenes: BTreeMap<&str, Vec<&Job>> = BTreeMap::new();
    for job in &plan.jobs {
        if let Some((_, name)) = job.id.split_once('/') {
            of_scenes.entry(name).or_default().push(job);
        }
    }
    let of_training = |job: &Job| {
        let name = job.id.split_once('/')?.1;
        // What all windows of a scene make together is shown with each.
        let whole = name.rsplit_once(WINDOW).and_then(|(whole, _)| of_scenes.get(whole));
        scene(plan, name, of_scenes.get(name)?, whole.map_or(&[], Vec::as_slice))
    };
    let trainings = plan.jobs.iter().filter(|job| plan.steps[job.step].name == TRAIN);
    let scenes: Vec<Scene> = trainings.filter_map(of_training).collect();
    let others = plan.jobs.iter().filter(|job| job.id != COLLECT);
    let undone: Vec<Undone> = others.filter_map(|job| undone(plan, job)).collect();
    let name = plan.plan.file_name().unwrap_or_default().to_string_lossy();
    let about = batch::Batch {
        name: &plan.name,
        command: &command_line(&["batch", &name]),
        jobs: plan.jobs.len(),
        scenes: &scenes,
        undone: &undone,
        benches: &benches(plan),
    };
    batch::write(&folder, &about)?;
    crate::messages::outcome!("wrote {}", folder.join("index.html").display());
    Ok(())
}

/// A path of the plan as the page has it.
fn beside_page(plan: &Batch, path: &Path) -> PathBuf {
    path.strip_prefix(&plan.output).unwrap_or(path).to_owned()
}

/// A scene, of the jobs that work on it, and of those on all windows that it is one of; `None` where none was begun.
fn scene(plan: &Batch, name: &str, own: &[&Job], of_whole: &[&Job]) -> Option<Scene> {
    let records: Vec<Record> = own.iter().filter_map(|job| Record::read(plan, job)).collect();
    if records.is_empty() {
        return None;
    }
    let (capture, settings) = name.split_once('/')?;
    let folder = plan.output.join("scenes").join(name);
    let json = |file: &str| -> Value {
        let text = std::fs::read_to_string(plan.place(&folder.join(file))).unwrap_or_default();
        serde_json::from_str(&text).unwrap_or_default()
    };
    let is_shown = |path: &&PathBuf| {
        plan.place(path).is_file() && path.extension().is_none_or(|ending| ending != "json")
    };
    let files = own
        .iter()
        .chain(of_whole)
        .flat_map(|job| &job.makes)
        .filter(is_shown)
        .map(|path| beside_page(plan, path))
        .collect();
    Some(Scene {
        capture: capture.to_owned(),
        settings: settings.to_owned(),
        scores: json("scores.json"),
        training: json("train.json"),
        picture: picture(&plan.place(&folder.join("pictures")))
            .map(|file| beside_page(plan, &folder.join("pictures").join(file))),
        files,
        cpu_s: records.iter().map(|record| record.spent.cpu_s).sum(),
        peak_bytes: records.iter().map(|record| record.spent.peak_bytes).max().unwrap_or(0),
    })
}

/// The first picture in a folder or below, relative to it.
fn picture(folder: &Path) -> Option<PathBuf> {
    let mut entries: Vec<PathBuf> =
        std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path()).collect();
    entries.sort();
    let is_png = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "png");
    let found = entries.iter().find(|path| is_png(path)).cloned();
    let below = || entries.iter().find_map(|path| Some(path.join(picture(path)?)));
    found.or_else(below)?.strip_prefix(folder).ok().map(Path::to_owned)
}

fn undone(plan: &Batch, job: &Job) -> Option<Undone> {
    let record = Record::read(plan, job);
    let error = match &record {
        Some(record) if record.state == State::Done => return None,
        Some(record) => record.error.clone(),
        None => None,
    };
    let log = plan.records().join(format!("{}.log", job.id));
    Some(Undone { job: job.id.clone(), error, log: beside_page(plan, &log) })
}

/// Pages of benches, in the folders that their commands name.
fn benches(plan: &Batch) -> Vec<PathBuf> {
    let folder = |job: &Job| {
        let mut after = job.words.iter().skip_while(|word| *word != "-o" && *word != "--output");
        let is_bench = job.words.first().is_some_and(|word| word == "bench")
            && !job.words.iter().any(|word| word == "--only");
        after.nth(1).filter(|_| is_bench).map(PathBuf::from)
    };
    let pages = plan.jobs.iter().filter_map(folder).flat_map(|folder| PAGES.map(|page| folder.join(page)));
    pages.filter(|page| plan.place(page).is_file()).map(|page| beside_page(plan, &page)).collect()
}
