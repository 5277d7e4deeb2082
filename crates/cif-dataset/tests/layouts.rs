//! Every layout becomes the same kind of dataset.

mod support;

use std::path::Path;

use cif_dataset::{Dataset, Frame, Layout, OpenOptions, PointSource, Split};
use glam::{DVec2, DVec3};
use serde_json::json;
use support::*;
use tempfile::TempDir;

fn names(dataset: &Dataset, split: Split) -> Vec<&str> {
    dataset.split_frames(split).into_iter().map(|index| dataset.frames[index].name.as_str()).collect()
}

#[test]
fn all_layouts_agree_about_one_camera() {
    let (axes, centre) = ring_camera(2);
    let captures = [
        (hypernerf(4), Layout::HyperNerf, "000002"),
        (neu3d(3, 2), Layout::Neu3d, "cam02/0001"),
        (dynamic_gaussians(3, 2), Layout::DynamicGaussians, "2/000020"),
        (llff(4), Layout::Llff, "00002"),
        (dnerf(4, 2), Layout::DNerf, "train/r_002"),
        (nerfstudio(4), Layout::Nerfstudio, "0002"),
        (colmap_text(4), Layout::Colmap, "0002"),
        (colmap_binary(4), Layout::Colmap, "0002"),
    ];
    for (folder, layout, name) in captures {
        let dataset = open(&folder);
        assert_eq!(dataset.layout, layout);
        let frame = dataset.frames.iter().find(|frame| frame.name == name).unwrap();
        let camera = &frame.camera;
        assert_eq!((camera.width, camera.height), (WIDTH, HEIGHT), "{layout}");
        assert!((camera.focal_px - DVec2::splat(FOCAL)).length() < 1e-9, "{layout}: {}", camera.focal_px);
        assert!(camera.centre().distance(centre) < 1e-9, "{layout}: {}", camera.centre());
        assert!(camera.forward().distance(axes.z_axis) < 1e-9, "{layout}: {}", camera.forward());
        // A point to the right of and below the axis lands right of and below the principal point.
        let point = centre + axes.z_axis * 2.0 + axes.x_axis * 0.1 + axes.y_axis * 0.2;
        let (pixel, depth) = camera.project(point).unwrap();
        assert!((pixel - camera.principal_px - DVec2::new(2.0, 4.0)).length() < 1e-9, "{layout}: {pixel}");
        assert!((depth - 2.0).abs() < 1e-9);
        let principal = match layout {
            Layout::Neu3d | Layout::Llff | Layout::DNerf => DVec2::new(16.0, 12.0),
            _ => DVec2::new(16.5, 11.0),
        };
        assert_eq!(camera.principal_px, principal, "{layout}");
    }
}

#[test]
fn hypernerf_lists_times_groups_and_labels() {
    let folder = hypernerf(7);
    let splits =
        json!({"train": ["000000"], "interp": ["000001"], "novel": ["000004", "000099"], "odd": ["000000"]});
    write_json(&folder.path().join("splits.json"), &splits);
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Val), ["000001", "000004"]);
    assert_eq!(names(&dataset, Split::Train).len(), 5);
    assert_eq!(dataset.frames[1].group.as_deref(), Some("interp"));
    assert_eq!(dataset.frames[4].group.as_deref(), Some("novel"));
    assert_eq!(dataset.frames[0].group, None);
    assert!(warns(&dataset, &["splits.json", "novel", "000099"]));
    assert!(warns(&dataset, &["splits.json", "odd", "training", "000000"]));
    assert_eq!(dataset.times.len(), 7);
    assert_eq!((dataset.frames[3].time, dataset.frames[3].time_index), (0.5, 3));
    let labels: Vec<_> =
        dataset.instances.iter().map(|i| (i.id, i.label.as_str(), i.category.as_str())).collect();
    assert_eq!(labels, [(1, "red mug", "mug"), (2, "blue ball", "blue ball")]);
    assert_eq!(dataset.points.positions, [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]]);
    assert!(matches!(&dataset.points.source, PointSource::File(path) if path.ends_with("points.npy")));
    // points.npy has no colours: they come from the images, whose blue is 10 per frame.
    assert_ne!(dataset.points.colors[0], [128; 3]);
    let (_, centre) = ring_camera(0);
    assert!(dataset.extent() > 0.5 && dataset.extent() < 1.1 * 2.0 * centre.length());
}

