//! The path to a tracker and back, and what is printed of a capture.

mod support;

use std::path::Path;

use cif_dataset::masks::{ViewOrder, ZigzagIndex, split_tracker_masks, write_zigzag};
use cif_dataset::{Dataset, OpenOptions};
use serde_json::json;
use support::*;

/// Plays a tracker: a mask for every image of the sequence.
fn track(index: &ZigzagIndex, folder: &Path, id: impl Fn(usize, &str, u32) -> u16) {
    for entry in &index.images {
        let path = folder.join(&entry.image);
        write_wide_mask(&path, WIDTH, HEIGHT, |x, _| id(entry.view, &entry.frame, x));
    }
}

#[test]
fn the_sequence_turns_at_every_view() {
    let folder = neu3d(3, 4);
    let out = folder.path().join("zigzag");
    let index = write_zigzag(&open(&folder), &out, ViewOrder::Name).unwrap();
    let frames: Vec<&str> = index.images.iter().map(|entry| entry.frame.as_str()).collect();
    assert_eq!(frames.len(), 12);
    assert_eq!(frames[2..6], ["cam00/0002", "cam00/0003", "cam01/0003", "cam01/0002"]);
    assert_eq!(frames[7..9], ["cam01/0000", "cam02/0000"]);
    assert_eq!(index.views, ["cam00", "cam01", "cam02"]);
    assert!(index.view_path_m > 2.0 && index.view_path_m < 3.0, "{}", index.view_path_m);
    assert_eq!(ZigzagIndex::load(&out).unwrap(), index);
    // Position 4 shows step 3.
    let image = image::open(out.join("000004.png")).unwrap().to_rgb8();
    assert_eq!((image.dimensions(), image.get_pixel(2, 1).0), ((WIDTH, HEIGHT), [14, 10, 30]));
}

#[test]
fn cameras_without_common_times_are_one_sequence() {
    let folder = hypernerf(5);
    edit_json(&folder.path().join("metadata.json"), |value| value["000004"]["camera_id"] = json!(1));
    let index = write_zigzag(&open(&folder), &folder.path().join("zigzag"), ViewOrder::Greedy).unwrap();
    assert!(!index.is_multi_view());
    let frames: Vec<&str> = index.images.iter().map(|entry| entry.frame.as_str()).collect();
    assert_eq!(frames, ["000000", "000001", "000002", "000003", "000004"]);
}

#[test]
fn ids_come_back_filtered_dense_and_with_their_table() {
    let folder = neu3d(3, 2);
    let root = folder.path();
    let index = write_zigzag(&open(&folder), &root.join("zigzag"), ViewOrder::Name).unwrap();
    // 40 is in every view; 700 in one frame of each; 9 is missing in view 1; 50 has too few pixels in view 2.
    track(&index, &root.join("tracked"), |view, frame, x| match x {
        0..8 => 40,
        8..16 if frame.ends_with('1') => 700,
        16..20 if view != 1 => 9,
        20..24 => 50,
        24 if view < 2 => 60,
        24 if frame.ends_with('0') => 60,
        _ => 0,
    });
    let out = root.join("masks_merged");
    let report = split_tracker_masks(&index, &root.join("tracked"), &out, 30).unwrap();
    let kept: Vec<_> = report.instances.iter().map(|kept| (kept.id, kept.tracker_id, kept.pixels)).collect();
    let rows = u64::from(HEIGHT);
    assert_eq!(kept, [(1, 40, 8 * 6 * rows), (2, 50, 4 * 6 * rows), (3, 700, 8 * 3 * rows)]);
    let removed: Vec<_> =
        report.removed.iter().map(|removed| (removed.tracker_id, removed.missing_in.len())).collect();
    assert_eq!(removed, [(9, 1), (60, 3)]);
    assert_eq!(report.removed[0].missing_in, ["cam01"]);

    let options = OpenOptions { masks: Some("masks_merged".into()), ..OpenOptions::default() };
    let dataset = Dataset::open(root, &options).unwrap();
    assert_eq!(dataset.instances.iter().map(|i| i.id).collect::<Vec<_>>(), [1, 2, 3]);
    assert_eq!(dataset.instances[2].label, "instance_3");
    let frame = dataset.frames.iter().position(|frame| frame.name == "cam01/0001").unwrap();
    let mask = dataset.load_mask(frame).unwrap().unwrap();
    assert_eq!([0, 9, 17, 21, 24, 30].map(|x| *mask.at(x, 5)), [1, 3, 0, 2, 0, 0]);
    assert!(dataset.warnings.is_empty(), "{:?}", dataset.warnings);
}

