//! Values per Gaussian blended with the weights of colour or of instances. Source: methods reference 3.1 (pixel
//! loop) and 4.1.

use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::pixels::{LANES, load, splat};
use super::project::Splat;
use super::tile::{Blending, GROUPS, Groups, Pass, SplatInTile, TilePixels, TilePlace, live, prepare};

/// Blends `values` (by row of the field) over a tile: `sum_i T_i alpha_i v_i`, with the weights and gates of a pass.
#[simd]
pub(super) fn blend_tile<S: Simd, const C: usize>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    pass: Pass,
    values: &[[f32; C]],
    blended: &mut [TilePixels; C],
) {
    *blended = [[[0.0; LANES]; GROUPS]; C];
    let blending = Blending::new(simd);
    let mut transmittance = place.initial_transmittance();
    let mut alive = live(&transmittance);
    for entry in entries {
        if alive.is_empty() {
            break;
        }
        let none = Groups::default();
        let wanted = match pass {
            Pass::Color => entry.wanted::<true>(alive, none),
            Pass::Instances => entry.wanted::<true>(none, alive),
        };
        if wanted[0].union(wanted[1]).is_empty() {
            continue;
        }
        let s = &splats[entry.rank()];
        let Some(prepared) = prepare(simd, s, place, wanted) else { continue };
        let prepared: SplatInTile<S> = prepared;
        let strength = match pass {
            Pass::Color => splat(simd, s.opacity),
            Pass::Instances => splat(simd, s.occupancy),
        };
        let value = values[s.gaussian as usize];
        for group in prepared.groups[pass as usize] {
            let at = prepared.footprint(simd, group);
            let step = blending.step(simd, strength * at.peak, &mut transmittance[group]);
            for channel in 0..C {
                let sum = &mut blended[channel][group];
                step.weight.mul_add(splat(simd, value[channel]), load(simd, sum)).store_array(sum);
            }
            alive.finish(group, step.finished);
        }
    }
}
