//! Recorded cameras as tracks over time.

use cif_field::RecordedCamera;

use crate::{CameraSample, CameraTrack, naming};

/// One track per camera name; views at one time under one name go to tracks of their own (`name_2`, ...),
/// trained views first. `time_code` gives the time code of a time index, later ones to later times, `None` outside
/// the exported range; `exposure` how much brighter a view records colours than the scene has them, stops.
#[must_use]
pub fn camera_tracks(
    cameras: &[RecordedCamera],
    time_code: impl Fn(usize) -> Option<f64>,
    exposure: impl Fn(&RecordedCamera) -> f64,
) -> Vec<CameraTrack> {
    let mut order: Vec<&RecordedCamera> = cameras.iter().collect();
    order.sort_by(|a, b| (&a.name, a.time_index, !a.trained).cmp(&(&b.name, b.time_index, !b.trained)));
    let mut tracks: Vec<CameraTrack> = Vec::new();
    let mut names = naming::Names::default();
    // Tracks from the first on carry the label at hand, those before the second have a view at the time at hand.
    let (mut first_of_label, mut first_free) = (0, 0);
    for recorded in order {
        let Some(time_code) = time_code(recorded.time_index) else { continue };
        let sample = CameraSample { time_code, camera: recorded.camera, exposure: exposure(recorded) };
        if tracks.get(first_of_label).is_none_or(|track| track.label != recorded.name) {
            first_of_label = tracks.len();
            first_free = tracks.len();
        }
        let last = tracks.get(first_of_label).and_then(|track| track.samples.last());
        if last.is_some_and(|last| last.time_code < time_code) {
            first_free = first_of_label;
        }
        let free = tracks.get_mut(first_free);
        first_free += 1;
        match free {
            Some(track) => track.samples.push(sample),
            None => {
                let name = names.take(naming::identifier(&recorded.name, "camera"));
                tracks.push(CameraTrack { name, label: recorded.name.clone(), samples: vec![sample] });
            }
        }
    }
    tracks
}

#[cfg(test)]
mod tests {
    use cif_geometry::{PinholeCamera, RigidTransform};
    use glam::{DVec2, DVec3};

    use super::*;

    fn recorded(name: &str, time_index: usize, trained: bool, x: f64) -> RecordedCamera {
        let pose = RigidTransform { translation: DVec3::X * x, ..RigidTransform::IDENTITY };
        let camera = PinholeCamera {
            width: 4,
            height: 4,
            focal_px: DVec2::ONE,
            principal_px: DVec2::ONE,
            camera_from_world: pose,
        };
        RecordedCamera { name: name.into(), time_index, trained, camera }
    }

    /// Quadratic searches took a minute here.
    #[test]
    fn eighty_thousand_cameras_of_one_name_have_names_of_their_own() {
        let cameras: Vec<_> = (0..80_000).map(|k| recorded("cam", k / 40_000, true, 0.0)).collect();
        let tracks = camera_tracks(&cameras, |index| Some(index as f64), |_| 0.0);
        assert_eq!((tracks.len(), tracks[39_999].name.as_str()), (40_000, "cam_40000"));
        assert!(tracks.iter().all(|track| track.samples.len() == 2));
    }

    #[test]
    fn views_are_grouped_and_ordered() {
        let cameras = [
            recorded("cam b", 1, true, 1.0),
            recorded("cam a", 5, false, 2.0),
            recorded("cam a", 5, true, 3.0),
            recorded("cam a", 0, true, 4.0),
            recorded("cam b", 9, true, 5.0),
        ];
        let tracks = camera_tracks(&cameras, |index| (index < 9).then_some(index as f64), |_| 0.0);
        let names: Vec<_> = tracks.iter().map(|track| (track.name.as_str(), track.samples.len())).collect();
        assert_eq!(names, [("cam_a", 2), ("cam_a_2", 1), ("cam_b", 1)]);
        assert_eq!(tracks[0].samples[1].camera.camera_from_world.translation.x, 3.0, "trained view first");
    }
}
