//! `cif import`: files of other tools as scenes, and edits coming home.

use std::path::{Path, PathBuf};

use cif_dataset::TimeWindow;
use cif_field::{Field, Instance};
use cif_scene::ReadOptions;
use clap::Args;
use serde::Serialize;

use super::diff::{Changes, cameras, print_objects};
use super::shared::scene;
use crate::endings;
use crate::error::Error;
use crate::formats;
use crate::lock::Lock;
use crate::messages::{note, outcome};
use crate::output::Outputs;
use crate::report::{JsonReport, Report};

/// Turn USD, glTF or PLY into a scene, or apply the edits of an exported file to its scene
#[derive(Debug, Args)]
#[command(after_help = "\
Without --base the file becomes a scene of its own: splats, objects with their labels, motion as the
file has it, cameras. It can be rendered, labelled, queried and exported, but not trained further.

With --base, the scene that the file was exported from, only what was changed in the file is applied
to it: objects moved (also over time), renamed, relabelled, hidden, deleted, duplicated or added, and
splats recoloured, faded, resized, deleted or moved. Everything else keeps its learned motion.
Cameras stay as they were recorded; edits of them are named.

--json lists the edits, or without --base what the scene holds.

  cif import fox.ply -o fox.cif
  cif export table.cif table.usda              # then edit table.usda in any tool
  cif import table.usda --base table.cif -o edited.cif
  cif diff table.cif edited.cif
  cif import walk.usda --window 2/4 -o walk.2.cif   # of a stage of several windows of time, one")]
pub(super) struct Import {
    /// File to read: .usda, .usdc, .usdz, .glb, .gltf or .ply
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Scene to write
    #[arg(short, long, value_name = "SCENE.cif", value_parser = endings::scene())]
    output: PathBuf,
    /// Scene that the file was exported from; it is not changed
    #[arg(long, value_name = "ORIGINAL.cif")]
    base: Option<PathBuf>,
    /// Take the base although the file was exported from another scene
    #[arg(long, requires = "base")]
    force_base: bool,
    /// Read layers that a stage brings in from outside its folder
    #[arg(long)]
    follow_external: bool,
    /// Take one of several windows of time of a stage, as in --window 2/4
    #[arg(long, value_name = "K/N", conflicts_with = "base")]
    window: Option<TimeWindow>,
    #[command(flatten)]
    report: Report,
    /// Replace an existing scene
    #[arg(long)]
    force: bool,
}

pub(super) fn run(command: &Import) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.file)?;
    command.base.as_deref().map_or(Ok(()), |base| outputs.reads(base))?;
    outputs.file(&command.output)?;
    command.report.check(&mut outputs)?;
    // Before the file is read, which may take longer.
    let base = command.base.as_deref().map(scene::load).transpose()?;
    let options = ReadOptions { follow_external: command.follow_external };
    let graph = formats::read(&command.file, options, command.window)?;
    for warning in &graph.warnings {
        crate::messages::warning!("{warning}");
    }
    let mut edits = None;
    let field = match &base {
        Some(base) => {
            let source = formats::name_of(&command.file);
            let (field, changes) = cif_scene::import_edits(base, &graph, &source, command.force_base)
                .map_err(|error| import_error(&error))?;
            if !changes.cameras.is_empty() {
                eprintln!(
                    "warning: cameras stay as they were recorded; not taken over: {}",
                    cameras(&changes)
                );
            }
            edits = Some(changes);
            field
        }
        None => {
            if graph.origin.field_fingerprint.is_some() {
                note!(
                    "cif exported this file; give the scene that it was exported from with --base to keep the learned motion"
                );
            }
            formats::field_of(&graph, &command.file)?
        }
    };
    let _lock = Lock::wait(&command.output)?;
    field.save(&command.output).map_err(Error::plain)?;
    match &edits {
        Some(changes) => command.report.give(|| Changes(changes), || print_objects(changes))?,
        None => command.report.give(|| ImportReport::of(&command.output, &field), || ())?,
    }
    outcome!(
        "wrote {}: {} Gaussians, {} instances, {} times",
        command.output.display(),
        field.len(),
        field.instances.len(),
        field.timeline.times.len()
    );
    Ok(())
}

/// A scene made of a file of another format.
#[derive(Serialize)]
struct ImportReport<'a> {
    /// The scene.
    scene: &'a Path,
    /// Gaussians.
    gaussians: usize,
    /// Instances.
    instances: &'a [Instance],
    /// Times.
    times: usize,
}

impl<'a> ImportReport<'a> {
    fn of(scene: &'a Path, field: &'a Field) -> Self {
        let (gaussians, times) = (field.len(), field.timeline.times.len());
        Self { scene, gaussians, instances: &field.instances, times }
    }
}

impl JsonReport for ImportReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif import"];
}

fn import_error(error: &cif_scene::SceneError) -> Error {
    match error {
        cif_scene::SceneError::OtherBase { .. } => Error::failed(
            error.to_string(),
            "--force-base takes this base all the same; rows of the file then count its Gaussians",
        ),
        _ => Error::plain(error),
    }
}
