//! Pictures as models take them: resized, normalised, padded.

mod resample;

pub use resample::{Filter, resize};

use cif_geometry::PixelGrid;

use crate::Tensor;

/// An 8-bit display-referred picture.
pub type Picture = PixelGrid<[u8; 3]>;

/// Mean and standard deviation of every channel of values in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Normalisation {
    /// Mean, red green blue.
    pub mean: [f32; 3],
    /// Standard deviation, red green blue.
    pub deviation: [f32; 3],
}

/// Statistics of ImageNet, which Grounding DINO and SAM were trained with.
pub const IMAGENET: Normalisation =
    Normalisation { mean: [0.485, 0.456, 0.406], deviation: [0.229, 0.224, 0.225] };

/// Statistics of the pictures that CLIP was trained with.
pub const CLIP: Normalisation = Normalisation {
    mean: [0.481_454_66, 0.457_827_5, 0.408_210_73],
    deviation: [0.268_629_54, 0.261_302_6, 0.275_777_1],
};

/// A picture as a tensor `[1, 3, height, width]` of normalised values, in the top left of a canvas whose rest is 0.
///
/// # Panics
/// When the picture is larger than the canvas.
#[must_use]
pub fn tensor(picture: &Picture, normalisation: Normalisation, (width, height): (u32, u32)) -> Tensor {
    assert!(picture.width <= width && picture.height <= height, "the picture is larger than its canvas");
    let (width, height) = (width as usize, height as usize);
    let mut values = vec![0.0; 3 * width * height];
    for (channel, plane) in values.chunks_mut((width * height).max(1)).enumerate() {
        let (mean, deviation) = (normalisation.mean[channel], normalisation.deviation[channel]);
        for (line, row) in picture.pixels.chunks(picture.width.max(1) as usize).zip(plane.chunks_mut(width)) {
            for (pixel, value) in line.iter().zip(row) {
                *value = (f32::from(pixel[channel]) / 255.0 - mean) / deviation;
            }
        }
    }
    Tensor::floats([1, 3, height, width], values)
}

/// Size of a picture whose short side becomes `short`, or less where the long side would exceed `long`; sizes are
/// (width, height). Source: `get_size_with_aspect_ratio` of DETR, whose rounding this is.
#[must_use]
pub fn short_side((width, height): (u32, u32), short: u32, long: u32) -> (u32, u32) {
    let (least, most) = (f64::from(width.min(height)), f64::from(width.max(height)));
    let side = if most / least * f64::from(short) > f64::from(long) {
        (f64::from(long) * least / most).round_ties_even().max(1.0)
    } else {
        f64::from(short)
    };
    let other = (side * most / least).floor() as u32;
    let side = side as u32;
    if width.min(height) == side {
        (width, height)
    } else if width < height {
        (side, other)
    } else {
        (other, side)
    }
}

/// Size of a picture whose long side becomes `long`. Source: `ResizeLongestSide` of Segment Anything.
#[must_use]
pub fn long_side((width, height): (u32, u32), long: u32) -> (u32, u32) {
    let scale = f64::from(long) / f64::from(width.max(height));
    let side = |length: u32| ((f64::from(length) * scale + 0.5).floor() as u32).max(1);
    (side(width), side(height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_follow_the_reference() {
        // From the Python function, `(w, h)` each.
        for (size, resized) in [
            ((640, 480), (1066, 800)),
            ((480, 640), (800, 1066)),
            ((1920, 1080), (1333, 750)),
            ((3000, 500), (1332, 222)),
            ((800, 800), (800, 800)),
            ((800, 1000), (800, 1000)),
            ((64, 48), (1066, 800)),
        ] {
            assert_eq!(short_side(size, 800, 1333), resized, "{size:?}");
        }
        assert_eq!(long_side((640, 480), 1024), (1024, 768));
        assert_eq!(long_side((333, 1000), 1024), (341, 1024));
        assert_eq!(long_side((1, 5000), 1024), (1, 1024));
    }

    #[test]
    fn tensors_are_planes_with_the_picture_in_the_corner() {
        let picture = Picture::from_pixels(2, 1, vec![[255, 0, 51], [0, 255, 102]]);
        let plain = Normalisation { mean: [0.5, 0.0, 0.2], deviation: [0.5, 1.0, 0.1] };
        let made = tensor(&picture, plain, (3, 2));
        assert_eq!(made.shape(), [1, 3, 2, 3]);
        let values = made.as_floats().unwrap();
        let expected: [&[f32]; 3] = [
            &[1.0, -1.0, 0.0, 0.0, 0.0, 0.0],
            &[0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            &[0.0, 2.0, 0.0, 0.0, 0.0, 0.0],
        ];
        for (value, expected) in values.iter().zip(expected.concat()) {
            assert!((value - expected).abs() < 1e-6, "{values:?}");
        }
    }
}
