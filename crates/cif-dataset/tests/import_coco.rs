//! Masks in JSON of COCO and of YouTube-VIS, brought to the frames of a capture.
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod support;

use std::path::Path;

use cif_dataset::masks::{Import, SourceKind};
use serde_json::json;
use support::imports::*;
use support::*;

/// COCO JSON of three frames; `edit` changes it.
fn coco(path: &Path, edit: impl FnOnce(&mut serde_json::Value)) {
    let images: Vec<_> = (0..3)
        .map(|k| json!({"id": 10 + k, "file_name": format!("rgb/{k:06}.jpg"), "width": WIDTH, "height": HEIGHT}))
        .collect();
    let (w, h) = (u64::from(WIDTH), u64::from(HEIGHT));
    let annotations: Vec<_> = (0..3)
        .flat_map(|k| {
            let polygon = json!([[0, 0, 8, 0, 8, HEIGHT, 0, HEIGHT]]);
            let runs = json!({"size": [HEIGHT, WIDTH], "counts": [24 * h, (w - 24) * h]});
            [(1, polygon), (2, runs)].map(|(track, segmentation)| {
                json!({"id": 2 * k + track, "image_id": 10 + k, "category_id": 7, "track_id": track,
                       "segmentation": segmentation})
            })
        })
        .collect();
    let mut value =
        json!({"images": images, "annotations": annotations, "categories": [{"id": 7, "name": "mug"}]});
    edit(&mut value);
    write_json(path, &value);
}

#[test]
fn coco_objects_go_by_their_tracks_and_share_a_category() {
    let folder = hypernerf(4);
    let path = folder.path().join("coco.json");
    coco(&path, |_| {});
    let (kind, labels, frames) = imported(&folder, &path);
    assert_eq!((kind, labels), (SourceKind::Coco, vec!["mug 1".to_owned(), "mug 2".to_owned()]));
    assert_eq!(frames, [BOTH, BOTH, BOTH, None]);
}

#[test]
fn boxes_without_a_mask_are_left_out_and_named() {
    let folder = hypernerf(3);
    let path = folder.path().join("coco.json");
    for nothing in [json!([]), json!(null)] {
        coco(&path, |v| v["annotations"][1]["segmentation"] = nothing);
        let (_, _, frames) = imported(&folder, &path);
        assert_eq!(frames[0], Some([1, 0, 0]));
        std::fs::remove_dir_all(folder.path().join("imported")).unwrap();
        let import = Import::open(&path, None, None, &open(&folder)).unwrap();
        let note = import.notes.iter().find(|note| note.contains("no segmentation")).unwrap();
        assert!(note.starts_with("1 annotations") && note.ends_with(": 2"), "{note}");
    }
    // An image with a box alone gets no mask, rather than an empty one.
    coco(&path, |v| {
        v["annotations"].as_array_mut().unwrap().remove(1);
        v["annotations"][0]["segmentation"] = json!([]);
    });
    assert_eq!(imported(&folder, &path).2, [None, BOTH, BOTH]);
}

#[test]
fn outlines_of_one_or_two_corners_cover_nothing() {
    let folder = hypernerf(3);
    let path = folder.path().join("coco.json");
    let stroke = json!([3, 4, 5, 6]);
    // With a true outline, and alone.
    coco(&path, |v| {
        v["annotations"][0]["segmentation"].as_array_mut().unwrap().insert(0, stroke.clone());
        v["annotations"][2]["segmentation"] = json!([stroke, [1.5, 2]]);
    });
    let import = Import::open(&path, None, None, &open(&folder)).unwrap();
    assert!(import.notes.iter().any(|note| note.starts_with("1 annotations") && note.ends_with(": 3")));
    assert_eq!(imported(&folder, &path).2, [BOTH, Some([0, 0, 2]), BOTH]);
}

#[test]
fn panoptic_coco_names_its_pictures() {
    let folder = hypernerf(3);
    let path = folder.path().join("coco.json");
    coco(&path, |v| {
        v["annotations"] =
            json!([{"image_id": 10, "file_name": "0.png", "segments_info": [{"id": 1, "category_id": 7}]}]);
    });
    holds(&failure_of(&folder, &path), &["coco.json", "COCO panoptic", "give the folder of these"]);
}

#[test]
fn names_that_roboflow_gave_are_those_of_before() {
    let folder = hypernerf(3);
    let path = folder.path().join("coco.json");
    coco(&path, |v| {
        for (k, image) in v["images"].as_array_mut().unwrap().iter_mut().enumerate() {
            image["file_name"] = format!("{k:06}_jpg.rf.0123456789abcdef0123456789abcde{k}.jpg").into();
        }
    });
    assert_eq!(imported(&folder, &path).2, [BOTH; 3]);
}

