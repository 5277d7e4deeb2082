//! Where cameras that stay in place see the capture change: what none of them sees change cannot be seen to move.

use std::collections::BTreeMap;

use cif_dataset::Dataset;
use cif_geometry::{PinholeCamera, PixelGrid};
use glam::DVec3;

use crate::error::TrainError;
use crate::frames::FrameStore;

/// Images of a camera that are compared, spread evenly over its time.
const IMAGES: usize = 24;

/// Range of a channel over time from which a pixel counts as changed, in units of the median range of the camera,
/// which is its noise where most of what it sees stands still; and its bounds.
const NOISE: u8 = 3;
const RANGE: [u8; 2] = [8, 24];

/// Half of the side of the window around a pixel in which so many must change: single pixels are noise, and what is
/// beside a change may belong to what changes.
const WINDOW: u32 = 2;
const FEWEST_PIXELS: u32 = 3;

/// Change that the cameras see at a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sight {
    /// No camera has it in its image.
    Unseen,
    /// Most cameras that have it in their images see nothing change there.
    Steady,
    /// At least half of them see something change.
    Changing,
}

/// One camera that stays in place.
struct View {
    camera: PinholeCamera,
    changes: PixelGrid<bool>,
}

/// All cameras of a capture, where every one stays in place.
pub(crate) struct Changes {
    views: Vec<View>,
}

/// Training frames of each camera in the order of the capture; nothing where a camera moves, or none has several
/// frames.
fn fixed_cameras(dataset: &Dataset, frames: &FrameStore) -> Vec<Vec<usize>> {
    let mut cameras: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for k in 0..frames.len() {
        cameras.entry(&dataset.frames[frames.index(k)].camera_name).or_default().push(k);
    }
    let cameras: Vec<Vec<usize>> = cameras.into_values().filter(|of| of.len() > 1).collect();
    let camera = |k: usize| &dataset.frames[frames.index(k)].camera;
    let stays = |of: &Vec<usize>| of.iter().all(|k| camera(*k) == camera(of[0]));
    if cameras.iter().all(stays) { cameras } else { Vec::new() }
}

impl Changes {
    /// True when a capture shows what changes: every camera with several training frames stays in place, at several
    /// times.
    pub(crate) fn are_shown(dataset: &Dataset, frames: &FrameStore) -> bool {
        dataset.times.len() > 1 && !fixed_cameras(dataset, frames).is_empty()
    }

    /// Compares the training images of every camera.
    pub(crate) fn find(dataset: &Dataset, frames: &FrameStore) -> Result<Self, TrainError> {
        let mut views = Vec::new();
        for of in fixed_cameras(dataset, frames) {
            let count = of.len().min(IMAGES);
            let first = frames.get(dataset, of[0])?;
            let mut ranges: Vec<[[u8; 2]; 3]> =
                first.image.pixels.iter().map(|pixel| pixel.map(|value| [value; 2])).collect();
            for k in 1..count {
                let data = frames.get(dataset, of[k * (of.len() - 1) / (count - 1)])?;
                for (range, pixel) in ranges.iter_mut().zip(&data.image.pixels) {
                    for (range, value) in range.iter_mut().zip(pixel) {
                        *range = [range[0].min(*value), range[1].max(*value)];
                    }
                }
            }
            let range = |of: &[[u8; 2]; 3]| of.iter().map(|[low, high]| high - low).max().unwrap_or(0);
            let ranges: Vec<u8> = ranges.iter().map(range).collect();
            let ranges = PixelGrid::from_pixels(first.image.width, first.image.height, ranges);
            views
                .push(View { camera: dataset.frames[frames.index(of[0])].camera, changes: changed(&ranges) });
        }
        Ok(Self { views })
    }

