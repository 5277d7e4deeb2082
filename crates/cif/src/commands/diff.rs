//! `cif diff`: what differs between two scenes.

use std::path::PathBuf;

use cif_scene::SceneDiff;
use clap::Args;
use serde::Serialize;

use crate::error::Error;
use crate::formats;
use crate::report::{JsonReport, OnlyReport};

/// Show what differs between two scenes, object by object
#[derive(Debug, Args)]
#[command(after_help = "\
Objects are matched by id, else by name. Distances are in world units, the largest over time. A scene
is compared as it would be exported; with an exported file, with the options of that export.

  cif diff table.cif table.usda
  cif diff before.glb after.glb --json")]
pub(super) struct Diff {
    /// Scene, stage or glTF file
    #[arg(value_name = "BEFORE")]
    before: PathBuf,
    /// Scene, stage or glTF file
    #[arg(value_name = "AFTER")]
    after: PathBuf,
    #[command(flatten)]
    pub(super) report: OnlyReport,
}

/// Differences of two scenes.
#[derive(Serialize)]
#[serde(transparent)]
pub(super) struct Changes<'a>(pub(super) &'a SceneDiff);

impl JsonReport for Changes<'_> {
    const COMMANDS: &'static [&'static str] = &["cif diff", "cif import --base"];
}

pub(super) fn run(command: &Diff) -> Result<(), Error> {
    command.report.check([command.before.as_path(), command.after.as_path()])?;
    let [before, after] = formats::read_both(&command.before, &command.after)?;
    let changes = cif_scene::diff::diff(&before, &after);
    command.report.give(|| Changes(&changes), || print_changes(&changes))
}

/// The differences as a table, one line each.
pub(super) fn print_changes(changes: &SceneDiff) {
    print_objects(changes);
    if !changes.cameras.is_empty() {
        println!("cameras that differ: {}", cameras(changes));
    }
}

/// Cameras that differ, in words.
pub(super) fn cameras(changes: &SceneDiff) -> String {
    changes.cameras.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

pub(super) fn print_objects(changes: &SceneDiff) {
    if changes.is_empty() {
        println!("no differences in {} objects", changes.unchanged);
        return;
    }
    let mut table = crate::commands::shared::table(["object", "label", "change"]);
    for object in &changes.objects {
        for (line, words) in object.describe().into_iter().enumerate() {
            let named = |text: &str| if line == 0 { text.to_owned() } else { String::new() };
            table.add_row([named(&object.name), named(&object.label), words]);
        }
    }
    println!("{table}");
    println!("{} objects differ, {} do not", changes.objects.len(), changes.unchanged);
}