#[test]
fn hypernerf_without_validation_ids_holds_out_two_after_every_fourth() {
    let folder = hypernerf(9);
    edit_json(&folder.path().join("dataset.json"), |value| {
        value["val_ids"] = json!([]);
        value["train_ids"] = json!([]);
    });
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Train), ["000000", "000004", "000008"]);
    assert_eq!(names(&dataset, Split::Val), ["000002", "000006"]);
}

#[test]
fn hypernerf_reduced_images_are_used_or_made() {
    let folder = hypernerf(3);
    for k in 0..3 {
        let path = folder.path().join(format!("rgb/2x/{k:06}.png"));
        write_rgb(&path, WIDTH / 2, HEIGHT / 2, |_, _| [9, 9, 9]);
    }
    let reduced = |factor| {
        Dataset::open(folder.path(), &OpenOptions { downscale: Some(factor), ..OpenOptions::default() })
            .unwrap()
    };
    let half = reduced(2);
    assert!(half.frames[0].image.ends_with("2x/000000.png"));
    assert_eq!((half.frames[0].camera.width, half.frames[0].camera.focal_px.x), (16, 20.0));
    let quarter = reduced(4);
    assert!(quarter.frames[0].image.ends_with("2x/000000.png"));
    let data = quarter.load_frame(0, [0.0; 3]).unwrap();
    assert_eq!((data.image.width, data.image.height), (8, 6));
    assert_eq!(data.mask.as_ref().map(|mask| (mask.width, mask.height)), Some((8, 6)));
    assert_eq!(quarter.frames[0].camera.principal_px, DVec2::new(4.125, 2.75));
    let third = reduced(3);
    assert!(third.frames[0].image.ends_with("1x/000000.png"));
    assert_eq!(third.load_frame(0, [0.0; 3]).unwrap().image.width, 11);
}

