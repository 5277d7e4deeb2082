//! Colour images: probing, decoding, box reduction.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use cif_geometry::PixelGrid;
use image::{DynamicImage, ImageDecoder, ImageReader};

use super::MAX_DEFLATE_RATIO;
use crate::Error;
use crate::orientation::{Orientation, Turn, turned_size};

/// Size of an image as it is stored, how it is to be turned, and whether it has alpha, from its header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ImageHeader {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) has_alpha: bool,
    /// Of its EXIF facts.
    pub(crate) orientation: Orientation,
}

impl ImageHeader {
    /// Width and height of the image of a frame that turns it.
    pub(crate) fn size_in(&self, turn: Turn) -> (u32, u32) {
        turned_size(turn.image, (self.width, self.height))
    }
}

fn problem(path: &Path) -> impl Fn(image::ImageError) -> Error + '_ {
    move |error| Error::Image { path: path.to_owned(), problem: error.to_string() }
}

fn open(path: &Path) -> Result<ImageReader<BufReader<File>>, Error> {
    let file = cif_input::open(path).map_err(Error::read(path))?;
    ImageReader::new(BufReader::new(file)).with_guessed_format().map_err(Error::read(path))
}

/// Reads the header of an image, and for PNG checks that the file is whole.
///
/// # Errors
/// When the file is missing, no image, empty, or a truncated PNG.
pub(crate) fn probe(path: &Path) -> Result<ImageHeader, Error> {
    let reader = open(path)?;
    let png = reader.format() == Some(image::ImageFormat::Png);
    let mut decoder = reader.into_decoder().map_err(problem(path))?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(Error::Image { path: path.to_owned(), problem: "it has no pixels".to_owned() });
    }
    let has_alpha = decoder.color_type().has_alpha();
    let size = cif_input::check(path).map_err(Error::read(path))?;
    // Palettes of one bit are decoded to three bytes.
    if png && decoder.total_bytes() / 24 > size.saturating_mul(MAX_DEFLATE_RATIO) {
        let problem =
            format!("its header claims {width} x {height} pixels, more than its {size} bytes can hold");
        return Err(Error::Image { path: path.to_owned(), problem });
    }
    if png && !ends_with_iend(path)? {
        // Bytes after the end are legal, so that only decoding shows damage.
        open(path)?.decode().map_err(problem(path))?;
    }
    // EXIF that cannot be read says nothing.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(ImageHeader { width, height, has_alpha, orientation })
}

/// True when a PNG file ends with its IEND chunk.
fn ends_with_iend(path: &Path) -> Result<bool, Error> {
    let mut file = cif_input::open(path).map_err(Error::read(path))?;
    let size = file.metadata().map_err(Error::read(path))?.len();
    file.seek(SeekFrom::Start(size.saturating_sub(8))).map_err(Error::read(path))?;
    let mut tail = Vec::new();
    file.read_to_end(&mut tail).map_err(Error::read(path))?;
    Ok(tail.starts_with(b"IEND"))
}

/// Decodes the image of a frame.
///
/// # Errors
/// When the file is missing, truncated or no image.
pub(crate) fn decode(path: &Path, turn: Turn) -> Result<DynamicImage, Error> {
    let mut image = open(path)?.decode().map_err(problem(path))?;
    image.apply_orientation(turn.image);
    Ok(image)
}

/// Linear RGB triples in 0..255 of display-referred values, alpha composited on `background` (0 to 1).
///
/// As in the base code, compositing happens on display-referred values.
pub(crate) fn composite(image: &DynamicImage, background: [f32; 3]) -> PixelGrid<[f32; 3]> {
    let (width, height) = (image.width(), image.height());
    let pixels = if image.color().has_alpha() {
        image
            .to_rgba8()
            .pixels()
            .map(|pixel| {
                let alpha = f32::from(pixel[3]) / 255.0;
                std::array::from_fn(|c| f32::from(pixel[c]) * alpha + background[c] * 255.0 * (1.0 - alpha))
            })
            .collect()
    } else {
        image.to_rgb8().pixels().map(|pixel| pixel.0.map(f32::from)).collect()
    };
    PixelGrid::from_pixels(width, height, pixels)
}

