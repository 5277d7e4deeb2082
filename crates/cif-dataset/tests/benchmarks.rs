//! Captures of published benchmarks, in the layouts of their own code.

mod support;

use std::fs;
use std::path::Path;

use cif_dataset::{Dataset, Layout, OpenOptions, PointSource, Split};
use glam::{DMat3, DVec3};
use serde_json::json;
use support::*;

fn names(dataset: &Dataset, split: Split) -> Vec<&str> {
    dataset.split_frames(split).into_iter().map(|index| dataset.frames[index].name.as_str()).collect()
}

/// A point cloud drawn in a cube with random colours, as 3DGS leaves it.
fn write_cube(path: &Path, count: usize) {
    let mut state = 1_u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1_u32 << 31)
    };
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    );
    for _ in 0..count {
        let [x, y, z] = [(); 3].map(|()| next() * 2.6 - 1.3);
        let [r, g, b] = [(); 3].map(|()| (next() * 255.0) as u8);
        text.push_str(&format!("{x} {y} {z} {r} {g} {b}\n"));
    }
    write(path, text);
}

#[test]
fn dynamic_gaussians_have_cameras_times_a_split_and_a_foreground() {
    let folder = dynamic_gaussians(4, 3);
    // Every time may have a camera of its own.
    edit_json(&folder.path().join("train_meta.json"), |meta| {
        meta["k"][1][0] = json!([[50.0, 0.5, 15.0], [0.0, 60.0, 10.0], [0.0, 0.0, 1.0]]);
    });
    let dataset = open(&folder);
    assert_eq!(dataset.layout, Layout::DynamicGaussians);
    assert_eq!(names(&dataset, Split::Val), ["0/000010", "0/000020", "0/000030"]);
    assert_eq!((dataset.frames.len(), dataset.train_frames().len()), (12, 9));
    assert_eq!(dataset.times, [0.0, 0.5, 1.0]);
    let frame = dataset.frames.iter().find(|frame| frame.name == "1/000020").unwrap();
    assert_eq!((frame.camera_name.as_str(), frame.time), ("camera_1", 0.5));
    assert_eq!(frame.camera.focal_px.to_array(), [50.0, 60.0]);
    assert_eq!((frame.camera.principal_px.to_array(), frame.lens.skew_px), ([15.0, 10.0], 0.5));
    assert!(frame.mask.as_ref().unwrap().ends_with("seg/1/000020.png"));
    // Two values are one thing and the rest; held-out views without masks are no oddity.
    let instances: Vec<(u16, &str)> =
        dataset.instances.iter().map(|instance| (instance.id, instance.label.as_str())).collect();
    assert_eq!(instances, [(255, "foreground")]);
    assert!(dataset.warnings.is_empty(), "{:?}", dataset.warnings);
    assert!(notes(&dataset, &["seg", "0 of 3 held-out frames", "scored on none"]), "{:?}", dataset.notes);
    assert!(notes(&dataset, &["seg", "255", "foreground"]));
    // As published: one bit per pixel.
    for camera in 1..4 {
        for step in 1..4 {
            let path = folder.path().join(format!("seg/{camera}/{:06}.png", 10 * step));
            write_bits(&path, WIDTH, HEIGHT, |x, _| x > 15);
        }
    }
    let dataset = open(&folder);
    assert_eq!((dataset.instances[0].id, dataset.instances[0].label.as_str()), (1, "foreground"));
    assert!(dataset.warnings.is_empty(), "{:?}", dataset.warnings);
    assert_eq!(dataset.points.source, PointSource::Random);
}

