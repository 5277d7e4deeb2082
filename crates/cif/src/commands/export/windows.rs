//! Scenes of several windows of time of one capture, which become one stage.

use std::path::PathBuf;

use cif_field::Field;
use cif_scene::{SceneGraph, SceneOptions, Seam};

use super::targets::{Target, Targets, Writing};
use crate::commands::shared::{scene, table};
use crate::endings;
use crate::error::Error;

/// Refuses what cannot be done with several scenes, before any is read.
pub(super) fn refuse(
    targets: &Targets,
    writing: &Writing,
    has_frames: bool,
    is_checked: bool,
) -> Result<(), Error> {
    if targets.windows.is_empty() {
        return Ok(());
    }
    if targets.iter().next().is_none() {
        return Err(Error::usage(
            "several scenes, and no file to write",
            "name a stage as well, as in walk.usda",
        ));
    }
    if let Some(target) = targets.iter().find(|target| !target.format.about().holds_windows) {
        return Err(Error::usage(
            format!("{target:?}: {} does not hold several windows of time", target.format.about().name),
            "write .usda or .usdc, or export each window by itself",
        ));
    }
    let is_packed = |target: &&Target| writing.is_single_file() || endings::ending(&target.path) == "usdz";
    if let Some(target) = targets.iter().find(is_packed) {
        return Err(Error::usage(
            format!("{target:?}: several windows of time are a stage with a file for each"),
            "write .usda or .usdc, without --single-file",
        ));
    }
    for (flag, is_given) in [("--frames", has_frames), ("--check", is_checked)] {
        if is_given {
            return Err(Error::usage(
                format!("{flag} is about one scene, and several are given"),
                "leave it out, or export each window by itself",
            ));
        }
    }
    Ok(())
}

/// Joins the graph of a field and those of further windows; the graph as it is where there are none.
pub(super) fn with_further(
    first: &Field,
    graph: SceneGraph,
    further: &[PathBuf],
    options: impl Fn(&Field) -> SceneOptions,
) -> Result<(SceneGraph, Vec<Seam>), Error> {
    if further.is_empty() {
        return Ok((graph, Vec::new()));
    }
    let mut graphs = vec![graph];
    for path in further {
        // One field at a time: graphs are smaller.
        let field = scene::load(path)?;
        let captures = [first, &field].map(|field| field.record.capture.as_deref());
        if let [Some(one), Some(other)] = captures
            && one != other
        {
            return Err(Error::failed(
                format!(
                    "{} was trained on the capture `{other}`, and the first scene on `{one}`",
                    path.display()
                ),
                "give the windows of one capture",
            ));
        }
        let graph = cif_scene::build(&field, &options(&field));
        graphs.push(graph.map_err(|error| Error::plain(format!("{}: {error}", path.display())))?);
    }
    cif_scene::joined(graphs).map_err(Error::plain)
}

/// Prints how far windows differ where they meet.
pub(super) fn print(seams: &[Seam], meters_per_unit: f64) {
    if seams.is_empty() {
        return;
    }
    println!("where windows meet, poses of both over the times that they share, RMS:");
    let mut rows = table(["from frame", "object", "mm", "deg"]);
    for seam in seams {
        for object in &seam.objects {
            rows.add_row([
                format!("{}", seam.time_code),
                object.name.clone(),
                format!("{:.1}", 1000.0 * meters_per_unit * object.distance),
                format!("{:.1}", object.degrees),
            ]);
        }
    }
    println!("{rows}");
}
