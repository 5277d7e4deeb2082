//! Instance masks: PNG files whose pixel values are instance ids.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use cif_geometry::PixelGrid;
use image::DynamicImage;
use png::{BitDepth, ColorType, Decoder, Limits, Transformations};

use super::MAX_DEFLATE_RATIO;
use crate::Error;

/// Larger masks than this are refused before anything is allocated.
const MAX_PIXELS: u64 = 1 << 28;

/// Half of white in 16 bits.
const HALF: u16 = 1 << 15;

/// The value 1 of 8 bits in 16.
const ONE: u16 = 257;

/// Size of a mask and the largest id that it can hold, from its header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MaskHeader {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Largest id that the file can hold.
    pub(crate) largest_id: u16,
}

/// Opens a PNG file whose pixels are to arrive as they are stored.
///
/// # Errors
/// When the file is missing, no PNG, or its header claims more than it can hold.
pub(super) fn open_png(path: &Path) -> Result<png::Reader<BufReader<File>>, Error> {
    let file = cif_input::open(path).map_err(Error::read(path))?;
    let size = file.metadata().map_err(Error::read(path))?.len();
    let mut decoder = Decoder::new_with_limits(BufReader::new(file), Limits { bytes: 1 << 31 });
    // Palette indices and 16-bit values must arrive as they are stored.
    decoder.set_transformations(Transformations::IDENTITY);
    let reader = decoder
        .read_info()
        .map_err(|error| Error::mask(path, format!("not a readable PNG file ({error}); export it again")))?;
    let info = reader.info();
    if u64::from(info.width) * u64::from(info.height) > MAX_PIXELS {
        return Err(Error::mask(path, format!("{} x {} pixels are too many", info.width, info.height)));
    }
    let row = (u64::from(info.width) * info.bits_per_pixel() as u64).div_ceil(8);
    if row * u64::from(info.height) > size.saturating_mul(MAX_DEFLATE_RATIO) {
        let problem = format!(
            "its header claims {} x {} pixels, more than its {size} bytes can hold; export it again",
            info.width, info.height
        );
        return Err(Error::mask(path, problem));
    }
    Ok(reader)
}

fn open(path: &Path) -> Result<png::Reader<BufReader<File>>, Error> {
    let reader = open_png(path)?;
    match reader.info().color_type {
        ColorType::Grayscale | ColorType::Indexed => {}
        ColorType::Rgb | ColorType::Rgba | ColorType::GrayscaleAlpha => {
            return Err(Error::mask(
                path,
                format!(
                    "it is a {} image; a mask is an 8- or 16-bit grey or palette PNG whose pixel values are \
                     instance ids, 0 for unlabelled; colours of a tracker become ids with `cif masks import`",
                    match reader.info().color_type {
                        ColorType::GrayscaleAlpha => "grey and alpha",
                        ColorType::Rgba => "RGBA",
                        _ => "RGB",
                    }
                ),
            ));
        }
    }
    Ok(reader)
}

/// Reads the header of a mask.
///
/// # Errors
/// When the file is missing, no PNG, or a colour image.
pub(crate) fn probe(path: &Path) -> Result<MaskHeader, Error> {
    let reader = open(path)?;
    let info = reader.info();
    Ok(MaskHeader {
        width: info.width,
        height: info.height,
        largest_id: if info.bit_depth == BitDepth::Sixteen {
            u16::MAX
        } else {
            (1_u16 << (info.bit_depth as u8)) - 1
        },
    })
}

/// Decodes a mask: the stored value of every pixel.
///
/// # Errors
/// When the file is missing, truncated, no PNG, or a colour image.
pub(crate) fn decode(path: &Path) -> Result<PixelGrid<u16>, Error> {
    let mut reader = open(path)?;
    let damaged =
        |problem: String| Error::mask(path, format!("it cannot be decoded ({problem}); export it again"));
    let size = reader.output_buffer_size().ok_or_else(|| damaged("too large".to_owned()))?;
    let mut buffer = vec![0; size];
    let frame = reader.next_frame(&mut buffer).map_err(|error| damaged(error.to_string()))?;
    let (width, height) = (frame.width as usize, frame.height as usize);
    let mut pixels = Vec::with_capacity(width * height);
    for row in buffer.chunks_exact(frame.line_size).take(height) {
        match frame.bit_depth {
            BitDepth::Sixteen => {
                pixels.extend(row.chunks_exact(2).take(width).map(|b| u16::from_be_bytes([b[0], b[1]])));
            }
            BitDepth::Eight => pixels.extend(row.iter().take(width).map(|value| u16::from(*value))),
            depth => {
                let bits = depth as usize;
                let mask = (1_u8 << bits) - 1;
                pixels.extend((0..width).map(|x| {
                    let shift = 8 - bits - (x * bits) % 8;
                    u16::from((row[x * bits / 8] >> shift) & mask)
                }));
            }
        }
    }
    Ok(PixelGrid::from_pixels(frame.width, frame.height, pixels))
}

