//! Poses of COLMAP and nerfstudio, by the names of images.

use std::fs;
use std::path::Path;

use cif_dataset::orientation::Orientation;
use glam::DVec3;

use super::*;
use crate::picture::Impression;
use crate::picture::tests::board;

fn shot(name: &str) -> Shot {
    Shot {
        camera: "a".to_owned(),
        name: name.to_owned(),
        file: name.into(),
        time: None,
        size: (64, 48),
        turned: Orientation::NoTransforms,
        impression: Impression::of(&board(50, 0)),
        source: None,
    }
}

fn colmap(folder: &Path) {
    fs::create_dir_all(folder).unwrap();
    fs::write(folder.join("cameras.txt"), "# cameras\n1 SIMPLE_RADIAL 64 48 50 32 24 -0.1\n").unwrap();
    let images = "1 1 0 0 0 1 2 3 1 one.jpg\n\n2 0 1 0 0 0 0 4 1 sub/two.jpg\n\n";
    fs::write(folder.join("images.txt"), images).unwrap();
    fs::write(folder.join("points3D.txt"), "1 0.5 0.25 2 10 20 30 0.1 1 0 2 0\n").unwrap();
}

#[test]
fn a_colmap_model_is_read_and_matched_by_name() {
    let root = tempfile::tempdir().unwrap();
    colmap(&root.path().join("sparse/0"));
    let mut shots = [shot("one.png"), shot("cam/two.png"), shot("three.png")];
    let found = read(root.path(), &shots).unwrap();
    assert_eq!((found.tool, found.metres_known, found.up_known), ("COLMAP", false, false));
    let found = found.matched(root.path(), &mut shots).unwrap();
    assert_eq!(found.poses.images.keys().collect::<Vec<_>>(), ["cam/two.png", "one.png"]);
    assert_eq!(found.poses.images["one.png"].world_from_camera.translation, DVec3::new(-1.0, -2.0, -3.0));
    // Turned by half about x.
    assert!(
        (found.poses.images["cam/two.png"].world_from_camera.translation - 4.0 * DVec3::Z).length() < 1e-9
    );
    assert_eq!((found.poses.lenses.len(), found.poses.lenses[0].distortion.radial[0]), (1, -0.1));
    assert_eq!(found.poses.points, [Point { position: DVec3::new(0.5, 0.25, 2.0), color: [10, 20, 30] }]);
    let error = read(root.path(), &shots).unwrap().matched(root.path(), &mut [shot("x.png")]).unwrap_err();
    assert!(error.to_string().contains("fit no image"), "{error}");
}

#[test]
fn a_transforms_file_brings_times_too() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("transforms.json");
    let text = r#"{"fl_x": 60, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [
        {"file_path": "./images/one.jpg", "time": 1.5,
         "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}]}"#;
    fs::write(&file, text).unwrap();
    let mut shots = [shot("one.png")];
    for path in [root.path(), &file] {
        let found = read(path, &shots).unwrap().matched(path, &mut shots).unwrap();
        let pose = found.poses.images["one.png"].world_from_camera;
        assert_eq!((pose.translation, pose.rotation * DVec3::Z), (DVec3::new(1.0, 2.0, 3.0), -DVec3::Z));
        assert_eq!(shots[0].time, Some(1.5));
    }
    fs::write(&file, text.replace("\"w\": 64,", "")).unwrap();
    let error = read(&file, &shots).unwrap_err().to_string();
    assert!(error.contains("size") && error.contains("transforms.json"), "{error}");
    fs::write(&file, text.replace("[1,0,0,1]", "[2,0,0,1]")).unwrap();
    let error = read(&file, &shots).unwrap_err().to_string();
    assert!(error.contains("one.jpg") && error.contains("rigid"), "{error}");
}

#[test]
fn what_is_of_no_tool_is_refused_with_those_that_are_known() {
    let root = tempfile::tempdir().unwrap();
    let Err(Error::System(cif_system::Error::Refused { problem, fix })) = read(root.path(), &[]) else {
        panic!("poses of nothing")
    };
    assert!(
        problem.contains("no poses") && fix.contains("COLMAP") && fix.contains("Polycam"),
        "{problem} {fix}"
    );
}

/// Size of an image, the place of a point in it, and what was noted.
type Seen = ((u32, u32), [f64; 2], Vec<String>);

/// Where the pose of the only camera of a COLMAP model sees a point, in an image of this size that was turned so.
fn seen(root: &Path, size: (u32, u32), turned: Orientation) -> Result<Seen, Error> {
    let mut shots = [Shot { size, turned, ..shot("one.png") }];
    let found = read(root, &shots)?.matched(root, &mut shots)?;
    let pose = found.poses.images["one.png"];
    let lens = found.poses.lenses[pose.lens].scaled(size);
    // 0.25 right of, 0.5 below and 2 before the camera of the model.
    let point = DVec3::new(-1.0 + 0.25, -2.0 + 0.5, -3.0 + 2.0);
    let p = pose.world_from_camera.inverse().apply(point);
    let pixel = [0, 1].map(|k| lens.focal_px[k] * p[k] / p.z + lens.principal_px[k]);
    Ok((lens.size, pixel, found.notes))
}

#[test]
fn poses_of_stored_pixels_turn_with_their_photographs() {
    let root = tempfile::tempdir().unwrap();
    let camera = |text: &str| fs::write(root.path().join("cameras.txt"), text).unwrap();
    fs::write(root.path().join("images.txt"), "1 1 0 0 0 1 2 3 1 one.jpg\n\n").unwrap();
    // Seen in the stored image, of 64 x 48, at (30, 20) + 40 * (0.125, 0.25) = (35, 30).
    camera("1 PINHOLE 64 48 40 40 30 20\n");
    for (turned, size, pixel) in [
        (Orientation::NoTransforms, (64, 48), [35.0, 30.0]),
        (Orientation::Rotate90, (48, 64), [18.0, 35.0]),
        (Orientation::Rotate180, (64, 48), [29.0, 18.0]),
        (Orientation::Rotate270, (48, 64), [30.0, 29.0]),
    ] {
        let (of, found, notes) = seen(root.path(), size, turned).unwrap();
        assert_eq!(of, size);
        assert!((0..2).all(|k| (found[k] - pixel[k]).abs() < 1e-9), "{turned:?}: {found:?}");
        assert_eq!(notes.len(), usize::from(turned != Orientation::NoTransforms), "{notes:?}");
    }
    let message = seen(root.path(), (48, 64), Orientation::Rotate90FlipH).unwrap_err().to_string();
    assert!(message.contains("one.png") && message.contains("mirrors"), "{message}");
    // Of photographs that were turned upright before.
    camera("1 PINHOLE 96 128 80 80 50 60\n");
    let (_, found, notes) = seen(root.path(), (48, 64), Orientation::Rotate90).unwrap();
    assert!(
        (0..2).all(|k| (found[k] - [30.0, 40.0][k]).abs() < 1e-9) && notes.is_empty(),
        "{found:?} {notes:?}"
    );
    for turned in [Orientation::NoTransforms, Orientation::Rotate90] {
        camera("1 PINHOLE 60 60 80 80 30 30\n");
        let message = seen(root.path(), (48, 64), turned).unwrap_err().to_string();
        assert!(
            message.contains("60 x 60") && message.contains("48 x 64") && message.contains("aspect"),
            "{message}"
        );
    }
}
