//! Instance images: argmax, probability, coverage and entropy of the rendered identities, over all labels
//! that occur in a tile. Source: methods reference 4.2 (evaluation).

use fearless_simd::prelude::*;
use fearless_simd::{f32x8, mask32x8};
use fearless_simd_macros::simd;

use super::project::Splat;
use super::rasterize::{GROUPS, IdentityRows, TilePixels, TilePlace, prepare};
use super::vector::{LANES, Lanes, load, splat};
use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE};

/// Instance outputs of a tile.
#[derive(Clone, Debug)]
pub(super) struct InstanceTile {
    /// Dense index + 1, 0 where nothing covers the pixel.
    pub(super) label: [[u16; LANES]; GROUPS],
    pub(super) probability: TilePixels,
    pub(super) coverage: TilePixels,
    pub(super) foreground: TilePixels,
    pub(super) entropy: TilePixels,
}

impl Default for InstanceTile {
    fn default() -> Self {
        let zero = [[0.0; LANES]; GROUPS];
        Self {
            label: [[0; LANES]; GROUPS],
            probability: zero,
            coverage: zero,
            foreground: zero,
            entropy: zero,
        }
    }
}

/// Blends the identities of a tile.
#[simd]
pub(super) fn instance_tile<S: Simd>(
    simd: S,
    splats: &[Splat],
    ranks: &[u32],
    place: &TilePlace,
    rows: IdentityRows<'_>,
    labelled_shares: &[f32],
    tile: &mut InstanceTile,
) {
    // The dictionary of labels that any splat of the tile supports keeps memory independent of K.
    let mut labels: Vec<u16> = Vec::new();
    let entries = |gaussian: u32| {
        rows.row_offsets[gaussian as usize] as usize..rows.row_offsets[gaussian as usize + 1] as usize
    };
    for &rank in ranks {
        labels.extend_from_slice(&rows.labels[entries(splats[rank as usize].gaussian)]);
        if labels.len() > 4096 {
            labels.sort_unstable();
            labels.dedup();
        }
    }
    labels.sort_unstable();
    labels.dedup();
    tile.foreground = [[0.0; LANES]; GROUPS];
    let mut masses: Vec<TilePixels> = vec![[[0.0; LANES]; GROUPS]; labels.len()];

    let zero = splat(simd, 0.0);
    let one = splat(simd, 1.0);
    let max_alpha = splat(simd, MAX_ALPHA);
    let min_alpha = splat(simd, MIN_ALPHA);
    let min_transmittance = splat(simd, MIN_TRANSMITTANCE);
    let mut instance_transmittance = place.initial_transmittance();
    let mut color_transmittance = instance_transmittance;
    let mut slots: Vec<(usize, f32)> = Vec::new();
    let (mut live_instances, mut live_color) = (u32::MAX, u32::MAX);
    // One step of either pass: the blended weight of each pixel, and whether the group is finished.
    let blend = |weight: f32x8<S>, valid: mask32x8<S>, transmittance: &mut Lanes| {
        let alpha = weight.min(max_alpha);
        let t = load(simd, transmittance);
        let draws = valid & alpha.simd_ge(min_alpha) & t.simd_gt(zero);
        let next = t * (one - alpha);
        let stops = draws & next.simd_lt(min_transmittance);
        let blends = draws & !stops;
        let blended = blends.select(t * alpha, zero);
        let t = stops.select(-t, blends.select(next, t));
        t.store_array(transmittance);
        (blended, t.simd_gt(zero).to_bitmask() == 0)
    };
    for &rank in ranks {
        if live_instances | live_color == 0 {
            break;
        }
        let s = &splats[rank as usize];
        let prepared = prepare::<S, true>(simd, s, place);
        let color_groups = prepared.groups[0] & live_color;
        let instance_groups = prepared.groups[1] & live_instances;
        let mut groups = color_groups | instance_groups;
        if groups == 0 {
            continue;
        }
        slots.clear();
        for entry in entries(s.gaussian) {
            let slot = labels.binary_search(&rows.labels[entry]).expect("the dictionary holds every label");
            slots.push((slot, rows.probabilities[entry]));
        }
        let (opacity, occupancy) = (splat(simd, s.opacity), splat(simd, s.occupancy));
        let share = splat(simd, labelled_shares[s.gaussian as usize]);
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let (dx, dy) = prepared.offset(group);
            let (p, valid) = prepared.footprint(simd, dx, dy);
            if color_groups >> group & 1 == 1 {
                let (weight, finished) = blend(opacity * p, valid, &mut color_transmittance[group]);
                let foreground = &mut tile.foreground[group];
                weight.mul_add(share, load(simd, foreground)).store_array(foreground);
                live_color &= !(u32::from(finished) << group);
            }
            if instance_groups >> group & 1 == 1 {
                let (weight, finished) = blend(occupancy * p, valid, &mut instance_transmittance[group]);
                for (slot, probability) in &slots {
                    let mass = &mut masses[*slot][group];
                    weight.mul_add(splat(simd, *probability), load(simd, mass)).store_array(mass);
                }
                live_instances &= !(u32::from(finished) << group);
            }
        }
    }

    for group in 0..GROUPS {
        for lane in 0..LANES {
            let (mut best, mut most, mut total) = (0_u16, 0.0_f32, 0.0_f32);
            for (label, mass) in labels.iter().zip(&masses) {
                let mass = mass[group][lane];
                total += mass;
                if mass > most {
                    (best, most) = (label + 1, mass);
                }
            }
            let mut entropy = 0.0;
            if total > 0.0 {
                for mass in &masses {
                    let share = mass[group][lane] / total;
                    if share > 0.0 {
                        entropy -= share * share.ln();
                    }
                }
            }
            tile.label[group][lane] = best;
            tile.probability[group][lane] = most;
            tile.coverage[group][lane] = total;
            tile.foreground[group][lane] = tile.foreground[group][lane].min(1.0);
            tile.entropy[group][lane] = entropy.max(0.0);
        }
    }
}
