//! Masks of a whole video for a capture of some of its frames.
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod support;

use std::path::Path;

use cif_dataset::masks::Import;
use cif_dataset::{Dataset, FrameSource, OpenOptions, VideoFrame};
use serde_json::{Value, json};
use support::imports::failure_of;
use support::*;
use tempfile::TempDir;

/// Frames that the captures take of a video of [`OF`].
const TAKEN: [u64; 4] = [1, 3, 6, 8];
const OF: u64 = 10;

/// A capture of half the size of its video, as `cif capture` writes it; below folders where there are several cameras.
fn capture(cameras: &[&str]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut frames: Vec<Value> = Vec::new();
    for (c, camera) in cameras.iter().enumerate() {
        for number in TAKEN {
            let name = if cameras.len() > 1 {
                format!("images/{camera}/{number:06}.png")
            } else {
                format!("images/{number:06}.png")
            };
            write_rgb(&folder.path().join(&name), WIDTH, HEIGHT, |x, _| [(8 * x) as u8, 90, number as u8]);
            let time = 0.1 * number as f64;
            let place = number as f64 * 0.1 - 0.5 + c as f64;
            frames.push(json!({
                "file_path": name,
                "time": time,
                "cif": {
                    "file": format!("{camera}.mp4"),
                    "size": [2 * WIDTH, 2 * HEIGHT],
                    "video": {"frame": number, "of": OF, "time": time},
                },
                "transform_matrix": [[1, 0, 0, place], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]],
            }));
        }
    }
    let file = json!({"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames});
    write_json(&folder.path().join("transforms.json"), &file);
    folder
}

/// Masks of the size of the video: the left half is the number of the frame and 10, from `first` on.
fn track(folder: &Path, digits: usize, first: u64, numbers: impl Iterator<Item = u64>) {
    for number in numbers {
        let id = |x, _| if x < WIDTH { (number - first + 10) as u8 } else { 0 };
        write_mask(&folder.join(format!("{number:0digits$}.png")), 2 * WIDTH, 2 * HEIGHT, id);
    }
}

/// Ids of the left and right half of all masks, as imported.
fn imported(folder: &TempDir, masks: &Path, first: Option<u64>) -> (Vec<Option<[u16; 2]>>, Vec<String>) {
    let dataset = open(folder);
    let import = Import::open(masks, None, first, &dataset).unwrap();
    let ids = (0..dataset.frames.len()).map(|index| {
        let drawn = import.draw(&dataset, index).unwrap()?;
        assert_eq!((drawn.ids.width, drawn.ids.height, drawn.size), (WIDTH, HEIGHT, (2 * WIDTH, 2 * HEIGHT)));
        Some([*drawn.ids.at(WIDTH / 2 - 1, 5), *drawn.ids.at(WIDTH / 2, 5)])
    });
    (ids.collect(), import.notes.clone())
}

fn expected() -> Vec<Option<[u16; 2]>> {
    TAKEN.map(|number| Some([number as u16 + 10, 0])).to_vec()
}

#[test]
fn a_capture_remembers_its_recording() {
    let folder = capture(&["walk"]);
    let dataset = open(&folder);
    let source = FrameSource {
        file: "walk.mp4".to_owned(),
        size: [2 * WIDTH, 2 * HEIGHT],
        video: Some(VideoFrame { frame: 6, of: OF, time: 0.1 * 6.0 }),
    };
    assert_eq!(dataset.frames[2].source, Some(source));
    edit_json(&folder.path().join("transforms.json"), |file| {
        file["frames"][1]["cif"]["video"]["of"] = json!(3)
    });
    holds(&failure(&folder), &["transforms.json", "000003", "does not have"]);
}

#[test]
fn masks_of_all_frames_are_imported_from_either_first_number() {
    for (digits, first) in [(5, 0), (5, 1), (6, 0), (6, 1), (4, 1001)] {
        let folder = capture(&["walk"]);
        let masks = folder.path().join("tracked");
        track(&masks, digits, first, first..first + OF);
        let (ids, notes) = imported(&folder, &masks, None);
        assert_eq!(ids, expected(), "{digits} digits from {first}");
        assert!(
            notes.iter().any(|note| note.contains("walk.mp4") && note.contains("4 of these")),
            "{notes:?}"
        );
        assert!(!notes.iter().any(|note| note.contains("belong to no frame")), "{notes:?}");
    }
}

#[test]
fn numbers_with_gaps_count_where_one_end_shows_the_first() {
    for (first, numbers) in [(0, [0, 3, 6, 9]), (1, [2, 4, 7, 10])] {
        let folder = capture(&["walk"]);
        let masks = folder.path().join("tracked");
        track(&masks, 5, first, numbers.into_iter());
        let (ids, _) = imported(&folder, &masks, None);
        let known =
            TAKEN.map(|number| numbers.contains(&(number + first)).then_some([number as u16 + 10, 0]));
        assert_eq!(ids, known);
        assert!(ids.iter().flatten().count() >= 2);
    }
}

#[test]
fn numbers_that_could_be_several_things_are_refused_until_it_is_said() {
    // One mask too few or many, a part of the video, and six digits, of which some are names of frames.
    for (digits, numbers) in [(5, 0..9), (5, 1..10), (5, 0..11), (5, 2..7), (6, 1..10), (6, 2..9)] {
        let folder = capture(&["walk"]);
        let masks = folder.path().join("tracked");
        track(&masks, digits, 0, numbers.clone());
        let message = failure_of(&folder, &masks);
        holds(&message, &["walk.mp4", "10 frames", "--first-number"]);
        let (ids, _) = imported(&folder, &masks, Some(0));
        let known = TAKEN.map(|number| numbers.contains(&number).then_some([number as u16 + 10, 0]));
        assert_eq!(ids, known, "{numbers:?}");
    }
}

#[test]
fn as_many_masks_as_frames_of_the_capture_are_those_in_their_order() {
    for first in [0, 1] {
        let folder = capture(&["walk"]);
        let masks = folder.path().join("tracked");
        track(&masks, 5, first, first..first + 4);
        let (ids, notes) = imported(&folder, &masks, None);
        assert_eq!(ids, [10, 11, 12, 13].map(|id| Some([id, 0])), "{notes:?}");
    }
    // Numbers of the frames themselves, without their zeros.
    let folder = capture(&["walk"]);
    let masks = folder.path().join("tracked");
    track(&masks, 1, 0, TAKEN.into_iter());
    assert_eq!(imported(&folder, &masks, None).0, expected());
}

#[test]
fn cameras_have_folders_of_their_own() {
    let folder = capture(&["left", "right"]);
    let masks = folder.path().join("tracked");
    track(&masks.join("left"), 5, 0, 0..OF);
    track(&masks.join("right"), 5, 1, 1..=OF);
    let (ids, _) = imported(&folder, &masks, None);
    assert_eq!(ids, [expected(), expected()].concat());
}

#[test]
fn such_a_folder_is_taken_as_it_is() {
    for (digits, first, cameras) in [(5, 0, &["walk"][..]), (6, 1, &["walk"]), (5, 1, &["left", "right"])] {
        let folder = capture(cameras);
        let masks = folder.path().join("tracked");
        for camera in cameras {
            let below = if cameras.len() > 1 { masks.join(camera) } else { masks.clone() };
            track(&below, digits, first, first..first + OF);
        }
        let options = OpenOptions { masks: Some("tracked".into()), ..OpenOptions::default() };
        let dataset = Dataset::open(folder.path(), &options).unwrap();
        for frame in 0..dataset.frames.len() {
            let mask = dataset.load_mask(frame).unwrap().unwrap();
            assert_eq!((mask.width, mask.height), (WIDTH, HEIGHT));
            let id = TAKEN[frame % TAKEN.len()] as u16 + 10;
            assert_eq!([*mask.at(WIDTH / 2 - 1, 5), *mask.at(WIDTH / 2, 5)], [id, 0]);
        }
        // Masks of frames that were not taken, and of the size of the video, are as they should be.
        for words in ["belong to no frame", "nearest neighbour", "frames have a mask"] {
            assert!(!warns(&dataset, &[words]), "{:?}", dataset.warnings);
        }
    }
}

#[test]
fn keyframes_are_not_judged_as_masks_to_train_on() {
    let folder = capture(&["walk"]);
    // The first frame is held out.
    write_mask(&folder.path().join("painted/000001.png"), WIDTH, HEIGHT, |_, _| 1);
    let open = |keyframes| {
        let options = OpenOptions { masks: Some("painted".into()), keyframes, ..OpenOptions::default() };
        Dataset::open(folder.path(), &options).unwrap()
    };
    assert!(warns(&open(false), &["no training frame"]) && warns(&open(false), &["1 of 4 frames"]));
    let dataset = open(true);
    assert!(!warns(&dataset, &["training"]) && !warns(&dataset, &["frames have"]), "{:?}", dataset.warnings);
    assert_eq!(dataset.frames.iter().filter(|frame| frame.mask.is_some()).count(), 1);
}
