//! Instance images: argmax, probability, coverage and entropy of the rendered identities, over all labels
//! that occur in a tile. Source: methods reference 4.2 (evaluation).

use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::labels::IdentityRows;
use super::pixels::{LANES, load, splat};
use super::project::Splat;
use super::tile::{Aligned, BlendingRule, GROUPS, SplatInTile, TilePixels, TilePlace, live, prepare};

/// Instance outputs of a tile.
#[derive(Clone, Debug)]
pub(super) struct InstanceTile {
    /// Dense index + 1, 0 where nothing covers the pixel.
    pub(super) label: [[u16; LANES]; GROUPS],
    pub(super) probability: TilePixels,
    pub(super) coverage: TilePixels,
    pub(super) foreground: TilePixels,
    pub(super) entropy: TilePixels,
    /// The most probable instances, most probable first: dense index + 1 (0 = none) and their probability.
    pub(super) ranks: Vec<[[(u16, f32); LANES]; GROUPS]>,
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
            ranks: Vec::new(),
        }
    }
}

/// Blends the identities of a tile; `tile.ranks` keeps as many instances per pixel as it has places.
#[simd]
pub(super) fn instance_tile<S: Simd>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    rows: IdentityRows<'_>,
    labelled_shares: &[f32],
    tile: &mut InstanceTile,
) {
    let labels = supported_labels(splats, entries, rows);
    tile.foreground = [[0.0; LANES]; GROUPS];
    let mut masses = vec![Aligned([[0.0; LANES]; GROUPS]); labels.len()];

    let blending = BlendingRule::new(simd);
    let mut color_transmittance = Aligned(place.initial_transmittance());
    let mut instance_transmittance = color_transmittance;
    let mut slots: Vec<(usize, f32)> = Vec::new();
    let mut live_color = live(&color_transmittance.0);
    let mut live_instances = live_color;
    for entry in entries {
        if live_color.union(live_instances).is_empty() {
            break;
        }
        let needed = entry.needed::<true>(live_color, live_instances);
        if needed[0].union(needed[1]).is_empty() {
            continue;
        }
        let s = &splats[entry.rank()];
        let Some(prepared) = prepare(simd, s, place, needed) else { continue };
        let prepared: SplatInTile<S> = prepared;
        let [in_color, in_instances] = prepared.groups;
        let (opacity, occupancy) = (splat(simd, s.opacity), splat(simd, s.occupancy));
        let share = splat(simd, labelled_shares[s.gaussian as usize]);
        for group in in_color {
            let at = prepared.footprint(simd, group);
            let blended = blending.step(simd, opacity * at.peak, &mut color_transmittance.0[group]);
            let foreground = &mut tile.foreground[group];
            blended.weight.mul_add(share, load(simd, foreground)).store_array(foreground);
            live_color.finish(group, blended.finished);
        }
        if in_instances.is_empty() {
            continue;
        }
        slots.clear();
        for entry in rows.entries(s.gaussian) {
            let slot = labels.binary_search(&rows.labels[entry]).expect("the dictionary holds every label");
            slots.push((slot, rows.probabilities[entry]));
        }
        for group in in_instances {
            let at = prepared.footprint(simd, group);
            let transmittance = &mut instance_transmittance.0[group];
            let blended = blending.step(simd, occupancy * at.peak, transmittance);
            for (slot, probability) in &slots {
                let mass = &mut masses[*slot].0[group];
                blended.weight.mul_add(splat(simd, *probability), load(simd, mass)).store_array(mass);
            }
            live_instances.finish(group, blended.finished);
        }
    }
    finish_pixels(&labels, &masses, tile);
}

/// Labels that any splat of a tile supports, ascending: this dictionary keeps memory independent of K.
#[inline(always)]
fn supported_labels(splats: &[Splat], entries: &[TileEntry], rows: IdentityRows<'_>) -> Vec<u16> {
    let mut labels: Vec<u16> = Vec::new();
    let mut enough = 4096;
    for entry in entries {
        labels.extend_from_slice(&rows.labels[rows.entries(splats[entry.rank()].gaussian)]);
        if labels.len() > enough {
            labels.sort_unstable();
            labels.dedup();
            enough = 4096.max(2 * labels.len());
        }
    }
    labels.sort_unstable();
    labels.dedup();
    labels
}

/// Sets what the pixels show, from the mass of each label.
#[inline(always)]
fn finish_pixels(labels: &[u16], masses: &[Aligned<TilePixels>], tile: &mut InstanceTile) {
    let mut ranked: Vec<(u16, f32)> = Vec::new();
    for group in 0..GROUPS {
        for lane in 0..LANES {
            let (mut best, mut most, mut total) = (0_u16, 0.0_f32, 0.0_f32);
            for (label, Aligned(mass)) in labels.iter().zip(masses) {
                let mass = mass[group][lane];
                total += mass;
                if mass > most {
                    (best, most) = (label + 1, mass);
                }
            }
            let mut entropy = 0.0;
            if total > 0.0 {
                for Aligned(mass) in masses {
                    let share = mass[group][lane] / total;
                    if share > 0.0 {
                        entropy -= share * share.ln();
                    }
                }
            }
            if !tile.ranks.is_empty() {
                ranked.clear();
                ranked.extend(
                    labels
                        .iter()
                        .zip(masses)
                        .map(|(label, Aligned(mass))| (label + 1, mass[group][lane]))
                        .filter(|(_, mass)| *mass > 0.0),
                );
                // Stable, so that ties go to the lowest index.
                ranked.sort_by(|a, b| b.1.total_cmp(&a.1));
                for (rank, place) in tile.ranks.iter_mut().enumerate() {
                    place[group][lane] = ranked.get(rank).copied().unwrap_or_default();
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
