//! Colour loss of a view and its gradient. Source: methods reference 1.4.

use cif_geometry::PixelGrid;
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::rows::{row_sum, unit};
use super::ssim::SsimScratch;

/// Loss of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ColorLoss {
    /// `(1 - lambda) L1 + lambda (1 - SSIM)`, mean over pixels and channels.
    pub loss: f64,
    /// Mean squared error over pixels and channels, colours in [0, 1].
    pub mean_squared_error: f64,
}

impl ColorLoss {
    /// Peak signal-to-noise ratio, dB; infinite for equal images.
    #[must_use]
    pub fn psnr(&self) -> f64 {
        -10.0 * self.mean_squared_error.log10()
    }
}

/// Colour loss of one view. `v_color` is overwritten with its gradient times `weight` (one over the views of
/// the step), and takes the size of the image.
///
/// # Panics
/// When the sizes of the images differ.
pub fn color_loss(
    rendered: &PixelGrid<[f32; 3]>,
    target: &PixelGrid<[u8; 3]>,
    lambda_dssim: f32,
    weight: f32,
    v_color: &mut PixelGrid<[f32; 3]>,
    scratch: &mut SsimScratch,
) -> ColorLoss {
    assert_eq!(
        (rendered.width, rendered.height),
        (target.width, target.height),
        "the render and its target differ in size"
    );
    v_color.width = rendered.width;
    v_color.height = rendered.height;
    v_color.pixels.resize(rendered.pixels.len(), [0.0; 3]);
    let values = (rendered.pixels.len() * 3).max(1) as f64;
    let v = ((f64::from(1.0 - lambda_dssim) * f64::from(weight)) / values) as f32;
    let row = (rendered.width as usize).max(1);
    let level = Level::new();
    // Row sums are added in order, so that the value does not depend on threads.
    let sums: Vec<(f64, f64)> = v_color
        .pixels
        .par_chunks_mut(row)
        .zip(rendered.pixels.par_chunks(row))
        .zip(target.pixels.par_chunks(row))
        .map_init(Vec::new, |differences, ((v_color, rendered), target)| {
            let (v_color, rendered) = (v_color.as_flattened_mut(), rendered.as_flattened());
            let target = target.as_flattened();
            dispatch!(level, _simd => absolute_difference(v_color, rendered, target, v, differences))
        })
        .collect();
    let (absolute, squared) = sums.iter().fold((0.0, 0.0), |sum, row| (sum.0 + row.0, sum.1 + row.1));
    let mut loss = f64::from(1.0 - lambda_dssim) * absolute / values;
    if lambda_dssim > 0.0 {
        let ssim = scratch.add_gradient(rendered, target, -lambda_dssim * weight, v_color);
        loss += f64::from(lambda_dssim) * (1.0 - ssim);
    }
    ColorLoss { loss, mean_squared_error: squared / values }
}

/// Sums of absolute and of squared differences of a row, and the gradient of the first times `v`.
#[inline(always)]
fn absolute_difference(
    v_color: &mut [f32],
    rendered: &[f32],
    target: &[u8],
    v: f32,
    differences: &mut Vec<f32>,
) -> (f64, f64) {
    differences.clear();
    differences.extend(rendered.iter().zip(target).map(|(rendered, target)| rendered - unit(*target)));
    for (v_color, difference) in v_color.iter_mut().zip(&*differences) {
        *v_color = v * (f32::from(*difference > 0.0) - f32::from(*difference < 0.0));
    }
    (row_sum(differences, f32::abs), row_sum(differences, |difference| difference * difference))
}