#[test]
fn one_view_keeps_every_instance() {
    let folder = hypernerf(4);
    let root = folder.path();
    let index = write_zigzag(&open(&folder), &root.join("zigzag"), ViewOrder::Name).unwrap();
    track(&index, &root.join("tracked"), |_, frame, x| if frame == "000002" && x == 0 { 5 } else { 0 });
    let report = split_tracker_masks(&index, &root.join("tracked"), &root.join("merged"), 1000).unwrap();
    assert_eq!(report.instances.iter().map(|kept| (kept.id, kept.tracker_id)).collect::<Vec<_>>(), [(1, 5)]);
    assert!(root.join("merged/000003.png").is_file());
}

#[test]
fn nothing_existing_is_overwritten() {
    let folder = neu3d(2, 2);
    let root = folder.path();
    let dataset = open(&folder);
    let out = root.join("zigzag");
    write(&out.join("mine.txt"), "keep");
    holds(&write_zigzag(&dataset, &out, ViewOrder::Name).unwrap_err().to_string(), &["zigzag", "new folder"]);
    assert_eq!(std::fs::read_to_string(out.join("mine.txt")).unwrap(), "keep");
    std::fs::remove_file(out.join("mine.txt")).unwrap();
    // An empty folder is taken.
    let index = write_zigzag(&dataset, &out, ViewOrder::Name).unwrap();
    holds(
        &split_tracker_masks(&index, &root.join("nowhere"), &root.join("out"), 1).unwrap_err().to_string(),
        &["nowhere"],
    );
    std::fs::create_dir(root.join("empty")).unwrap();
    holds(
        &split_tracker_masks(&index, &root.join("empty"), &root.join("out"), 1).unwrap_err().to_string(),
        &["empty", "000000.png"],
    );
    assert!(!root.join("out").exists());
    // No scratch folders stay behind.
    assert!(
        std::fs::read_dir(root)
            .unwrap()
            .all(|entry| { !entry.unwrap().file_name().to_string_lossy().starts_with(".partial") })
    );
}

#[test]
fn a_damaged_index_cannot_write_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("zigzag.json");
    for frame in ["../../evil", "/evil", ""] {
        write_json(
            &path,
            &json!({"views": ["a"], "view_path_m": 0.0, "images": [{"image": "0.png", "frame": frame, "view": 0}]}),
        );
        holds(&ZigzagIndex::load(&path).unwrap_err().to_string(), &["zigzag.json", "damaged"]);
    }
    holds(
        &ZigzagIndex::load(&folder.path().join("no.json")).unwrap_err().to_string(),
        &["no.json", "masks zigzag"],
    );
}

#[test]
fn the_summary_counts_what_was_understood() {
    let folder = hypernerf(6);
    write_json(&folder.path().join("splits.json"), &json!({"interp": ["000001", "000004"]}));
    std::fs::remove_file(folder.path().join("masks/000005.png")).unwrap();
    let dataset = open(&folder);
    let summary = dataset.summary().unwrap();
    assert_eq!((summary.frames, summary.train, summary.val, summary.times), (6, 4, 2, 6));
    assert_eq!(summary.groups["interp"], 2);
    let masks = summary.masks.as_ref().unwrap();
    assert_eq!((masks.frames, masks.train), (5, 3));
    assert!((masks.labelled - 21.0 / 32.0).abs() < 1e-12);
    let mug = &summary.instances[0];
    assert_eq!((mug.frames, mug.train_frames, mug.pixels), (5, 3, 5 * 11 * u64::from(HEIGHT)));
    assert!(summary.cameras[0].moves);
    assert_eq!(summary.resolutions, [(WIDTH, HEIGHT, 6)]);
    let text = summary.to_string();
    for words in
        ["hyper-nerf", "4 train, 2 val: 2 interp", "red mug", "5 of 6 frames", "32 x 24", "warning: "]
    {
        assert!(text.contains(words), "`{words}` is not in:\n{text}");
    }
    assert!(serde_json::to_value(&summary).unwrap()["instances"][1]["label"] == "blue ball");
}

