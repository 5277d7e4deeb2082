//! Mass of the Gaussians that contribute to the labelled pixels of a view, pixel by pixel. Source: methods reference 8.4
//! (the strongest of the first contributors) and 8.5 (a histogram of labels per view).

use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::blend::DrawnSplats;
use super::labels::TileLabels;
use super::pixels::{LANES, splat};
use super::project::Splat;
use super::tile::{BlendingRule, GROUPS, TilePlace};
use crate::Blending;

/// Mass of a contributor of a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ContributorMass {
    /// Its blending weight `T alpha`.
    #[default]
    Weight,
    /// 1.
    One,
}

/// Contributors of a pixel that count, and their mass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ContributorRule {
    /// Contributors looked at, from the front.
    pub first: usize,
    /// Those of them that count: the ones with the largest weights, nearer ones first among equals.
    pub strongest: usize,
    /// Mass of each.
    pub mass: ContributorMass,
}

impl ContributorRule {
    /// All contributors with their weights.
    pub const ALL: Self = Self { first: usize::MAX, strongest: usize::MAX, mass: ContributorMass::Weight };
}

/// A contributor of a pixel: its place in the list of the tile, and its weight.
type Contributor = (u32, f32);

/// Adds the mass of a tile: `mass` is `[entries, labels + 1]`, the last column the sum over the labels.
#[simd]
pub(super) fn contributors_of_tile<S: Simd>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    labels: &TileLabels,
    rule: &ContributorRule,
    mass: &mut [f32],
) {
    let blending = BlendingRule::new(simd);
    let mut drawn = DrawnSplats::new(splats, entries, place, Blending::Color);
    let mut of_pixels: Vec<Vec<Contributor>> = vec![Vec::new(); GROUPS * LANES];
    while let Some((pair, s, prepared, groups)) = drawn.next(simd) {
        let opacity = splat(simd, s.strength(Blending::Color));
        for group in groups {
            let at = prepared.footprint(simd, group);
            let step = blending.step(simd, opacity * at.peak, &mut drawn.transmittance[group]);
            drawn.alive.finish(group, step.finished);
            let weights = step.weight.to_array();
            for lane in labels.labelled_lanes(group) {
                let of_pixel = &mut of_pixels[group * LANES + lane];
                if weights[lane] > 0.0 && of_pixel.len() < rule.first {
                    of_pixel.push((pair as u32, weights[lane]));
                }
            }
        }
    }
    let columns = labels.labels.len() + 1;
    for (pixel, contributors) in of_pixels.iter_mut().enumerate().filter(|(_, found)| !found.is_empty()) {
        if contributors.len() > rule.strongest {
            // Stable, so that nearer ones stay first among equals.
            contributors.sort_by(|a, b| b.1.total_cmp(&a.1));
            contributors.truncate(rule.strongest);
        }
        let slot = labels.slots[pixel / LANES][pixel % LANES] as usize;
        for (pair, weight) in contributors {
            let row = &mut mass[*pair as usize * columns..(*pair as usize + 1) * columns];
            let share = match rule.mass {
                ContributorMass::Weight => *weight,
                ContributorMass::One => 1.0,
            };
            row[slot] += share;
            row[columns - 1] += share;
        }
    }
}
