//! Colour-weighted label mass of a view. Source: methods reference 5.1.

use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::labels::TileLabels;
use super::pixels::{LANES, load, splat, sum};
use super::project::Splat;
use super::rasterize::TileImage;
use super::tile::{BlendingRule, GROUPS, Groups, SplatInTile, TilePlace, live, prepare};
use crate::constants::MIN_COVERAGE;

/// Adds `w_i(u) = T_i alpha_i / A_c(u)` of a tile: `mass` is `[entries, labels + 1]`, the last column the sum
/// over all pixels of the tile, labelled or not. `image` is the tile's forward pass.
#[simd]
pub(super) fn label_mass_tile<S: Simd>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    labels: Option<&TileLabels>,
    image: &TileImage,
    mass: &mut [f32],
) {
    let blending = BlendingRule::new(simd);
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
    let mut live_color = live(&transmittance);
    for (pair, entry) in entries.iter().enumerate() {
        if live_color.is_empty() {
            break;
        }
        let s = &splats[entry.rank()];
        let needed = [live_color, Groups::default()];
        let Some(prepared) = prepare(simd, s, place, needed) else { continue };
        let prepared: SplatInTile<S> = prepared;
        let opacity = splat(simd, s.opacity);
        let out = &mut mass[pair * columns..(pair + 1) * columns];
        for group in prepared.groups[0] {
            let at = prepared.footprint(simd, group);
            let blended = blending.step(simd, opacity * at.peak, &mut transmittance[group]);
            live_color.finish(group, blended.finished);
            let weight = blended.weight * load(simd, &inverse_coverage[group]);
            out[columns - 1] += sum(simd, weight);
            if let Some(labels) = labels {
                let weight = weight.to_array();
                for lane in labels.labelled_lanes(group) {
                    out[labels.slots[group][lane] as usize] += weight[lane];
                }
            }
        }
    }
}