#[test]
fn masks_of_another_folder_score_the_same_frames() {
    let folder = hypernerf(3);
    for k in 0..3 {
        write_mask(&folder.path().join(format!("masks_tracker/{k:06}.png")), WIDTH, HEIGHT, |_, _| 4);
    }
    let options = OpenOptions { masks: Some("masks_tracker".into()), ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    assert_eq!(dataset.instances.iter().map(|i| i.id).collect::<Vec<_>>(), [4]);
    let exact = dataset.with_masks(Path::new("masks")).unwrap();
    assert_eq!(exact.instances.iter().map(|i| i.id).collect::<Vec<_>>(), [1, 2]);
    assert_eq!(exact.frames.len(), dataset.frames.len());
    let paths = dataset.mask_paths(Path::new("masks")).unwrap();
    let mask = dataset.load_mask_file(2, paths[2].as_ref().unwrap()).unwrap();
    assert_eq!(Some(mask), exact.load_mask(2).unwrap());
    holds(&dataset.with_masks(Path::new("mask_x")).unwrap_err().to_string(), &["mask_x", "masks_tracker"]);
}

#[test]
fn motion_counts_at_times_at_which_enough_of_an_instance_is_seen() {
    let folder = hypernerf(3);
    // Of instance 2, 19 pixels are too few and 20 enough.
    for (k, pixels) in [19, 20].into_iter().enumerate() {
        let path = folder.path().join(format!("masks/{k:06}.png"));
        write_mask(&path, WIDTH, HEIGHT, |x, y| if y == 0 && x < pixels { 2 } else { 0 });
    }
    let truth = cif_dataset::MotionTruth { times: vec![0.0, 0.5, 1.0], ..Default::default() };
    let seen = truth.seen_steps(&open(&folder)).unwrap();
    assert_eq!(seen.into_iter().collect::<Vec<_>>(), [(1, vec![2]), (2, vec![1, 2])]);
}

#[test]
fn feature_maps_are_read_at_the_size_of_images_and_belong_to_training_frames() {
    let folder = hypernerf(6);
    let dataset = open(&folder);
    let maps = folder.path().join("maps");
    // Half the size of the images; one pixel is not a number, one is 0.
    let (width, height) = (WIDTH as usize / 2, HEIGHT as usize / 2);
    let mut values: Vec<f64> = (0..width * height * 3).map(|at| 1.0 + at as f64 / 4.0).collect();
    values[4] = f64::NAN;
    values[6..9].fill(0.0);
    let shape = format!("({height}, {width}, 3)");
    for index in dataset.train_frames() {
        write(&maps.join(format!("{}_clip.npy", dataset.frames[index].name)), npy_of(&shape, &values));
    }
    let files = cif_dataset::feature_maps(&dataset, &maps).unwrap();
    assert_eq!(files.keys().copied().collect::<Vec<_>>(), dataset.train_frames());
    let (index, path) = files.first_key_value().unwrap();
    let map = dataset.load_feature_map(*index, path).unwrap();
    assert_eq!((map.width, map.height), (WIDTH, HEIGHT));
    assert_eq!((*map.at(0, 0), *map.at(1, 1)), ([1.0, 1.25, 1.5], [1.0, 1.25, 1.5]));
    assert_eq!((*map.at(2, 0), *map.at(5, 1), *map.at(6, 0)), ([0.0; 3], [0.0; 3], [3.25, 3.5, 3.75]));

    let refused = |bytes: &[u8], words: &[&str]| {
        write(path, bytes);
        holds(&dataset.load_feature_map(*index, path).unwrap_err().to_string(), words);
    };
    refused(&npy(4, 3, &[0.0; 12]), &["[4, 3]", "[height, width, 3]"]);
    refused(&npy_of("(24, 8, 3)", &[0.0; 24 * 8 * 3]), &["8 x 24", "aspect"]);
    refused(&npy_of("(3, 4, 3)", &[f64::INFINITY; 36]), &["infinite", "NaN"]);
    refused(b"no array", &["_clip.npy", "NumPy"]);
    std::fs::write(path.with_file_name(format!("{}_b.npy", dataset.frames[*index].name)), b"").unwrap();
    holds(
        &cif_dataset::feature_maps(&dataset, &maps).unwrap_err().to_string(),
        &["several feature maps", "_b.npy"],
    );
    std::fs::remove_dir_all(&maps).unwrap();
    std::fs::create_dir(&maps).unwrap();
    let name = &dataset.frames[dataset.train_frames()[0]].name;
    let message = cif_dataset::feature_maps(&dataset, &maps).unwrap_err().to_string();
    holds(&message, &["maps", &format!("{name}.npy"), "has no feature map"]);
}

/// Masks of one id for the frames of `nerfstudio`.
fn write_ids(folder: &Path, frames: std::ops::Range<usize>, id: u8) {
    for k in frames {
        write_mask(&folder.join(format!("{k:04}.png")), WIDTH, HEIGHT, |_, _| id);
    }
}

fn ids(dataset: &Dataset) -> Vec<u16> {
    dataset.instances.iter().map(|instance| instance.id).collect()
}

fn masked(dataset: &Dataset) -> usize {
    dataset.frames.iter().filter(|frame| frame.mask.is_some()).count()
}

#[test]
fn masks_of_the_current_folder_belong_to_no_capture_unless_asked_for() {
    const CAPTURE: &str = "CIF_DATASET_TEST_CAPTURE";
    if let Some(capture) = std::env::var_os(CAPTURE) {
        let dataset = Dataset::open(&capture, &OpenOptions::default()).unwrap();
        assert_eq!((masked(&dataset), ids(&dataset)), (0, vec![]));
        let asked = OpenOptions { masks: Some("masks".into()), ..OpenOptions::default() };
        let dataset = Dataset::open(&capture, &asked).unwrap();
        assert_eq!((masked(&dataset), ids(&dataset)), (3, vec![7]));
        return;
    }
    let (capture, current) = (nerfstudio(3), tempfile::tempdir().unwrap());
    write_ids(&current.path().join("masks"), 0..3, 7);
    // The current folder is one for the whole process.
    let child = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "masks_of_the_current_folder_belong_to_no_capture_unless_asked_for"])
        .env(CAPTURE, capture.path())
        .current_dir(current.path())
        .output()
        .unwrap();
    assert!(child.status.success(), "{}", String::from_utf8_lossy(&child.stdout));
}