#[test]
fn dynamic_gaussians_bring_points_and_better_masks_go_first() {
    let folder = dynamic_gaussians(3, 2);
    let rows = [0.1, 0.2, 0.3, 1.0, 0.5, 0.0, 1.0, -0.1, 0.0, 0.4, 0.2, 2.0, f64::NAN, 0.0];
    write(&folder.path().join("init_pt_cld.npz"), npz("data", "(2, 7)", &rows));
    for name in ["0/000010", "1/000010", "1/000020", "2/000010", "2/000020"] {
        write_mask(&folder.path().join(format!("masks/{name}.png")), WIDTH, HEIGHT, |x, _| (x / 11) as u8);
    }
    let dataset = open(&folder);
    assert_eq!(dataset.points.positions, [[0.1, 0.2, 0.3], [-0.1, 0.0, 0.4]]);
    assert_eq!(dataset.points.colors, [[255, 128, 0], [51, 255, 0]]);
    assert!(matches!(&dataset.points.source, PointSource::File(path) if path.ends_with("init_pt_cld.npz")));
    assert_eq!(dataset.instances.iter().map(|i| i.id).collect::<Vec<_>>(), [1, 2]);
    // Of the held-out frames, one can be scored.
    assert!(notes(&dataset, &["masks", "1 of 2 held-out frames", "scored on these"]), "{:?}", dataset.notes);
    assert!(dataset.frames[0].mask.is_some() && dataset.frames[1].mask.is_none());
    write(&folder.path().join("init_pt_cld.npz"), npz("data", "(7, 2)", &rows));
    holds(&failure(&folder), &["init_pt_cld.npz", "data", "[points, 7]"]);
    write(&folder.path().join("init_pt_cld.npz"), npz("points", "(2, 7)", &rows));
    holds(&failure(&folder), &["init_pt_cld.npz", "`data`", "missing"]);
}

#[test]
fn dynamic_gaussians_lists_agree_by_frame_number() {
    let folder = dynamic_gaussians(3, 4);
    // Held out is the third time alone.
    edit_json(&folder.path().join("test_meta.json"), |meta| {
        for key in ["k", "w2c", "fn", "cam_id"] {
            let third = meta[key][2].clone();
            meta[key] = json!([third]);
        }
    });
    let dataset = open(&folder);
    assert_eq!(names(&dataset, Split::Val), ["0/000030"]);
    assert!((dataset.frames[dataset.val_frames()[0]].time - 2.0 / 3.0).abs() < 1e-12);
    // Names without numbers cannot say it.
    fs::rename(folder.path().join("ims/0/000030.jpg"), folder.path().join("ims/0/last.jpg")).unwrap();
    edit_json(&folder.path().join("test_meta.json"), |meta| meta["fn"][0][0] = json!("0/last.jpg"));
    holds(&failure(&folder), &["train_meta.json", "4 and 1 times", "list the same times"]);
}

#[test]
fn damaged_lists_of_dynamic_gaussians_are_named() {
    let damage = |edit: fn(&mut serde_json::Value)| {
        let folder = dynamic_gaussians(3, 2);
        edit_json(&folder.path().join("train_meta.json"), edit);
        failure(&folder)
    };
    holds(&damage(|meta| drop(meta["k"].as_array_mut().unwrap().pop())), &["2 times", "`k` 1"]);
    holds(
        &damage(|meta| drop(meta["w2c"][1].as_array_mut().unwrap().pop())),
        &["train_meta.json", "time 1 has 2 images", "1 entries in `w2c`"],
    );
    holds(&damage(|meta| meta["w2c"][0][1] = json!([[1.0, 0.0, 0.0, 0.0]])), &["2/000010", "4 x 4", "w2c"]);
    holds(&damage(|meta| meta["w2c"][0][1][3] = json!([0.0, 0.0, 0.0, 2.0])), &["2/000010", "last row"]);
    holds(&damage(|meta| meta["k"][0][0] = json!([[1.0]])), &["train_meta.json:", "length 3"]);
    holds(&damage(|meta| meta["k"][0][0][0][0] = json!(0.0)), &["1/000010", "focal length"]);
    holds(&damage(|meta| meta["fn"][0][0] = json!("1/000077.jpg")), &["1/000077", "ims/1/000077", "missing"]);
    holds(
        &damage(|meta| meta["fn"][0][0] = json!("../ims/1/000010.jpg")),
        &["train_meta.json", "paths inside"],
    );
    holds(&damage(|meta| meta["fn"][0][0] = json!("2/000010.jpg")), &["2/000010", "listed twice"]);
    holds(&damage(|meta| meta["h"] = json!(WIDTH)), &["1/000010", "aspect"]);
    holds(&damage(|meta| drop(meta.as_object_mut().unwrap().remove("fn"))), &["train_meta.json", "`fn`"]);
    let folder = dynamic_gaussians(3, 2);
    fs::remove_dir_all(folder.path().join("ims")).unwrap();
    holds(&failure(&folder), &["1/000010", "missing"]);
}

