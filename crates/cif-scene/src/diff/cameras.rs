//! Cameras that differ. They say how the scene was captured: edits of them are reported, never applied.

use std::collections::BTreeMap;
use std::fmt;

use cif_geometry::PinholeCamera;
use glam::DQuat;
use serde::Serialize;

use super::units::{SAME_PLACE, SAME_TURN};
use crate::{CameraTrack, SceneGraph};

/// Focal lengths closer than this part of themselves are the same.
const SAME_FOCAL: f64 = 1e-4;
/// Principal points closer than this are the same, pixels.
const SAME_PIXEL: f64 = 0.01;
/// Time codes closer than this are the same.
const SAME_CODE: f64 = 1e-3;

/// Kind of a camera's difference.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraChangeKind {
    /// Only in the second graph.
    Added,
    /// Only in the first graph.
    Removed,
    /// Elsewhere, turned, or at other times.
    Moved,
    /// Another focal length, principal point or picture size.
    Lens,
}

/// Difference of one camera.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CameraChange {
    /// Its name.
    pub name: String,
    /// Kind of its difference.
    pub kind: CameraChangeKind,
}

impl fmt::Display for CameraChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = match self.kind {
            CameraChangeKind::Added => "added",
            CameraChangeKind::Removed => "removed",
            CameraChangeKind::Moved => "moved",
            CameraChangeKind::Lens => "another lens",
        };
        write!(f, "{} ({what})", self.name)
    }
}

/// Cameras that differ, matched by name: those of the first graph in its order, then added ones.
pub(super) fn changes(before: &SceneGraph, after: &SceneGraph) -> Vec<CameraChange> {
    let named = |tracks: &[CameraTrack]| -> BTreeMap<String, usize> {
        // Of several of one name the first counts.
        tracks.iter().enumerate().rev().map(|(index, track)| (track.name.clone(), index)).collect()
    };
    let (first_of, second_of) = (named(&before.cameras), named(&after.cameras));
    let change = |track: &CameraTrack, kind| CameraChange { name: track.name.clone(), kind };
    let kept = before.cameras.iter().filter_map(|first| match second_of.get(&first.name) {
        Some(&second) => compare(first, &after.cameras[second]).map(|kind| change(first, kind)),
        None => Some(change(first, CameraChangeKind::Removed)),
    });
    let added = after
        .cameras
        .iter()
        .filter(|track| !first_of.contains_key(&track.name))
        .map(|track| change(track, CameraChangeKind::Added));
    kept.chain(added).collect()
}

fn compare(first: &CameraTrack, second: &CameraTrack) -> Option<CameraChangeKind> {
    let pairs = || first.samples.iter().zip(&second.samples);
    let other_times = first.samples.len() != second.samples.len()
        || pairs().any(|(a, b)| (a.time_code - b.time_code).abs() > SAME_CODE);
    if other_times || pairs().any(|(a, b)| moved(&a.camera, &b.camera)) {
        return Some(CameraChangeKind::Moved);
    }
    pairs().any(|(a, b)| other_lens(&a.camera, &b.camera)).then_some(CameraChangeKind::Lens)
}

fn moved(a: &PinholeCamera, b: &PinholeCamera) -> bool {
    let (from, to) = (a.centre(), b.centre());
    let turn = DQuat::from_mat3(&(a.camera_from_world.rotation.transpose() * b.camera_from_world.rotation));
    let sine = turn.xyz().length().min(1.0);
    (from - to).length() > SAME_PLACE * (1.0 + from.length()) || 2.0 * sine.asin() > SAME_TURN
}

fn other_lens(a: &PinholeCamera, b: &PinholeCamera) -> bool {
    (a.width, a.height) != (b.width, b.height)
        || ((a.focal_px - b.focal_px) / a.focal_px).abs().max_element() > SAME_FOCAL
        || (a.principal_px - b.principal_px).abs().max_element() > SAME_PIXEL
}
