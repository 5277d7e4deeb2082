//! PSNR and SSIM of one picture against its truth. Source: methods reference 9.

use cif_geometry::PixelGrid;
use rayon::prelude::*;

/// Taps of the SSIM window.
const WINDOW: usize = 11;
/// Zero padding on each side, so that the SSIM map has the size of the image.
const PADDING: usize = WINDOW / 2;
/// Rows of a band; what is blurred along rows is kept of one band at a time.
const BAND: usize = 32;
/// Standard deviation of the SSIM window, pixels.
const WINDOW_SIGMA: f64 = 1.5;
/// (0.01 x range)^2 with range 1.
const C1: f64 = 1e-4;
/// (0.03 x range)^2 with range 1.
const C2: f64 = 9e-4;

/// 8-bit colour to [0, 1].
#[must_use]
pub fn unit_color(image: &PixelGrid<[u8; 3]>) -> PixelGrid<[f32; 3]> {
    image.map(|pixel| pixel.map(|value| f32::from(value) / 255.0))
}

/// Peak signal-to-noise ratio in dB, `10 log10(1 / MSE)` over all pixels and channels, the render clamped to
/// [0, 1]. Infinite when the pictures agree exactly; NaN for pictures without pixels.
///
/// # Panics
/// When the sizes differ.
#[must_use]
pub fn psnr(rendered: &PixelGrid<[f32; 3]>, truth: &PixelGrid<[f32; 3]>) -> f64 {
    assert_same_size(rendered, truth);
    let squares: f64 = rendered
        .pixels
        .iter()
        .zip(&truth.pixels)
        .flat_map(|(a, b)| a.iter().zip(b))
        .map(|(a, b)| (f64::from(a.clamp(0.0, 1.0)) - f64::from(*b)).powi(2))
        .sum();
    -10.0 * (squares / (truth.pixels.len() * 3) as f64).log10()
}

/// [`psnr`] over the pixels that `counts` marks; `None` where it marks none.
///
/// # Panics
/// When the sizes differ.
#[must_use]
pub fn masked_psnr(
    rendered: &PixelGrid<[f32; 3]>,
    truth: &PixelGrid<[f32; 3]>,
    counts: &PixelGrid<bool>,
) -> Option<f64> {
    assert_same_size(rendered, truth);
    assert_eq!((counts.width, counts.height), (truth.width, truth.height), "a mask of another size");
    let chosen = |image: &PixelGrid<[f32; 3]>| {
        let pixels: Vec<[f32; 3]> =
            image.pixels.iter().zip(&counts.pixels).filter(|(_, counts)| **counts).map(|(p, _)| *p).collect();
        PixelGrid::from_pixels(pixels.len() as u32, 1, pixels)
    };
    let (rendered, truth) = (chosen(rendered), chosen(truth));
    (!truth.pixels.is_empty()).then(|| psnr(&rendered, &truth))
}

/// Structural similarity: 11 x 11 Gaussian window of standard deviation 1.5, zero padding of 5 pixels,
/// C1 = 1e-4, C2 = 9e-4, range 1, the render clamped to [0, 1]; mean over pixels and channels.
///
/// Zero padding darkens the windows at the border on both sides alike, which raises the similarity there;
/// values are comparable only with implementations that pad the same way.
///
/// # Panics
/// When the sizes differ.
#[must_use]
pub fn ssim(rendered: &PixelGrid<[f32; 3]>, truth: &PixelGrid<[f32; 3]>) -> f64 {
    assert_same_size(rendered, truth);
    let (width, height) = (truth.width as usize, truth.height as usize);
    let window = window();
    // Sums of bands are added in their order, so that the mean does not depend on the threads.
    let sums: Vec<f64> = (0..height.div_ceil(BAND))
        .into_par_iter()
        .map(|band| {
            let rows = band * BAND..height.min((band + 1) * BAND);
            let around = rows.start.saturating_sub(PADDING)..height.min(rows.end + PADDING);
            // Moments x, y, x^2, y^2, xy of each of the three channels, blurred along the rows.
            let mut blurred = vec![[[0.0f64; 5]; 3]; width * around.len()];
            for (row, out) in around.clone().zip(blurred.chunks_mut(width.max(1))) {
                let line = row * width..(row + 1) * width;
                let moments: Vec<[[f64; 5]; 3]> = rendered.pixels[line.clone()]
                    .iter()
                    .zip(&truth.pixels[line])
                    .map(|(x, y)| {
                        std::array::from_fn(|channel| {
                            let (x, y) = (f64::from(x[channel].clamp(0.0, 1.0)), f64::from(y[channel]));
                            [x, y, x * x, y * y, x * y]
                        })
                    })
                    .collect();
                for (column, sum) in out.iter_mut().enumerate() {
                    for tap in taps(column, width) {
                        add_scaled(sum, &moments[column + tap - PADDING], window[tap]);
                    }
                }
            }
            let mut similarities = 0.0;
            for row in rows {
                let mut line = vec![[[0.0f64; 5]; 3]; width];
                for tap in taps(row, height) {
                    let source = (row + tap - PADDING - around.start) * width;
                    for (sum, value) in line.iter_mut().zip(&blurred[source..source + width]) {
                        add_scaled(sum, value, window[tap]);
                    }
                }
                similarities += line.iter().flatten().map(similarity).sum::<f64>();
            }
            similarities
        })
        .collect();
    sums.iter().sum::<f64>() / (width * height * 3) as f64
}