#[test]
fn sequences_of_one_camera_have_a_time_per_image() {
    let folder = llff(18);
    let dataset = open(&folder);
    assert_eq!(dataset.layout, Layout::Llff);
    // Neither the first nor the last: they would have to be foreseen.
    assert_eq!(names(&dataset, Split::Val), ["00001", "00009"]);
    assert_eq!(dataset.times.len(), 18);
    assert_eq!((dataset.frames[0].time, dataset.frames[17].time), (0.0, 1.0));
    assert!(dataset.frames.iter().all(|frame| frame.camera_name == "camera"));
    assert!(warns(&dataset, &["no masks"]) && dataset.warnings.len() == 1, "{:?}", dataset.warnings);
    // Rows follow the names, times the numbers.
    let images = folder.path().join("images");
    fs::rename(images.join("00017.png"), images.join("00016b.png")).unwrap();
    fs::rename(images.join("00000.png"), images.join("9.png")).unwrap();
    let dataset = open(&folder);
    let first = dataset.frames.iter().find(|frame| frame.name == "9").unwrap();
    let centre = ring_camera(17).1;
    assert!(first.time == 0.0 && first.camera.centre().distance(centre) < 1e-9);
}

#[test]
fn reduced_images_of_sequences_are_read_where_they_fit() {
    let folder = llff(9);
    for (name, width, height) in [("images_2", WIDTH / 2, HEIGHT / 2), ("images_20x15", 20, 15)] {
        for k in 0..9 {
            write_rgb(&folder.path().join(format!("{name}/{k:05}.png")), width, height, shade(k));
        }
    }
    let loaded = |downscale: Option<u32>| {
        let options = OpenOptions { downscale, ..OpenOptions::default() };
        let dataset = Dataset::open(folder.path(), &options).unwrap();
        let frame = &dataset.frames[0];
        let from = frame.image.parent().unwrap().file_name().unwrap().to_string_lossy().into_owned();
        (from, frame.camera.width, frame.camera.focal_px.x)
    };
    assert_eq!(loaded(None), ("images".to_owned(), WIDTH, FOCAL));
    assert_eq!(loaded(Some(2)), ("images_2".to_owned(), WIDTH / 2, FOCAL / 2.0));
    assert_eq!(loaded(Some(4)), ("images_2".to_owned(), WIDTH / 4, FOCAL / 4.0));
    assert_eq!(loaded(Some(3)).0, "images");
    // As DynamicNeRF is published: the reduced ones alone.
    fs::remove_dir_all(folder.path().join("images")).unwrap();
    assert_eq!(loaded(None), ("images_20x15".to_owned(), 20, FOCAL * 20.0 / f64::from(WIDTH)));
    fs::remove_dir_all(folder.path().join("images_20x15")).unwrap();
    assert_eq!(loaded(None), ("images_2".to_owned(), WIDTH / 2, FOCAL / 2.0));
}

