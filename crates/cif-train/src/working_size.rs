//! The size of images that a run works on. Large ones are reduced as far as its Gaussians can show, for everything but the
//! last fine steps, which see them as they were captured.

use std::sync::Arc;

use cif_dataset::{Dataset, Split};
use cif_geometry::PinholeCamera;

use crate::budget::{Part, StepCosts};
use crate::config::{MAX_REDUCTION, StagesConfig, TrainConfig};
use crate::error::TrainError;
use crate::frames::{FrameStore, TrainFrame};
use crate::schedule::{SMALLEST_SIDE, may_halve};

/// Pixels of an image for each Gaussian of a full set beyond which images are reduced, so that 8 or more are left.
/// Held-out PSNR of `draft` with half the width and height instead of whole images: 0.3 dB less in half the time where
/// that leaves 10 (800 x 600), 1.9 less in 0.7 of it with 4.8 and images full of detail (640 x 360), and 1.3 less with 3.3
/// (400 x 400).
const PIXELS_PER_GAUSSIAN: f64 = 32.0;

/// Share of a fine step on images of the size that is worked on that grows with their pixels: 0.33 to 0.84 on four captures
/// of 256 x 192 to 800 x 600, most where most stands still and images are large.
pub(crate) const PIXEL_SHARE: f64 = 0.55;

/// The reduction of the images of a run: as its settings say, else of the training images by powers of two until they have
/// no more than [`PIXELS_PER_GAUSSIAN`], or sides that are too short.
pub(crate) fn reduction(dataset: &Dataset, config: &TrainConfig) -> u32 {
    of_size(captured(dataset), config)
}

/// Size of the largest training image.
pub(crate) fn captured(dataset: &Dataset) -> [u32; 2] {
    let training = dataset.frames.iter().filter(|frame| frame.split == Split::Train);
    let sizes = training.map(|frame| [frame.camera.width, frame.camera.height]);
    sizes.max_by_key(|[width, height]| u64::from(*width) * u64::from(*height)).unwrap_or_default()
}

/// The size of such images after a reduction.
pub(crate) fn reduced_size(size: [u32; 2], by: u32) -> [u32; 2] {
    size.map(|side| ((f64::from(side) / f64::from(by)).round() as u32).max(1))
}

/// The reduction of images of such a size.
pub(crate) fn of_size([width, height]: [u32; 2], config: &TrainConfig) -> u32 {
    if config.stages.reduction > 0 {
        return config.stages.reduction;
    }
    let pixels = f64::from(width) * f64::from(height);
    let shown = PIXELS_PER_GAUSSIAN * f64::from(config.densify.max_gaussians);
    let mut reduction = 1;
    while pixels / f64::from(reduction * reduction) > shown
        && width.min(height) / (2 * reduction) >= SMALLEST_SIDE
        && 2 * reduction <= MAX_REDUCTION
    {
        reduction *= 2;
    }
    reduction
}

/// Costs of fine steps, where images have such a size after a reduction.
pub(crate) fn step_costs([width, height]: [u32; 2], reduction: u32, stages: &StagesConfig) -> StepCosts {
    let last = if reduction > 1 { f64::from(stages.whole_size) } else { 0.0 };
    let first = if may_halve(width, height) { f64::from(stages.half_size).min(1.0 - last) } else { 0.0 };
    // Of a step with so many times the pixels.
    let cost = |pixels: f64| 1.0 + PIXEL_SHARE * (pixels - 1.0);
    StepCosts {
        first: Part { share: first, cost: cost(0.25) },
        last: Part { share: last, cost: cost(f64::from(reduction.max(1)).powi(2)) },
    }
}

/// A capture whose images are loaded reduced.
pub(crate) fn reduced(mut dataset: Dataset, by: u32) -> Dataset {
    for frame in &mut dataset.frames {
        let [width, height] = reduced_size([frame.camera.width, frame.camera.height], by);
        frame.camera = frame.camera.resized(width, height);
    }
    dataset
}