/// Window positions that fall inside a line of `length` pixels when centred at `centre`.
fn taps(centre: usize, length: usize) -> std::ops::Range<usize> {
    PADDING.saturating_sub(centre)..WINDOW.min(length + PADDING - centre)
}

fn add_scaled(sum: &mut [[f64; 5]; 3], value: &[[f64; 5]; 3], weight: f64) {
    for channel in 0..3 {
        for moment in 0..5 {
            sum[channel][moment] += weight * value[channel][moment];
        }
    }
}

fn similarity(&[mean_x, mean_y, xx, yy, xy]: &[f64; 5]) -> f64 {
    let (variance_x, variance_y) = (xx - mean_x * mean_x, yy - mean_y * mean_y);
    let covariance = xy - mean_x * mean_y;
    (2.0 * mean_x * mean_y + C1) * (2.0 * covariance + C2)
        / ((mean_x * mean_x + mean_y * mean_y + C1) * (variance_x + variance_y + C2))
}

fn window() -> [f64; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|tap| {
        let offset = tap as f64 - PADDING as f64;
        (-offset * offset / (2.0 * WINDOW_SIGMA * WINDOW_SIGMA)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|value| value / sum)
}

fn assert_same_size(rendered: &PixelGrid<[f32; 3]>, truth: &PixelGrid<[f32; 3]>) {
    assert_eq!(
        (rendered.width, rendered.height),
        (truth.width, truth.height),
        "a render is compared with a truth of another size"
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width: u32, height: u32, value: f32) -> PixelGrid<[f32; 3]> {
        PixelGrid::filled(width, height, [value; 3])
    }

    fn noise(width: u32, height: u32, seed: u32) -> PixelGrid<[f32; 3]> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let pixels = (0..width * height).map(|_| [next(), next(), next()]).collect();
        PixelGrid::from_pixels(width, height, pixels)
    }

    #[test]
    fn psnr_of_a_constant_error() {
        // MSE 0.01 is 20 dB.
        assert!((psnr(&flat(5, 3, 0.6), &flat(5, 3, 0.5)) - 20.0).abs() < 1e-5);
    }

    #[test]
    fn a_masked_psnr_is_that_of_the_pixels_that_count() {
        let (mut rendered, truth) = (flat(4, 1, 0.6), flat(4, 1, 0.5));
        rendered.pixels[1] = [1.0; 3];
        let counts = |marks: [bool; 4]| PixelGrid::from_pixels(4, 1, marks.to_vec());
        let value = |marks| masked_psnr(&rendered, &truth, &counts(marks));
        assert!((value([true, false, true, true]).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(value([true; 4]), Some(psnr(&rendered, &truth)));
        assert_eq!(value([false; 4]), None);
    }

    #[test]
    fn psnr_clamps_the_render_and_not_the_truth() {
        assert!(psnr(&flat(4, 4, 7.0), &flat(4, 4, 1.0)).is_infinite());
        assert!((psnr(&flat(4, 4, -3.0), &flat(4, 4, 0.1)) - 20.0).abs() < 1e-5);
    }

    #[test]
    fn ssim_of_equal_pictures_is_one() {
        let picture = noise(17, 9, 1);
        assert!((ssim(&picture, &picture) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn ssim_of_flat_pictures_away_from_the_border() {
        // Without variance only the luminance term is left. The border is zero-padded, so compare a picture
        // large enough that the interior decides, with the border's share bounded.
        let (x, y) = (0.4f64, 0.8f64);
        let interior = (2.0 * x * y + C1) / (x * x + y * y + C1);
        let value = ssim(&flat(400, 400, 0.4), &flat(400, 400, 0.8));
        assert!((value - interior).abs() < 0.02, "{value} {interior}");
    }

    /// The textbook double loop with explicit zero padding.
    fn naive_ssim(rendered: &PixelGrid<[f32; 3]>, truth: &PixelGrid<[f32; 3]>) -> f64 {
        let g = window();
        let (width, height) = (truth.width as i64, truth.height as i64);
        let mut total = 0.0;
        for channel in 0..3 {
            for row in 0..height {
                for column in 0..width {
                    let mut m = [0.0; 5];
                    for dy in -5..=5i64 {
                        for dx in -5..=5i64 {
                            let (r, c) = (row + dy, column + dx);
                            if r < 0 || r >= height || c < 0 || c >= width {
                                continue;
                            }
                            let at = (r * width + c) as usize;
                            let x = f64::from(rendered.pixels[at][channel]);
                            let y = f64::from(truth.pixels[at][channel]);
                            let w = g[(dy + 5) as usize] * g[(dx + 5) as usize];
                            for (sum, v) in m.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                                *sum += w * v;
                            }
                        }
                    }
                    total += similarity(&m);
                }
            }
        }
        total / (3 * width * height) as f64
    }

    #[test]
    fn ssim_equals_the_direct_sum() {
        for (width, height) in [(23, 14), (3, 20), (7, 1), (1, 1), (4, 71), (9, 64)] {
            let (a, b) = (noise(width, height, 3), noise(width, height, 4));
            let (fast, slow) = (ssim(&a, &b), naive_ssim(&a, &b));
            assert!((fast - slow).abs() < 1e-10, "{width} x {height}: {fast} {slow}");
        }
    }

    #[test]
    fn window_sums_to_one() {
        assert!((window().iter().sum::<f64>() - 1.0).abs() < 1e-15);
    }

    #[test]
    #[should_panic(expected = "another size")]
    fn sizes_must_agree() {
        let _ = psnr(&flat(2, 2, 0.0), &flat(2, 3, 0.0));
    }
}
