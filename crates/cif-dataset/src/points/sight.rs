//! Check that the training cameras see the initial points.

use glam::DVec3;

use crate::{Dataset, PointSource};

/// Points that are looked for, spread evenly over the cloud.
const LOOKED_FOR: usize = 2_000;

/// Share of the points that a training camera should show. Reconstructions of large places show a part in few
/// cameras, but hardly ever less; a cloud in other coordinates than the cameras is often seen not at all.
const FEWEST_SEEN: f64 = 0.02;

/// Warning where the training cameras see next to none of the initial points.
pub(crate) fn unseen_warning(dataset: &Dataset) -> Option<String> {
    let positions = &dataset.points.positions;
    let cameras: Vec<_> =
        dataset.train_frames().into_iter().map(|index| &dataset.frames[index].camera).collect();
    let count = positions.len().min(LOOKED_FOR);
    if count == 0 || cameras.is_empty() {
        return None;
    }
    let (mut seen, mut behind) = (0, 0);
    for k in 0..count {
        let point = DVec3::from_array(positions[k * positions.len() / count].map(f64::from));
        seen += usize::from(cameras.iter().any(|camera| camera.pixel_of(point).is_some()));
        behind += usize::from(cameras.iter().all(|camera| camera.project(point).is_none()));
    }
    if seen as f64 >= FEWEST_SEEN * count as f64 {
        return None;
    }
    let what = match &dataset.points.source {
        PointSource::File(path) => path.display().to_string(),
        PointSource::Triangulated => format!("{}: the triangulated points", dataset.root.display()),
        PointSource::Random => format!("{}: the random points", dataset.root.display()),
    };
    let looked_for = match positions.len() {
        all if all > count => format!("{count} of its {all} points that were looked for"),
        all => format!("its {all} points"),
    };
    Some(format!(
        "{what}: {seen} of {looked_for} lie in the picture of any training camera, and {behind} lie behind all of them: \
         points and cameras seem to be in different coordinates, or the cameras look the wrong way (cif wants them to \
         look along +z with x right and y down); training cannot make up for that"
    ))
}

#[cfg(test)]
mod tests {
    use cif_geometry::{LensDistortion, PinholeCamera, RigidTransform};
    use glam::{DMat3, DVec2};

    use super::*;
    use crate::{CaptureFrame, Frame, Layout, PointCloud, Split, Turn};

    /// A camera at the origin that looks along +z, and points around `(0, 0, depth)`.
    fn dataset(depth: f32) -> Dataset {
        let camera = PinholeCamera {
            width: 64,
            height: 48,
            focal_px: DVec2::splat(50.0),
            principal_px: DVec2::new(32.0, 24.0),
            camera_from_world: RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
        };
        let frame = |(name, split): (&str, Split)| Frame {
            name: name.into(),
            camera_name: name.into(),
            camera,
            lens: LensDistortion::default(),
            time: 0.0,
            time_index: 0,
            split,
            group: None,
            image: "none.png".into(),
            turn: Turn::NONE,
            source: None,
            mask: None,
            confidence: None,
        };
        let positions: Vec<[f32; 3]> =
            (0..5_000).map(|k| [(k % 50) as f32 * 0.01, (k / 50) as f32 * 0.01, depth]).collect();
        Dataset {
            root: "table".into(),
            layout: Layout::Colmap,
            frames: [("a", Split::Train), ("b", Split::Val)].map(frame).to_vec(),
            times: vec![0.0],
            window: None,
            frames_per_second: None,
            instances: Vec::new(),
            mask_objects: Default::default(),
            points: PointCloud {
                colors: vec![[0; 3]; positions.len()],
                positions,
                source: PointSource::File("points3D.bin".into()),
            },
            has_alpha: false,
            warnings: Vec::new(),
            notes: Vec::new(),
            unknown: None,
            frame: CaptureFrame::default(),
        }
    }

    #[test]
    fn points_behind_all_cameras_are_reported() {
        let message = unseen_warning(&dataset(-3.0)).unwrap();
        for word in ["points3D.bin", "0 of 2000 of its 5000 points", "2000 lie behind all"] {
            assert!(message.contains(word), "{word} in {message}");
        }
        // In front, and beside the picture.
        let mut beside = dataset(3.0);
        beside.points.positions.iter_mut().for_each(|p| p[0] += 100.0);
        assert!(unseen_warning(&beside).unwrap().contains("0 lie behind all"));
    }

    #[test]
    fn what_some_training_camera_shows_is_fine() {
        assert_eq!(unseen_warning(&dataset(3.0)), None);
        // Most of a place may lie behind, as long as a part is seen.
        let mut part = dataset(-3.0);
        part.points.positions.iter_mut().step_by(20).for_each(|p| p[2] = 3.0);
        assert_eq!(unseen_warning(&part), None);
        // Only a camera that is held out looks there.
        let mut turned = dataset(-3.0);
        turned.frames[1].camera.camera_from_world.rotation = DMat3::from_rotation_y(std::f64::consts::PI);
        assert!(unseen_warning(&turned).is_some());
    }
}
