//! Summary of `cif capture` for programs.

use std::collections::BTreeSet;
use std::path::Path;

use cif_capture::frames::Shot;
use cif_capture::masks::Masks;
use serde::Serialize;

use super::options::Capture;
use super::posed::Posed;
use super::report;
use crate::error::Error;
use crate::report::JsonReport;

/// Prints the summary, or gives it as JSON.
pub(super) fn give(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    posed: &Posed,
    world: &[String],
) -> Result<(), Error> {
    command.report.give(
        || summary(command, shots, masks, posed, world),
        || report::print(command, shots, masks, posed, world),
    )
}

/// A capture that was made.
#[derive(Serialize)]
struct CaptureReport<'a> {
    /// Its folder.
    capture: &'a Path,
    /// Names of the cameras.
    cameras: BTreeSet<&'a str>,
    /// Images.
    images: usize,
    /// Images whose pose was found.
    images_with_pose: usize,
    /// Images with a time.
    images_with_time: usize,
    /// Images with a pose and a mask.
    images_with_mask: usize,
    /// Points.
    points: usize,
    /// Origin of the poses: `pycolmap` with its version, or the files that were imported.
    poses_from: &'a str,
    /// Verdict on the poses; null where they were imported.
    verdict: Option<VerdictReport<'a>>,
    /// True where a unit of the world is a metre.
    metres_known: bool,
    /// True where the z axis of the world points up.
    up_known: bool,
    /// How scale, up and origin of the world were chosen, one sentence each.
    world: &'a [String],
}

/// Arguments for and against poses.
#[derive(Serialize)]
struct VerdictReport<'a> {
    /// True where the poses can be relied on.
    good: bool,
    /// Every argument.
    checks: Vec<PoseCheck<'a>>,
}

/// An argument for or against poses.
#[derive(Serialize)]
struct PoseCheck<'a> {
    /// True where it speaks for the poses.
    holds: bool,
    /// The argument, with its figures.
    words: &'a str,
}

impl JsonReport for CaptureReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif capture"];
}

fn summary<'a>(
    command: &'a Capture,
    shots: &'a [Shot],
    masks: Option<&Masks>,
    posed: &'a Posed,
    world: &'a [String],
) -> CaptureReport<'a> {
    let images = &posed.poses.images;
    let masked = |masks: &Masks| images.keys().filter(|name| masks.files.contains_key(*name)).count();
    let verdict = posed.verdict.as_ref().map(|verdict| VerdictReport {
        good: verdict.is_good(),
        checks: verdict
            .checks
            .iter()
            .map(|check| PoseCheck { holds: check.holds, words: &check.words })
            .collect(),
    });
    CaptureReport {
        capture: &command.output,
        cameras: shots.iter().map(|shot| shot.camera.as_str()).collect(),
        images: shots.len(),
        images_with_pose: shots.iter().filter(|shot| images.contains_key(&shot.name)).count(),
        images_with_time: shots.iter().filter(|shot| shot.time.is_some()).count(),
        images_with_mask: masks.map_or(0, masked),
        points: posed.poses.points.len(),
        poses_from: &posed.from,
        verdict,
        metres_known: posed.metres_known,
        up_known: posed.up_known,
        world,
    }
}
