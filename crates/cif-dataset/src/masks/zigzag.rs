//! The pseudo-monocular sequence: view 1 forwards, view 2 backwards, and so on.
//!
//! At each seam the neighbouring frames share their time and differ only in view, so that motion and viewpoint
//! never jump together.

use std::collections::BTreeSet;
use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::folder::NewFolder;
use super::view_order::{ViewOrder, ordered_views};
use crate::files::{image, json};
use crate::{Dataset, Error};

/// File next to the images that says which frame each of them is.
pub const INDEX_FILE: &str = "zigzag.json";

/// Position in the sequence of a frame of a view, all from 0, with `frames` frames per view.
#[must_use]
pub fn position_of(view: usize, frame: usize, frames: usize) -> usize {
    view * frames + if view.is_multiple_of(2) { frame } else { frames - 1 - frame }
}

/// View and frame at a position in the sequence, all from 0; the inverse of [`position_of`].
#[must_use]
pub fn frame_of(position: usize, frames: usize) -> (usize, usize) {
    let (view, rest) = (position / frames, position % frames);
    (view, if view.is_multiple_of(2) { rest } else { frames - 1 - rest })
}

/// The whole sequence as (view, frame), from 0.
#[must_use]
pub fn zigzag_order(views: usize, frames: usize) -> Vec<(usize, usize)> {
    (0..views * frames).map(|position| frame_of(position, frames)).collect()
}

/// One image of the sequence.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ZigzagEntry {
    /// File name in the folder, e.g. `000017.png`; the tracker's mask has the same stem.
    pub image: String,
    /// Frame of the capture, e.g. `cam03/0007`.
    pub frame: String,
    /// Index into [`ZigzagIndex::views`].
    pub view: usize,
}

/// Index of the sequence that [`write_zigzag`] wrote, as stored in `zigzag.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ZigzagIndex {
    /// Camera names in the order of the sequence; one entry when the capture has no synchronised cameras.
    pub views: Vec<String>,
    /// Sum of the distances between consecutive camera centres, metres.
    pub view_path_m: f64,
    /// Images in the order of the sequence.
    pub images: Vec<ZigzagEntry>,
}

impl ZigzagIndex {
    /// Reads the index of a sequence: a folder that [`write_zigzag`] wrote, or its `zigzag.json`.
    ///
    /// # Errors
    /// When there is no such file, or it is not an index.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let path = if path.is_dir() { path.join(INDEX_FILE) } else { path.to_owned() };
        if !path.is_file() {
            return Err(Error::MissingFile {
                path,
                fix: "write the sequence first: cif masks zigzag CAPTURE -o DIR".to_owned(),
            });
        }
        let index: Self = json::read(&path)?;
        let mut names = BTreeSet::new();
        for entry in &index.images {
            let escapes = cif_output::check_name(&entry.frame).is_err();
            if entry.view >= index.views.len() || escapes {
                return Err(Error::invalid(
                    &path,
                    format!("the entry of {} is damaged; write it again", entry.image),
                ));
            }
            if !names.insert(entry.frame.as_str()) {
                return Err(Error::DuplicateFrame { path, frame: entry.frame.clone() });
            }
        }
        Ok(index)
    }

    /// True when ids are compared across views.
    #[must_use]
    pub fn is_multi_view(&self) -> bool {
        self.views.len() > 1
    }
}

/// The sequence of a capture: (view, frame index), and the views.
///
/// Cameras that all have the same times are views of a rig. Otherwise there is one sequence, in the order of
/// the capture.
fn sequence(dataset: &Dataset, order: ViewOrder) -> (Vec<String>, f64, Vec<(usize, usize)>) {
    let (views, length) = ordered_views(dataset, order);
    let by_view: Vec<Vec<usize>> = views
        .iter()
        .map(|view| (0..dataset.frames.len()).filter(|k| dataset.frames[*k].camera_name == *view).collect())
        .collect();
    let times = |frames: &[usize]| frames.iter().map(|k| dataset.frames[*k].time_index).collect::<Vec<_>>();
    let synchronised = by_view.windows(2).all(|pair| times(&pair[0]) == times(&pair[1]));
    if views.len() < 2 || !synchronised {
        let name = views.first().cloned().unwrap_or_default();
        return (vec![name], 0.0, (0..dataset.frames.len()).map(|index| (0, index)).collect());
    }
    let frames = by_view[0].len();
    let sequence = zigzag_order(views.len(), frames)
        .into_iter()
        .map(|(view, frame)| (view, by_view[view][frame]))
        .collect();
    (views, length, sequence)
}

/// Writes the images of a capture into a new folder as one numbered sequence for a video tracker, with
/// `zigzag.json` next to them. Frames are ordered by time inside a view, and views alternate in direction.
///
/// Images are written as captured, at their stored size and with their lens, since masks belong to captured
/// images; alpha is composited on white.
///
/// # Errors
/// When an image cannot be read, or the folder is not empty or cannot be written.
pub fn write_zigzag(dataset: &Dataset, out_dir: &Path, order: ViewOrder) -> Result<ZigzagIndex, Error> {
    let (views, view_path_m, sequence) = sequence(dataset, order);
    let folder = NewFolder::create(out_dir)?;
    let images: Vec<ZigzagEntry> = sequence
        .iter()
        .enumerate()
        .map(|(position, (view, index))| ZigzagEntry {
            image: format!("{position:06}.png"),
            frame: dataset.frames[*index].name.clone(),
            view: *view,
        })
        .collect();
    let written: Vec<Result<(), Error>> = images
        .par_iter()
        .zip(&sequence)
        .map(|(entry, (_, index))| {
            let frame = &dataset.frames[*index];
            let upright = image::decode(&frame.image, frame.turn)?;
            let colors = image::to_bytes(&image::composite(&upright, [1.0; 3]));
            let bytes = colors.pixels.as_flattened();
            image::write_rgb(&folder.path().join(&entry.image), bytes, colors.width, colors.height)
        })
        .collect();
    written.into_iter().collect::<Result<(), Error>>()?;
    let index = ZigzagIndex { views, view_path_m, images };
    json::write(&folder.path().join(INDEX_FILE), &index)?;
    folder.finish()?;
    Ok(index)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_and_frames_are_a_bijection() {
        for (views, frames) in [(1, 1), (1, 7), (2, 1), (3, 4), (6, 5)] {
            let order = zigzag_order(views, frames);
            assert_eq!(order.iter().collect::<BTreeSet<_>>().len(), views * frames);
            for (position, (view, frame)) in order.iter().enumerate() {
                assert!(*view < views && *frame < frames);
                assert_eq!(position_of(*view, *frame, frames), position);
            }
        }
    }

    #[test]
    fn seams_change_the_view_and_keep_the_time() {
        let (views, frames) = (5, 4);
        let order = zigzag_order(views, frames);
        for seam in (frames..views * frames).step_by(frames) {
            let (before, after) = (order[seam - 1], order[seam]);
            assert_eq!((before.0 + 1, before.1), after);
        }
        // The two cases of the reference, from 0: forward views end at the last frame, backward ones at the
        // first.
        assert_eq!(position_of(0, frames - 1, frames) + 1, position_of(1, frames - 1, frames));
        assert_eq!(position_of(1, 0, frames) + 1, position_of(2, 0, frames));
        assert_eq!(order[..6], [(0, 0), (0, 1), (0, 2), (0, 3), (1, 3), (1, 2)]);
    }
}
