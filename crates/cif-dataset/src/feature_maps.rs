//! Feature maps: three numbers per pixel of a frame, which people make with models of their own.
//!
//! A folder holds a NumPy file per training frame, named as the frame as masks of detectors are (see
//! [`crate::masks::found_masks`]): 4- or 8-byte floats, `[height, width, 3]`, of the captured image at any size of its
//! aspect. Pixels that are not a number, or 0 in all three channels, have no feature.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;

use crate::files::{mask, npy};
use crate::lens_removal::undistort_mask;
use crate::masks::files_of_frames;
use crate::sizes::same_aspect;
use crate::{Dataset, Error};

/// Channels of a map.
const CHANNELS: usize = 3;

/// Files of feature maps of the training frames, by index of the frame.
///
/// # Errors
/// When there is no such folder, or a training frame has no file in it, or several.
pub fn feature_maps(dataset: &Dataset, folder: &Path) -> Result<BTreeMap<usize, PathBuf>, Error> {
    let (mut of_frames, _) = files_of_frames(dataset, folder, "npy")?;
    let mut maps = BTreeMap::new();
    for index in dataset.train_frames() {
        let name = &dataset.frames[index].name;
        match &mut of_frames[index][..] {
            [file] => maps.insert(index, std::mem::take(file)),
            [] => {
                return Err(Error::invalid(
                    folder,
                    format!(
                        "training frame {name} has no feature map; write it as {name}.npy, floats of [height, width, 3]"
                    ),
                ));
            }
            several => {
                let names: Vec<String> = several.iter().map(|file| file.display().to_string()).collect();
                return Err(Error::invalid(
                    folder,
                    format!("training frame {name} has several feature maps, {}; keep one", names.join(", ")),
                ));
            }
        };
    }
    Ok(maps)
}

impl Dataset {
    /// Loads the feature map of a frame at the size of its camera, freed of lens distortion as images are; pixels
    /// without a feature are 0 in all channels.
    ///
    /// # Errors
    /// When the file is no such map, of another aspect than the image, or holds infinities.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_feature_map(&self, index: usize, path: &Path) -> Result<PixelGrid<[f32; CHANNELS]>, Error> {
        let frame = &self.frames[index];
        let (width, height) = (frame.camera.width, frame.camera.height);
        let array = npy::read_floats(path)?;
        let (stored_height, stored_width) = match array.shape[..] {
            [rows, columns, CHANNELS] if rows > 0 && columns > 0 => (rows as u32, columns as u32),
            _ => {
                let shape = &array.shape;
                return Err(Error::invalid(
                    path,
                    format!("shape {shape:?} where [height, width, 3] is expected"),
                ));
            }
        };
        let seen = frame.turn.seen_size((stored_width, stored_height), (width, height));
        if !same_aspect(seen, (width, height)) {
            return Err(Error::invalid(
                path,
                format!(
                    "{stored_width} x {stored_height} pixels, and the image of {} has {width} x {height}; give maps of \
                     the same aspect",
                    frame.name
                ),
            ));
        }
        if array.values.iter().any(|value| value.is_infinite()) {
            return Err(Error::invalid(path, "infinite values; write NaN where a pixel has no feature"));
        }
        let feature = |of: &[f64]| {
            let of = [of[0] as f32, of[1] as f32, of[2] as f32];
            if of.iter().all(|value| value.is_finite()) { of } else { [0.0; CHANNELS] }
        };
        let pixels = array.values.chunks_exact(CHANNELS).map(feature).collect();
        let stored = PixelGrid::from_pixels(stored_width, stored_height, pixels);
        let stored = frame.turn.seen(stored, (width, height));
        let map = mask::nearest_resize(&stored, width, height);
        Ok(if frame.lens.is_identity() { map } else { undistort_mask(&map, &frame.camera, &frame.lens) })
    }
}
