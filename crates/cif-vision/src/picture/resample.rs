//! Resizing to the bit as Pillow does it, whose pictures the models were trained on.
//!
//! Source: `Resample.c` of Pillow 13: a pass along rows, then one along columns; weights of a filter that widens when a
//! picture shrinks, in fixed point of 22 bits; every pass ends in 8 bits.

use super::Picture;

/// Bits behind the point of a weight.
const PRECISION: u32 = 32 - 8 - 2;

/// A filter of Pillow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Triangle, reaching one pixel.
    Bilinear,
    /// Cubic with a = -1/2, reaching two pixels.
    Bicubic,
}

impl Filter {
    fn reach(self) -> f64 {
        match self {
            Self::Bilinear => 1.0,
            Self::Bicubic => 2.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        const A: f64 = -0.5;
        let x = x.abs();
        match self {
            Self::Bilinear if x < 1.0 => 1.0 - x,
            Self::Bicubic if x < 1.0 => ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0,
            Self::Bicubic if x < 2.0 => (((x - 5.0) * x + 8.0) * x - 4.0) * A,
            Self::Bilinear | Self::Bicubic => 0.0,
        }
    }
}

/// Weights of the pixels that make up one pixel of the result.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

fn taps(from: u32, to: u32, filter: Filter) -> Vec<Taps> {
    let scale = f64::from(from) / f64::from(to);
    let widening = scale.max(1.0);
    let support = filter.reach() * widening;
    let of_pixel = |at: u32| {
        let centre = (f64::from(at) + 0.5) * scale;
        let first = (centre - support + 0.5).max(0.0) as usize;
        let end = ((centre + support + 0.5) as usize).min(from as usize);
        let weights: Vec<f64> =
            (first..end).map(|x| filter.weight((x as f64 - centre + 0.5) / widening)).collect();
        let total: f64 = weights.iter().sum();
        let fixed = |weight: f64| {
            let share = if total == 0.0 { weight } else { weight / total };
            (share * f64::from(1_u32 << PRECISION) + 0.5_f64.copysign(share)) as i32
        };
        Taps { first, weights: weights.into_iter().map(fixed).collect() }
    };
    (0..to).map(of_pixel).collect()
}

fn blend<'a>(pixels: impl Iterator<Item = (&'a [u8; 3], &'a i32)>) -> [u8; 3] {
    let mut sums = [1_i32 << (PRECISION - 1); 3];
    for (pixel, weight) in pixels {
        for (sum, value) in sums.iter_mut().zip(pixel) {
            *sum += i32::from(*value) * weight;
        }
    }
    sums.map(|sum| (sum >> PRECISION).clamp(0, 255) as u8)
}

/// A picture of another size, equal to that of `PIL.Image.resize`.
///
/// # Panics
/// When a side is 0.
#[must_use]
pub fn resize(picture: &Picture, (width, height): (u32, u32), filter: Filter) -> Picture {
    assert!(picture.width.min(picture.height).min(width).min(height) > 0, "a picture without pixels");
    let stride = picture.width as usize;
    let wide: Vec<[u8; 3]> = if width == picture.width {
        picture.pixels.clone()
    } else {
        let taps = taps(picture.width, width, filter);
        let row = |row: &[[u8; 3]]| -> Vec<[u8; 3]> {
            taps.iter().map(|taps| blend(row[taps.first..].iter().zip(&taps.weights))).collect()
        };
        picture.pixels.chunks(stride).flat_map(row).collect()
    };
    if height == picture.height {
        return Picture::from_pixels(width, height, wide);
    }
    let stride = width as usize;
    let mut pixels = Vec::with_capacity(stride * height as usize);
    for taps in taps(picture.height, height, filter) {
        for column in 0..stride {
            let along = wide[taps.first * stride + column..].iter().step_by(stride);
            pixels.push(blend(along.zip(&taps.weights)));
        }
    }
    Picture::from_pixels(width, height, pixels)
}