#[test]
fn sequences_of_nvidias_rig_hold_out_what_the_other_cameras_saw() {
    let folder = llff(14);
    for (time, camera) in [(0, 1), (0, 4), (13, 2), (13, 12)] {
        let path = folder.path().join(format!("mv_images/{time:05}/cam{camera:02}.jpg"));
        write_rgb(&path, WIDTH, HEIGHT, shade(time));
    }
    let dataset = open(&folder);
    assert_eq!(dataset.train_frames().len(), 14);
    // Cameras 1 and 2 took the images of the sequence at these times.
    assert_eq!(names(&dataset, Split::Val), ["mv_images/00000/cam04", "mv_images/00013/cam12"]);
    let frame = &dataset.frames[dataset.val_frames()[1]];
    assert_eq!((frame.time, frame.camera_name.as_str()), (1.0, "cam12"));
    assert!(frame.camera.centre().distance(ring_camera(11).1) < 1e-9);
    write_rgb(&folder.path().join("mv_images/00014/cam03.jpg"), WIDTH, HEIGHT, shade(0));
    let dataset = open(&folder);
    assert_eq!(dataset.val_frames().len(), 2);
    assert!(notes(&dataset, &["not used", "mv_images", "00014/cam03"]), "{:?}", dataset.notes);
}

#[test]
fn endoscopes_that_stand_still_are_upright_and_their_masks_belong_by_number() {
    let folder = llff(10);
    let mut poses = llff_poses(10, [WIDTH, HEIGHT], FOCAL);
    for row in poses.chunks_exact_mut(17) {
        for (r, c) in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)] {
            row[5 * r + c] = f64::from(u8::from(r == c));
        }
        [row[3], row[8], row[13]] = [0.0; 3];
    }
    write(&folder.path().join("poses_bounds.npy"), npy(10, 17, &poses));
    for k in 0..10 {
        let path = folder.path().join(format!("masks/frame-{k:06}.mask.png"));
        write_mask(&path, WIDTH, HEIGHT, |x, _| if x < 8 { 255 } else { 0 });
    }
    let dataset = open(&folder);
    let rotation = dataset.frames[3].camera.camera_from_world.rotation;
    // The identity is right, up, back for EndoNeRF: up in the image is +y of the world.
    assert!(rotation.abs_diff_eq(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), 1e-12));
    assert!(warns(&dataset, &["one camera centre"]));
    assert!(dataset.frames[7].mask.as_ref().unwrap().ends_with("frame-000007.mask.png"));
    assert!(notes(&dataset, &["by their numbers", "frame-000000.mask.png for 00000"]), "{:?}", dataset.notes);
    // EndoNeRF leaves out what is 255, the instruments; nobody can know that from the files.
    assert_eq!(dataset.instances[0].label, "foreground");
    assert!(warns(&dataset, &["apart from 0 (255)", "--no-masks"]), "{:?}", dataset.warnings);
    // Two files of one number belong to nobody.
    write_mask(&folder.path().join("masks/7.png"), WIDTH, HEIGHT, |_, _| 1);
    assert!(open(&folder).frames[7].mask.is_none());
}

#[test]
fn sequences_take_the_points_of_their_reconstruction_where_it_is_theirs() {
    let folder = llff(4);
    let colmap = colmap_text(4);
    for name in ["cameras.txt", "images.txt", "points3D.txt"] {
        let text = fs::read(colmap.path().join("sparse/0").join(name)).unwrap();
        write(&folder.path().join("sparse/0").join(name), text);
    }
    // COLMAP names its images 0000.png, those of the sequence are 00000.png.
    assert_eq!(open(&folder).points.source, PointSource::Random);
    for k in 0..4 {
        let images = folder.path().join("images");
        fs::rename(images.join(format!("{k:05}.png")), images.join(format!("{k:04}.png"))).unwrap();
    }
    let dataset = open(&folder);
    assert_eq!(dataset.layout, Layout::Llff);
    assert!(notes(&dataset, &["llff", "--layout colmap", "without times"]), "{:?}", dataset.notes);
    assert_eq!(dataset.points.positions, [[0.5, -0.25, 1.0], [0.0, 0.0, 0.0]]);
    let options = OpenOptions { layout: Some(Layout::Colmap), ..OpenOptions::default() };
    assert_eq!(Dataset::open(folder.path(), &options).unwrap().times, [0.0]);
    // The same cameras in another frame.
    let mut poses = llff_poses(4, [WIDTH, HEIGHT], FOCAL);
    poses.chunks_exact_mut(17).for_each(|row| row[3] += 0.5);
    write(&folder.path().join("poses_bounds.npy"), npy(4, 17, &poses));
    let dataset = open(&folder);
    assert!(notes(&dataset, &["sparse/0", "2 points are moved", "4 cameras"]), "{:?}", dataset.notes);
    let moved = [[1.0, -0.25, 1.0], [0.5, 0.0, 0.0]];
    let near = |(a, b): (&[f32; 3], &[f32; 3])| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    assert!(dataset.points.positions.iter().zip(&moved).all(near), "{:?}", dataset.points.positions);
    // Other cameras.
    poses[3] += 0.2;
    write(&folder.path().join("poses_bounds.npy"), npy(4, 17, &poses));
    let dataset = open(&folder);
    assert_eq!(dataset.points.source, PointSource::Random);
    assert!(notes(&dataset, &["sparse/0", "not taken"]), "{:?}", dataset.notes);
}

