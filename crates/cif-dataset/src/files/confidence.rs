//! Confidences of masks: 8-bit grey PNG files, the probability that the id of a pixel is right in units of 1 / 255.

use std::path::Path;

use cif_geometry::PixelGrid;
use png::{BitDepth, ColorType};

use super::mask;
use crate::Error;
use crate::orientation::Turn;
use crate::sizes::same_aspect;

/// Checks the header of a confidence against the size of its image.
///
/// # Errors
/// When the file is missing, no 8-bit grey PNG, or has another aspect than its image.
pub(crate) fn check(path: &Path, image_size: (u32, u32), turn: Turn) -> Result<(), Error> {
    let refused = |problem: String| Err(Error::Confidence { path: path.to_owned(), problem });
    let reader = mask::open_png(path).map_err(of_confidence)?;
    let info = reader.info();
    if (info.color_type, info.bit_depth) != (ColorType::Grayscale, BitDepth::Eight) {
        return refused("it is not 8-bit grey".to_owned());
    }
    let (width, height) = (info.width, info.height);
    if width == 0 || height == 0 || !same_aspect(turn.seen_size((width, height), image_size), image_size) {
        let (image_width, image_height) = image_size;
        return refused(format!(
            "it has {width} x {height} pixels, its image {image_width} x {image_height}: another aspect"
        ));
    }
    Ok(())
}

/// Decodes a confidence: the value of every pixel of the image, 0 to 255.
///
/// # Errors
/// As [`check`], and when the file is truncated.
pub(crate) fn decode(path: &Path, image_size: (u32, u32), turn: Turn) -> Result<PixelGrid<u16>, Error> {
    check(path, image_size, turn)?;
    Ok(turn.seen(mask::decode(path).map_err(of_confidence)?, image_size))
}

/// The error of a mask file, as one of a confidence.
fn of_confidence(error: Error) -> Error {
    match error {
        Error::Mask { path, problem } => {
            let problem = problem.trim_end_matches("; export it again").to_owned();
            Error::Confidence { path, problem }
        }
        other => other,
    }
}