/// Decodes what a detector found, in a PNG file of any kind: 1 where the colour is not black, else 0. Alpha does
/// not count.
///
/// # Errors
/// When the file is missing, truncated or no PNG.
pub(crate) fn decode_binary(path: &Path) -> Result<PixelGrid<u16>, Error> {
    let damaged = |error: image::ImageError| {
        Error::mask(path, format!("it cannot be decoded ({error}); export it again"))
    };
    let file = cif_input::open(path).map_err(Error::read(path))?;
    let mut reader = image::ImageReader::with_format(BufReader::new(file), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(1 << 16), Some(1 << 16));
    reader.limits(limits);
    // 16 bits, so that small values of deep files are not rounded to black.
    let picture = reader.decode().map_err(damaged)?.into_rgb16();
    let pixels = picture.pixels().map(|pixel| u16::from(pixel.0 != [0; 3])).collect();
    Ok(PixelGrid::from_pixels(picture.width(), picture.height(), pixels))
}

/// Width and height of a PNG file of any kind.
///
/// # Errors
/// When the file is missing or no PNG.
pub(crate) fn size(path: &Path) -> Result<(u32, u32), Error> {
    let reader = open_png(path)?;
    Ok((reader.info().width, reader.info().height))
}

/// Kind of the pixels of a PNG file.
///
/// # Errors
/// When the file is missing or no PNG.
pub(crate) fn color_type(path: &Path) -> Result<ColorType, Error> {
    Ok(open_png(path)?.info().color_type)
}

/// Decodes a PNG file of any kind, 8 bits per channel.
fn decode_picture(path: &Path) -> Result<DynamicImage, Error> {
    drop(open_png(path)?);
    let damaged = |error: image::ImageError| {
        Error::mask(path, format!("it cannot be decoded ({error}); export it again"))
    };
    let file = cif_input::open(path).map_err(Error::read(path))?;
    image::ImageReader::with_format(BufReader::new(file), image::ImageFormat::Png).decode().map_err(damaged)
}

/// Decodes a picture whose colours stand for objects: 8 bits of red, green and blue; transparent pixels are black.
///
/// # Errors
/// When the file is missing, truncated, no PNG, has more than 8 bits per channel or partly transparent pixels.
pub(crate) fn decode_colors(path: &Path) -> Result<PixelGrid<[u8; 3]>, Error> {
    if open_png(path)?.info().bit_depth == BitDepth::Sixteen {
        return Err(Error::mask(path, "16 bits per colour channel; export colours with 8 bits"));
    }
    let picture = decode_picture(path)?.into_rgba8();
    let pixels = picture
        .pixels()
        .map(|pixel| match pixel.0 {
            [r, g, b, 255] => Ok([r, g, b]),
            [_, _, _, 0] => Ok([0; 3]),
            _ => Err(Error::mask(
                path,
                "partly transparent pixels: edges are blended; export it without antialiasing",
            )),
        })
        .collect::<Result<_, _>>()?;
    Ok(PixelGrid::from_pixels(picture.width(), picture.height(), pixels))
}

