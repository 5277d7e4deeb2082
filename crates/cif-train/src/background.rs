//! The colour behind everything, which shows where no Gaussian is.
//!
//! What has its colour needs no Gaussians, and leaves as a hole. So where the images of a capture are full of scene, steps
//! have a colour that is far from them, and only what is opaque explains them. Scenes show what lies beyond the images
//! then in the mean colour at their borders: of all colours the one that is least far from what would be there, in the
//! mean squared error.

use std::collections::HashMap;

use cif_dataset::Dataset;
use cif_geometry::PixelGrid;

use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::frames::FrameStore;

/// Training images that are looked at.
const IMAGES: usize = 16;

/// Width of the border of an image, of its shorter side.
const BORDER: f64 = 0.05;

/// Share of the pixels at the borders that have exactly one colour from which it is a backdrop: one of four sides. No
/// camera records one value so often, unless it is the largest or the least.
const BACKDROP: f64 = 0.25;

/// The background of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Background {
    /// Colour that scenes show, display-referred RGB in [0, 1].
    pub(crate) shown: [f32; 3],
    /// Colour that steps have.
    pub(crate) of_steps: [f32; 3],
}

impl Background {
    /// The background that settings ask for, or that the training images of a capture imply.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub(crate) fn of(
        dataset: &Dataset,
        frames: &FrameStore,
        config: &TrainConfig,
    ) -> Result<Self, TrainError> {
        let constant = |shown: [f32; 3]| Self { shown, of_steps: shown };
        if let Some(given) = config.background {
            return Ok(constant(given));
        }
        let count = frames.len().min(IMAGES);
        let (mut sum, mut pixels) = ([0.0_f64; 3], 0_usize);
        let mut counts: HashMap<[u8; 3], usize> = HashMap::new();
        for k in (0..count).map(|k| k * frames.len() / count) {
            let frame = frames.get(dataset, k)?;
            if dataset.has_alpha {
                let over_black = dataset.load_image(frames.index(k), [0.0; 3])?;
                if over_black.pixels != frame.image.pixels {
                    return Ok(constant(config.laid_over()));
                }
            }
            for color in border(&frame.image) {
                (0..3).for_each(|channel| sum[channel] += f64::from(color[channel]));
                *counts.entry(color).or_default() += 1;
                pixels += 1;
            }
        }
        // Of equals the least: the order of a table of counts is random.
        let most = counts.into_iter().max_by_key(|(color, count)| (*count, std::cmp::Reverse(*color)));
        Ok(match most {
            Some((color, count)) if count as f64 >= BACKDROP * pixels as f64 => {
                constant(color.map(|value| f32::from(value) / 255.0))
            }
            _ => {
                let shown = sum.map(|sum| (sum / (255.0 * pixels.max(1) as f64)) as f32);
                Self { shown, of_steps: farther(shown) }
            }
        })
    }
}

/// Black or white, whichever is farther from a colour. Saturated colours, and another colour in every step, were tried:
/// against them Gaussians grew that are as large as the scene, and hide it from elsewhere.
fn farther(color: [f32; 3]) -> [f32; 3] {
    let brightness = color.iter().sum::<f32>() / 3.0;
    [if brightness < 0.5 { 1.0 } else { 0.0 }; 3]
}

/// Pixels at the border of an image.
fn border(image: &PixelGrid<[u8; 3]>) -> impl Iterator<Item = [u8; 3]> {
    let (width, height) = (image.width, image.height);
    let wide = ((BORDER * f64::from(width.min(height))).round() as u32).max(1);
    let is_within = move |at: u32, size: u32| at >= wide && at + wide < size;
    let places = (0..height).flat_map(move |y| (0..width).map(move |x| [x, y]));
    let outer = places.filter(move |[x, y]| !(is_within(*x, width) && is_within(*y, height)));
    outer.map(|[x, y]| *image.at(x, y))
}