#[test]
fn files_left_over_from_another_layout_do_not_stand_in_the_way() {
    let folder = llff(4);
    write_json(&folder.path().join("dataset.json"), &json!({"ids": ["00000"]}));
    let dataset = open(&folder);
    assert_eq!(dataset.layout, Layout::Llff);
    assert!(notes(&dataset, &["llff", "of hyper-nerf there is only dataset.json"]), "{:?}", dataset.notes);
    // Where it is forced, or nothing else is there, what is missing is named.
    let options = OpenOptions { layout: Some(Layout::HyperNerf), ..OpenOptions::default() };
    holds(&failure_with(&folder, &options), &["metadata.json", "missing"]);
    fs::remove_file(folder.path().join("poses_bounds.npy")).unwrap();
    holds(&failure(&folder), &["metadata.json", "missing"]);
}

#[test]
fn damaged_sequences_are_named() {
    let folder = llff(4);
    fs::remove_file(folder.path().join("images/00002.png")).unwrap();
    holds(&failure(&folder), &["poses_bounds.npy", "4 rows", "3 images", "name order"]);
    let folder = llff(2);
    write(&folder.path().join("poses_bounds.npy"), npy(2, 14, &[0.0; 28]));
    holds(&failure(&folder), &["poses_bounds.npy", "14 values", "17"]);
    write(&folder.path().join("poses_bounds.npy"), npy(0, 17, &[]));
    holds(&failure(&folder), &["poses_bounds.npy", "no row"]);
    write(&folder.path().join("poses_bounds.npy"), npy(2, 17, &[f64::NAN; 34]));
    holds(&failure(&folder), &["poses_bounds.npy"]);
    fs::remove_dir_all(folder.path().join("images")).unwrap();
    holds(&failure(&folder), &["cam00", "images/ for one camera that moves"]);
    let options = OpenOptions { layout: Some(Layout::Llff), ..OpenOptions::default() };
    holds(&failure_with(&folder, &options), &["llff", "poses_bounds.npy beside images"]);
}

