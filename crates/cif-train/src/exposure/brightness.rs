//! How bright images record points: relative to their known colours, and to one another.

use cif_dataset::{Dataset, PointSource};
use cif_geometry::stats::{median, upper_median};
use cif_geometry::{PinholeCamera, PixelGrid};
use glam::DVec3;

/// Points that brightness is compared with.
const POINTS: usize = 4_000;

/// Values that cameras record in proportion to the light.
const PROPORTIONAL: std::ops::RangeInclusive<u8> = 24..=232;

/// Points with such values, per channel, that images are judged by.
const SAMPLES: usize = 60;

/// A point and its colour.
type Point = ([f32; 3], [u8; 3]);

/// Points of a capture that brightness is compared with, spread evenly; none where its points were not measured.
pub(crate) fn known_points(dataset: &Dataset) -> Vec<Point> {
    let points = &dataset.points;
    if matches!(points.source, PointSource::Random) {
        return Vec::new();
    }
    let all = points.positions.iter().copied().zip(points.colors.iter().copied());
    all.step_by(points.positions.len().div_ceil(POINTS).max(1)).collect()
}

/// Logarithm of a value, NaN where cameras do not record in proportion: near black and white.
fn brightness(value: u8) -> f64 {
    if PROPORTIONAL.contains(&value) { f64::from(value).ln() } else { f64::NAN }
}

/// Rounds in which gains of images and brightness of points follow each other.
const ROUNDS: usize = 10;

/// Logarithms of the values in which several images record the same points.
#[derive(Clone, Debug)]
pub(crate) struct Recorded<'a> {
    points: &'a [Point],
    /// By image and point; NaN where it does not record one in proportion.
    images: Vec<Vec<[f64; 3]>>,
}

impl<'a> Recorded<'a> {
    /// No images of some points.
    pub(crate) fn of(points: &'a [Point]) -> Self {
        Self { points, images: Vec::new() }
    }

    /// Adds an image.
    pub(crate) fn add(&mut self, image: &PixelGrid<[u8; 3]>, camera: &PinholeCamera) {
        let of = |(position, _): &Point| {
            let pixel = camera.pixel_of(DVec3::from(position.map(f64::from)));
            pixel.map_or([f64::NAN; 3], |[x, y]| image.at(x, y).map(brightness))
        };
        self.images.push(self.points.iter().map(of).collect());
    }

    /// Logarithms of how much brighter than their colours all images record the points, by channel: the median, for half of
    /// these may be hidden, shiny or misplaced. `None` of too few.
    pub(crate) fn relative_to_colors(&self) -> Option<[f64; 3]> {
        let of = |channel: usize| {
            let points = || self.points.iter().map(|(_, color)| brightness(color[channel]));
            let differences = |image: &Vec<[f64; 3]>| {
                image.iter().zip(points()).map(|(seen, known)| seen[channel] - known).collect::<Vec<_>>()
            };
            let mut ratios: Vec<f64> =
                self.images.iter().flat_map(differences).filter(|ratio| ratio.is_finite()).collect();
            upper_median(&mut ratios).filter(|_| ratios.len() >= SAMPLES)
        };
        Some([of(0)?, of(1)?, of(2)?])
    }

    /// Logarithms of the gains of the images, by channel, of those that record enough of the points which others record
    /// too: half of these may be hidden or move. Their mean is 0.
    pub(crate) fn gains(&self) -> Vec<Option<[f64; 3]>> {
        let mut gains = vec![[0.0_f64; 3]; self.images.len()];
        let mut is_known = vec![true; self.images.len()];
        for channel in 0..3 {
            let value = |image: usize, point: usize| self.images[image][point][channel];
            for _ in 0..ROUNDS {
                let of_point = |point: usize| {
                    let seen =
                        (0..self.images.len()).map(|image| value(image, point) - gains[image][channel]);
                    let mut seen: Vec<f64> = seen.filter(|value| value.is_finite()).collect();
                    if seen.len() > 1 { median(&mut seen).unwrap_or(f64::NAN) } else { f64::NAN }
                };
                let points: Vec<f64> = (0..self.points.len()).map(of_point).collect();
                for (image, gain) in gains.iter_mut().enumerate() {
                    let apart = points.iter().enumerate().map(|(point, known)| value(image, point) - known);
                    let mut apart: Vec<f64> = apart.filter(|value| value.is_finite()).collect();
                    is_known[image] &= apart.len() >= SAMPLES;
                    gain[channel] = if is_known[image] { median(&mut apart).unwrap_or(0.0) } else { 0.0 };
                }
                let mean = gains.iter().map(|gain| gain[channel]).sum::<f64>() / gains.len().max(1) as f64;
                gains.iter_mut().for_each(|gain| gain[channel] -= mean);
            }
        }
        gains.into_iter().zip(is_known).map(|(gain, is_known)| is_known.then_some(gain)).collect()
    }
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;
    use glam::DVec2;

    use super::*;

    const WIDTH: u32 = 40;

    /// A camera before a wall of one point a pixel.
    fn camera() -> PinholeCamera {
        PinholeCamera {
            width: WIDTH,
            height: WIDTH,
            focal_px: DVec2::splat(f64::from(WIDTH)),
            principal_px: DVec2::splat(f64::from(WIDTH) / 2.0),
            camera_from_world: RigidTransform::IDENTITY,
        }
    }

    #[test]
    fn gains_of_images_are_found_whatever_moves_before_the_points() {
        let place = |k: u32| (f64::from(k) + 0.5) / f64::from(WIDTH) - 0.5;
        let points: Vec<Point> = (0..WIDTH * WIDTH)
            .map(|k| ([place(k % WIDTH) as f32, place(k / WIDTH) as f32, 1.0], [128; 3]))
            .collect();
        let mut recorded = Recorded::of(&points);
        let truth = [0.8_f64, 1.0, 1.1, 1.3];
        let mean = truth.iter().map(|gain| gain.ln()).sum::<f64>() / 4.0;
        for (image, gain) in truth.iter().enumerate() {
            let mut pixels = PixelGrid::filled(WIDTH, WIDTH, [0_u8; 3]);
            for (k, pixel) in pixels.pixels.iter_mut().enumerate() {
                // A quarter of the image is something else each time.
                let hidden = k % 4 == image;
                let value = if hidden { 40.0 } else { 60.0 + (k * 7 % 110) as f64 };
                *pixel = [(gain * value).round() as u8; 3];
            }
            recorded.add(&pixels, &camera());
        }
        let gains = recorded.gains();
        for (found, truth) in gains.iter().zip(truth) {
            let found = found.unwrap();
            let expected = truth.ln() - mean;
            assert!(found.iter().all(|gain| (gain - expected).abs() < 0.02), "{found:?} for {expected}");
        }
        // One image has nothing to be compared with; nor has one that shows too little.
        let mut one = Recorded::of(&points);
        one.add(&PixelGrid::filled(WIDTH, WIDTH, [100; 3]), &camera());
        assert_eq!(one.gains(), [None]);
        one.add(&PixelGrid::filled(WIDTH, WIDTH, [255; 3]), &camera());
        assert_eq!(one.gains(), [None, None]);
    }
}
