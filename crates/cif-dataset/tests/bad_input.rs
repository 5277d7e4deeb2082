//! Captures that are damaged, odd or foreign: each gives a message with file and fix, none a panic.

mod support;

use std::fs;

use cif_dataset::{Dataset, Layout, OpenOptions, PointSource};
use serde_json::json;
use support::*;

#[test]
fn a_missing_folder_and_a_file_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("nowhere");
    let error = Dataset::open(&missing, &OpenOptions::default()).unwrap_err().to_string();
    holds(&error, &["nowhere", "no such folder"]);
    write(&folder.path().join("file"), "");
    let error = Dataset::open(folder.path().join("file"), &OpenOptions::default()).unwrap_err().to_string();
    holds(&error, &["this is a file", "folder"]);
}

#[test]
fn a_folder_without_layout_says_what_was_looked_for() {
    let folder = tempfile::tempdir().unwrap();
    holds(&failure(&folder), &["dataset.json", "poses_bounds.npy", "transforms.json", "sparse/0"]);
    // A capture one level down is pointed at.
    write(&folder.path().join("scene/dataset.json"), "{}");
    let message = failure(&folder);
    holds(&message, &["did you mean", "scene"]);
}

#[test]
fn two_layouts_name_both_and_the_option() {
    let folder = hypernerf(2);
    write(&folder.path().join("poses_bounds.npy"), npy(1, 17, &[0.0; 17]));
    write_rgb(&folder.path().join("cam00/images/0000.png"), WIDTH, HEIGHT, shade(0));
    holds(&failure(&folder), &["hyper-nerf", "neu3d", "dataset.json", "poses_bounds.npy", "--layout"]);
    let options = OpenOptions { layout: Some(Layout::HyperNerf), ..OpenOptions::default() };
    assert_eq!(Dataset::open(folder.path(), &options).unwrap().layout, Layout::HyperNerf);
    let options = OpenOptions { layout: Some(Layout::Colmap), ..OpenOptions::default() };
    holds(&failure_with(&folder, &options), &["colmap", "sparse/0"]);
}

#[test]
fn a_camera_without_image_is_named() {
    let folder = hypernerf(3);
    fs::remove_file(folder.path().join("rgb/1x/000001.png")).unwrap();
    holds(&failure(&folder), &["000001", "rgb/1x/000001.png", "missing", "restore the image"]);
    let folder = nerfstudio(3);
    fs::remove_file(folder.path().join("images/0002.png")).unwrap();
    holds(&failure(&folder), &["images/0002", "transforms.json", "missing"]);
    let folder = colmap_text(3);
    fs::remove_file(folder.path().join("images/0002.png")).unwrap();
    holds(&failure(&folder), &["0002", "images.txt", "missing"]);
    let folder = neu3d(2, 2);
    fs::remove_dir_all(folder.path().join("cam01")).unwrap();
    holds(&failure(&folder), &["poses_bounds.npy", "2 cameras", "of 1"]);
}

#[test]
fn an_image_without_camera_is_named() {
    let folder = hypernerf(3);
    fs::remove_file(folder.path().join("camera/000002.json")).unwrap();
    holds(&failure(&folder), &["000002.png", "camera/000002.json", "missing"]);
    // Where the list is what counts, images next to it are only noted.
    let folder = nerfstudio(3);
    write_rgb(&folder.path().join("images/extra.png"), WIDTH, HEIGHT, shade(0));
    assert!(notes(&open(&folder), &["not used", "1 images", "no camera"]));
}

#[test]
fn truncated_images_and_masks_are_named() {
    let folder = hypernerf(3);
    let path = folder.path().join("rgb/1x/000001.png");
    let bytes = fs::read(&path).unwrap();
    for keep in [0, 7, 20, bytes.len() / 2, bytes.len() - 40] {
        fs::write(&path, &bytes[..keep]).unwrap();
        holds(&failure(&folder), &["000001.png", "copy or export the image again"]);
    }
    fs::write(&path, &bytes).unwrap();
    let path = folder.path().join("masks/000002.png");
    let bytes = fs::read(&path).unwrap();
    for keep in [0, 20, bytes.len() / 2, bytes.len() - 30] {
        fs::write(&path, &bytes[..keep]).unwrap();
        holds(&failure(&folder), &["masks/000002.png", "export it again"]);
    }
}

