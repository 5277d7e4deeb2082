//! Confidences of masks, and folders of masks that are written with them.
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod support;

use std::fs;
use std::path::Path;

use cif_dataset::masks::MaskWriter;
use cif_dataset::{Dataset, InstanceLabel, OpenOptions};
use cif_geometry::PixelGrid;
use support::*;
use tempfile::TempDir;

/// Frame whose mask has a confidence.
const FRAME: &str = "000001";

fn write_grey(path: &Path, width: u32, height: u32, value: impl Fn(u32, u32) -> u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::GrayImage::from_fn(width, height, |x, y| image::Luma([value(x, y)])).save(path).unwrap();
}

/// A capture, and the place of the confidence of [`FRAME`].
fn place() -> (TempDir, std::path::PathBuf) {
    let folder = hypernerf(3);
    let path = folder.path().join(format!("masks/confidence/{FRAME}.png"));
    (folder, path)
}

#[test]
fn confidences_are_read_per_pixel_and_at_reduced_size() {
    let (folder, path) = place();
    write_grey(&path, WIDTH, HEIGHT, |x, y| (y * WIDTH + x) as u8);
    // A confidence without a mask belongs to nothing.
    fs::remove_file(folder.path().join("masks/000002.png")).unwrap();
    write_grey(&path.with_file_name("000002.png"), WIDTH, HEIGHT, |_, _| 9);
    let dataset = open(&folder);
    assert!(!warns(&dataset, &["belong to no frame"]), "{:?}", dataset.warnings);
    assert_eq!(
        dataset.frames.iter().map(|f| f.confidence.is_some()).collect::<Vec<_>>(),
        [false, true, false]
    );
    assert!(dataset.files().any(|file| file == path));
    let loaded = dataset.load_frame(1, [1.0; 3]).unwrap();
    let expected: Vec<u8> = (0..WIDTH * HEIGHT).map(|k| k as u8).collect();
    assert_eq!(loaded.confidence.unwrap(), PixelGrid::from_pixels(WIDTH, HEIGHT, expected));
    assert_eq!(dataset.load_confidence(0).unwrap(), None);
    assert_eq!(dataset.load_frame(2, [1.0; 3]).unwrap().confidence, None);

    let halved = OpenOptions { downscale: Some(2), ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &halved).unwrap();
    let small = dataset.load_frame(1, [1.0; 3]).unwrap();
    let (mask, confidence) = (small.mask.unwrap(), small.confidence.unwrap());
    assert_eq!((confidence.width, confidence.height), (WIDTH / 2, HEIGHT / 2));
    assert_eq!((mask.width, mask.height), (WIDTH / 2, HEIGHT / 2));
    // Nearest neighbour, the same pixel of every block of four as the mask.
    for (x, y) in [(0, 0), (5, 3), (WIDTH / 2 - 1, HEIGHT / 2 - 1)] {
        assert_eq!(*confidence.at(x, y), ((2 * y + 1) * WIDTH + 2 * x + 1) as u8, "{x}, {y}");
        assert_eq!(u32::from(*mask.at(x, y)), (2 * x + 1) / 11, "{x}, {y}");
    }
}

#[test]
fn confidences_that_do_not_fit_are_named_with_the_fix() {
    let (folder, path) = place();
    let reports = |words: &[&str]| {
        let message = failure(&folder);
        let fix = ["masks/confidence/000001.png", "8-bit grey PNG of the size of the mask", "or remove it"];
        holds(&message, &[&fix, words].concat());
    };
    write_grey(&path, HEIGHT, WIDTH, |_, _| 255);
    reports(&["24 x 32", "32 x 24", "another aspect"]);
    write_wide_mask(&path, WIDTH, HEIGHT, |_, _| 65_535);
    reports(&["not 8-bit grey"]);
    write_mask(&path, WIDTH, HEIGHT, |_, _| 255);
    reports(&["not 8-bit grey"]);
    write_rgb(&path, WIDTH, HEIGHT, shade(0));
    reports(&["not 8-bit grey"]);
    write(&path, "no picture");
    reports(&["not a readable PNG"]);

    // What only decoding finds is found when the frame is loaded.
    write_grey(&path, WIDTH, HEIGHT, |x, y| (x * y * 37 % 251) as u8);
    let bytes = fs::read(&path).unwrap();
    write(&path, &bytes[..bytes.len() / 2]);
    let message = open(&folder).load_frame(1, [1.0; 3]).unwrap_err().to_string();
    holds(&message, &["masks/confidence/000001.png", "cannot be decoded", "or remove it"]);
    // Without it the mask is read as ever.
    fs::remove_file(&path).unwrap();
    assert_eq!(open(&folder).load_frame(1, [1.0; 3]).unwrap().confidence, None);
}

#[test]
fn written_masks_come_back_with_large_ids_and_confidences() {
    let folder = hypernerf(3);
    let out = folder.path().join("made");
    let pixels = (WIDTH * HEIGHT) as usize;
    let ids = |first: u16| {
        let mut ids = vec![0; pixels];
        (ids[0], ids[1]) = (first, 300);
        PixelGrid::from_pixels(WIDTH, HEIGHT, ids)
    };
    let confidence = PixelGrid::from_pixels(WIDTH, HEIGHT, (0..pixels).map(|k| (k % 256) as u8).collect());
    let writer = MaskWriter::create(&out).unwrap();
    writer.add("000000", &ids(65_535), Some(&confidence)).unwrap();
    writer.add("000002", &ids(255), None).unwrap();
    // A name that leads out of the folder is refused, and nothing is there before the end.
    assert!(writer.add("../000001", &ids(1), None).is_err());
    assert!(!out.exists());
    let label = |id: u16| InstanceLabel {
        id,
        label: format!("thing {id}"),
        category: "thing".to_owned(),
        taxonomies: Default::default(),
    };
    writer.finish(&[label(255), label(300), label(65_535)]).unwrap();
    assert!(!folder.path().join("000001.png").exists());

    let options = OpenOptions { masks: Some("made".into()), ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    assert_eq!(dataset.instances, [label(255), label(300), label(65_535)]);
    let loaded = dataset.load_frame(0, [1.0; 3]).unwrap();
    assert_eq!((loaded.mask, loaded.confidence), (Some(ids(65_535)), Some(confidence)));
    let loaded = dataset.load_frame(2, [1.0; 3]).unwrap();
    assert_eq!((loaded.mask, loaded.confidence), (Some(ids(255)), None));
}

#[test]
fn a_folder_that_holds_something_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("made");
    let mask = out.join("000000.png");
    write(&mask, "mine");
    let refused = MaskWriter::create(&out).err().unwrap().to_string();
    holds(&refused, &["made", "something is there already", "new folder"]);
    assert_eq!(fs::read_to_string(&mask).unwrap(), "mine");

    // A file that appears while masks are written is not replaced either.
    let later = folder.path().join("later");
    let writer = MaskWriter::create(&later).unwrap();
    writer.add("000000", &PixelGrid::from_pixels(1, 1, vec![1]), None).unwrap();
    write(&later.join("000000.png"), "mine");
    assert!(writer.finish(&[]).is_err());
    assert_eq!(fs::read_to_string(later.join("000000.png")).unwrap(), "mine");
}
