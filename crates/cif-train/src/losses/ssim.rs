//! Structural similarity and its gradient. Source: Wang et al. 2004; gradient from methods reference 1.4.

use cif_geometry::PixelGrid;
use rayon::prelude::*;

use super::unit;

/// Half the window: 11 taps.
pub(crate) const RADIUS: usize = 5;

/// Standard deviation of the window, pixels.
const SIGMA: f64 = 1.5;

/// `(0.01)^2` and `(0.03)^2` for colours in [0, 1].
pub(crate) const C1: f32 = 1e-4;
pub(crate) const C2: f32 = 9e-4;

/// Memory kept between calls.
#[derive(Clone, Debug, Default)]
pub struct SsimScratch {
    x: Vec<f32>,
    y: Vec<f32>,
    product: Vec<f32>,
    row_pass: Vec<f32>,
    /// Blurred x, y, x^2, y^2, x y; then D, E, F and their blurs.
    maps: [Vec<f32>; 6],
}

/// Normalised taps from the centre outwards.
pub(crate) fn window() -> [f32; RADIUS + 1] {
    let tap = |k: usize| (-(k as f64 * k as f64) / (2.0 * SIGMA * SIGMA)).exp();
    let sum = tap(0) + 2.0 * (1..=RADIUS).map(tap).sum::<f64>();
    std::array::from_fn(|k| (tap(k) / sum) as f32)
}

/// Separable blur with zero padding.
fn blur(source: &[f32], row_pass: &mut [f32], target: &mut [f32], width: usize) {
    let taps = window();
    let height = source.len() / width;
    row_pass.par_chunks_mut(width).zip(source.par_chunks(width)).for_each(|(out, row)| {
        for (x, out) in out.iter_mut().enumerate() {
            let mut sum = taps[0] * row[x];
            for (k, tap) in taps.iter().enumerate().skip(1) {
                if x >= k {
                    sum += tap * row[x - k];
                }
                if x + k < width {
                    sum += tap * row[x + k];
                }
            }
            *out = sum;
        }
    });
    let rows = &*row_pass;
    target.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (out, value) in out.iter_mut().zip(&rows[y * width..]) {
            *out = taps[0] * value;
        }
        for (k, tap) in taps.iter().enumerate().skip(1) {
            for other in [y.checked_sub(k), Some(y + k)].into_iter().flatten().filter(|o| *o < height) {
                for (out, value) in out.iter_mut().zip(&rows[other * width..]) {
                    *out += tap * value;
                }
            }
        }
    });
}

impl SsimScratch {
    /// Mean structural similarity over pixels and channels; adds its gradient times `weight` to `v_color`.
    pub(super) fn add_gradient(
        &mut self,
        rendered: &PixelGrid<[f32; 3]>,
        target: &PixelGrid<[u8; 3]>,
        weight: f32,
        v_color: &mut PixelGrid<[f32; 3]>,
    ) -> f64 {
        let pixels = rendered.pixels.len();
        let width = (rendered.width as usize).max(1);
        for buffer in [&mut self.x, &mut self.y, &mut self.product, &mut self.row_pass] {
            buffer.resize(pixels, 0.0);
        }
        for map in &mut self.maps {
            map.resize(pixels, 0.0);
        }
        let values = (pixels * 3).max(1) as f64;
        let v = (f64::from(weight) / values) as f32;
        let mut sum = 0.0;
        for channel in 0..3 {
            for (x, pixel) in self.x.iter_mut().zip(&rendered.pixels) {
                *x = pixel[channel];
            }
            for (y, pixel) in self.y.iter_mut().zip(&target.pixels) {
                *y = unit(pixel[channel]);
            }
            sum += self.channel(width, v);
            let [d, e, f, ..] = &self.maps;
            for (k, v_color) in v_color.pixels.iter_mut().enumerate() {
                v_color[channel] += d[k] + 2.0 * self.x[k] * e[k] + self.y[k] * f[k];
            }
        }
        sum / values
    }

    /// Sum of the similarity of one channel; leaves the blurred `v D`, `v E`, `v F` in the first three maps.
    fn channel(&mut self, width: usize, v: f32) -> f64 {
        let Self { x, y, product, row_pass, maps } = self;
        let multiply = |product: &mut [f32], a: &[f32], b: &[f32]| {
            for ((product, a), b) in product.iter_mut().zip(a).zip(b) {
                *product = a * b;
            }
        };
        blur(x, row_pass, &mut maps[0], width);
        blur(y, row_pass, &mut maps[1], width);
        multiply(product, x, x);
        blur(product, row_pass, &mut maps[2], width);
        multiply(product, y, y);
        blur(product, row_pass, &mut maps[3], width);
        multiply(product, x, y);
        blur(product, row_pass, &mut maps[4], width);
        let [m1s, m2s, xx, yy, xy, spare] = maps;
        let mut sum = 0.0;
        for k in 0..x.len() {
            let (m1, m2) = (m1s[k], m2s[k]);
            let (s1, s2, s12) = (xx[k] - m1 * m1, yy[k] - m2 * m2, xy[k] - m1 * m2);
            let (a, b) = (2.0 * m1 * m2 + C1, 2.0 * s12 + C2);
            let (c, d) = (m1 * m1 + m2 * m2 + C1, s1 + s2 + C2);
            let similarity = a * b / (c * d);
            sum += f64::from(similarity);
            xx[k] =
                v * (2.0 * m2 * (b - a) / (c * d) - 2.0 * m1 * similarity / c + 2.0 * m1 * similarity / d);
            yy[k] = v * (-similarity / d);
            xy[k] = v * (2.0 * a / (c * d));
        }
        blur(xx, row_pass, spare, width);
        m1s.copy_from_slice(spare);
        blur(yy, row_pass, spare, width);
        m2s.copy_from_slice(spare);
        blur(xy, row_pass, spare, width);
        xx.copy_from_slice(spare);
        sum
    }
}