#[test]
fn masks_of_another_aspect_are_refused_and_of_another_size_resized() {
    let folder = hypernerf(3);
    let path = folder.path().join("masks/000001.png");
    write_mask(&path, HEIGHT, WIDTH, |_, _| 1);
    holds(&failure(&folder), &["masks/000001.png", "24 x 32", "32 x 24", "aspect"]);
    write_mask(&path, WIDTH * 2, HEIGHT * 2, |x, _| if x < WIDTH { 1 } else { 2 });
    let dataset = open(&folder);
    assert!(warns(&dataset, &["000001.png", "64 x 48", "nearest"]));
    let mask = dataset.load_mask(1).unwrap().unwrap();
    assert_eq!((mask.width, mask.height, *mask.at(15, 0), *mask.at(16, 0)), (WIDTH, HEIGHT, 1, 2));
}

#[test]
fn ids_above_255_need_wide_masks() {
    let folder = hypernerf(3);
    write_json(
        &folder.path().join("instances.json"),
        &json!([{"id": 1, "label": "a"}, {"id": 2, "label": "b"}, {"id": 300, "label": "c"}]),
    );
    assert!(warns(&open(&folder), &["instances.json", "above 255", "300", "16-bit"]));
    write_wide_mask(&folder.path().join("masks/000000.png"), WIDTH, HEIGHT, |_, _| 300);
    let dataset = open(&folder);
    assert!(dataset.warnings.is_empty(), "{:?}", dataset.warnings);
    assert_eq!(dataset.instances.iter().map(|i| i.id).collect::<Vec<_>>(), [1, 2, 300]);
    assert_eq!(*dataset.load_mask(0).unwrap().unwrap().at(3, 3), 300);
}

#[test]
fn ids_that_nobody_named_are_called_by_number() {
    let folder = hypernerf(3);
    write_mask(&folder.path().join("masks/000000.png"), WIDTH, HEIGHT, |_, _| 77);
    let dataset = open(&folder);
    let unnamed = dataset.instances.last().unwrap();
    assert_eq!(
        (unnamed.id, unnamed.label.as_str(), unnamed.category.as_str()),
        (77, "instance_77", "instance_77")
    );
    assert!(warns(&dataset, &["instances.json", "77"]));
}

#[test]
fn instance_lists_are_checked() {
    let folder = hypernerf(2);
    let path = folder.path().join("instances.json");
    write_json(&path, &json!([{"id": 70_000, "label": "far"}]));
    holds(&failure(&folder), &["instances.json", "70000", "65535"]);
    write_json(&path, &json!([{"id": -1, "label": "far"}]));
    holds(&failure(&folder), &["instances.json", "-1"]);
    write_json(&path, &json!([{"id": 1, "label": "a"}, {"id": 1, "label": "b"}]));
    holds(&failure(&folder), &["instances.json", "id 1 is listed twice"]);
    write_json(&path, &json!({"things": 3}));
    holds(&failure(&folder), &["instances.json", "list of"]);
    for (taxonomies, words) in [
        (json!({"wikidata-qcode": "Q81727"}), ["wikidata-qcode", "letters, digits and _"]),
        (json!({"class": "mug"}), ["class", "is taken"]),
        (json!({"coco": " "}), ["coco", "has no name"]),
        (json!({"coco": 47}), ["taxonomies are texts", "wikidata_qcode"]),
    ] {
        write_json(&path, &json!([{"id": 1, "label": "a", "taxonomies": taxonomies}]));
        holds(&failure(&folder), &["instances.json", words[0], words[1]]);
    }
    write_json(
        &path,
        &json!([{"id": 1, "taxonomies": {"wikidata_qcode": "Q81727", "coco": "cup"}}, {"id": 2}]),
    );
    let named = &open(&folder).instances;
    assert_eq!(named[0].taxonomies.values().map(String::as_str).collect::<Vec<_>>(), ["cup", "Q81727"]);
    assert!(named[1].taxonomies.is_empty());
    write_json(
        &path,
        &json!({"instances": [{"id": 0, "label": "void"}, {"id": 1}, {"id": 9, "label": "lost"}]}),
    );
    let dataset = open(&folder);
    assert_eq!(dataset.instances[0].label, "instance_1");
    assert!(warns(&dataset, &["id 0"]) && warns(&dataset, &["no mask shows", "9"]));
}

#[test]
fn colour_images_are_no_masks() {
    let folder = hypernerf(2);
    write_rgb(&folder.path().join("masks/000001.png"), WIDTH, HEIGHT, shade(0));
    holds(&failure(&folder), &["masks/000001.png", "RGB", "grey or palette"]);
}

