//! D-NeRF and Blender captures: `transforms_{train,val,test}.json`.
//!
//! Held out is `transforms_test.json`, as in the base code; `transforms_val.json` is read only where there is
//! no test file. Without any time the capture is static.

use std::path::Path;

use super::draft::{Draft, DraftFrame, Source, customary_points};
use super::transforms;
use crate::files::listing;
use crate::{Error, Split};

/// Half edge of the box for random points (methods reference 1.1).
const BOX: f64 = 1.3;

pub(super) fn read(source: &Source<'_>) -> Result<Draft, Error> {
    let root = source.root;
    let [train, val, test] =
        ["train", "val", "test"].map(|split| root.join(format!("transforms_{split}.json")));
    if !listing::is_there(&train) {
        return Err(Error::MissingFile { path: train, fix: "it lists the frames to train on".to_owned() });
    }
    let (mut warnings, mut unused) = (Vec::new(), Vec::new());
    let held_out = if listing::is_there(&test) {
        if listing::is_there(&val) {
            unused.push("transforms_val.json (held out are the frames of transforms_test.json)".to_owned());
        }
        Some(test)
    } else if listing::is_there(&val) {
        Some(val)
    } else {
        warnings.push(format!(
            "{}: there is neither transforms_test.json nor transforms_val.json; nothing is held out",
            root.display()
        ));
        None
    };

    let mut files = Vec::new();
    for (path, split) in [(Some(train.clone()), Split::Train), (held_out, Split::Val)] {
        let Some(path) = path else { continue };
        files.push((transforms::read(&path)?, path, split));
    }
    let file_paths: Vec<&Path> =
        files.iter().flat_map(|(file, ..)| &file.frames).map(|entry| entry.file_path.as_path()).collect();
    let mut inner = transforms::inside(root, &file_paths).into_iter();
    let mut frames = Vec::new();
    let mut times = Vec::new();
    let mut frames_per_second = None;
    for (file, path, split) in &files {
        frames_per_second = frames_per_second.or(file.fps);
        for (entry, inner) in file.frames.iter().zip(inner.by_ref()) {
            times.push(entry.time);
            frames.push(DraftFrame {
                name: transforms::frame_name(&inner),
                camera_name: "camera".to_owned(),
                time: 0.0,
                split: *split,
                image: transforms::image(root, path, entry)?,
                mask: entry.mask_path.as_ref().map(|mask| root.join(transforms::clean(mask))),
                camera: transforms::camera(path, file, entry)?,
            });
        }
    }
    let times = transforms::times(&train, &times)?;
    for (frame, time) in frames.iter_mut().zip(&times.normalised) {
        frame.time = *time;
    }
    let unit = if frames_per_second.is_none() { times.note(&train) } else { None };
    Ok(Draft {
        frames,
        stored_reduction: 1,
        points: customary_points(root)?,
        random_box: Some(BOX),
        frames_per_second: frames_per_second.or(times.per_second),
        notes: unit.into_iter().collect(),
        warnings,
        unused,
        ..Draft::default()
    })
}
