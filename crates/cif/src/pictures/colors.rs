//! Numbers per pixel to colours.

use cif_geometry::PixelGrid;

use super::Picture;

/// Mean absolute error, as a fraction of full range, that the error picture shows brightest.
const BRIGHTEST_ERROR: f32 = 0.25;

/// Colour of pixels without instance.
const UNLABELLED: [u8; 3] = [28, 28, 32];

/// Colour of pixels without depth.
const NO_DEPTH: [u8; 3] = [0, 0, 0];

/// Colour of a mask id: hues a golden ratio apart, so that neighbouring ids differ; 0 is nearly black.
#[must_use]
pub fn instance_color(id: u16) -> [u8; 3] {
    if id == 0 {
        return UNLABELLED;
    }
    let hue = (f64::from(id) * 0.618_033_988_749_895).fract() * 6.0;
    // Three rounds of saturation and value keep ids apart whose hues come close again.
    let (saturation, value) = [(0.65, 0.95), (0.85, 0.75), (0.45, 0.85)][usize::from(id % 3)];
    [5.0, 3.0, 1.0].map(|offset: f64| {
        let k = (offset + hue) % 6.0;
        let channel = value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0);
        (channel * 255.0).round() as u8
    })
}

/// Mask ids in their colours, fading to nearly black by `foreground` where the pixel belongs to no instance:
/// every pixel has a most probable one, however improbable.
///
/// # Panics
/// When the sizes differ.
#[must_use]
pub fn instance_picture(ids: &PixelGrid<u16>, foreground: &PixelGrid<f32>) -> Picture {
    assert_eq!((ids.width, ids.height), (foreground.width, foreground.height), "pictures of another size");
    let pixels = ids.pixels.iter().zip(&foreground.pixels).map(|(id, share)| {
        let (color, share) = (instance_color(*id), share.clamp(0.0, 1.0));
        std::array::from_fn(|channel| {
            let (full, none) = (f32::from(color[channel]), f32::from(UNLABELLED[channel]));
            (none + (full - none) * share).round() as u8
        })
    });
    PixelGrid::from_pixels(ids.width, ids.height, pixels.collect())
}

/// Rendered colour, clamped to what 8 bits hold.
#[must_use]
pub fn rgb_picture(color: &PixelGrid<[f32; 3]>) -> Picture {
    color.map(|pixel| pixel.map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8))
}

/// Mean absolute difference over the channels: black where equal, brightest from a quarter of full range on.
///
/// # Panics
/// When the sizes differ.
#[must_use]
pub fn error_picture(rendered: &PixelGrid<[f32; 3]>, truth: &Picture) -> Picture {
    assert_eq!((rendered.width, rendered.height), (truth.width, truth.height), "pictures of another size");
    let pixels = rendered
        .pixels
        .iter()
        .zip(&truth.pixels)
        .map(|(a, b)| {
            let difference: f32 = (0..3)
                .map(|channel| (a[channel].clamp(0.0, 1.0) - f32::from(b[channel]) / 255.0).abs())
                .sum();
            map_color(colorous::INFERNO, difference / 3.0 / BRIGHTEST_ERROR)
        })
        .collect();
    PixelGrid::from_pixels(truth.width, truth.height, pixels)
}

/// Depth, near bright and far dark, between the 2nd and 98th percentile of the picture; black without depth.
#[must_use]
pub fn depth_picture(depth: &PixelGrid<f32>) -> Picture {
    let range = DepthRange::of(&depth.pixels);
    depth.map(|depth| range.color(*depth))
}

/// Depths that are shown brightest and darkest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRange {
    near: f32,
    far: f32,
}

impl DepthRange {
    /// The 2nd and 98th percentile of the depths above 0. Nothing is copied.
    #[must_use]
    pub fn of(depths: &[f32]) -> Self {
        let count = depths.iter().filter(|depth| **depth > 0.0).count();
        let percentile = |fraction: f32| {
            let rank = (count.max(1) - 1) as f32 * fraction;
            if count == 0 { 0.0 } else { by_rank(depths, rank as u64) }
        };
        Self { near: percentile(0.02), far: percentile(0.98) }
    }

    /// The colour of a depth; black for 0.
    #[must_use]
    pub fn color(&self, depth: f32) -> [u8; 3] {
        if depth > 0.0 {
            let distance = (depth - self.near) / (self.far - self.near).max(f32::MIN_POSITIVE);
            map_color(colorous::VIRIDIS, 1.0 - distance)
        } else {
            NO_DEPTH
        }
    }
}

