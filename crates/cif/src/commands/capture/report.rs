//! Summary of `cif capture`: what was found, what is missing, and the command that goes on.

use std::collections::BTreeSet;

use cif_capture::frames::Shot;
use cif_capture::masks::Masks;
use cif_capture::structure::Verdict;

use super::options::Capture;
use super::posed::{Posed, scene_name};
use crate::commands::shared::command_line;
use crate::error::Error;

/// Prints the report.
pub(super) fn print(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    posed: &Posed,
    world: &[String],
) {
    let place = command.output.display().to_string();
    let cameras: BTreeSet<&str> = shots.iter().map(|shot| shot.camera.as_str()).collect();
    let with_pose = shots.iter().filter(|shot| posed.poses.images.contains_key(&shot.name)).count();
    let timed = shots.iter().all(|shot| shot.time.is_some());
    println!(
        "{place}: {with_pose} of {} images of {} cameras have a pose, {} points",
        shots.len(),
        cameras.len(),
        posed.poses.points.len()
    );
    println!("poses: {}", posed.from);
    if let Some(verdict) = &posed.verdict {
        println!("{verdict}");
    }
    for line in world {
        println!("world: {line}");
    }
    println!(
        "times: {}",
        if timed {
            "of every image, seconds"
        } else {
            "none, so that the scene is taken as static (--times)"
        }
    );
    let masked = masks
        .map_or(0, |masks| posed.poses.images.keys().filter(|name| masks.files.contains_key(*name)).count());
    println!("masks: {masked} of {with_pose} images");
    if command.step {
        return;
    }
    println!("next:");
    let scene = scene_name(&command.output).display().to_string();
    if masked == with_pose {
        println!("  {}", command_line(&["train", &place, "-o", &scene]));
        return;
    }
    let folder = format!("{place}-masks");
    let painted = match masks {
        Some(masks) => masks.folder.display().to_string(),
        None => "painted".to_owned(),
    };
    if masks.is_none() {
        println!(
            "  paint the objects of a few of {place}/images as PNG files of ids in the folder {painted}, then"
        );
    }
    println!("  {}", command_line(&["masks", "propagate", &place, "--keyframes", &painted, "-o", &folder]));
    println!("  {}", command_line(&["train", &place, "--masks", &folder, "-o", &scene]));
    if masks.is_none() {
        println!("  or, without objects: {}", command_line(&["train", &place, "-o", &scene]));
    }
}

/// The error of poses that are not to be believed.
pub(super) fn not_believed(command: &Capture, verdict: &Verdict, images: usize) -> Error {
    let mut advice = Vec::new();
    if command.masks.is_none() {
        advice.push("leave moving objects out (--masks, a few painted frames help)");
    }
    if command.focal.is_none() {
        advice.push("give the focal length (--focal)");
    }
    if images < 40 {
        advice.push("take more images that overlap (--rate, --count)");
    }
    advice.push("take poses of another tool (--poses)");
    advice.push("or write it all the same (--accept)");
    Error::failed(
        format!("poses were found, but they are not to be believed, and no capture was written:\n{verdict}"),
        advice.join("; "),
    )
}
