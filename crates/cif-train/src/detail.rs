//! How many Gaussians the images of a capture ask for: those of grass and gravel more than those of a plain table.

use cif_dataset::Dataset;
use cif_geometry::PixelGrid;

use crate::config::DensifyConfig;
use crate::error::TrainError;
use crate::frames::FrameStore;

/// Training images that are looked at.
const IMAGES: usize = 8;

/// Least difference from the mean around it that is seen, in colours of [0, 1]: 5 of 255. An image of a film of a model
/// railway (640 x 360) has 93 000 such pixels, one of a lawn (480 x 270) 40 000, and those of eight other captures 2 800 to
/// 19 000; a full set of `draft` or `standard` grows from 48 000 or 50 000 on.
const SEEN: f64 = 5.0 / 255.0;

/// Standard deviations of the noise beyond which a difference is none of it.
const DEVIATIONS: f64 = 3.0;

/// Most Gaussians of a full set, of those in its settings: what it costs is bounded, too.
pub(crate) const MOST: f64 = 2.0;

/// Gaussians that a full set may have, and the pixels of detail in an image that ask for them: one for each
/// `densify.detail` of them, but no less than `densify.max_gaussians` and no more than [`MOST`] of them. `None` where
/// that stays.
pub(crate) fn most_gaussians(
    dataset: &Dataset,
    frames: &FrameStore,
    config: &DensifyConfig,
) -> Result<Option<(u32, usize)>, TrainError> {
    let count = frames.len().min(IMAGES);
    if config.detail <= 0.0 || count == 0 {
        return Ok(None);
    }
    let mut found = Vec::with_capacity(count);
    for k in 0..count {
        let frame = frames.get(dataset, k * frames.len() / count)?;
        found.push(pixels_of_detail(&frame.image));
    }
    found.sort_unstable();
    let pixels = found[count / 2];
    let most = f64::from(config.max_gaussians);
    let asked = (pixels as f64 / f64::from(config.detail)).min(MOST * most);
    Ok((asked > most).then(|| (asked.round() as u32, pixels)))
}

/// Pixels that an image of half the width and height would not show: their brightness differs from the mean of their 2 x
/// 2 pixels by more than the noise of the image and than is seen.
fn pixels_of_detail(image: &PixelGrid<[u8; 3]>) -> usize {
    let (width, height) = (image.width as usize, image.height as usize);
    let of = |pixel: [u8; 3]| pixel.map(f64::from).iter().sum::<f64>() / (3.0 * 255.0);
    let brightness: Vec<f64> = image.pixels.iter().map(|pixel| of(*pixel)).collect();
    let at = |x: usize, y: usize| brightness[y * width + x];
    let least = SEEN.max(DEVIATIONS * noise(&brightness, width));
    let mut count = 0;
    for y in (0..height / 2 * 2).step_by(2) {
        for x in (0..width / 2 * 2).step_by(2) {
            let block = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
            let mean = block.iter().sum::<f64>() / 4.0;
            count += block.iter().filter(|value| (*value - mean).abs() > least).count();
        }
    }
    count
}

/// Standard deviation of the noise of rows of `width` values, by differences that planes and edges along the axes do not
/// have (Immerkaer 1996), of which the lower quarter is taken: it is that of the smoother parts.
fn noise(values: &[f64], width: usize) -> f64 {
    /// Standard deviation of the differences of noise of 1, and the lower quartile of the size of a normal number.
    const SPREAD: f64 = 6.0;
    const QUARTILE: f64 = 0.318_639;
    let height = values.len() / width.max(1);
    if width < 3 || height < 3 {
        return 0.0;
    }
    let at = |x: usize, y: usize| values[y * width + x];
    let along = |x: usize, y: usize| at(x - 1, y) - 2.0 * at(x, y) + at(x + 1, y);
    let mut sizes: Vec<f64> = (1..height - 1)
        .flat_map(|y| (1..width - 1).map(move |x| (x, y)))
        .map(|(x, y)| (along(x, y - 1) - 2.0 * along(x, y) + along(x, y + 1)).abs())
        .collect();
    let quarter = sizes.len() / 4;
    let (_, lower, _) = sizes.select_nth_unstable_by(quarter, f64::total_cmp);
    *lower / (SPREAD * QUARTILE)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    fn image(of: impl FnMut(u32, u32) -> f64) -> PixelGrid<[u8; 3]> {
        let mut of = of;
        let pixels = (0..64 * 64).map(|k| [(255.0 * of(k % 64, k / 64)).clamp(0.0, 255.0).round() as u8; 3]);
        PixelGrid::from_pixels(64, 64, pixels.collect())
    }

    /// Mean of twelve uniform numbers, of unit variance.
    fn normal(random: &mut Pcg64Mcg) -> f64 {
        (0..12).map(|_| random.random_range(-0.5..0.5)).sum()
    }

    #[test]
    fn texture_is_detail_and_ramps_large_shapes_and_noise_are_not() {
        let ramp = |x: u32, y: u32| 0.2 + 0.004 * f64::from(x) + 0.003 * f64::from(y);
        assert_eq!(pixels_of_detail(&image(ramp)), 0);
        // Edges of squares of 8 pixels lie between the 2 x 2 pixels.
        assert_eq!(pixels_of_detail(&image(|x, y| f64::from((x / 8 + y / 8) % 2))), 0);
        // A checkerboard of single pixels in one quarter.
        let board = |x: u32, y: u32| {
            if x < 32 && y < 32 { 0.4 + 0.2 * f64::from((x + y) % 2) } else { ramp(x, y) }
        };
        assert_eq!(pixels_of_detail(&image(board)), 32 * 32);
        let mut random = Pcg64Mcg::seed_from_u64(1);
        for deviation in [0.01, 0.03, 0.06] {
            let noisy = image(|x, y| 0.2 + ramp(x, y) + deviation * normal(&mut random));
            let values: Vec<f64> = noisy.pixels.iter().map(|pixel| f64::from(pixel[0]) / 255.0).collect();
            let found = noise(&values, 64);
            assert!((found / deviation - 1.0).abs() < 0.15, "{found} of {deviation}");
            // Three deviations of the noise, of which the mean of the four takes a part.
            let share = pixels_of_detail(&noisy) as f64 / (64.0 * 64.0);
            assert!(share < 0.01, "{share} at {deviation}");
        }
        let noise_and_texture = image(|x, y| board(x, y) + 0.01 * normal(&mut random));
        let found = pixels_of_detail(&noise_and_texture) as f64 / (32.0 * 32.0);
        assert!((found - 1.0).abs() < 0.05, "{found}");
        for (width, height) in [(1, 1), (2, 5), (0, 0)] {
            let small = PixelGrid::filled(width, height, [9; 3]);
            assert_eq!(pixels_of_detail(&small), 0);
        }
    }
}