/// Rounds to bytes.
pub(crate) fn to_bytes(image: &PixelGrid<[f32; 3]>) -> PixelGrid<[u8; 3]> {
    image.map(|pixel| pixel.map(|value| value.round().clamp(0.0, 255.0) as u8))
}

/// Area average onto a smaller grid (a box filter whose edges may cut pixels); enlarging repeats pixels.
pub(crate) fn box_resize(image: &PixelGrid<[f32; 3]>, width: u32, height: u32) -> PixelGrid<[f32; 3]> {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let columns = box_weights(image.width, width);
    let rows = box_weights(image.height, height);
    let source_width = image.width as usize;
    let mut narrow = vec![[0.0_f32; 3]; width as usize * image.height as usize];
    for y in 0..image.height as usize {
        let row = &image.pixels[y * source_width..(y + 1) * source_width];
        for (x, (first, weights)) in columns.iter().enumerate() {
            let out = &mut narrow[y * width as usize + x];
            for (pixel, weight) in row[*first..].iter().zip(weights) {
                for c in 0..3 {
                    out[c] += pixel[c] * weight;
                }
            }
        }
    }
    let mut pixels = vec![[0.0_f32; 3]; width as usize * height as usize];
    for (y, (first, weights)) in rows.iter().enumerate() {
        for (k, weight) in weights.iter().enumerate() {
            let row = &narrow[(first + k) * width as usize..(first + k + 1) * width as usize];
            for (out, pixel) in pixels[y * width as usize..(y + 1) * width as usize].iter_mut().zip(row) {
                for c in 0..3 {
                    out[c] += pixel[c] * weight;
                }
            }
        }
    }
    PixelGrid::from_pixels(width, height, pixels)
}

/// First source index and weights, summing to 1, of every target index.
fn box_weights(source: u32, target: u32) -> Vec<(usize, Vec<f32>)> {
    let step = f64::from(source) / f64::from(target);
    (0..target)
        .map(|k| {
            let (low, high) = (f64::from(k) * step, f64::from(k + 1) * step);
            let first = (low.floor() as u32).min(source - 1);
            let last = ((high.ceil() as u32).max(first + 1)).min(source);
            let weights: Vec<f64> = (first..last)
                .map(|i| (high.min(f64::from(i + 1)) - low.max(f64::from(i))).max(0.0))
                .collect();
            let sum: f64 = weights.iter().sum();
            (first as usize, weights.iter().map(|weight| (weight / sum) as f32).collect())
        })
        .collect()
}

/// Writes RGB bytes as PNG.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn write_rgb(path: &Path, bytes: &[u8], width: u32, height: u32) -> Result<(), Error> {
    image::save_buffer_with_format(
        path,
        bytes,
        width,
        height,
        image::ColorType::Rgb8,
        image::ImageFormat::Png,
    )
    .map_err(|error| Error::Write {
        path: path.to_owned(),
        source: match error {
            image::ImageError::IoError(error) => error,
            other => std::io::Error::other(other),
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn box_reduction_averages_areas() {
        let image = PixelGrid::from_pixels(4, 2, (0..8).map(|k| [k as f32; 3]).collect());
        let half = box_resize(&image, 2, 1);
        assert_eq!(half.pixels, vec![[2.5; 3], [4.5; 3]]);
        // Three columns into two: one and a half each.
        let row = PixelGrid::from_pixels(3, 1, vec![[0.0; 3], [6.0; 3], [12.0; 3]]);
        assert_eq!(box_resize(&row, 2, 1).pixels, vec![[2.0; 3], [10.0; 3]]);
    }

    #[test]
    fn enlarging_keeps_the_range() {
        let row = PixelGrid::from_pixels(2, 1, vec![[1.0; 3], [3.0; 3]]);
        assert_eq!(box_resize(&row, 4, 2).pixels[..4], [[1.0; 3], [1.0; 3], [3.0; 3], [3.0; 3]]);
    }

    #[test]
    fn alpha_is_composited_on_the_background() {
        let image = DynamicImage::ImageRgba8(
            image::RgbaImage::from_raw(2, 1, vec![200, 100, 0, 255, 200, 100, 0, 0]).unwrap(),
        );
        let composited = to_bytes(&composite(&image, [1.0, 0.5, 0.0]));
        assert_eq!(composited.pixels, vec![[200, 100, 0], [255, 128, 0]]);
    }
}
