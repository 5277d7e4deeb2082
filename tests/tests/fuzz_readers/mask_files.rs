//! Masks of other tools for a capture of [`crate::captures`], and their import.

use std::path::Path;

use cif_dataset::masks::Import;
use cif_dataset::{Dataset, OpenOptions};
use serde_json::json;

/// Size of the images that masks are for.
fn size() -> (u32, u32) {
    (crate::captures::WIDTH, crate::captures::HEIGHT)
}

pub(crate) fn import(folder: &Path, file: &str) -> Result<(), String> {
    let options = OpenOptions { without_masks: true, ..OpenOptions::default() };
    let dataset = Dataset::open(folder, &options).map_err(|error| error.to_string())?;
    let import = Import::open(&folder.join(file), None, None, &dataset).map_err(|error| error.to_string())?;
    for frame in 0..dataset.frames.len() {
        import.draw(&dataset, frame).map_err(|error| error.to_string())?;
    }
    Ok(())
}

pub(crate) fn coco() -> String {
    let (width, height) = size();
    let runs = [u64::from(height), u64::from(width - 1) * u64::from(height)];
    json!({
        "images": [{"id": 1, "file_name": "000001.png", "width": width, "height": height}],
        "categories": [{"id": 3, "name": "mug"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 3, "track_id": 4, "segmentation": [[0, 0, 3, 0, 3, 3, 0, 3]]},
            {"id": 2, "image_id": 1, "category_id": 3, "track_id": 5,
             "segmentation": {"size": [height, width], "counts": runs}},
        ],
    })
    .to_string()
}

pub(crate) fn youtube_vis() -> String {
    let (width, height) = size();
    let runs = [u64::from(height), u64::from(width - 1) * u64::from(height)];
    json!({
        "videos": [{"id": 1, "file_names": ["clip/000000.jpg", "clip/000001.jpg"], "width": width, "height": height}],
        "categories": [{"id": 3, "name": "mug"}],
        "annotations": [
            {"id": 1, "video_id": 1, "category_id": 3, "segmentations": [[[0, 0, 3, 0, 3, 3, 0, 3]], null]},
            {"id": 2, "video_id": 1, "category_id": 3,
             "segmentations": [null, {"size": [height, width], "counts": runs}]},
        ],
    })
    .to_string()
}

pub(crate) fn label_studio() -> String {
    let (width, height) = size();
    // All opaque: runs of up to 2^16 values.
    let (mut bits, mut left) =
        (format!("{:032b}001110010001101111111", 4 * width * height), 4 * width * height);
    while left > 0 {
        let run = left.min(1 << 16);
        bits += &format!("111{:016b}11111111", run - 1);
        left -= run;
    }
    let byte =
        |text: &[u8]| text.iter().enumerate().fold(0_u8, |value, (k, bit)| value | (bit - b'0') << (7 - k));
    let code: Vec<u8> = bits.as_bytes().chunks(8).map(byte).collect();
    json!([{"id": 1, "data": {"image": "/data/upload/1/0a1b2c3d-000001.png"}, "annotations": [{"result": [
        {"id": "a", "type": "brushlabels", "original_width": width, "original_height": height,
         "value": {"format": "rle", "rle": code, "brushlabels": ["mug"]}},
        {"id": "b", "type": "polygonlabels", "original_width": width, "original_height": height,
         "value": {"points": [[0, 0], [50, 0], [50, 50]], "polygonlabels": ["cup"]}},
    ]}]}])
    .to_string()
}

pub(crate) fn cvat() -> String {
    let (width, height) = size();
    format!(
        "<annotations><version>1.1</version><image id=\"0\" name=\"000001.png\" width=\"{width}\" height=\"{height}\">\
         <polygon label=\"mug\" points=\"0,0;4,0;4,4\" z_order=\"1\"/>\
         <mask label=\"cup\" rle=\"1, 3\" left=\"1\" top=\"0\" width=\"2\" height=\"2\" z_order=\"0\"/></image></annotations>"
    )
}