/// Decodes a mask of one object: true from a half of white on, or of opacity where that varies. In a palette every index
/// but 0 is the object; so is every value but 0 where 8 bits go no higher than 1.
///
/// # Errors
/// When the file is missing, truncated or no PNG.
pub(crate) fn decode_matte(path: &Path) -> Result<PixelGrid<bool>, Error> {
    if color_type(path)? == ColorType::Indexed {
        return Ok(decode(path)?.map(|index| *index != 0));
    }
    let picture = decode_picture(path)?.into_rgba16();
    let (width, height) = picture.dimensions();
    let opaque: Vec<bool> = picture.pixels().map(|pixel| pixel.0[3] >= HALF).collect();
    if opaque.contains(&true) && opaque.contains(&false) {
        return Ok(PixelGrid::from_pixels(width, height, opaque));
    }
    let brightest = |pixel: &image::Rgba<u16>| pixel.0[..3].iter().copied().max().unwrap_or(0);
    let values: Vec<u16> = picture.pixels().map(brightest).collect();
    let most = values.iter().copied().max().unwrap_or(0);
    let least = if most <= ONE { 1 } else { HALF };
    Ok(PixelGrid::from_pixels(width, height, values.into_iter().map(|value| value >= least).collect()))
}

/// Nearest-neighbour resize: never invents an id (methods reference 7, row 39).
pub(crate) fn nearest_resize<T: Copy>(mask: &PixelGrid<T>, width: u32, height: u32) -> PixelGrid<T> {
    if (mask.width, mask.height) == (width, height) {
        return mask.clone();
    }
    let index = |k: u32, target: u32, source: u32| {
        ((2 * u64::from(k) + 1) * u64::from(source) / (2 * u64::from(target))) as usize
    };
    let columns: Vec<usize> = (0..width).map(|x| index(x, width, mask.width)).collect();
    let pixels = (0..height)
        .flat_map(|y| {
            let start = index(y, height, mask.height) * mask.width as usize;
            columns.iter().map(move |x| mask.pixels[start + x])
        })
        .collect();
    PixelGrid::from_pixels(width, height, pixels)
}

/// Writes ids as a grey PNG, 8 bits where they fit, else 16.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn write(path: &Path, mask: &PixelGrid<u16>) -> Result<(), Error> {
    let wide = mask.pixels.iter().any(|id| *id > 255);
    let file = File::create(path).map_err(Error::write(path))?;
    let mut encoder = png::Encoder::new(std::io::BufWriter::new(file), mask.width, mask.height);
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(if wide { BitDepth::Sixteen } else { BitDepth::Eight });
    let bytes: Vec<u8> = if wide {
        mask.pixels.iter().flat_map(|id| id.to_be_bytes()).collect()
    } else {
        mask.pixels.iter().map(|id| *id as u8).collect()
    };
    let encode = || -> Result<(), png::EncodingError> {
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&bytes)?;
        writer.finish()
    };
    encode().map_err(|error| Error::Write { path: path.to_owned(), source: error.into() })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn ids_after_a_resize_are_a_subset() {
        let mask = PixelGrid::from_pixels(7, 5, (0..35).map(|k| (k * 37 % 11) as u16 * 100).collect());
        let before: BTreeSet<u16> = mask.pixels.iter().copied().collect();
        for (width, height) in [(3, 2), (14, 10), (17, 33), (1, 1)] {
            let resized = nearest_resize(&mask, width, height);
            assert_eq!((resized.width, resized.height), (width, height));
            assert!(resized.pixels.iter().all(|id| before.contains(id)));
        }
    }

    #[test]
    fn halving_takes_a_pixel_of_each_block() {
        let mask = PixelGrid::from_pixels(4, 1, vec![1, 1, 2, 2]);
        assert_eq!(nearest_resize(&mask, 2, 1).pixels, vec![1, 2]);
    }

    #[test]
    fn written_ids_come_back() {
        let folder = tempfile::tempdir().unwrap();
        for ids in [vec![0, 7, 255], vec![0, 256, 65_535]] {
            let path = folder.path().join("mask.png");
            let mask = PixelGrid::from_pixels(3, 1, ids);
            write(&path, &mask).unwrap();
            assert_eq!(decode(&path).unwrap(), mask);
        }
    }

    #[test]
    fn packed_palette_indices_are_read_as_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mask.png");
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 5, 2);
        encoder.set_color(ColorType::Indexed);
        encoder.set_depth(BitDepth::Four);
        encoder.set_palette(vec![0; 48]);
        encoder.write_header().unwrap().write_image_data(&[0x01, 0x23, 0x40, 0xFE, 0xDC, 0xB0]).unwrap();
        let mask = decode(&path).unwrap();
        assert_eq!(mask.pixels, vec![0, 1, 2, 3, 4, 15, 14, 13, 12, 11]);
        assert_eq!(probe(&path).unwrap().largest_id, 15);
    }
}
