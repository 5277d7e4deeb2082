//! Colour-weighted label mass of a view. Source: methods reference 5.1.

use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::project::Splat;
use super::rasterize::{GROUPS, TileImage, TileLabels, TilePlace, prepare};
use super::vector::{LANES, load, splat, sum};
use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_COVERAGE, MIN_TRANSMITTANCE};

/// Adds `w_i(u) = T_i alpha_i / A_c(u)` of a tile: `mass` is `[ranks, labels + 1]`, the last column the sum
/// over all pixels of the tile, labelled or not. `image` is the tile's forward pass.
#[simd]
pub(super) fn label_mass_tile<S: Simd>(
    simd: S,
    splats: &[Splat],
    ranks: &[u32],
    place: &TilePlace,
    labels: Option<&TileLabels>,
    image: &TileImage,
    mass: &mut [f32],
) {
    let zero = splat(simd, 0.0);
    let one = splat(simd, 1.0);
    let max_alpha = splat(simd, MAX_ALPHA);
    let min_alpha = splat(simd, MIN_ALPHA);
    let min_transmittance = splat(simd, MIN_TRANSMITTANCE);
    let mut transmittance = place.initial_transmittance();
    let mut inverse_coverage = [[0.0_f32; LANES]; GROUPS];
    for group in 0..GROUPS {
        for lane in 0..LANES {
            let coverage = 1.0 - image.transmittance[group][lane];
            if transmittance[group][lane] > 0.0 && coverage >= MIN_COVERAGE {
                inverse_coverage[group][lane] = 1.0 / coverage;
            }
        }
    }
    let columns = labels.map_or(0, |labels| labels.labels.len()) + 1;
    let mut live = u32::MAX;
    for (pair, &rank) in ranks.iter().enumerate() {
        if live == 0 {
            break;
        }
        let s = &splats[rank as usize];
        let prepared = prepare::<S, false>(simd, s, place);
        let mut groups = prepared.groups[0] & live;
        let opacity = splat(simd, s.opacity);
        let out = &mut mass[pair * columns..(pair + 1) * columns];
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let (dx, dy) = prepared.offset(group);
            let (p, valid) = prepared.footprint(simd, dx, dy);
            let alpha = (opacity * p).min(max_alpha);
            let t = load(simd, &transmittance[group]);
            let draws = valid & alpha.simd_ge(min_alpha) & t.simd_gt(zero);
            if draws.to_bitmask() == 0 {
                continue;
            }
            let next = t * (one - alpha);
            let stops = draws & next.simd_lt(min_transmittance);
            let blends = draws & !stops;
            let weight = blends.select(t * alpha, zero) * load(simd, &inverse_coverage[group]);
            out[columns - 1] += sum(weight);
            if let Some(labels) = labels {
                for (lane, weight) in weight.to_array().into_iter().enumerate() {
                    if labels.labelled[group] >> lane & 1 == 1 {
                        out[labels.slots[group][lane] as usize] += weight;
                    }
                }
            }
            let t = stops.select(-t, blends.select(next, t));
            t.store_array(&mut transmittance[group]);
            if t.simd_gt(zero).to_bitmask() == 0 {
                live &= !(1 << group);
            }
        }
    }
}
