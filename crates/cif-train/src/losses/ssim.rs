//! Structural similarity and its gradient. Source: Wang et al. 2004; gradient from methods reference 1.4.
//!
//! The five blurred maps of the similarity are made and used band by band, so that they stay in the cache of the thread
//! that works on the band; only the three maps that the gradient blurs again are kept for the whole image.

use std::sync::OnceLock;

use cif_geometry::PixelGrid;
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::unit;

/// Half the window: 11 taps.
pub(crate) const RADIUS: usize = 5;

/// Standard deviation of the window, pixels.
const SIGMA: f64 = 1.5;

/// `(0.01)^2` and `(0.03)^2` for colours in [0, 1].
pub(crate) const C1: f32 = 1e-4;
pub(crate) const C2: f32 = 9e-4;

/// Rows of a band. Each is blurred along its rows with [`RADIUS`] rows more above and below.
const BAND: usize = 16;

/// Channels of a pixel, which lie side by side.
const CHANNELS: usize = 3;

/// Memory kept between calls.
#[derive(Clone, Debug, Default)]
pub struct SsimScratch {
    /// `v D`, `v E` and `v F` of every value, before they are blurred.
    maps: [Vec<f32>; 3],
}

/// Memory of one band at work.
#[derive(Default)]
struct Band {
    /// A row between zeros.
    padded: Vec<f32>,
    /// Maps blurred along their rows, `[rows with those around, values of a row]` each.
    along: [Vec<f32>; 5],
    /// Maps blurred both ways, `[rows, values of a row]` each.
    blurred: [Vec<f32>; 5],
}

/// Normalised taps from the centre outwards.
pub(crate) fn window() -> [f32; RADIUS + 1] {
    static TAPS: OnceLock<[f32; RADIUS + 1]> = OnceLock::new();
    *TAPS.get_or_init(|| {
        let tap = |k: usize| (-(k as f64 * k as f64) / (2.0 * SIGMA * SIGMA)).exp();
        let sum = tap(0) + 2.0 * (1..=RADIUS).map(tap).sum::<f64>();
        std::array::from_fn(|k| (tap(k) / sum) as f32)
    })
}

/// The row of a band with its surroundings: `None` above and below the image, which counts as zeros.
fn row_of(start: usize, around: usize, height: usize) -> Option<usize> {
    (start + around).checked_sub(RADIUS).filter(|row| *row < height)
}

impl Band {
    /// Blurs a row of values into one of the maps; `value` gives the values, one by one.
    #[inline(always)]
    fn blur_along(&mut self, map: usize, around: usize, length: usize, value: impl Fn(usize) -> f32) {
        const MARGIN: usize = RADIUS * CHANNELS;
        self.padded.resize(length + 2 * MARGIN, 0.0);
        for (k, padded) in self.padded[MARGIN..MARGIN + length].iter_mut().enumerate() {
            *padded = value(k);
        }
        let out = &mut self.along[map];
        out.resize((BAND + 2 * RADIUS) * length, 0.0);
        let out = &mut out[around * length..(around + 1) * length];
        blurred(out, |tap| &self.padded[tap * CHANNELS..][..length]);
    }

    /// Sets a row outside the image to zero.
    fn clear_along(&mut self, maps: usize, around: usize, length: usize) {
        for out in &mut self.along[..maps] {
            out.resize((BAND + 2 * RADIUS) * length, 0.0);
            out[around * length..(around + 1) * length].fill(0.0);
        }
    }

    /// Blurs the first maps across their rows.
    #[inline(always)]
    fn blur_across(&mut self, maps: usize, rows: usize, length: usize) {
        for (out, along) in self.blurred[..maps].iter_mut().zip(&self.along) {
            out.resize(BAND * length, 0.0);
            for (row, out) in out.chunks_exact_mut(length).take(rows).enumerate() {
                blurred(out, |tap| &along[(row + tap) * length..][..length]);
            }
        }
    }
}

/// Sums values under the window, `at` giving those that lie under each of its taps, from the first to the last.
#[inline(always)]
fn blurred<'a>(out: &mut [f32], at: impl Fn(usize) -> &'a [f32]) {
    let taps = window();
    let centre = at(RADIUS);
    let [[a1, b1], [a2, b2], [a3, b3], [a4, b4], [a5, b5]] =
        [1, 2, 3, 4, 5].map(|k| [at(RADIUS - k), at(RADIUS + k)]);
    for k in 0..out.len() {
        out[k] = taps[0] * centre[k]
            + taps[1] * (a1[k] + b1[k])
            + taps[2] * (a2[k] + b2[k])
            + taps[3] * (a3[k] + b3[k])
            + taps[4] * (a4[k] + b4[k])
            + taps[5] * (a5[k] + b5[k]);
    }
}

