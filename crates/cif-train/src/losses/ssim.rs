//! Structural similarity and its gradient. Source: Wang et al. 2004; gradient from methods reference 1.4.
//!
//! Rows pass through once: each is blurred along itself into a ring of as many rows as the window has, and the ring is
//! blurred across into one row of results, so that all of it stays in the cache of the thread that works on a band. Only
//! the three maps that the gradient blurs again are kept for the whole image.

use std::sync::OnceLock;

use bytemuck::{Pod, Zeroable};
use cif_geometry::PixelGrid;
use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, f32x16};
use fearless_simd_macros::simd;
use rayon::prelude::*;

use super::rows::{LANES, row_sum, unit};

/// Half the window: 11 taps.
pub(crate) const RADIUS: usize = 5;

/// Taps of the window.
const TAPS: usize = 2 * RADIUS + 1;

/// Standard deviation of the window, pixels.
const SIGMA: f64 = 1.5;

/// `(0.01)^2` and `(0.03)^2` for colours in [0, 1].
pub(crate) const C1: f32 = 1e-4;
pub(crate) const C2: f32 = 9e-4;

/// Rows of a band. Each band also blurs [`RADIUS`] rows above and below along themselves.
const BAND: usize = 32;

/// Channels of a pixel, which lie side by side.
const CHANNELS: usize = 3;

/// Memory kept between calls.
#[derive(Clone, Debug, Default)]
pub struct SsimScratch {
    /// `v D`, `v E` and `v F` of every value, before they are blurred; rows are padded.
    maps: [Vec<Vector>; 3],
}

/// A view with its target, `[height, width, 3]` each.
#[derive(Clone, Copy)]
struct Compared<'a> {
    /// Colours of the view, in [0, 1] where they are in range.
    rendered: &'a [f32],
    /// Those of the frame, 8 bits.
    target: &'a [u8],
}

/// Memory of one band at work, for some maps at once.
struct Band<const MAPS: usize> {
    /// Values of a row.
    length: usize,
    /// Vectors of a row.
    vectors: usize,
    /// A row of each map between zeros.
    padded: [Vec<f32>; MAPS],
    /// The last rows blurred along themselves, `[TAPS, vectors]`; a row lies at its index modulo [`TAPS`].
    ring: [Vec<Vector>; MAPS],
    /// A row blurred both ways.
    blurred: [Vec<Vector>; MAPS],
}

/// Values that begin a cache line, so that no load goes across two.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C, align(64))]
struct Vector([f32; LANES]);

/// Normalised taps from the centre outwards.
pub(crate) fn window() -> [f32; RADIUS + 1] {
    static WINDOW: OnceLock<[f32; RADIUS + 1]> = OnceLock::new();
    *WINDOW.get_or_init(|| {
        let tap = |k: usize| (-(k as f64 * k as f64) / (2.0 * SIGMA * SIGMA)).exp();
        let sum = tap(0) + 2.0 * (1..=RADIUS).map(tap).sum::<f64>();
        std::array::from_fn(|k| (tap(k) / sum) as f32)
    })
}

/// Zeros on either side of a row.
const MARGIN: usize = RADIUS * CHANNELS;

impl<const MAPS: usize> Band<MAPS> {
    fn new(length: usize) -> Self {
        let vectors = length.div_ceil(LANES);
        Self {
            length,
            vectors,
            padded: std::array::from_fn(|_| vec![0.0; vectors * LANES + 2 * MARGIN]),
            ring: std::array::from_fn(|_| vec![Vector([0.0; LANES]); TAPS * vectors]),
            blurred: std::array::from_fn(|_| vec![Vector([0.0; LANES]); vectors]),
        }
    }

    /// The padded rows, without their margins.
    #[inline(always)]
    fn rows_mut(&mut self) -> [&mut [f32]; MAPS] {
        let length = self.length;
        self.padded.each_mut().map(|row| &mut row[MARGIN..MARGIN + length])
    }