/// The capture of a run that works on reduced images, as it is.
pub(crate) struct Whole {
    pub capture: Dataset,
    /// The same without masks, which steps on whole images do not look at.
    images: Dataset,
    frames: FrameStore,
}

impl Whole {
    /// `training`: indices of the training frames, in order.
    pub(crate) fn of(capture: Dataset, training: Vec<usize>, background: [f32; 3]) -> Self {
        let mut images = capture.clone();
        for frame in &mut images.frames {
            (frame.mask, frame.confidence) = (None, None);
        }
        images.points.positions.clear();
        images.points.colors.clear();
        let frames = FrameStore::decoded_ahead(&images, training, background);
        Self { capture, images, frames }
    }

    /// Training frame `k`, and its camera.
    pub(crate) fn view(&self, k: usize) -> Result<(Arc<TrainFrame>, PinholeCamera), TrainError> {
        let frame = self.frames.get(&self.images, k)?;
        Ok((frame, self.capture.frames[self.frames.index(k)].camera))
    }

    /// Begins to decode training frames that are needed soon.
    pub(crate) fn expect(&self, coming: impl IntoIterator<Item = usize>) {
        self.frames.expect(coming);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trainer::guard_tests::support::{Scene, capture};

    #[test]
    fn images_are_reduced_until_gaussians_are_as_many_as_they_show() {
        let mut config = TrainConfig::default();
        config.densify.max_gaussians = 500;
        // 32 pixels for each of 500 Gaussians.
        for (size, expected) in [
            ([160, 100], 1),
            ([160, 101], 1),
            ([320, 200], 2),
            ([640, 400], 4),
            ([2_000, 150], 2),
            ([8_000, 6_000], 16),
        ] {
            assert_eq!(of_size(size, &config), expected, "{size:?}");
        }
        config.stages.reduction = 3;
        assert_eq!(of_size([160, 100], &config), 3, "as it is said");
    }

    #[test]
    fn reduced_captures_show_means_of_areas_where_their_cameras_see_them() {
        let folder = tempfile::tempdir().unwrap();
        let whole = capture(folder.path(), Scene { times: 1, views: 2, larger: 2, ..Scene::default() });
        let reduced = reduced(whole.clone(), 2);
        for (index, (of_whole, of_reduced)) in whole.frames.iter().zip(&reduced.frames).enumerate() {
            let [image, small] =
                [&whole, &reduced].map(|dataset| dataset.load_image(index, [1.0; 3]).unwrap());
            assert_eq!([small.width, small.height], [of_reduced.camera.width, of_reduced.camera.height]);
            for (k, pixel) in small.pixels.iter().enumerate() {
                let (x, y) = (k % small.width as usize, k / small.width as usize);
                let at = |dx, dy| image.pixels[(2 * y + dy) * image.width as usize + 2 * x + dx];
                for (c, value) in pixel.iter().enumerate() {
                    let four = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)].map(|p| f64::from(p[c]));
                    assert!((four.iter().sum::<f64>() / 4.0 - f64::from(*value)).abs() <= 0.51, "pixel {k}");
                }
            }
            let place = glam::DVec3::new(0.1, -0.05, 0.2);
            let [a, b] = [of_whole, of_reduced].map(|frame| frame.camera.project(place).unwrap().0);
            assert!((a / 2.0 - b).length() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn costs_of_steps_follow_the_sizes_that_they_see() {
        let stages = StagesConfig { half_size: 0.4, whole_size: 0.2, ..StagesConfig::default() };
        let of = |size, reduction| step_costs(size, reduction, &stages);
        let rounded = |share: f64| (share * 1e4).round() / 1e4;
        let shares = |costs: StepCosts| [costs.first.share, costs.last.share].map(rounded);
        assert_eq!(shares(of([256, 192], 1)), [0.4, 0.0]);
        assert_eq!(shares(of([256, 120], 2)), [0.0, 0.2], "too small to be halved");
        let two = of([256, 192], 2);
        assert_eq!(shares(two), [0.4, 0.2]);
        assert!(two.first.cost > 0.25 && two.first.cost < 1.0 && two.last.cost > 1.0 && two.last.cost < 4.0);
    }
}