#[test]
fn the_principal_point_can_be_centred() {
    let folder = hypernerf(3);
    let options = OpenOptions { centre_principal_point: true, ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    assert_eq!(dataset.frames[0].camera.principal_px, DVec2::new(16.0, 12.0));
}

#[test]
fn a_window_of_time_has_its_frames_and_the_instances_and_points_of_all() {
    let folder = hypernerf(40);
    let all = open(&folder);
    let seen = |window: &str| {
        let options = OpenOptions { window: Some(window.parse().unwrap()), ..OpenOptions::default() };
        Dataset::open(folder.path(), &options)
    };
    // Nine and ten times of its own, and two of each neighbour.
    for (window, first, last) in [("1/4", 0, 11), ("2/4", 8, 21), ("4/4", 28, 39)] {
        let part = seen(window).unwrap();
        let names: Vec<&str> = part.frames.iter().map(|frame| frame.name.as_str()).collect();
        let expected: Vec<&Frame> =
            all.frames.iter().filter(|frame| (first..=last).contains(&frame.time_index)).collect();
        assert_eq!(names, expected.iter().map(|frame| frame.name.as_str()).collect::<Vec<_>>());
        assert_eq!((part.times[0], part.times[part.times.len() - 1]), (0.0, 1.0));
        for (frame, whole) in part.frames.iter().zip(&expected) {
            assert_eq!((frame.time_index, frame.split), (whole.time_index - first, whole.split));
            assert_eq!(part.times[frame.time_index], frame.time);
            assert_eq!(frame.camera, whole.camera);
        }
        assert_eq!((&part.instances, &part.points), (&all.instances, &all.points));
        let found = part.window.unwrap();
        assert_eq!((found.window.to_string().as_str(), found.first), (window, first));
    }
    let error = seen("3/11").unwrap_err().to_string();
    assert!(error.contains("its 40 times are too few for 11 windows; give at most 10"), "{error}");
}

#[test]
fn lenses_are_removed_from_image_and_mask() {
    let folder = hypernerf(3);
    edit_json(&folder.path().join("camera/000000.json"), |camera| {
        camera["radial_distortion"] = json!([-0.3, 0.0, 0.0]);
        camera["skew"] = json!(0.5);
    });
    let dataset = open(&folder);
    let frame = &dataset.frames[0];
    assert_eq!((frame.lens.radial[0], frame.lens.skew_px), (-0.3, 0.5));
    let data = dataset.load_frame(0, [0.0; 3]).unwrap();
    // Red is 7 per column as captured: an ideal pixel must show the column that the lens took it to.
    let (x, y) = (28, 20);
    let ideal = (DVec2::new(28.5, 20.5) - frame.camera.principal_px) / frame.camera.focal_px;
    let captured = frame.lens.distort(ideal);
    let column = FOCAL * captured.x + 0.5 * captured.y + 16.5 - 0.5;
    let red = f64::from(data.image.at(x, y)[0]);
    assert!((red - 7.0 * column).abs() < 1.0, "{red} {}", 7.0 * column);
    assert!(data.mask.unwrap().pixels.iter().all(|id| *id <= 2));
}

#[test]
fn neu3d_holds_out_cam00_and_counts_frames() {
    let folder = neu3d(3, 5);
    let dataset = open(&folder);
    assert_eq!((dataset.train_frames().len(), dataset.val_frames().len()), (10, 5));
    assert!(dataset.val_frames().iter().all(|index| dataset.frames[*index].camera_name == "cam00"));
    assert_eq!(dataset.times, [0.0, 0.2, 0.4, 0.6, 0.8]);
    // Ordered by camera and time.
    let order: Vec<&str> = dataset.frames.iter().map(|frame| frame.name.as_str()).take(6).collect();
    assert_eq!(order, ["cam00/0000", "cam00/0001", "cam00/0002", "cam00/0003", "cam00/0004", "cam01/0000"]);
    assert!(dataset.frames[7].mask.as_ref().unwrap().ends_with("cam01/masks/0002.png"));
    assert!(warns(&dataset, &["no instances.json"]));
    assert_eq!(dataset.instances[0].label, "instance_1");
    assert_eq!(dataset.points.source, PointSource::Random);
}

#[test]
fn frame_numbers_may_outgrow_their_zeros() {
    let folder = neu3d(1, 2);
    let images = folder.path().join("cam00/images");
    std::fs::rename(images.join("0000.png"), images.join("9999.png")).unwrap();
    std::fs::rename(images.join("0001.png"), images.join("10000.png")).unwrap();
    let dataset = open(&folder);
    let order: Vec<(&str, f64)> =
        dataset.frames.iter().map(|frame| (frame.name.as_str(), frame.time)).collect();
    assert_eq!(order, [("cam00/9999", 0.0), ("cam00/10000", 0.5)]);
}

#[test]
fn neu3d_masks_may_lie_next_to_the_cameras_and_a_step_may_be_missing() {
    let folder = neu3d(2, 4);
    std::fs::remove_file(folder.path().join("cam01/images/0001.png")).unwrap();
    for step in 0..4 {
        let path = folder.path().join(format!("tracked/cam01/{step:04}.png"));
        write_mask(&path, WIDTH, HEIGHT, |_, _| 9);
    }
    let options = OpenOptions { masks: Some("tracked".into()), ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    assert!(warns(&dataset, &["cam01", "1 of 4"]));
    let frame = dataset.frames.iter().find(|frame| frame.name == "cam01/0002").unwrap();
    assert_eq!((frame.time, frame.time_index), (0.5, 2));
    assert!(frame.mask.as_ref().unwrap().ends_with("tracked/cam01/0002.png"));
    assert_eq!(dataset.instances.iter().map(|i| i.id).collect::<Vec<_>>(), [9]);
    assert!(dataset.frames[0].mask.is_none() && notes(&dataset, &["0 of 4 held-out frames have a mask"]));
    std::fs::remove_file(folder.path().join("tracked/cam01/0002.png")).unwrap();
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    assert!(warns(&dataset, &["2 of 7 frames have a mask"]));
}

#[test]
fn dnerf_normalises_times_and_composites_alpha() {
    let folder = dnerf(3, 2);
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Val), ["test/r_000", "test/r_001"]);
    assert_eq!(dataset.times, [0.0, 0.5, 1.0]);
    assert!(dataset.has_alpha);
    let index = dataset.frames.iter().position(|frame| frame.name == "train/r_001").unwrap();
    let image = dataset.load_frame(index, [1.0, 0.5, 0.0]).unwrap().image;
    assert_eq!(*image.at(0, 3), [255, 128, 0]);
    assert_eq!(*image.at(20, 3), [140, 30, 10]);
    assert_eq!(dataset.points.positions.len(), 2000);
    assert!(dataset.points.positions.iter().flatten().all(|v| v.abs() <= 1.3));
}