    /// Blurs the padded rows along themselves into the ring, as row `row` counted from [`RADIUS`] above the band.
    #[inline(always)]
    fn blur_along<S: Simd>(&mut self, simd: S, row: usize) {
        let (place, vectors, taps) = (row % TAPS * self.vectors, self.vectors, window());
        for (padded, ring) in self.padded.iter().zip(&mut self.ring) {
            let mut at = [&padded.as_chunks::<LANES>().0[..vectors]; TAPS];
            for (tap, at) in at.iter_mut().enumerate() {
                *at = &padded[tap * CHANNELS..].as_chunks::<LANES>().0[..vectors];
            }
            for (k, Vector(out)) in ring[place..place + vectors].iter_mut().enumerate() {
                let mut under = [f32x16::splat(simd, 0.0); TAPS];
                for tap in 0..TAPS {
                    under[tap] = load(simd, &at[tap][k]);
                }
                blurred(simd, &taps, under).store_array(out);
            }
        }
    }

    /// Sets a row outside the image to zero.
    fn clear(&mut self, row: usize) {
        let place = row % TAPS * self.vectors;
        for ring in &mut self.ring {
            ring[place..place + self.vectors].fill(Vector([0.0; LANES]));
        }
    }

    /// Blurs the ring across, whose first row is `row`.
    #[inline(always)]
    fn blur_across<S: Simd>(&mut self, simd: S, row: usize) {
        let (vectors, taps) = (self.vectors, window());
        for (ring, out) in self.ring.iter().zip(&mut self.blurred) {
            let mut at = [&ring[..vectors]; TAPS];
            for (tap, at) in at.iter_mut().enumerate() {
                *at = &ring[(row + tap) % TAPS * vectors..][..vectors];
            }
            for (k, Vector(out)) in out[..vectors].iter_mut().enumerate() {
                let mut under = [f32x16::splat(simd, 0.0); TAPS];
                for tap in 0..TAPS {
                    under[tap] = load(simd, &at[tap][k].0);
                }
                blurred(simd, &taps, under).store_array(out);
            }
        }
    }
}

/// Sum of the values under the taps of the window.
#[inline(always)]
fn blurred<S: Simd>(simd: S, taps: &[f32; RADIUS + 1], under: [f32x16<S>; TAPS]) -> f32x16<S> {
    let mut sum = under[RADIUS] * taps[0];
    for distance in 1..=RADIUS {
        let pair = under[RADIUS - distance] + under[RADIUS + distance];
        sum = pair.mul_add(f32x16::splat(simd, taps[distance]), sum);
    }
    sum
}

/// The first values of some vectors.
fn flattened(vectors: &[Vector], length: usize) -> &[f32] {
    &bytemuck::cast_slice(vectors)[..length]
}

#[inline(always)]
fn load<S: Simd>(simd: S, values: &[f32; LANES]) -> f32x16<S> {
    f32x16::load_array_ref(simd, values)
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
        let compared =
            Compared { rendered: rendered.pixels.as_flattened(), target: target.pixels.as_flattened() };
        let values = compared.rendered.len();
        let length = (rendered.width as usize).max(1) * CHANNELS;
        let vectors = length.div_ceil(LANES);
        for map in &mut self.maps {
            map.resize(values / length * vectors, Vector([0.0; LANES]));
        }
        let v = (f64::from(weight) / values.max(1) as f64) as f32;
        let level = Level::new();
        let [d, e, f] = &mut self.maps;
        let size = BAND * vectors;
        // Sums of bands are added in order, so that the value does not depend on threads.
        let sums: Vec<f64> = d
            .par_chunks_mut(size)
            .zip(e.par_chunks_mut(size))
            .zip(f.par_chunks_mut(size))
            .enumerate()
            .map_init(
                || Band::new(length),
                |band, (index, ((d, e), f))| {
                    dispatch!(level, simd => similarity(simd, band, compared, index * BAND, v, [&mut *d, &mut *e, &mut *f]))
                },
            )
            .collect();
        let maps = &self.maps;
        v_color.pixels.as_flattened_mut().par_chunks_mut(BAND * length).enumerate().for_each_init(
            || Band::new(length),
            |band, (index, v_color)| {
                dispatch!(level, simd => add_blurred(simd, band, maps, compared, index * BAND, v_color));
            },
        );
        sums.iter().sum::<f64>() / values.max(1) as f64
    }
}