impl SsimScratch {
    /// Mean structural similarity over pixels and channels; adds its gradient times `weight` to `v_color`.
    pub(super) fn add_gradient(
        &mut self,
        rendered: &PixelGrid<[f32; CHANNELS]>,
        target: &PixelGrid<[u8; CHANNELS]>,
        weight: f32,
        v_color: &mut PixelGrid<[f32; CHANNELS]>,
    ) -> f64 {
        let (x, y) = (rendered.pixels.as_flattened(), target.pixels.as_flattened());
        let length = (rendered.width as usize).max(1) * CHANNELS;
        let height = x.len() / length;
        for map in &mut self.maps {
            map.resize(x.len(), 0.0);
        }
        let v = (f64::from(weight) / x.len().max(1) as f64) as f32;
        let level = Level::new();
        let [d, e, f] = &mut self.maps;
        let size = BAND * length;
        // Sums of bands are added in order, so that the value does not depend on threads.
        let sums: Vec<f64> = d
            .par_chunks_mut(size)
            .zip(e.par_chunks_mut(size))
            .zip(f.par_chunks_mut(size))
            .enumerate()
            .map_init(Band::default, |band, (index, ((d, e), f))| {
                let rows = (index * BAND, height);
                dispatch!(level, _simd => similarity(band, (x, y), rows, length, v, [&mut *d, &mut *e, &mut *f]))
            })
            .collect();
        let maps = &self.maps;
        v_color.pixels.as_flattened_mut().par_chunks_mut(size).enumerate().for_each_init(
            Band::default,
            |band, (index, v_color)| {
                let rows = (index * BAND, height);
                dispatch!(level, _simd => add_blurred(band, maps, (x, y), rows, length, v_color));
            },
        );
        sums.iter().sum::<f64>() / x.len().max(1) as f64
    }
}

/// Sum of the similarity of a band that starts at a row of an image of some height, and its `v D`, `v E`, `v F`.
#[inline(always)]
fn similarity(
    band: &mut Band,
    (x, y): (&[f32], &[u8]),
    (start, height): (usize, usize),
    length: usize,
    v: f32,
    [d, e, f]: [&mut [f32]; 3],
) -> f64 {
    let rows = d.len() / length;
    for around in 0..rows + 2 * RADIUS {
        let Some(row) = row_of(start, around, height) else {
            band.clear_along(5, around, length);
            continue;
        };
        let (x, y) = (&x[row * length..][..length], &y[row * length..][..length]);
        band.blur_along(0, around, length, |k| x[k]);
        band.blur_along(1, around, length, |k| unit(y[k]));
        band.blur_along(2, around, length, |k| x[k] * x[k]);
        band.blur_along(3, around, length, |k| unit(y[k]) * unit(y[k]));
        band.blur_along(4, around, length, |k| x[k] * unit(y[k]));
    }
    band.blur_across(5, rows, length);
    let count = d.len();
    let [m1, m2, xx, yy, xy] = band.blurred.each_ref().map(|map| &map[..count]);
    let (d, e, f) = (&mut d[..count], &mut e[..count], &mut f[..count]);
    let mut sum = 0.0;
    // In parts of few values, whose sum in single precision is as good as exact.
    for part in (0..count).step_by(64) {
        let mut part_sum = [0.0_f32; 8];
        for k in part..(part + 64).min(count) {
            let (m1, m2) = (m1[k], m2[k]);
            let (s1, s2, s12) = (xx[k] - m1 * m1, yy[k] - m2 * m2, xy[k] - m1 * m2);
            let (luminance, structure) = (2.0 * m1 * m2 + C1, 2.0 * s12 + C2);
            let (c, s) = (m1 * m1 + m2 * m2 + C1, s1 + s2 + C2);
            let similarity = luminance * structure / (c * s);
            part_sum[k % 8] += similarity;
            d[k] = v
                * (2.0 * m2 * (structure - luminance) / (c * s) - 2.0 * m1 * similarity / c
                    + 2.0 * m1 * similarity / s);
            e[k] = v * (-similarity / s);
            f[k] = v * (2.0 * luminance / (c * s));
        }
        sum += part_sum.iter().copied().map(f64::from).sum::<f64>();
    }
    sum
}

/// Adds the blurred maps of a band, times what the similarity depends on, to its gradient.
#[inline(always)]
fn add_blurred(
    band: &mut Band,
    maps: &[Vec<f32>; 3],
    (x, y): (&[f32], &[u8]),
    (start, height): (usize, usize),
    length: usize,
    v_color: &mut [f32],
) {
    let rows = v_color.len() / length;
    for around in 0..rows + 2 * RADIUS {
        let Some(row) = row_of(start, around, height) else {
            band.clear_along(3, around, length);
            continue;
        };
        for (map, values) in maps.iter().enumerate() {
            let values = &values[row * length..][..length];
            band.blur_along(map, around, length, |k| values[k]);
        }
    }
    band.blur_across(3, rows, length);
    let count = v_color.len();
    let (x, y) = (&x[start * length..][..count], &y[start * length..][..count]);
    let [d, e, f, ..] = band.blurred.each_ref().map(|map| &map[..map.len().min(count)]);
    for k in 0..count {
        v_color[k] += d[k] + 2.0 * x[k] * e[k] + unit(y[k]) * f[k];
    }
}
