//! Paths of nodes and parts as poses of track groups.

use cif_field::tracks::TrackPose;
use glam::DVec3;

use crate::graph::{Part, PoseSample, pose_at};
use crate::motion::time_map::TimeMap;

/// Poses that differ by less do not move: part of the size of coordinates, and radians.
const STILL: f64 = 1e-9;

/// A path whose keys are joined by lines and arcs, with its pose at the reference time.
pub(super) struct Path {
    keys: Vec<PoseSample>,
    pub(super) reference: PoseSample,
}

impl Path {
    pub(super) fn still(at: DVec3) -> Self {
        Self::of(Vec::new(), at, 0.0)
    }

    pub(super) fn of(keys: Vec<PoseSample>, rest: DVec3, reference: f64) -> Self {
        let mut reference = pose_at(&keys, rest, reference);
        reference.rotation = reference.rotation.normalize();
        Self { keys, reference }
    }

    /// The keys relative to the reference pose; none where they are all as it is.
    pub(super) fn poses(&self, times: &TimeMap) -> Vec<TrackPose> {
        let back = self.reference.rotation.conjugate();
        let poses: Vec<TrackPose> = self
            .keys
            .iter()
            .map(|key| TrackPose {
                time: times.time(key.time_code),
                translation: key.translation,
                rotation: (key.rotation * back).normalize(),
            })
            .collect();
        let at = self.reference.translation;
        let is_still = |pose: &TrackPose| {
            (pose.translation - at).length() <= STILL * (1.0 + at.length())
                && pose.rotation.xyz().length() <= STILL
        };
        if poses.iter().all(is_still) { Vec::new() } else { poses }
    }
}

/// Poses of a part in the world, at the keys of both levels and at the sampled time codes between them.
pub(super) fn part_path(
    node_track: &[PoseSample],
    pivot: DVec3,
    part: &Part,
    samples: &[f64],
    reference: f64,
) -> Path {
    let mut codes: Vec<f64> = node_track.iter().chain(&part.track).map(|key| key.time_code).collect();
    if !node_track.is_empty() && !part.track.is_empty() {
        codes.extend_from_slice(samples);
    }
    codes.sort_by(f64::total_cmp);
    codes.dedup();
    let world = |code: f64| {
        let (node, part) = (pose_at(node_track, pivot, code), pose_at(&part.track, part.pivot, code));
        PoseSample {
            time_code: code,
            translation: node.rotation * part.translation + node.translation,
            rotation: (node.rotation * part.rotation).normalize(),
        }
    };
    let mut keys: Vec<PoseSample> = Vec::with_capacity(codes.len());
    for code in codes {
        let mut key = world(code);
        if keys.last().is_some_and(|last| last.rotation.dot(key.rotation) < 0.0) {
            key.rotation = -key.rotation;
        }
        keys.push(key);
    }
    Path { keys, reference: world(reference) }
}
