//! Answers of features to questions: how relevant a pixel is, and from when on it belongs to the answer.
//!
//! Source: `eval.py` of the released code; methods reference 8.6. With the cosines `c` of the feature of a
//! pixel with the question, and `n` with a text of anything ("object", "things", "stuff", "texture"), its
//! relevance is the least `e^(10 c) / (e^(10 c) + e^(10 n))` over these texts (Kerr et al., LERF, 2023). The
//! map is averaged with its mean over 29 x 29 pixels, brought to [-1, 1] by its least and largest value and
//! clipped at 0; pixels above 0.4 are the answer, where most of the 7 x 7 pixels around them are. Windows are
//! cut off at borders.
//!
//! Deviation: cosines are those of the three-channel codes; the published method decodes features to 512
//! numbers first, by an autoencoder that is not given here. A pixel that shows nothing has cosines of 0.

use cif_geometry::PixelGrid;
use cif_render::BlendedImage;
use serde::Serialize;

/// Factor of cosines: the inverse of a temperature.
const SHARPNESS: f32 = 10.0;

/// Pixels that the mean filter reaches to every side: 29 x 29.
const MEAN_REACH: usize = 14;

/// Value in [-1, 1] above which a pixel is part of the answer.
const THRESHOLD: f64 = 0.4;

/// Pixels that the majority is taken over to every side: 7 x 7.
const MAJORITY_REACH: usize = 3;

/// Added to the range of a map, so that one without relief has no answer.
const TINY: f64 = 1e-9;

/// Features shorter than this show nothing.
const LEAST_LENGTH: f32 = 1e-6;

/// Code of a question, and those of texts of anything, of any length.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Question {
    /// The question.
    pub code: [f32; 3],
    /// Texts of anything.
    pub anything: Vec<[f32; 3]>,
}

/// Direction of a code; 0 where it has none.
fn direction(code: [f32; 3]) -> [f32; 3] {
    let length = code.iter().map(|value| value * value).sum::<f32>().sqrt();
    if length > LEAST_LENGTH { code.map(|value| value / length) } else { [0.0; 3] }
}