#[test]
fn masks_next_to_the_images_of_a_split_are_found_with_their_classes() {
    let folder = dnerf(3, 2);
    for (split, count) in [("train", 4), ("test", 2)] {
        for k in 0..count {
            let path = folder.path().join(format!("{split}/masks/r_{k:03}.png"));
            write_mask(&path, WIDTH, HEIGHT, |x, _| (x / 11) as u8);
        }
    }
    let classes = folder.path().join("class_mapping.json");
    write_json(&classes, &json!({"0": "background", "1": "sphere_1", "2": "cube_1"}));
    let dataset = open(&folder);
    let masks = |split: Split| {
        let frames = dataset.split_frames(split);
        frames.iter().filter(|index| dataset.frames[**index].mask.is_some()).count()
    };
    assert_eq!((masks(Split::Train), masks(Split::Val)), (3, 2));
    let labels: Vec<&str> = dataset.instances.iter().map(|instance| instance.label.as_str()).collect();
    assert_eq!(labels, ["sphere_1", "cube_1"]);
    assert!(dataset.warnings.is_empty(), "{:?}", dataset.warnings);
    // One line for all that is left over.
    assert_eq!(dataset.notes.len(), 1, "{:?}", dataset.notes);
    assert!(notes(&dataset, &["not used", "1 mask files"]), "{:?}", dataset.notes);
    // Next to the masks and above them, the nearest goes first; instances.json goes before both of a folder.
    write_json(&folder.path().join("train/class_mapping.json"), &json!({"1": "ball", "2": "box"}));
    assert_eq!(open(&folder).instances[0].label, "ball");
    write_json(&folder.path().join("train/instances.json"), &json!([{"id": 1, "label": "globe"}]));
    assert_eq!(open(&folder).instances[0].label, "globe");
    fs::remove_file(folder.path().join("train/instances.json")).unwrap();
    for bad in [json!({"sphere": 1}), json!(["sphere"]), json!({"1": {"name": "sphere"}})] {
        write_json(&folder.path().join("train/class_mapping.json"), &bad);
        holds(&failure(&folder), &["class_mapping.json", "a name per id", "instances.json"]);
    }
    write_json(&folder.path().join("train/class_mapping.json"), &json!({"70000": "sphere"}));
    holds(&failure(&folder), &["class_mapping.json", "70000", "65535"]);
}

#[test]
fn phones_of_dycheck_have_their_own_lists_cameras_and_rate() {
    let folder = dycheck();
    let dataset = open(&folder);
    assert_eq!(dataset.layout, Layout::HyperNerf);
    assert_eq!(names(&dataset, Split::Train).len(), 6);
    assert_eq!(names(&dataset, Split::Val), ["1_00001", "1_00002", "1_00003", "1_00004", "1_00005"]);
    assert_eq!(dataset.times, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]);
    assert_eq!(dataset.frames_per_second, Some(30.0));
    let cameras: Vec<&str> = dataset.frames.iter().map(|frame| frame.camera_name.as_str()).collect();
    assert_eq!((cameras[0], cameras[10]), ("camera_0", "camera_1"));
    assert!(dataset.frames.iter().all(|frame| frame.mask.is_none()), "covisible pixels are no instances");
    assert_eq!(dataset.notes.len(), 1, "{:?}", dataset.notes);
    assert!(notes(&dataset, &["not used", "1 frames", "splits"]), "{:?}", dataset.notes);
    // Nothing is held out where a phone filmed alone.
    write_json(&folder.path().join("splits/val.json"), &json!({"frame_names": []}));
    let alone = open(&folder);
    assert!(alone.train_frames().len() == 6 && alone.val_frames().is_empty());
    write_json(&folder.path().join("splits/val.json"), &json!({"frame_names": ["2_00000"]}));
    holds(&failure(&folder), &["splits", "2_00000", "dataset.json"]);
    write_json(&folder.path().join("splits/val.json"), &json!({"names": []}));
    holds(&failure(&folder), &["val.json", "frame_names"]);
}

#[test]
fn cubes_that_a_program_drew_count_as_no_points() {
    for name in ["fused.ply", "points3d.ply", "sparse_pc.ply"] {
        let folder = dnerf(3, 1);
        write_cube(&folder.path().join(name), 2_000);
        let dataset = open(&folder);
        assert_eq!(dataset.points.source, PointSource::Random, "{name}");
        assert!(notes(&dataset, &[name, "2000 points", "at random"]), "{:?}", dataset.notes);
    }
    // Too few to distinguish them from measured ones.
    let folder = dnerf(3, 1);
    write_cube(&folder.path().join("fused.ply"), 100);
    assert!(matches!(open(&folder).points.source, PointSource::File(_)));
}