#[test]
fn poses_must_be_finite_rotations() {
    let folder = hypernerf(3);
    let camera = folder.path().join("camera/000001.json");
    edit_json(&camera, |value| value["orientation"][0][0] = json!(3.0));
    holds(&failure(&folder), &["camera/000001.json", "frame 000001", "not a rotation"]);
    let folder = neu3d(2, 1);
    let path = folder.path().join("poses_bounds.npy");
    let mut bytes = fs::read(&path).unwrap();
    let first = bytes.len() - 2 * 17 * 8;
    bytes[first..first + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    fs::write(&path, bytes).unwrap();
    holds(&failure(&folder), &["poses_bounds.npy", "cam00/0000", "NaN"]);
    let folder = nerfstudio(2);
    edit_json(&folder.path().join("transforms.json"), |value| {
        value["frames"][0]["transform_matrix"][3] = json!([0.0, 0.0, 1.0, 1.0]);
    });
    holds(&failure(&folder), &["transforms.json", "0000", "4 x 4"]);
    let folder = colmap_text(1);
    write(&folder.path().join("sparse/0/images.txt"), "1 0 0 0 0 0 0 0 1 0000.png\n\n");
    holds(&failure(&folder), &["images.txt", "quaternion"]);
    // What is only rounded is repaired.
    let folder = hypernerf(2);
    edit_json(&folder.path().join("camera/000000.json"), |value| {
        let x = value["orientation"][0][0].as_f64().unwrap();
        value["orientation"][0][0] = json!(x + 2e-4);
    });
    assert!(open(&folder).frames[0].camera.camera_from_world.orthonormality_error() < 1e-12);
}

#[test]
fn focal_lengths_must_be_positive() {
    for focal in [0.0, -3.0] {
        let folder = hypernerf(2);
        edit_json(&folder.path().join("camera/000001.json"), |value| value["focal_length"] = json!(focal));
        holds(&failure(&folder), &["camera/000001.json", "focal length", "positive"]);
        let folder = nerfstudio(2);
        edit_json(&folder.path().join("transforms.json"), |value| value["fl_y"] = json!(focal));
        holds(&failure(&folder), &["transforms.json", "focal length"]);
    }
    let folder = dnerf(2, 1);
    edit_json(&folder.path().join("transforms_train.json"), |value| value["camera_angle_x"] = json!(4.0));
    holds(&failure(&folder), &["camera_angle_x"]);
    edit_json(&folder.path().join("transforms_train.json"), |value| value["camera_angle_x"] = json!(null));
    holds(&failure(&folder), &["fl_x", "camera_angle_x"]);
}

#[test]
fn cameras_that_cannot_be_ideal_are_refused() {
    let folder = nerfstudio(2);
    edit_json(&folder.path().join("transforms.json"), |value| {
        value["camera_model"] = json!("OPENCV_FISHEYE")
    });
    holds(&failure(&folder), &["transforms.json", "OPENCV_FISHEYE", "undistort"]);
    let folder = hypernerf(2);
    edit_json(&folder.path().join("camera/000000.json"), |value| value["image_size"] = json!([24, 32]));
    holds(&failure(&folder), &["camera/000000.json", "24 x 32", "32 x 24", "aspect"]);
    edit_json(&folder.path().join("camera/000000.json"), |value| value["image_size"] = json!([0, 32]));
    holds(&failure(&folder), &["0 x 32"]);
}

#[test]
fn one_frame_is_trained_on_and_noted() {
    let folders = [hypernerf(1), nerfstudio(1), colmap_text(1), neu3d(1, 1)];
    for folder in folders {
        let dataset = open(&folder);
        assert_eq!((dataset.train_frames().len(), dataset.val_frames().len()), (1, 0), "{}", dataset.layout);
        assert!(warns(&dataset, &["one frame only"]), "{:?}", dataset.warnings);
        assert_eq!((dataset.extent(), dataset.times.as_slice()), (1.0, [0.0].as_slice()));
    }
}

#[test]
fn one_fixed_camera_is_read_and_noted() {
    let folder = neu3d(1, 4);
    let dataset = open(&folder);
    assert_eq!((dataset.train_frames().len(), dataset.extent()), (4, 1.0));
    assert!(warns(&dataset, &["one camera centre"]) && warns(&dataset, &["no frame is held out"]));
    assert!(!dataset.points.positions.is_empty());
}

#[test]
fn captures_without_masks_or_labels_are_read_and_noted() {
    let folder = nerfstudio(3);
    let dataset = open(&folder);
    assert!(dataset.instances.is_empty() && warns(&dataset, &["no masks", "only colour"]));
    // Asked for on purpose, it is no oddity.
    let options = OpenOptions { without_masks: true, ..OpenOptions::default() };
    let masked = hypernerf(3);
    let dataset = Dataset::open(masked.path(), &options).unwrap();
    assert!(dataset.frames.iter().all(|frame| frame.mask.is_none()) && dataset.warnings.is_empty());
    for k in 0..3 {
        write_mask(&masked.path().join(format!("masks/{k:06}.png")), WIDTH, HEIGHT, |_, _| 0);
    }
    let dataset = open(&masked);
    assert!(warns(&dataset, &["masks", "no labelled pixel"]) && dataset.instances.is_empty());
}

#[test]
fn a_mask_folder_that_is_asked_for_must_fit() {
    let folder = hypernerf(3);
    let asked = |name: &str| OpenOptions { masks: Some(name.into()), ..OpenOptions::default() };
    holds(&failure_with(&folder, &asked("mask_tracker")), &["mask_tracker", "the capture has masks"]);
    write_mask(&folder.path().join("other/frame1.png"), WIDTH, HEIGHT, |_, _| 1);
    holds(&failure_with(&folder, &asked("other")), &["other", "named as the frames", "000000.png"]);
    // A folder outside the capture.
    let elsewhere = tempfile::tempdir().unwrap();
    write_mask(&elsewhere.path().join("000001.png"), WIDTH, HEIGHT, |_, _| 5);
    let options = OpenOptions { masks: Some(elsewhere.path().to_owned()), ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    assert_eq!(dataset.instances[0].id, 5);
    assert!(warns(&dataset, &["1 of 3 frames have a mask"]));
}

#[test]
fn json_mistakes_have_a_line() {
    let folder = hypernerf(2);
    write(&folder.path().join("dataset.json"), "{\n  \"ids\": [\"000000\",\n  ]\n}\n");
    holds(&failure(&folder), &["dataset.json:3:", "trailing comma"]);
    let folder = hypernerf(2);
    write(&folder.path().join("camera/000000.json"), "{\"orientation\": NaN}");
    holds(&failure(&folder), &["camera/000000.json:1:"]);
    let folder = nerfstudio(2);
    write(&folder.path().join("transforms.json"), "{\"frames\": []}");
    holds(&failure(&folder), &["transforms.json", "empty"]);
}

#[test]
fn frames_listed_twice_are_named() {
    let folder = hypernerf(2);
    edit_json(&folder.path().join("dataset.json"), |value| {
        value["ids"] = json!(["000000", "000001", "000000"])
    });
    holds(&failure(&folder), &["dataset.json", "000000", "twice"]);
    let folder = nerfstudio(2);
    edit_json(&folder.path().join("transforms.json"), |value| {
        value["frames"][1] = value["frames"][0].clone()
    });
    holds(&failure(&folder), &["transforms.json", "0000", "twice"]);
}

#[test]
fn hypernerf_metadata_must_cover_the_frames() {
    let folder = hypernerf(2);
    edit_json(&folder.path().join("metadata.json"), |value| {
        value.as_object_mut().unwrap().remove("000001");
    });
    holds(&failure(&folder), &["metadata.json", "000001"]);
    fs::remove_file(folder.path().join("metadata.json")).unwrap();
    holds(&failure(&folder), &["metadata.json", "missing"]);
    let folder = hypernerf(2);
    edit_json(&folder.path().join("dataset.json"), |value| value["val_ids"] = json!(["000009"]));
    holds(&failure(&folder), &["dataset.json", "000009"]);
    fs::remove_dir_all(folder.path().join("rgb")).unwrap();
    holds(&failure(&folder), &["rgb", "missing"]);
}

#[test]
fn times_must_be_complete() {
    let folder = nerfstudio(2);
    edit_json(&folder.path().join("transforms.json"), |value| value["frames"][0]["time"] = json!(0.5));
    holds(&failure(&folder), &["transforms.json", "time"]);
    edit_json(&folder.path().join("transforms.json"), |value| value["frames"][1]["time"] = json!(-0.5));
    assert_eq!(open(&folder).times, [0.0, 1.0], "clocks may begin before 0");
}

#[test]
fn damaged_arrays_neither_allocate_nor_panic() {
    let folder = hypernerf(2);
    let path = folder.path().join("points.npy");
    let good = fs::read(&path).unwrap();
    let text = String::from_utf8_lossy(&good[10..128]).into_owned();
    let with_shape = |shape: &str| {
        let mut header = text.replace("(2, 3)", shape).trim_end().to_owned();
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend([0; 48]);
        bytes
    };
    for bytes in [
        Vec::new(),
        b"\x93NUMPY".to_vec(),
        good[..60].to_vec(),
        good[..good.len() - 3].to_vec(),
        with_shape("(1000000000000, 3)"),
        with_shape("(9223372036854775807, 9223372036854775807)"),
        with_shape("(99999999999999999999999, 3)"),
        with_shape("(4294967296, 4294967296, 0)"),
        with_shape("(3,)"),
        with_shape("(3, 2)"),
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff{".to_vec(),
        b"\x93NUMPY\x01\x00\xff\x0f".iter().copied().chain(std::iter::repeat_n(b'(', 0xfff)).collect(),
        b"\x93NUMPY\x09\x00\x10\x00".to_vec(),
    ] {
        fs::write(&path, bytes).unwrap();
        holds(&failure(&folder), &["points.npy"]);
    }
    // Points that are not finite are left out; without any left, random ones are drawn.
    fs::write(&path, npy(2, 3, &[f64::NAN, 0.0, 0.0, 1.0, 1.0, 1.0])).unwrap();
    let dataset = open(&folder);
    assert_eq!(dataset.points.positions, [[1.0; 3]]);
    assert!(warns(&dataset, &["points.npy", "1 points are not finite"]));
    fs::write(&path, npy(0, 3, &[])).unwrap();
    let dataset = open(&folder);
    assert_eq!(dataset.points.source, PointSource::Random);
    assert!(warns(&dataset, &["points.npy", "random"]));
    // Columns first, as Fortran has it.
    let mut fortran = npy(2, 3, &[1.0, 4.0, 2.0, 5.0, 3.0, 6.0]);
    let at = fortran.windows(5).position(|window| window == b"False").unwrap();
    fortran[at..at + 5].copy_from_slice(b"True ");
    fs::write(&path, fortran).unwrap();
    assert_eq!(open(&folder).points.positions, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
}

#[test]
fn damaged_point_clouds_neither_allocate_nor_panic() {
    let folder = nerfstudio(2);
    let path = folder.path().join("points3d.ply");
    let header = |format: &str, count: &str, rest: &str| {
        format!("ply\nformat {format} 1.0\nelement vertex {count}\n{rest}end_header\n").into_bytes()
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let list = "property list uint float x\nproperty float y\nproperty float z\n";
    let mut long_list = header("binary_little_endian", "1", list);
    long_list.extend([0xff; 16]);
    for bytes in [
        Vec::new(),
        b"ply\n".to_vec(),
        header("binary_little_endian", "1000000000", xyz),
        header("ascii", "1000000000", xyz),
        header("binary_little_endian", "1000000000", ""),
        header("binary_little_endian", "18446744073709551615", xyz),
        header("binary_big_endian", "3", xyz),
        header("ascii", "1", "property float x\n"),
        b"ply\nformat ascii 1.0\nelement face 0\nproperty int v\nend_header\n".to_vec(),
        long_list,
    ] {
        fs::write(&path, &bytes).unwrap();
        holds(&failure(&folder), &["points3d.ply"]);
    }
    // Binary, big endian, doubles, without colour.
    let mut good = header(
        "binary_big_endian",
        "1",
        "property double x\nproperty double y\nproperty double z\nproperty uchar quality\n",
    );
    good.extend([0.25_f64, -1.0, 2.0].iter().flat_map(|v| v.to_be_bytes()));
    good.push(1);
    fs::write(&path, &good).unwrap();
    assert_eq!(open(&folder).points.positions, [[0.25, -1.0, 2.0]]);
    edit_json(&folder.path().join("transforms.json"), |value| value["ply_file_path"] = json!("gone.ply"));
    holds(&failure(&folder), &["gone.ply", "ply_file_path"]);
}

#[test]
fn damaged_reconstructions_neither_allocate_nor_panic() {
    let folder = colmap_binary(2);
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = folder.path().join("sparse/0").join(name);
        let good = fs::read(&path).unwrap();
        for keep in [0, 5, 8, 20, good.len() - 1] {
            fs::write(&path, &good[..keep]).unwrap();
            holds(&failure(&folder), &[name, "export it again"]);
        }
        let mut huge = good.clone();
        huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        fs::write(&path, &huge).unwrap();
        holds(&failure(&folder), &[name, "export it again"]);
        let mut end = good.clone();
        let tail = end.len() - if name == "images.bin" { 32 } else { 16 };
        end[tail..tail + 8].copy_from_slice(&u64::MAX.to_le_bytes());
        fs::write(&path, &end).unwrap();
        if name != "cameras.bin" {
            holds(&failure(&folder), &[name, "export it again"]);
        }
        fs::write(&path, &good).unwrap();
    }
    let text = colmap_text(2);
    let cameras = text.path().join("sparse/0/cameras.txt");
    write(&cameras, "# c\n1 PINHOLE 32 24 forty 40 16 12\n");
    holds(&failure(&text), &["cameras.txt", "line 2", "forty"]);
    write(&cameras, "2 PINHOLE 32 24 40 40 16 12\n");
    holds(&failure(&text), &["images.txt", "camera 1", "cameras.txt"]);
    fs::remove_file(&cameras).unwrap();
    holds(&failure(&text), &["cameras", "export the reconstruction"]);
}

#[test]
fn a_video_that_is_none_is_named() {
    let folder = neu3d(2, 1);
    fs::remove_dir_all(folder.path().join("cam01")).unwrap();
    write(&folder.path().join("cam01.mp4"), "no video");
    // With or without an ffmpeg on the path.
    holds(&failure(&folder), &["cam01.mp4", "ffmpeg"]);
}

#[test]
fn images_cannot_be_reduced_by_nothing() {
    let options = OpenOptions { downscale: Some(0), ..OpenOptions::default() };
    holds(&failure_with(&hypernerf(2), &options), &["reduced by 0"]);
}

#[test]
fn frame_names_stay_inside_a_folder() {
    // Whoever writes a picture per frame joins its name to a folder.
    let folder = hypernerf(3);
    for name in ["rgb/1x/a", "camera/a"] {
        std::fs::create_dir(folder.path().join(name)).unwrap();
    }
    let renamed = "a/../000001";
    for file in ["dataset.json", "metadata.json"] {
        let path = folder.path().join(file);
        let text = std::fs::read_to_string(&path).unwrap();
        write(&path, text.replace("\"000001\"", &format!("\"{renamed}\"")));
    }
    holds(&failure(&folder), &[renamed, "..", "inside the folder of the capture"]);

    let folder = dnerf(2, 1);
    let path = folder.path().join("images").join("../train/r_000.png");
    std::fs::create_dir(folder.path().join("images")).unwrap();
    edit_json(&folder.path().join("transforms_train.json"), |value| {
        value["frames"][0]["file_path"] = json!(path.strip_prefix(folder.path()).unwrap());
    });
    holds(&failure(&folder), &["transforms_train.json", "images/../train/r_000"]);
}

#[cfg(unix)]
#[test]
fn pipes_in_a_capture_are_named_and_not_waited_for() {
    for name in ["dataset.json", "camera/000001.json", "rgb/1x/000001.png", "masks/000000.png", "points.npy"]
    {
        let folder = hypernerf(3);
        let path = folder.path().join(name);
        fs::remove_file(&path).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        holds(&failure(&folder), &[name, "named pipe", "regular file"]);
    }
    let folder = hypernerf(3);
    let path = folder.path().join("instances.json");
    fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
    holds(&failure(&folder), &["instances.json", "a device"]);
}

#[test]
fn labels_that_usd_would_cut_are_refused() {
    let folder = hypernerf(3);
    write_json(&folder.path().join("instances.json"), &json!([{"id": 1, "label": "red\u{0} mug"}]));
    holds(&failure(&folder), &["instances.json", "id 1", "NUL"]);
}

#[test]
fn images_cannot_claim_more_pixels_than_their_bytes_hold() {
    // The width and the height of a PNG stand behind its mark; their checksum follows the header.
    let enlarged = |path: &std::path::Path| {
        let mut bytes = fs::read(path).unwrap();
        bytes[16..24].copy_from_slice(&[0, 0, 0x30, 0, 0, 0, 0x30, 0]);
        let checksum = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
        fs::write(path, bytes).unwrap();
    };
    for name in ["rgb/1x/000001.png", "masks/000000.png"] {
        let folder = hypernerf(3);
        enlarged(&folder.path().join(name));
        holds(&failure(&folder), &[name, "12288 x 12288", "bytes can hold"]);
    }
}

/// The checksum of PNG chunks.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ (0xedb8_8320 & 0_u32.wrapping_sub(crc & 1)))
    })
}