fn cosine(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

impl Question {
    /// Relevance of every pixel of blended features, (0, 1).
    ///
    /// # Panics
    /// When the features do not have three channels.
    #[must_use]
    pub fn relevance(&self, features: &BlendedImage) -> PixelGrid<f32> {
        let (question, anything) = (direction(self.code), self.anything.iter().map(|code| direction(*code)));
        let anything: Vec<[f32; 3]> = anything.collect();
        let relevance = |pixel: &[f32]| {
            let feature = direction([pixel[0], pixel[1], pixel[2]]);
            let asked = cosine(feature, question);
            let of = |other: &[f32; 3]| 1.0 / (1.0 + (SHARPNESS * (cosine(feature, *other) - asked)).exp());
            anything.iter().map(of).fold(1.0, f32::min)
        };
        assert_eq!(features.channels, 3, "features of three channels are asked");
        PixelGrid::from_pixels(features.width, features.height, features.pixels().map(relevance).collect())
    }

    /// Pixels that answer the question.
    ///
    /// # Panics
    /// When the features do not have three channels.
    #[must_use]
    pub fn answer(&self, features: &BlendedImage) -> PixelGrid<bool> {
        answer(&self.relevance(features))
    }
}

/// Pixels of a map of relevance that are the answer.
#[must_use]
pub fn answer(relevance: &PixelGrid<f32>) -> PixelGrid<bool> {
    let raw = relevance.map(|value| f64::from(*value));
    let mut smooth = mean_filter(&raw, MEAN_REACH);
    smooth.pixels.iter_mut().zip(&raw.pixels).for_each(|(mean, raw)| *mean = 0.5 * (*mean + raw));
    let least = smooth.pixels.iter().copied().fold(f64::INFINITY, f64::min);
    let range = smooth.pixels.iter().copied().fold(f64::NEG_INFINITY, f64::max) - least + TINY;
    // A threshold above 0 leaves nothing for clipping to do.
    let above = smooth.map(|value| f64::from(u8::from(2.0 * (value - least) / range - 1.0 > THRESHOLD)));
    mean_filter(&above, MAJORITY_REACH).map(|share| *share > 0.5)
}

/// Mean over the window of every pixel, cut off at borders.
fn mean_filter(grid: &PixelGrid<f64>, reach: usize) -> PixelGrid<f64> {
    let (width, height) = (grid.width as usize, grid.height as usize);
    // Sums over everything above and to the left.
    let stride = width + 1;
    let mut sums = vec![0.0; stride * (height + 1)];
    for y in 0..height {
        let mut row = 0.0;
        for x in 0..width {
            row += grid.pixels[y * width + x];
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
        }
    }
    let pixels = (0..height).flat_map(|y| {
        let (top, bottom) = (y.saturating_sub(reach), (y + reach + 1).min(height));
        let sums = &sums;
        (0..width).map(move |x| {
            let (left, right) = (x.saturating_sub(reach), (x + reach + 1).min(width));
            let at = |x: usize, y: usize| sums[y * stride + x];
            let sum = at(right, bottom) + at(left, top) - at(right, top) - at(left, bottom);
            sum / ((right - left) * (bottom - top)) as f64
        })
    });
    PixelGrid::from_pixels(grid.width, grid.height, pixels.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn question() -> Question {
        Question { code: [2.0, 0.0, 0.0], anything: vec![[0.0, 1.0, 0.0], [0.0, 0.0, 3.0]] }
    }

    #[test]
    fn relevance_is_the_least_against_texts_of_anything() {
        let values = vec![5.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0];
        let features = BlendedImage { width: 4, height: 1, channels: 3, values };
        let found = question().relevance(&features).pixels;
        let against =
            |asked: f64, other: f64| (10.0 * asked).exp() / ((10.0 * asked).exp() + (10.0 * other).exp());
        let expected = [against(1.0, 0.0), against(0.0, 1.0), 0.5, 0.5];
        for (found, expected) in found.iter().zip(expected) {
            assert!((f64::from(*found) - expected).abs() < 1e-6, "{found} and {expected}");
        }
    }

    /// The published steps one by one, in the slowest way.
    fn plainly(relevance: &PixelGrid<f32>) -> Vec<bool> {
        let (width, height) = (relevance.width as i64, relevance.height as i64);
        let mean = |of: &dyn Fn(i64, i64) -> f64, x: i64, y: i64, reach: i64| {
            let (mut sum, mut count) = (0.0, 0);
            for v in (y - reach).max(0)..=(y + reach).min(height - 1) {
                for u in (x - reach).max(0)..=(x + reach).min(width - 1) {
                    sum += of(u, v);
                    count += 1;
                }
            }
            sum / f64::from(count)
        };
        let places: Vec<(i64, i64)> = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).collect();
        let raw = |x: i64, y: i64| f64::from(*relevance.at(x as u32, y as u32));
        let smooth: Vec<f64> =
            places.iter().map(|(x, y)| 0.5 * (mean(&raw, *x, *y, 14) + raw(*x, *y))).collect();
        let least = smooth.iter().copied().fold(f64::MAX, f64::min);
        let shifted: Vec<f64> = smooth.iter().map(|value| value - least).collect();
        let most = shifted.iter().copied().fold(f64::MIN, f64::max);
        let mapped = shifted.iter().map(|value| (value / (most + 1e-9) * 2.0 - 1.0).clamp(0.0, 1.0));
        let above: Vec<f64> = mapped.map(|value| f64::from(u8::from(value > 0.4))).collect();
        let of = |x: i64, y: i64| above[(y * width + x) as usize];
        places.iter().map(|(x, y)| mean(&of, *x, *y, 3) > 0.5).collect()
    }

    #[test]
    fn answers_are_those_of_the_published_steps() {
        // A disc with a hole, a stray pixel, and a slope.
        let pixel = |x: u32, y: u32| {
            let squared = (f64::from(x) - 20.0).powi(2) + (f64::from(y) - 14.0).powi(2);
            let inside = squared < 80.0 && (x, y) != (20, 14) || (x, y) == (45, 3);
            if inside { 0.9 } else { 0.1 + 0.004 * x as f32 }
        };
        let pixels = (0..30).flat_map(|y| (0..50).map(move |x| pixel(x, y))).collect();
        let map = PixelGrid::from_pixels(50, 30, pixels);
        let found = answer(&map);
        assert_eq!(found.pixels, plainly(&map));
        assert!(*found.at(20, 14) && *found.at(14, 14), "the hole is closed");
        assert!(!*found.at(45, 3) && !*found.at(2, 28), "the stray pixel goes");
        assert!(!answer(&PixelGrid::filled(9, 7, 0.7)).pixels.contains(&true), "a map without relief");
    }
}