    /// Classifies a point of the world by the change that the cameras see there.
    pub(crate) fn at(&self, point: [f32; 3]) -> Sight {
        let point = DVec3::from(point.map(f64::from));
        let (mut seen, mut changing) = (0, 0);
        for View { camera, changes } in &self.views {
            let Some([x, y]) = camera.pixel_of(point) else { continue };
            seen += 1;
            changing += usize::from(*changes.at(x, y));
        }
        match (seen, changing) {
            (0, _) => Sight::Unseen,
            _ if 2 * changing >= seen => Sight::Changing,
            _ => Sight::Steady,
        }
    }
}

/// Pixels around which several have a range beyond the noise.
fn changed(ranges: &PixelGrid<u8>) -> PixelGrid<bool> {
    let mut sorted = ranges.pixels.clone();
    sorted.sort_unstable();
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0);
    let limit = median.saturating_mul(NOISE).clamp(RANGE[0], RANGE[1]);
    let (width, height) = (ranges.width, ranges.height);
    let around = |at: u32, size: u32| at.saturating_sub(WINDOW)..(at + WINDOW + 1).min(size);
    let mut pixels = Vec::with_capacity(ranges.pixels.len());
    for y in 0..height {
        for x in 0..width {
            let near = around(y, height).flat_map(|y| around(x, width).map(move |x| (x, y)));
            let count = near.filter(|(x, y)| *ranges.at(*x, *y) >= limit).count();
            pixels.push(count >= FEWEST_PIXELS as usize);
        }
    }
    PixelGrid::from_pixels(width, height, pixels)
}

#[cfg(test)]
mod tests {
    use cif_geometry::RigidTransform;
    use glam::{DMat3, DVec2};

    use super::*;

    #[test]
    fn changes_stand_out_of_noise_and_single_pixels_do_not() {
        let mut ranges = PixelGrid::from_pixels(16, 12, vec![4_u8; 16 * 12]);
        ranges.pixels[3 * 16 + 2] = 200;
        assert!(!changed(&ranges).pixels.contains(&true), "one hot pixel");
        for (x, y) in [(8, 6), (9, 6), (9, 7)] {
            ranges.pixels[y * 16 + x] = 13;
        }
        let found = changed(&ranges);
        assert!(*found.at(8, 6) && *found.at(9, 7) && *found.at(7, 5));
        assert!(!*found.at(12, 6) && !*found.at(2, 3));
        // A noisier camera sees nothing in that.
        let noisy = PixelGrid::from_pixels(16, 12, ranges.pixels.iter().map(|v| (*v).max(6)).collect());
        assert!(!changed(&noisy).pixels.contains(&true));
        // Nor is everything noise where everything changes.
        assert!(!changed(&PixelGrid::from_pixels(4, 4, vec![90_u8; 16])).pixels.contains(&false));
    }

    fn view(x: f64, changing: bool) -> View {
        let camera = PinholeCamera {
            width: 8,
            height: 6,
            focal_px: DVec2::splat(8.0),
            principal_px: DVec2::new(4.0, 3.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::IDENTITY,
                translation: DVec3::new(x, 0.0, 2.0),
            },
        };
        View { camera, changes: PixelGrid::from_pixels(8, 6, vec![changing; 48]) }
    }

    #[test]
    fn half_of_the_cameras_that_see_a_point_must_see_it_change() {
        let sight = |views: Vec<View>| Changes { views }.at([0.0; 3]);
        assert_eq!(sight(vec![view(0.0, false), view(0.1, false)]), Sight::Steady);
        assert_eq!(sight(vec![view(0.0, false), view(0.1, true)]), Sight::Changing);
        assert_eq!(sight(vec![view(0.0, false), view(0.1, false), view(0.2, true)]), Sight::Steady);
        // One that does not have it in its image has no say.
        assert_eq!(sight(vec![view(0.0, false), view(9.0, true), view(-9.0, true)]), Sight::Steady);
        assert_eq!(sight(vec![view(9.0, true)]), Sight::Unseen);
        let behind = Changes { views: vec![view(0.0, true)] };
        assert_eq!(behind.at([0.0, 0.0, -5.0]), Sight::Unseen);
    }
}