#[test]
fn damaged_coco_is_refused_by_entry() {
    let folder = hypernerf(3);
    let path = folder.path().join("coco.json");
    type Edit = fn(&mut serde_json::Value);
    let cases: [(Edit, &[&str]); 8] = [
        (
            |v| {
                v["images"].as_array_mut().unwrap().iter_mut().for_each(|image| {
                    (image["width"], image["height"]) = (json!(9 * WIDTH), json!(9 * HEIGHT));
                })
            },
            &["000000.jpg", "288 x 216 = 62208 pixels", "64 times", "32 x 24", "(49152)"],
        ),
        (
            |v| {
                v["annotations"]
                    .as_array_mut()
                    .unwrap()
                    .iter_mut()
                    .for_each(|a| a["segmentation"] = json!([]))
            },
            &["none of its", "segmentation", "boxes"],
        ),
        (
            |v| v["annotations"][1]["segmentation"]["counts"][1] = json!(999_999),
            &["annotation 2", "broken run-length"],
        ),
        (|v| v["annotations"][1]["segmentation"]["counts"] = json!("~~"), &["annotation 2", "no letter"]),
        (|v| v["annotations"][0]["category_id"] = json!(8), &["annotation 1", "category_id 8"]),
        (|v| v["annotations"][0]["image_id"] = json!(99), &["annotation 1", "image_id 99"]),
        (|v| v["images"][2]["width"] = json!(64), &["000002.jpg", "64 x 24", "32 x 24", "another aspect"]),
        (
            |v| v["annotations"].as_array_mut().unwrap().iter_mut().for_each(|a| a["track_id"] = json!(null)),
            &["several annotations", "track_id"],
        ),
    ];
    for (edit, words) in cases {
        coco(&path, edit);
        holds(&failure_of(&folder, &path), words);
    }
    coco(&path, |_| {});
    let text = std::fs::read_to_string(&path).unwrap();
    write(&path, &text[..text.len() / 2]);
    holds(&failure_of(&folder, &path), &["coco.json:", "EOF"]);
}

/// YouTube-VIS JSON of three frames, the last of which does not show object 2; `edit` changes it.
fn youtube_vis(path: &Path, edit: impl FnOnce(&mut serde_json::Value)) {
    let names: Vec<String> = (0..3).map(|k| format!("clip/{k:06}.jpg")).collect();
    let (w, h) = (u64::from(WIDTH), u64::from(HEIGHT));
    let runs = json!({"size": [h, w], "counts": [24 * h, (w - 24) * h]});
    let mut value = json!({
        "videos": [{"id": 4, "file_names": names, "width": w, "height": h, "length": 3}],
        "annotations": [
            {"id": 1, "video_id": 4, "category_id": 7, "segmentations": vec![json!([[0, 0, 8, 0, 8, h, 0, h]]); 3]},
            {"id": 2, "video_id": 4, "category_id": 8, "segmentations": [runs, runs, null]}],
        "categories": [{"id": 7, "name": "mug"}, {"id": 8, "name": "plate"}]});
    edit(&mut value);
    write_json(path, &value);
}

#[test]
fn objects_of_a_youtube_vis_video_are_its_annotations() {
    let folder = hypernerf(3);
    let path = folder.path().join("vis.json");
    youtube_vis(&path, |_| {});
    let (kind, labels, frames) = imported(&folder, &path);
    assert_eq!((kind, labels), (SourceKind::YoutubeVis, vec!["mug".to_owned(), "plate".to_owned()]));
    assert_eq!(frames, [BOTH, BOTH, Some([1, 0, 0])]);
}

#[test]
fn the_video_of_the_capture_is_found_among_several() {
    let folder = hypernerf(3);
    let path = folder.path().join("vis.json");
    let add = |value: &mut serde_json::Value, name: &str| {
        let other = json!({"id": 5, "file_names": [name], "width": 9, "height": 9});
        value["videos"].as_array_mut().unwrap().insert(0, other);
        let annotation =
            json!({"id": 3, "video_id": 5, "segmentations": [{"size": [9, 9], "counts": [0, 81]}]});
        value["annotations"].as_array_mut().unwrap().push(annotation);
    };
    youtube_vis(&path, |value| add(value, "other/77.jpg"));
    let (_, labels, frames) = imported(&folder, &path);
    assert_eq!((labels.len(), frames[0]), (2, BOTH));
    youtube_vis(&path, |value| add(value, "other/000001.jpg"));
    holds(&failure_of(&folder, &path), &["vis.json", "2 videos", "of which 2"]);
}

#[test]
fn damaged_youtube_vis_is_refused_by_entry() {
    let folder = hypernerf(3);
    let path = folder.path().join("vis.json");
    type Edit = fn(&mut serde_json::Value);
    let cases: [(Edit, &[&str]); 5] = [
        (
            |v| v["annotations"][1]["segmentations"][1]["counts"][1] = json!(999_999),
            &["annotation 2 in clip/000001.jpg", "broken run-length"],
        ),
        (
            |v| v["annotations"][1]["segmentations"] = json!([null]),
            &["annotation 2", "1 segmentations", "3 frames"],
        ),
        (|v| v["annotations"][0]["category_id"] = json!(9), &["annotation 1", "category_id 9"]),
        (|v| v["annotations"][0]["id"] = json!(null), &["no id"]),
        (|v| v["videos"][0]["width"] = json!(64), &["000000.jpg", "64 x 24", "32 x 24"]),
    ];
    for (edit, words) in cases {
        youtube_vis(&path, edit);
        holds(&failure_of(&folder, &path), words);
    }
}
