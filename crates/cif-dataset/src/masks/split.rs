//! Brings a tracker's ids back to the frames of a capture.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::folder::NewFolder;
use super::zigzag::{ZigzagEntry, ZigzagIndex};
use crate::Error;
use crate::files::{json, listing, mask};

/// An instance that passed the filter.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeptInstance {
    /// Id in the new masks, 1 to K without gaps.
    pub id: u16,
    /// Name until somebody gives a better one: `instance_<id>`.
    pub label: String,
    /// Class; equal to the label.
    pub category: String,
    /// Id that the tracker gave.
    pub tracker_id: u16,
    /// Pixels over all frames.
    pub pixels: u64,
}

/// An instance that the visibility filter removed; its pixels are unlabelled.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RemovedInstance {
    /// Id that the tracker gave.
    pub tracker_id: u16,
    /// Pixels over all frames.
    pub pixels: u64,
    /// Views in none of whose frames it has enough pixels.
    pub missing_in: Vec<String>,
}

/// Result of [`split_tracker_masks`]; stored as `instances.json` next to the masks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SplitReport {
    /// Kept instances, ascending id.
    pub instances: Vec<KeptInstance>,
    /// Removed instances, ascending tracker id.
    pub removed: Vec<RemovedInstance>,
    /// Masks written.
    pub masks: usize,
    /// Frames for which the tracker wrote no mask.
    pub without_mask: Vec<String>,
    /// Pixels that an instance must have in one frame of every view.
    pub min_px: u64,
}

/// Reads the id images that a tracker wrote for a zigzag sequence and writes them as the masks of the
/// capture's frames into a new folder: `<out_dir>/<frame>.png`, with the table of ids in `instances.json`.
/// The folder can then be given as the mask folder of the capture.
///
/// With several views, an instance is kept only if every view, the held-out one included, has a frame in which
/// it has at least `min_px` pixels (0 counts as 1); the others become 0 everywhere. With one view all are kept.
/// Ids are then numbered densely from 1 in ascending order.
///
/// The tracker's files are found by the stem of the image; where none fits, PNG files in name order are taken
/// if there are as many as images.
///
/// # Errors
/// When a mask cannot be read, none is there, or the folder is not empty or cannot be written.
pub fn split_tracker_masks(
    index: &ZigzagIndex,
    tracker_dir: &Path,
    out_dir: &Path,
    min_px: u64,
) -> Result<SplitReport, Error> {
    let min_px = min_px.max(1);
    let sources = tracker_files(index, tracker_dir)?;
    let counts: Vec<_> = sources
        .par_iter()
        .map(|(entry, path)| {
            let mut counts: BTreeMap<u16, u64> = BTreeMap::new();
            for run in mask::decode(path)?.pixels.chunk_by(|a, b| a == b) {
                *counts.entry(run[0]).or_default() += run.len() as u64;
            }
            counts.remove(&0);
            Ok::<_, Error>((entry.view, counts))
        })
        .collect();

    let mut pixels: BTreeMap<u16, u64> = BTreeMap::new();
    let mut seen: BTreeMap<u16, BTreeSet<usize>> = BTreeMap::new();
    for count in counts {
        let (view, count) = count?;
        for (id, count) in count {
            *pixels.entry(id).or_default() += count;
            if count >= min_px {
                seen.entry(id).or_default().insert(view);
            }
        }
    }
    let mut instances = Vec::new();
    let mut removed = Vec::new();
    for (tracker_id, pixels) in pixels {
        let missing_in: Vec<String> = (0..index.views.len())
            .filter(|view| !seen.get(&tracker_id).is_some_and(|views| views.contains(view)))
            .map(|view| index.views[view].clone())
            .collect();
        if index.is_multi_view() && !missing_in.is_empty() {
            removed.push(RemovedInstance { tracker_id, pixels, missing_in });
            continue;
        }
        // Distinct 16-bit ids without 0 are at most 65 535.
        let id = instances.len() as u16 + 1;
        let label = format!("instance_{id}");
        instances.push(KeptInstance { id, category: label.clone(), label, tracker_id, pixels });
    }

    let new_id: BTreeMap<u16, u16> = instances.iter().map(|kept| (kept.tracker_id, kept.id)).collect();
    let folder = NewFolder::create(out_dir)?;
    let written: Vec<Result<(), Error>> = sources
        .par_iter()
        .map(|(entry, path)| {
            let tracked = mask::decode(path)?;
            let remapped: PixelGrid<u16> = tracked.map(|id| new_id.get(id).copied().unwrap_or(0));
            let target =
                cif_output::inside(folder.path(), &entry.frame, "png").map_err(Error::write(out_dir))?;
            if let Some(parent) = target.parent() {
                std::fs::create_dir_all(parent).map_err(Error::write(parent))?;
            }
            mask::write(&target, &remapped)
        })
        .collect();
    written.into_iter().collect::<Result<(), Error>>()?;
    let with_mask: BTreeSet<&str> = sources.iter().map(|(entry, _)| entry.frame.as_str()).collect();
    let report = SplitReport {
        instances,
        removed,
        masks: sources.len(),
        without_mask: index
            .images
            .iter()
            .filter(|entry| !with_mask.contains(entry.frame.as_str()))
            .map(|entry| entry.frame.clone())
            .collect(),
        min_px,
    };
    json::write(&folder.path().join("instances.json"), &report)?;
    folder.finish()?;
    Ok(report)
}

/// Tracker file of each image that has one.
fn tracker_files<'a>(
    index: &'a ZigzagIndex,
    tracker_dir: &Path,
) -> Result<Vec<(&'a ZigzagEntry, PathBuf)>, Error> {
    if !tracker_dir.is_dir() {
        return Err(Error::MissingFolder { path: tracker_dir.to_owned() });
    }
    let by_stem: Vec<(&ZigzagEntry, PathBuf)> = index
        .images
        .iter()
        .map(|entry| (entry, tracker_dir.join(Path::new(&entry.image).with_extension("png"))))
        .filter(|(_, path)| path.is_file())
        .collect();
    if !by_stem.is_empty() {
        return Ok(by_stem);
    }
    let files: Vec<PathBuf> = listing::entries(tracker_dir)?
        .into_iter()
        .filter(|path| listing::has_extension(path, &["png"]))
        .collect();
    if files.is_empty() || files.len() != index.images.len() {
        return Err(Error::MaskFolder {
            folder: tracker_dir.to_owned(),
            problem: format!(
                "{} PNG files, none named as an image of the sequence ({} ...); the tracker's id images are \
                 expected, {} of them",
                files.len(),
                index.images.first().map(|entry| entry.image.as_str()).unwrap_or_default(),
                index.images.len()
            ),
        });
    }
    Ok(index.images.iter().zip(files).collect())
}