/// The depth above 0 with so many others below it. Positive floats order like their bits: the upper half is found
/// first, then the lower half among depths with that upper one.
fn by_rank(depths: &[f32], rank: u64) -> f32 {
    let bits = || depths.iter().filter(|depth| **depth > 0.0).map(|depth| depth.to_bits());
    let (high, rank) = half_by_rank(bits().map(|bits| bits >> 16), rank);
    let (low, _) = half_by_rank(bits().filter(|bits| bits >> 16 == high).map(|bits| bits & 0xffff), rank);
    f32::from_bits(high << 16 | low)
}

/// Of 16-bit numbers: the one at a rank, and the rank among its equals.
fn half_by_rank(halves: impl Iterator<Item = u32>, mut rank: u64) -> (u32, u64) {
    let mut counts = vec![0_u64; 1 << 16];
    for half in halves {
        counts[half as usize] += 1;
    }
    for (half, count) in counts.iter().enumerate() {
        if rank < *count {
            return (half as u32, rank);
        }
        rank -= count;
    }
    (0, 0)
}

fn map_color(gradient: colorous::Gradient, position: f32) -> [u8; 3] {
    gradient.eval_continuous(f64::from(position.clamp(0.0, 1.0))).into_array()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn nearby_ids_have_distant_colours() {
        let colors: BTreeSet<[u8; 3]> = (0..200).map(instance_color).collect();
        assert!(colors.len() > 195, "{}", colors.len());
        for id in 1..30 {
            let (a, b) = (instance_color(id), instance_color(id + 1));
            let distance: i32 = (0..3).map(|c| (i32::from(a[c]) - i32::from(b[c])).abs()).sum();
            assert!(distance > 90, "{id}: {a:?} {b:?}");
        }
    }

    #[test]
    fn instances_fade_into_the_background() {
        let ids = PixelGrid::from_pixels(3, 1, vec![4, 4, 0]);
        let picture = instance_picture(&ids, &PixelGrid::from_pixels(3, 1, vec![1.0, 0.0, 1.0]));
        assert_eq!(picture.pixels, [instance_color(4), UNLABELLED, UNLABELLED]);
    }

    #[test]
    fn errors_are_black_where_equal() {
        let truth = PixelGrid::from_pixels(2, 1, vec![[255, 0, 51], [0, 0, 0]]);
        let rendered = PixelGrid::from_pixels(2, 1, vec![[1.0, -0.5, 0.2], [1.0, 1.0, 1.0]]);
        let picture = error_picture(&rendered, &truth);
        assert_eq!(picture.pixels[0], map_color(colorous::INFERNO, 0.0));
        assert_eq!(picture.pixels[1], map_color(colorous::INFERNO, 1.0));
    }

    #[test]
    fn percentiles_are_those_of_the_sorted_depths() {
        let mut depths: Vec<f32> = (0..5000_u32).map(|k| (k * 7919 % 5003) as f32 * 0.37 - 20.0).collect();
        depths.extend([f32::NAN, f32::INFINITY, 0.0]);
        let mut sorted: Vec<f32> = depths.iter().copied().filter(|depth| *depth > 0.0).collect();
        sorted.sort_by(f32::total_cmp);
        for rank in [0, 1, sorted.len() / 50, sorted.len() / 2, sorted.len() - 1] {
            assert_eq!(by_rank(&depths, rank as u64), sorted[rank], "{rank}");
        }
        let rank = |fraction: f32| ((sorted.len() - 1) as f32 * fraction) as usize;
        let range = DepthRange { near: sorted[rank(0.02)], far: sorted[rank(0.98)] };
        assert_eq!(DepthRange::of(&depths), range);
    }

    #[test]
    fn depth_is_bright_near_and_black_where_missing() {
        let depth = PixelGrid::from_pixels(3, 1, vec![0.0, 1.0, 5.0]);
        let sum = |pixel: [u8; 3]| pixel.iter().map(|v| u32::from(*v)).sum::<u32>();
        let picture = depth_picture(&depth);
        assert_eq!(picture.pixels[0], [0, 0, 0]);
        assert!(sum(picture.pixels[1]) > sum(picture.pixels[2]));
        // One depth, or none at all, is no division by zero.
        assert_eq!(depth_picture(&PixelGrid::filled(2, 2, 3.0)).pixels.len(), 4);
        assert_eq!(depth_picture(&PixelGrid::filled(2, 2, 0.0)).pixels[3], [0, 0, 0]);
    }
}