#[test]
fn dnerf_takes_validation_frames_only_without_test_frames() {
    let folder = dnerf(3, 2);
    let root = folder.path();
    std::fs::copy(root.join("transforms_test.json"), root.join("transforms_val.json")).unwrap();
    assert!(notes(&open(&folder), &["not used", "transforms_val.json"]));
    std::fs::remove_file(root.join("transforms_test.json")).unwrap();
    let dataset = open(&folder);
    assert_eq!(dataset.val_frames().len(), 2);
    std::fs::remove_file(root.join("transforms_val.json")).unwrap();
    assert!(warns(&open(&folder), &["nothing is held out"]));
}

#[test]
fn nerfstudio_holds_out_every_eighth_and_honours_lists() {
    let folder = nerfstudio(10);
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Val), ["0000", "0008"]);
    assert_eq!(dataset.times, [0.0]);
    edit_json(&folder.path().join("transforms.json"), |value| {
        value["train_filenames"] = json!(["images/0000.png", "images/0001.png", "images/0002.png"]);
        value["val_filenames"] = json!(["./images/0003.png"]);
        value["test_filenames"] = json!(["images/0004.png"]);
    });
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Train), ["0000", "0001", "0002"]);
    assert_eq!(names(&dataset, Split::Val), ["0003", "0004"]);
    assert!(notes(&dataset, &["not used", "5 frames"]));
}

#[test]
fn nerfstudio_frames_override_intrinsics_and_may_have_times_masks_and_points() {
    let folder = nerfstudio(3);
    let root = folder.path();
    edit_json(&root.join("transforms.json"), |value| {
        value["k1"] = json!(0.01);
        value["ply_file_path"] = json!("sfm.ply");
        for k in 0..3 {
            value["frames"][k]["time"] = json!(k as f64 * 5.0);
            value["frames"][k]["mask_path"] = json!(format!("ids/{k}.png"));
        }
        value["frames"][1]["fl_x"] = json!(50.0);
        value["frames"][1]["k1"] = json!(0.0);
    });
    for k in 0..3 {
        write_mask(&root.join(format!("ids/{k}.png")), WIDTH, HEIGHT, |_, _| 3);
    }
    write(
        &root.join("sfm.ply"),
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 1 2 3\n1 0.5 0 4 5 6\n",
    );
    let dataset = open(&folder);
    assert_eq!(dataset.frames[1].camera.focal_px, DVec2::new(50.0, FOCAL));
    assert!(dataset.frames[1].lens.is_identity() && !dataset.frames[0].lens.is_identity());
    assert_eq!(dataset.times, [0.0, 0.5, 1.0]);
    assert_eq!(dataset.points.colors, [[1, 2, 3], [4, 5, 6]]);
    assert_eq!(dataset.points.positions[1], [1.0, 0.5, 0.0]);
    assert_eq!(dataset.instances[0].id, 3);
}

#[test]
fn nerfstudio_captures_may_state_that_they_know_neither_metre_nor_up() {
    let folder = nerfstudio(3);
    assert!(!warns(&open(&folder), &["guesses"]), "files that do not state it are taken at their word");
    for (metres, up, warning) in [
        (false, false, &["neither", "masses"][..]),
        (false, true, &["metre", "masses"]),
        (true, false, &["up", "gravity"]),
    ] {
        edit_json(&folder.path().join("transforms.json"), |value| {
            value["cif"] = json!({ "metres_known": metres, "up_known": up, "poses_from": "images" });
        });
        assert!(warns(&open(&folder), warning), "{warning:?}");
    }
    edit_json(&folder.path().join("transforms.json"), |value| {
        value["cif"] = json!({ "metres_known": true, "up_known": true });
    });
    assert!(!warns(&open(&folder), &["guesses"]));
}

#[test]
fn colmap_text_and_binary_are_the_same_capture() {
    let (text, binary) = (colmap_text(10), colmap_binary(10));
    let (text, binary) = (open(&text), open(&binary));
    assert_eq!(names(&text, Split::Val), ["0000", "0008"]);
    assert_eq!(text.points.positions, [[0.5, -0.25, 1.0], [0.0, 0.0, 0.0]]);
    assert_eq!(text.points.colors, [[10, 20, 30], [1, 2, 3]]);
    assert_eq!(text.points.positions, binary.points.positions);
    assert_eq!(text.points.colors, binary.points.colors);
    for (a, b) in text.frames.iter().zip(&binary.frames) {
        assert_eq!((&a.name, a.split), (&b.name, b.split));
        let point = DVec3::new(0.1, 0.2, 0.3);
        let (p, q) = (a.camera.project(point).unwrap(), b.camera.project(point).unwrap());
        assert!((p.0 - q.0).length() < 1e-9);
    }
}

