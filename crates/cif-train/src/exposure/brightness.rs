//! How bright images record points whose colours are known.

use cif_dataset::{Dataset, PointSource};
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

/// Logarithms of how much brighter than their points images are, by channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct Brightness {
    ratios: [Vec<f64>; 3],
}

impl Brightness {
    /// Adds an image.
    pub(crate) fn add(&mut self, image: &PixelGrid<[u8; 3]>, camera: &PinholeCamera, points: &[Point]) {
        for (position, color) in points {
            let Some([x, y]) = camera.pixel_of(DVec3::from(position.map(f64::from))) else { continue };
            let seen = image.at(x, y);
            for channel in 0..3 {
                let pair = [seen[channel], color[channel]];
                // Near black and white, cameras do not record in proportion.
                if pair.iter().all(|value| PROPORTIONAL.contains(value)) {
                    let [seen, known] = pair.map(f64::from);
                    self.ratios[channel].push((seen / known).ln());
                }
            }
        }
    }

    /// Adds what another found.
    pub(crate) fn append(&mut self, other: &Self) {
        for (own, more) in self.ratios.iter_mut().zip(&other.ratios) {
            own.extend(more);
        }
    }

    /// Medians by channel, for half of the points may be hidden, shiny or misplaced; `None` of too few points.
    pub(crate) fn medians(self) -> Option<[f64; 3]> {
        let is_enough = self.ratios.iter().all(|of| of.len() >= SAMPLES);
        is_enough.then(|| {
            self.ratios.map(|mut of| {
                of.sort_by(f64::total_cmp);
                of[of.len() / 2]
            })
        })
    }
}
