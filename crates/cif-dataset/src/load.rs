//! Frames and masks as the trainer sees them: decoded, reduced, without lens.

use std::path::Path;

use cif_geometry::PixelGrid;

use crate::files::{confidence, image, mask};
use crate::lens_removal::{undistort_image, undistort_mask};
use crate::sizes::same_aspect;
use crate::{Dataset, Error, Frame, FrameData, mask_files};

impl Dataset {
    /// Loads image and mask of a frame.
    ///
    /// The image is decoded and turned upright, its alpha composited on `background` (display-referred, 0 to 1), reduced to the
    /// size of the frame's camera by area averages, and freed of lens distortion and skew by bilinear
    /// resampling. The mask is treated alike by nearest neighbour only, with its original ids.
    ///
    /// # Errors
    /// When a file is missing, truncated, or a mask has another aspect than its image.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_frame(&self, index: usize, background: [f32; 3]) -> Result<FrameData, Error> {
        Ok(FrameData {
            image: self.load_image(index, background)?,
            mask: self.load_mask(index)?,
            confidence: self.load_confidence(index)?,
        })
    }

    /// Loads the image of a frame; see [`Dataset::load_frame`].
    ///
    /// # Errors
    /// When the file is missing or truncated.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_image(&self, index: usize, background: [f32; 3]) -> Result<PixelGrid<[u8; 3]>, Error> {
        let frame = &self.frames[index];
        let reduced = self.reduced_image(index, background)?;
        if frame.lens.is_identity() {
            return Ok(image::to_bytes(&reduced));
        }
        Ok(image::to_bytes(&undistort_image(&reduced, &frame.camera, &frame.lens)))
    }

    /// Loads the image of a frame as [`Dataset::load_image`] does, but with its lens distortion: as masks lie in their
    /// files.
    ///
    /// # Errors
    /// When the file is missing or truncated.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_distorted_image(
        &self,
        index: usize,
        background: [f32; 3],
    ) -> Result<PixelGrid<[u8; 3]>, Error> {
        Ok(image::to_bytes(&self.reduced_image(index, background)?))
    }

    fn reduced_image(&self, index: usize, background: [f32; 3]) -> Result<PixelGrid<[f32; 3]>, Error> {
        let frame = &self.frames[index];
        let stored = image::composite(&image::decode(&frame.image, frame.turn)?, background);
        Ok(image::box_resize(&stored, frame.camera.width, frame.camera.height))
    }

    /// Loads the mask of a frame, where it has one, at the size of its image and with its lens distortion.
    ///
    /// # Errors
    /// As [`Dataset::load_mask`].
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_distorted_mask(&self, index: usize) -> Result<Option<PixelGrid<u16>>, Error> {
        self.frames[index].mask.as_deref().map(|path| self.resized_mask(index, path)).transpose()
    }

    /// Loads the confidence of the mask of a frame, where it has one, resampled as the mask.
    ///
    /// # Errors
    /// When the file is missing, truncated, no 8-bit grey PNG, or has another aspect than its image.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_confidence(&self, index: usize) -> Result<Option<PixelGrid<u8>>, Error> {
        let frame = &self.frames[index];
        let Some(path) = &frame.confidence else { return Ok(None) };
        let (width, height) = (frame.camera.width, frame.camera.height);
        let stored = confidence::decode(path, (width, height), frame.turn)?;
        let values = without_lens(mask::nearest_resize(&stored, width, height), frame);
        Ok(Some(values.map(|value| *value as u8)))
    }

    /// Loads the mask of a frame, where it has one; see [`Dataset::load_frame`].
    ///
    /// # Errors
    /// When the file is missing, truncated, no mask, or has another aspect than its image.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_mask(&self, index: usize) -> Result<Option<PixelGrid<u16>>, Error> {
        self.frames[index].mask.as_deref().map(|path| self.load_mask_file(index, path)).transpose()
    }

    /// Loads a mask file as the mask of a frame, for masks of another folder (see [`Dataset::mask_paths`]). Objects
    /// of a Cryptomatte are those of [`Dataset::mask_objects`].
    ///
    /// # Errors
    /// When the file is missing, truncated, no mask, or has another aspect than the frame.
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_mask_file(&self, index: usize, path: &Path) -> Result<PixelGrid<u16>, Error> {
        Ok(without_lens(self.resized_mask(index, path)?, &self.frames[index]))
    }

    /// Loads a mask file as the mask of a frame, at the size of its image and with its lens distortion.
    ///
    /// # Errors
    /// As [`Dataset::load_mask_file`].
    ///
    /// # Panics
    /// When there is no frame `index`.
    pub fn load_distorted_mask_file(&self, index: usize, path: &Path) -> Result<PixelGrid<u16>, Error> {
        self.resized_mask(index, path)
    }

    fn resized_mask(&self, index: usize, path: &Path) -> Result<PixelGrid<u16>, Error> {
        let frame = &self.frames[index];
        let (width, height) = (frame.camera.width, frame.camera.height);
        let stored = frame.turn.seen(mask_files::decode(path, &self.mask_objects)?, (width, height));
        if !same_aspect((stored.width, stored.height), (width, height)) {
            return Err(Error::MaskSize {
                mask: path.to_owned(),
                mask_size: (stored.width, stored.height),
                image: frame.image.clone(),
                image_size: (width, height),
            });
        }
        Ok(mask::nearest_resize(&stored, width, height))
    }
}

/// Values of the pixels of a frame without its lens distortion.
fn without_lens(values: PixelGrid<u16>, frame: &Frame) -> PixelGrid<u16> {
    if frame.lens.is_identity() { values } else { undistort_mask(&values, &frame.camera, &frame.lens) }
}
