//! Frames next to their masks, many on one picture.

use std::collections::BTreeMap;
use std::path::Path;

use cif_geometry::PixelGrid;

use super::{Picture, instance_color, side_by_side};
use crate::error::Error;

/// Columns of pixels of a frame on the sheet at most.
const WIDTH: u32 = 320;

/// Frames next to each other.
const COLUMNS: usize = 3;

/// Rows of white between two rows of frames.
const GAP: usize = 2;

/// A picture that frames and masks are added to.
#[derive(Debug, Default)]
pub struct ContactSheet {
    tiles: BTreeMap<usize, Picture>,
}

impl ContactSheet {
    /// Without frames.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a frame next to its mask; frames lie in the order of their indices.
    ///
    /// # Panics
    /// When image and mask differ in size.
    pub fn add(&mut self, index: usize, image: &Picture, ids: &PixelGrid<u16>) {
        assert_eq!((image.width, image.height), (ids.width, ids.height), "a mask of another size");
        let factor = image.width.div_ceil(WIDTH).max(1);
        let (width, height) = ((image.width / factor).max(1), (image.height / factor).max(1));
        let colors = ids.map(|id| instance_color(*id));
        let small = |picture: &Picture| {
            let pixels = (0..width * height).map(|k| *picture.at(k % width * factor, k / width * factor));
            Picture::from_pixels(width, height, pixels.collect())
        };
        self.tiles.insert(index, side_by_side(&[small(image), small(&colors)]));
    }

    /// The picture: rows of frames next to their masks.
    #[must_use]
    pub fn finish(self) -> Picture {
        let tiles: Vec<Picture> = self.tiles.into_values().collect();
        let rows: Vec<Picture> = tiles.chunks(COLUMNS).map(side_by_side).collect();
        let width = rows.iter().map(|row| row.width).max().unwrap_or(1);
        let mut pixels = Vec::new();
        for (k, row) in rows.iter().enumerate() {
            if k > 0 {
                pixels.extend(vec![[255; 3]; GAP * width as usize]);
            }
            for line in row.pixels.chunks(row.width as usize) {
                pixels.extend_from_slice(line);
                pixels.extend(vec![[255; 3]; (width - row.width) as usize]);
            }
        }
        if pixels.is_empty() {
            pixels.push([255; 3]);
        }
        let height = pixels.len() as u32 / width;
        Picture::from_pixels(width, height, pixels)
    }
}

/// Writes a JPEG file.
///
/// # Errors
/// When the file cannot be written.
pub fn save_jpeg(path: &Path, picture: &Picture) -> Result<(), Error> {
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 90);
    let encoded = image::ImageEncoder::write_image(
        encoder,
        picture.pixels.as_flattened(),
        picture.width,
        picture.height,
        image::ExtendedColorType::Rgb8,
    );
    encoded.map_err(|error| Error::io("write", path)(std::io::Error::other(error)))?;
    cif_output::write(path, &bytes).map_err(Error::io("write", path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_lie_in_order_beside_their_masks() {
        let mut sheet = ContactSheet::new();
        for index in [30, 10, 20, 40] {
            let image = Picture::filled(4, 3, [index as u8; 3]);
            sheet.add(index, &image, &PixelGrid::filled(4, 3, index as u16));
        }
        let picture = sheet.finish();
        // Three frames of two pictures of 4 columns with gaps of 2; two rows of 3 with a gap of 2.
        assert_eq!((picture.width, picture.height), (3 * 10 + 2 * 2, 3 + 2 + 3));
        assert_eq!(*picture.at(0, 0), [10; 3]);
        assert_eq!(*picture.at(6, 0), instance_color(10));
        assert_eq!(*picture.at(12, 2), [20; 3]);
        assert_eq!(*picture.at(0, 5), [40; 3]);
        assert_eq!(*picture.at(33, 7), [255; 3]);
        assert_eq!(ContactSheet::new().finish().pixels.len(), 1);
    }
}