/// Sum of the similarity of a band that starts at a row of an image, and its `v D`, `v E`, `v F`.
#[simd]
fn similarity<S: Simd>(
    simd: S,
    band: &mut Band<5>,
    compared: Compared<'_>,
    start: usize,
    v: f32,
    [d, e, f]: [&mut [Vector]; 3],
) -> f64 {
    let Compared { rendered: x, target: y } = compared;
    let length = band.length;
    let (height, rows) = (x.len() / length, d.len() / band.vectors);
    let mut sum = 0.0;
    for around in 0..rows + 2 * RADIUS {
        match (start + around).checked_sub(RADIUS).filter(|row| *row < height) {
            None => band.clear(around),
            Some(row) => {
                let (x, y) = (&x[row * length..][..length], &y[row * length..][..length]);
                let [m1, m2, xx, yy, xy] = band.rows_mut();
                for k in 0..length {
                    let (x, y) = (x[k], unit(y[k]));
                    (m1[k], m2[k], xx[k], yy[k], xy[k]) = (x, y, x * x, y * y, x * y);
                }
                band.blur_along(simd, around);
            }
        }
        let Some(row) = around.checked_sub(2 * RADIUS) else { continue };
        band.blur_across(simd, row);
        let vectors = band.vectors;
        let [d, e, f] = [&mut *d, &mut *e, &mut *f].map(|map| &mut map[row * vectors..][..vectors]);
        compare(simd, &mut band.blurred, v, [d, e, f]);
        sum += row_sum(flattened(&band.blurred[0], length), |here| here);
    }
    sum
}

/// The similarity of a row from its blurred maps, of which it replaces the first; and `v D`, `v E`, `v F`.
#[inline(always)]
fn compare<S: Simd>(simd: S, blurred: &mut [Vec<Vector>; 5], v: f32, [d, e, f]: [&mut [Vector]; 3]) {
    let [similarity, m2, xx, yy, xy] = blurred;
    let one = f32x16::splat(simd, 1.0);
    let maps = similarity.iter_mut().zip(m2).zip(xx).zip(yy).zip(xy);
    for (((((((first, m2), xx), yy), xy), d), e), f) in maps.zip(d).zip(e).zip(f) {
        let (m1, m2) = (load(simd, &first.0), load(simd, &m2.0));
        let product = m1 * m2;
        let squares = m1.mul_add(m1, m2 * m2);
        let luminance = product * 2.0 + C1;
        let structure = (load(simd, &xy.0) - product) * 2.0 + C2;
        let over_c = one / (squares + C1);
        let over_s = one / (load(simd, &xx.0) + load(simd, &yy.0) - squares + C2);
        let over_both = over_c * over_s * (2.0 * v);
        let here = luminance * structure * over_c * over_s;
        here.store_array(&mut first.0);
        let along = m1 * here * (over_s - over_c) * (2.0 * v);
        (m2 * (structure - luminance)).mul_add(over_both, along).store_array(&mut d.0);
        (here * over_s * -v).store_array(&mut e.0);
        (luminance * over_both).store_array(&mut f.0);
    }
}

/// Adds the blurred maps of a band that starts at a row, times what the similarity depends on, to its gradient.
#[simd]
fn add_blurred<S: Simd>(
    simd: S,
    band: &mut Band<3>,
    maps: &[Vec<Vector>; 3],
    compared: Compared<'_>,
    start: usize,
    v_color: &mut [f32],
) {
    let Compared { rendered: x, target: y } = compared;
    let (length, vectors) = (band.length, band.vectors);
    let (height, rows) = (x.len() / length, v_color.len() / length);
    for around in 0..rows + 2 * RADIUS {
        match (start + around).checked_sub(RADIUS).filter(|row| *row < height) {
            None => band.clear(around),
            Some(row) => {
                for (padded, map) in band.rows_mut().into_iter().zip(maps) {
                    padded.copy_from_slice(flattened(&map[row * vectors..][..vectors], length));
                }
                band.blur_along(simd, around);
            }
        }
        let Some(row) = around.checked_sub(2 * RADIUS) else { continue };
        band.blur_across(simd, row);
        let here = (start + row) * length;
        let (x, y) = (&x[here..][..length], &y[here..][..length]);
        let [d, e, f] = band.blurred.each_ref().map(|map| flattened(map, length));
        let v_color = &mut v_color[row * length..][..length];
        for k in 0..length {
            v_color[k] += d[k] + 2.0 * x[k] * e[k] + unit(y[k]) * f[k];
        }
    }
}
