//! Image files, and images from afar: how bright and sharp one is, and what changed since another one.

use std::io::{self, BufReader, BufWriter};
use std::path::Path;

use cif_dataset::orientation::Orientation;
use cif_geometry::stats::upper_median;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{DynamicImage, ImageDecoder, ImageEncoder, ImageFormat};

use crate::Error;

/// Size of the reduced grey images that are judged, pixels.
pub(crate) const WIDTH: usize = 320;
/// Rows of such an image.
pub(crate) const HEIGHT: usize = 240;
/// Side of the blocks that are compared, pixels of the reduced image.
const BLOCK: usize = 20;

/// Quality of reduced JPEG files, of 100: above it files grow faster than what is lost shrinks.
const JPEG_QUALITY: u8 = 95;

/// An image file, decoded and turned upright.
pub(crate) struct Photograph {
    pub(crate) image: DynamicImage,
    /// How it was turned.
    pub(crate) turned: Orientation,
    format: ImageFormat,
    exif: Option<Vec<u8>>,
    color_profile: Option<Vec<u8>>,
}

impl Photograph {
    /// Decodes a file, and turns the image as its EXIF says.
    ///
    /// # Errors
    /// When it is no image.
    pub(crate) fn read(path: &Path) -> Result<Self, Error> {
        let refused = |error: image::ImageError| {
            Error::refused(
                format!("{}: this is no image that can be read: {error}", path.display()),
                "give PNG or JPEG files, or leave it out",
            )
        };
        let file = cif_input::open(path).map_err(Error::io("read", path))?;
        let reader = image::ImageReader::new(BufReader::new(file))
            .with_guessed_format()
            .map_err(Error::io("read", path))?;
        let format = reader.format().unwrap_or(ImageFormat::Png);
        let mut decoder = reader.into_decoder().map_err(refused)?;
        let mut limits = image::Limits::default();
        limits.reserve(decoder.total_bytes()).map_err(refused)?;
        decoder.set_limits(limits).map_err(refused)?;
        let mut exif = decoder.exif_metadata().ok().flatten();
        let turned = exif.as_mut().and_then(|exif| Orientation::remove_from_exif_chunk(exif));
        let turned = turned.unwrap_or(Orientation::NoTransforms);
        let color_profile = decoder.icc_profile().ok().flatten();
        let mut image = DynamicImage::from_decoder(decoder).map_err(refused)?;
        image.apply_orientation(turned);
        Ok(Self { image, turned, format, exif, color_profile })
    }

    /// Width and height of the image of a file as it is stored; it is not decoded.
    ///
    /// # Errors
    /// When it is no image.
    pub(crate) fn size(path: &Path) -> Result<(u32, u32), Error> {
        let file = cif_input::open(path).map_err(Error::io("read", path))?;
        let reader = image::ImageReader::new(BufReader::new(file)).with_guessed_format();
        let reader = reader.map_err(Error::io("read", path))?;
        reader.into_dimensions().map_err(|error| Error::io("read", path)(io::Error::other(error)))
    }

    /// Reduces the image by area averages so that its larger side has `side` pixels.
    pub(crate) fn reduce(&mut self, side: u32) {
        let (width, height) = (self.image.width(), self.image.height());
        let share = f64::from(side) / f64::from(width.max(height));
        let of = |length: u32| ((f64::from(length) * share).round() as u32).max(1);
        self.image = self.image.thumbnail_exact(of(width), of(height));
    }

    /// Writes the image in the format that it was read in, with the facts about camera and colours that it came with.
    ///
    /// # Errors
    /// When the file system refuses.
    pub(crate) fn write(&self, path: &Path) -> Result<(), Error> {
        let failed = |error: image::ImageError| Error::io("write", path)(io::Error::other(error));
        let file = BufWriter::new(std::fs::File::create(path).map_err(Error::io("write", path))?);
        if self.format == ImageFormat::Jpeg {
            let encoder = self.with_facts(JpegEncoder::new_with_quality(file, JPEG_QUALITY));
            self.image.write_with_encoder(encoder).map_err(failed)
        } else {
            self.image.write_with_encoder(self.with_facts(PngEncoder::new(file))).map_err(failed)
        }
    }

    fn with_facts<E: ImageEncoder>(&self, mut encoder: E) -> E {
        // An encoder that cannot keep them leaves them out.
        let _ = self.exif.clone().map(|exif| encoder.set_exif_metadata(exif));
        let _ = self.color_profile.clone().map(|profile| encoder.set_icc_profile(profile));
        encoder
    }
}