#[test]
fn masks_that_frames_name_go_before_a_folder_that_is_there() {
    let folder = nerfstudio(4);
    let root = folder.path();
    edit_json(&root.join("transforms.json"), |value| {
        for k in 0..4 {
            value["frames"][k]["mask_path"] = json!(format!("segm/{k:04}.png"));
        }
    });
    write_ids(&root.join("segm"), 0..4, 3);
    // As many, or one only; its names are not those of the other folder's ids.
    for count in [4, 1] {
        let _ = std::fs::remove_dir_all(root.join("masks"));
        write_ids(&root.join("masks"), 0..count, 7);
        write_json(&root.join("masks/instances.json"), &json!([{"id": 3, "label": "of others"}]));
        let dataset = open(&folder);
        assert_eq!((masked(&dataset), ids(&dataset)), (4, vec![3]));
        assert_eq!(dataset.instances[0].label, "instance_3");
        assert!(warns(&dataset, &["masks: not used", "segm"]), "{:?}", dataset.warnings);
        let asked = OpenOptions { masks: Some("masks".into()), ..OpenOptions::default() };
        let dataset = Dataset::open(root, &asked).unwrap();
        assert_eq!((masked(&dataset), ids(&dataset)), (count, vec![7]));
        assert_eq!(ids(&open(&folder).with_masks(Path::new("masks")).unwrap()), [7]);
    }
    // Frames that name none have none of another numbering.
    edit_json(&root.join("transforms.json"), |value| {
        value["frames"][1].as_object_mut().unwrap().remove("mask_path");
    });
    write_ids(&root.join("masks"), 0..4, 7);
    let dataset = open(&folder);
    assert_eq!((masked(&dataset), ids(&dataset)), (3, vec![3]));
    // In the folder itself, the rest of its files is of the same numbering.
    edit_json(&root.join("transforms.json"), |value| {
        for k in [0, 2, 3] {
            value["frames"][k]["mask_path"] = json!(format!("./masks/{k:04}.png"));
        }
    });
    write_ids(&root.join("masks"), 0..4, 5);
    let dataset = open(&folder);
    assert_eq!((masked(&dataset), ids(&dataset)), (4, vec![5]));
    assert!(!warns(&dataset, &["not used"]), "{:?}", dataset.warnings);
}

#[cfg(unix)]
#[test]
fn links_in_a_folder_of_masks_are_not_walked_in_circles() {
    let folder = nerfstudio(3);
    let masks = folder.path().join("masks");
    write_ids(&masks, 0..4, 2);
    for link in ["a", "b"] {
        std::os::unix::fs::symlink(".", masks.join(link)).unwrap();
    }
    let dataset = open(&folder);
    assert_eq!((masked(&dataset), ids(&dataset)), (3, vec![2]));
    assert!(notes(&dataset, &["1 mask files in masks"]), "{:?}", dataset.notes);
    assert_eq!(cif_dataset::masks::found_masks(&dataset, &masks).unwrap().concat().len(), 3);
}
