//! Masks that a 2D detector found for a prompt: one per frame, in the ways that detectors write them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;

use crate::files::{listing, mask};
use crate::lens_removal::undistort_mask;
use crate::sizes::same_aspect;
use crate::{Dataset, Error};

/// Name of a frame as a single file name: `cam03/0007` is `cam03_0007`.
#[must_use]
pub fn flat_name(frame: &str) -> String {
    frame.replace(['/', '\\'], "_")
}

/// Files of detector masks by frame, `[frames]`; several files of a frame (one per detection) belong together.
///
/// A file belongs to a frame when its name, or the name of the folder it lies in, is the name of the frame, its
/// [`flat_name`], or the stem of its image where stems are unique; anything may follow an underscore or a dot
/// (`000012_mask.png`, `000012_1.png`, `000012.jpg.png`). Where names of several frames fit, the longest counts.
///
/// # Errors
/// When there is no such folder, or none of its PNG files belongs to a frame.
pub fn found_masks(dataset: &Dataset, folder: &Path) -> Result<Vec<Vec<PathBuf>>, Error> {
    let (masks, files) = files_of_frames(dataset, folder, "png")?;
    if masks.iter().all(Vec::is_empty) {
        let example = dataset.frames.first().map(|frame| frame.name.as_str()).unwrap_or_default();
        return Err(Error::MaskFolder {
            folder: folder.to_owned(),
            problem: format!(
                "none of its {files} PNG files belongs to a frame; name them as the frames, e.g. {example}.png"
            ),
        });
    }
    Ok(masks)
}

/// Files of a folder with an ending by frame, `[frames]`, as [`found_masks`] assigns them, and how many there
/// are in all.
pub(crate) fn files_of_frames(
    dataset: &Dataset,
    folder: &Path,
    ending: &str,
) -> Result<(Vec<Vec<PathBuf>>, usize), Error> {
    if !folder.is_dir() {
        return Err(Error::MissingFolder { path: folder.to_owned() });
    }
    let mut names: BTreeMap<String, Option<usize>> = BTreeMap::new();
    for (index, frame) in dataset.frames.iter().enumerate() {
        names.insert(frame.name.clone(), Some(index));
        names.insert(flat_name(&frame.name), Some(index));
    }
    let mut stems: BTreeMap<String, Option<usize>> = BTreeMap::new();
    for (index, frame) in dataset.frames.iter().enumerate() {
        stems.entry(listing::stem(&frame.image)).and_modify(|one| *one = None).or_insert(Some(index));
    }
    for (stem, index) in stems {
        names.entry(stem).or_insert(index);
    }
    let mut files = listing::below(folder)?;
    files.retain(|path| listing::has_extension(path, &[ending]));
    let mut of_frames = vec![Vec::new(); dataset.frames.len()];
    for file in &files {
        let inside = file.strip_prefix(folder).unwrap_or(file).with_extension("");
        let inside = inside.to_string_lossy().replace('\\', "/");
        if let Some(index) = frame_of(&inside, &names) {
            of_frames[index].push(file.clone());
        }
    }
    Ok((of_frames, files.len()))
}

/// The frame with the longest name that a path begins with, up to a separator.
fn frame_of(path: &str, names: &BTreeMap<String, Option<usize>>) -> Option<usize> {
    let ends = path.char_indices().filter(|(_, letter)| "_./-".contains(*letter)).map(|(at, _)| at);
    let mut ends: Vec<usize> = ends.chain([path.len()]).collect();
    ends.reverse();
    ends.into_iter().find_map(|end| names.get(&path[..end]).copied().flatten())
}

impl Dataset {
    /// Loads detector masks of a frame at the size of its camera: true where any of them is not black. Masks of
    /// captured images are freed of lens distortion as those are; `loaded` ones were made on images as
    /// [`Dataset::load_image`] returns them.
    ///
    /// # Errors
    /// When a file cannot be decoded, or has another aspect than the image.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_found_mask(
        &self,
        index: usize,
        files: &[PathBuf],
        loaded: bool,
    ) -> Result<PixelGrid<bool>, Error> {
        let frame = &self.frames[index];
        let (width, height) = (frame.camera.width, frame.camera.height);
        let mut found = PixelGrid::filled(width, height, false);
        for path in files {
            let stored = frame.turn.seen(mask::decode_binary(path)?, (width, height));
            if !same_aspect((stored.width, stored.height), (width, height)) {
                return Err(Error::MaskSize {
                    mask: path.clone(),
                    mask_size: (stored.width, stored.height),
                    image: frame.image.clone(),
                    image_size: (width, height),
                });
            }
            let mut mask = mask::nearest_resize(&stored, width, height);
            if !loaded && !frame.lens.is_identity() {
                mask = undistort_mask(&mask, &frame.camera, &frame.lens);
            }
            for (found, value) in found.pixels.iter_mut().zip(&mask.pixels) {
                *found |= *value != 0;
            }
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_belong_to_the_frame_with_the_longest_name() {
        let names: BTreeMap<String, Option<usize>> =
            [("a", Some(0)), ("a_1", Some(1)), ("cam0/07", Some(2)), ("cam0_07", Some(2)), ("07", None)]
                .into_iter()
                .map(|(name, index)| (name.to_owned(), index))
                .collect();
        for (path, frame) in [
            ("a", Some(0)),
            ("a_mask", Some(0)),
            ("a_1", Some(1)),
            ("a_1_2", Some(1)),
            ("a_12", Some(0)),
            ("a.jpg", Some(0)),
            ("a/mug", Some(0)),
            ("cam0/07", Some(2)),
            ("cam0_07_0", Some(2)),
            ("07", None),
            ("b", None),
            ("ab", None),
        ] {
            assert_eq!(frame_of(path, &names), frame, "{path}");
        }
    }
}
