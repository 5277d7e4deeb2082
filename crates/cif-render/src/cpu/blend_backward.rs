//! Gradient of the values that were blended over a tile, and of their weights where asked for. Source: methods
//! reference 3.2, with the values in place of colours and nothing behind them.
//!
//! A splat's weights are found once and kept for all channels, which are taken four at a time.

use fearless_simd::f32x16;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::blend::DrawnSplats;
use super::pixels::{LANES, Lanes, load, splat, sum_each};
use super::project::Splat;
use super::project_backward::SplatGradient;
use super::rasterize_backward::Sums;
use super::tile::{BlendingRule, GROUPS, TilePixels, TilePlace};
use crate::{BlendRequest, Blending, GeometryPath};

/// Channels whose sums are taken at once.
const TOGETHER: usize = 4;

/// Gradients by the blended values of the pixels of a tile.
#[repr(C, align(64))]
pub(super) struct BlendCotangents {
    /// `v_B . B` and what is left of it behind the splats so far; 0 where nothing goes through the weights.
    remainder: TilePixels,
    /// dL/dblended, `[GROUPS, padded]`: C channels and zeros up to a multiple of [`TOGETHER`].
    v_blended: Vec<Lanes>,
    padded: usize,
}

impl BlendCotangents {
    /// Of a tile, from `[height, width, C]`; `blended` is the image where gradients go through the weights.
    pub(super) fn new(
        place: &TilePlace,
        channels: usize,
        v_blended: &[f32],
        blended: Option<&[f32]>,
    ) -> Self {
        let padded = channels.next_multiple_of(TOGETHER);
        let mut cotangents = Self {
            v_blended: vec![[0.0; LANES]; GROUPS * padded],
            padded,
            remainder: [[0.0; LANES]; GROUPS],
        };
        for (group, lanes) in cotangents.v_blended.chunks_exact_mut(padded).enumerate() {
            for lane in 0..LANES {
                let Some(pixel) = place.pixel(group, lane) else { continue };
                let of_pixel = pixel * channels..(pixel + 1) * channels;
                let v_pixel = &v_blended[of_pixel.clone()];
                for (lanes, v) in lanes.iter_mut().zip(v_pixel) {
                    lanes[lane] = *v;
                }
                if let Some(blended) = blended {
                    let products = v_pixel.iter().zip(&blended[of_pixel]).map(|(v, b)| v * b);
                    cotangents.remainder[group][lane] = products.sum();
                }
            }
        }
        cotangents
    }
}

/// Writes the gradients of the values of every entry, `[entries, C]`, and with `WEIGHTS` of its splat, to the
/// strength of the blending and to that geometry.
#[simd]
pub(super) fn blend_tile_backward<S: Simd, const WEIGHTS: bool>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    request: &BlendRequest<'_>,
    geometry: GeometryPath,
    cotangents: &mut BlendCotangents,
    v_values: &mut [f32],
    gradients: &mut [SplatGradient],
) {
    let rule = BlendingRule::new(simd);
    let zero = splat(simd, 0.0);
    let (channels, padded) = (request.channels, cotangents.padded);
    let mut weights: TilePixels = [[0.0; LANES]; GROUPS];
    let mut drawn = DrawnSplats::new(splats, entries, place, request.blending);
    while let Some((pair, s, prepared, groups)) = drawn.next(simd) {
        let strength = splat(simd, s.strength(request.blending));
        let values = request.of(s.gaussian as usize);
        let mut sums = Sums::zero(zero);
        for group in groups {
            let at = prepared.footprint(simd, group);
            let unclamped = strength * at.peak;
            let blended = rule.step(simd, unclamped, &mut drawn.transmittance[group]);
            drawn.alive.finish(group, blended.finished);
            blended.weight.store_array(&mut weights[group]);
            if WEIGHTS {
                let mut e = zero;
                let of_group = &cotangents.v_blended[group * padded..group * padded + channels];
                for (v, value) in of_group.iter().zip(values) {
                    e = load(simd, v).mul_add(splat(simd, *value), e);
                }
                let v_alpha = rule.backward(simd, &blended, unclamped, e, &mut cotangents.remainder[group]);
                let v_sigma = -(blended.alpha * v_alpha);
                match request.blending {
                    Blending::Color => sums.opacity = at.peak.mul_add(v_alpha, sums.opacity),
                    Blending::Own => sums.responsibility += v_sigma,
                }
                match geometry {
                    GeometryPath::Full => sums.add_moments(&at, v_sigma, v_sigma),
                    GeometryPath::MeansOnly => sums.add_moments(&at, zero, v_sigma),
                    GeometryPath::Off => {}
                }
            }
        }
        let out = &mut v_values[pair * channels..(pair + 1) * channels];
        for (block, out) in out.chunks_mut(TOGETHER).enumerate() {
            let mut of_block = [zero; TOGETHER];
            for group in groups {
                let weight: f32x16<S> = load(simd, &weights[group]);
                let first = group * padded + block * TOGETHER;
                let v = &cotangents.v_blended[first..first + TOGETHER];
                for channel in 0..TOGETHER {
                    of_block[channel] = weight.mul_add(load(simd, &v[channel]), of_block[channel]);
                }
            }
            let totals = sum_each(simd, of_block);
            out.copy_from_slice(&totals[..out.len()]);
        }
        if WEIGHTS {
            gradients[pair] = sums.finish(simd, s);
        }
    }
}