#[test]
fn colmap_models_carry_their_distortion() {
    let folder = colmap_text(2);
    let cameras = folder.path().join("sparse/0/cameras.txt");
    for (model, radial, tangential) in [
        ("SIMPLE_PINHOLE 32 24 40 16 12", [0.0; 4], [0.0; 2]),
        ("SIMPLE_RADIAL 32 24 40 16 12 0.1", [0.1, 0.0, 0.0, 0.0], [0.0; 2]),
        ("RADIAL 32 24 40 16 12 0.1 0.02", [0.1, 0.02, 0.0, 0.0], [0.0; 2]),
        ("OPENCV 32 24 40 40 16 12 0.1 0.02 0.003 0.004", [0.1, 0.02, 0.0, 0.0], [0.003, 0.004]),
        (
            "FULL_OPENCV 32 24 40 40 16 12 0.1 0.02 0.003 0.004 0.5 0 0 0",
            [0.1, 0.02, 0.5, 0.0],
            [0.003, 0.004],
        ),
    ] {
        write(&cameras, format!("1 {model}\n"));
        let dataset = open(&folder);
        assert_eq!(dataset.frames[0].lens.radial, radial, "{model}");
        assert_eq!(dataset.frames[0].lens.tangential, tangential, "{model}");
        assert_eq!(dataset.frames[0].camera.focal_px, DVec2::splat(40.0));
    }
    for model in ["OPENCV_FISHEYE 32 24 40 40 16 12 0 0 0 0", "FULL_OPENCV 32 24 40 40 16 12 0 0 0 0 0 1 0 0"]
    {
        write(&cameras, format!("1 {model}\n"));
        holds(&failure(&folder), &["cameras.txt", "not supported", "image_undistorter"]);
    }
    write(&cameras, "1 PINHOLE 32 24 40 16 12\n");
    holds(&failure(&folder), &["PINHOLE", "3 parameters", "4"]);
}

#[test]
fn a_reconstruction_next_to_another_layout_only_warns() {
    let folder = nerfstudio(3);
    write(&folder.path().join("sparse/0/cameras.txt"), "1 PINHOLE 32 24 40 40 16 12\n");
    let dataset = open(&folder);
    assert_eq!(dataset.layout, Layout::Nerfstudio);
    assert!(notes(&dataset, &["COLMAP", "--layout colmap"]));
}

#[test]
fn other_pairs_of_layouts_need_a_choice() {
    let folder = dnerf(3, 2);
    let mut value: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("transforms_train.json")).unwrap()).unwrap();
    value["k1"] = json!(0.0);
    write_json(&folder.path().join("transforms.json"), &value);
    holds(&failure(&folder), &["d-nerf", "nerfstudio", "--layout", "transforms.json"]);
    let options = OpenOptions { layout: Some(Layout::Nerfstudio), ..OpenOptions::default() };
    assert_eq!(Dataset::open(folder.path(), &options).unwrap().layout, Layout::Nerfstudio);
}

#[test]
fn absolute_paths_of_images_give_names_inside_the_capture() {
    // As some tools write them: inside the capture, in a folder elsewhere, or up and down again.
    let absolute = |root: &Path, folder: &TempDir, file: &str| {
        edit_json(&folder.path().join(file), |value| {
            for frame in value["frames"].as_array_mut().unwrap() {
                let path = frame["file_path"].as_str().unwrap().trim_start_matches("./").to_owned();
                frame["file_path"] = json!(root.join(path));
            }
        });
    };
    let folder = dnerf(2, 1);
    for file in ["transforms_train.json", "transforms_test.json"] {
        absolute(folder.path(), &folder, file);
    }
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Train), ["train/r_000", "train/r_001"]);
    assert_eq!(names(&dataset, Split::Val), ["test/r_000"]);

    let (elsewhere, folder) = (dnerf(2, 1), dnerf(2, 1));
    for file in ["transforms_train.json", "transforms_test.json"] {
        absolute(elsewhere.path(), &folder, file);
    }
    assert_eq!(names(&open(&folder), Split::Train), ["train/r_000", "train/r_001"]);

    let folder = nerfstudio(2);
    absolute(&folder.path().join("images/.."), &folder, "transforms.json");
    assert_eq!(names(&open(&folder), Split::Train), ["0001"]);
}