/// A reduced image.
#[derive(Clone, Debug, PartialEq)]
pub struct Impression {
    /// Mean brightness, 0 to 255.
    pub brightness: f64,
    /// Variance of the Laplacian of the reduced image over its brightness's variance, free of contrast; 0 for
    /// one colour.
    pub sharpness: f64,
    /// Mean brightness of blocks, row by row.
    blocks: Vec<f64>,
}

impl Impression {
    /// Judges a grey image of [`WIDTH`] x [`HEIGHT`] pixels.
    pub(crate) fn of(grey: &[u8]) -> Self {
        let at = |x: usize, y: usize| f64::from(grey[y * WIDTH + x]);
        let count = grey.len() as f64;
        let brightness = grey.iter().map(|value| f64::from(*value)).sum::<f64>() / count;
        let contrast = grey.iter().map(|value| (f64::from(*value) - brightness).powi(2)).sum::<f64>() / count;
        let mut laplacian = 0.0;
        for y in 1..HEIGHT - 1 {
            for x in 1..WIDTH - 1 {
                let edge = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1) - 4.0 * at(x, y);
                laplacian += edge * edge;
            }
        }
        let inner = ((WIDTH - 2) * (HEIGHT - 2)) as f64;
        let sharpness = if contrast > 1e-9 { laplacian / inner / contrast } else { 0.0 };
        let mut blocks = vec![0.0; (WIDTH / BLOCK) * (HEIGHT / BLOCK)];
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                blocks[y / BLOCK * (WIDTH / BLOCK) + x / BLOCK] += at(x, y) / (BLOCK * BLOCK) as f64;
            }
        }
        Self { brightness, sharpness, blocks }
    }

    /// Of an image that nobody looks at.
    pub(crate) fn unknown() -> Self {
        Self { brightness: 0.0, sharpness: 0.0, blocks: Vec::new() }
    }

    /// Judges an image, with its alpha left out.
    pub(crate) fn of_image(image: &DynamicImage) -> Self {
        let filter = image::imageops::FilterType::Triangle;
        let small = image::imageops::resize(&image.to_luma8(), WIDTH as u32, HEIGHT as u32, filter);
        Self::of(small.as_raw())
    }

    /// True where nothing can be seen: all of it near black, or of one colour.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        let low = self.blocks.iter().copied().fold(f64::INFINITY, f64::min);
        let high = self.blocks.iter().copied().fold(0.0, f64::max);
        high < 12.0 || high - low < 2.0
    }

    /// Median over blocks of the change of brightness, 0 to 255: objects that move before a camera that stands
    /// still change few blocks, a camera that moves changes most.
    #[must_use]
    pub fn change(&self, other: &Self) -> f64 {
        let mut changes: Vec<f64> =
            self.blocks.iter().zip(&other.blocks).map(|(a, b)| (a - b).abs()).collect();
        upper_median(&mut changes).unwrap_or(0.0)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A chessboard of `side` pixels, moved by `shift`.
    pub(crate) fn board(side: usize, shift: usize) -> Vec<u8> {
        let square = |x: usize, y: usize| ((x + shift) / side + y / side).is_multiple_of(2);
        (0..WIDTH * HEIGHT).map(|k| if square(k % WIDTH, k / WIDTH) { 220 } else { 30 }).collect()
    }

    #[test]
    fn blur_lowers_sharpness_and_contrast_does_not() {
        let sharp = board(16, 0);
        let blurred: Vec<u8> = (0..sharp.len())
            .map(|k| {
                let around = (0..7).map(|d| u32::from(sharp[(k + d).min(sharp.len() - 1)])).sum::<u32>();
                (around / 7) as u8
            })
            .collect();
        let faint: Vec<u8> = sharp.iter().map(|value| value / 2).collect();
        let of = |grey: &[u8]| Impression::of(grey).sharpness;
        assert!(of(&blurred) < 0.7 * of(&sharp), "{} {}", of(&blurred), of(&sharp));
        assert!((of(&faint) / of(&sharp) - 1.0).abs() < 0.05);
    }

    #[test]
    fn what_shows_nothing_is_detected() {
        let of = |value: u8| Impression::of(&vec![value; WIDTH * HEIGHT]);
        assert!(of(0).is_empty() && of(5).is_empty() && of(200).is_empty());
        assert!(!Impression::of(&board(50, 0)).is_empty());
    }

    #[test]
    fn moving_objects_are_distinguished_from_a_moving_camera() {
        let still = Impression::of(&board(50, 0));
        let mut with_object = board(50, 0);
        for y in 60..160 {
            for x in 100..220 {
                with_object[y * WIDTH + x] = 128;
            }
        }
        assert!(still.change(&Impression::of(&with_object)) < 1.0);
        assert!(still.change(&Impression::of(&board(50, 25))) > 8.0);
    }
}
