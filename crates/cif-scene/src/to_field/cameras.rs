//! Recorded cameras, and the extent that they span.

use std::collections::BTreeMap;

use cif_field::{Exposure, Gaussians, RecordedCamera, TimedExposure};
use cif_geometry::Bounds;
use glam::DVec3;

use crate::motion::time_map::TimeMap;
use crate::{CameraSample, CameraTrack};

/// Views of all tracks, one per frame and track.
pub(super) fn cameras(tracks: &[CameraTrack], times: &TimeMap) -> Vec<RecordedCamera> {
    let mut cameras: Vec<RecordedCamera> = Vec::new();
    for track in tracks {
        let name = name_of(track);
        let mut previous = None;
        for sample in &track.samples {
            let time_index = times.nearest_frame(sample.time_code);
            if previous.replace(time_index) != Some(time_index) {
                let camera = sample.camera;
                cameras.push(RecordedCamera { name: name.clone(), time_index, trained: true, camera });
            }
        }
    }
    cameras
}

/// Exposures of the tracks whose cameras record colours otherwise than the scene has them, by the name of the camera.
pub(super) fn exposures(tracks: &[CameraTrack], times: &TimeMap) -> BTreeMap<String, Vec<TimedExposure>> {
    let adapts = |track: &&CameraTrack| track.samples.iter().any(|sample| sample.exposure != 0.0);
    let timed = |sample: &CameraSample| TimedExposure {
        time: times.time(sample.time_code),
        exposure: Exposure::of_stops(sample.exposure),
    };
    let of = |track: &CameraTrack| (name_of(track).clone(), track.samples.iter().map(timed).collect());
    tracks.iter().filter(adapts).map(of).collect()
}

/// Name in the capture, or of the prim.
fn name_of(track: &CameraTrack) -> &String {
    if track.label.is_empty() { &track.name } else { &track.label }
}

/// Scene extent: from the cameras as in training, else half the box of the centres.
pub(super) fn extent(cameras: &[RecordedCamera], gaussians: &Gaussians) -> f32 {
    let from_points = || {
        let bounds =
            Bounds::around(gaussians.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from))));
        if gaussians.is_empty() { 0.0 } else { bounds.size().length() / 2.0 }
    };
    let centres: Vec<DVec3> = cameras.iter().map(|camera| camera.camera.centre()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let spread = centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max) * 1.1;
    let extent = if spread > 0.0 { spread } else { from_points() };
    if extent.is_finite() { extent as f32 } else { 0.0 }
}
