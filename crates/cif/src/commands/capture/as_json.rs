//! Summary of `cif capture` for programs.

use std::collections::BTreeSet;

use cif_capture::frames::Shot;
use cif_capture::masks::Masks;
use serde_json::{Value, json};

use super::{Capture, Posed, report};
use crate::error::Error;

/// Prints the summary, or gives it as JSON.
pub(super) fn give(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    posed: &Posed,
    world: &[String],
) -> Result<(), Error> {
    command.report.give(
        || as_json(command, shots, masks, posed, world),
        || report::print(command, shots, masks, posed, world),
    )
}

fn as_json(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    posed: &Posed,
    world: &[String],
) -> Value {
    let images = &posed.poses.images;
    let cameras: BTreeSet<&str> = shots.iter().map(|shot| shot.camera.as_str()).collect();
    let masked = |masks: &Masks| images.keys().filter(|name| masks.files.contains_key(*name)).count();
    let verdict = posed.verdict.as_ref().map(|verdict| {
        let checks = verdict.checks.iter();
        let checks = checks.map(|check| json!({ "holds": check.holds, "words": check.words }));
        json!({ "good": verdict.is_good(), "checks": checks.collect::<Vec<_>>() })
    });
    json!({
        "capture": command.output,
        "cameras": cameras,
        "images": shots.len(),
        "images_with_pose": shots.iter().filter(|shot| images.contains_key(&shot.name)).count(),
        "images_with_time": shots.iter().filter(|shot| shot.time.is_some()).count(),
        "images_with_mask": masks.map_or(0, masked),
        "points": posed.poses.points.len(),
        "poses_from": posed.from,
        "verdict": verdict,
        "metres_known": posed.metres_known,
        "up_known": posed.up_known,
        "world": world,
    })
}
