//! Values per Gaussian blended over a tile. Source: methods reference 3.1 (pixel loop) and 4.1.

use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::pixels::{Lanes, load, splat};
use super::project::Splat;
use super::tile::{BlendingRule, Groups, SplatInTile, TilePixels, TilePlace, live, prepare};
use crate::{BlendRequest, Blending};

/// The splats that one blending still draws somewhere in a tile, front to back.
#[repr(C, align(64))]
pub(super) struct DrawnSplats<'a> {
    /// Transmittance of every pixel so far, as [`BlendingRule::step`] keeps it.
    pub(super) transmittance: TilePixels,
    splats: &'a [Splat],
    entries: std::iter::Enumerate<std::slice::Iter<'a, TileEntry>>,
    place: &'a TilePlace,
    blending: Blending,
    /// Groups that still let light through.
    pub(super) alive: Groups,
}

impl<'a> DrawnSplats<'a> {
    pub(super) fn new(
        splats: &'a [Splat],
        entries: &'a [TileEntry],
        place: &'a TilePlace,
        blending: Blending,
    ) -> Self {
        let transmittance = place.initial_transmittance();
        let alive = live(&transmittance);
        Self { splats, entries: entries.iter().enumerate(), place, blending, transmittance, alive }
    }

    /// The next one with its position in the list of the tile, and the groups that it touches.
    #[inline(always)]
    pub(super) fn next<S: Simd>(&mut self, simd: S) -> Option<(usize, &'a Splat, SplatInTile<S>, Groups)> {
        if self.alive.is_empty() {
            return None;
        }
        for (pair, entry) in self.entries.by_ref() {
            let none = Groups::default();
            let needed = match self.blending {
                Blending::Color => entry.needed::<true>(self.alive, none),
                Blending::Own => entry.needed::<true>(none, self.alive),
            };
            if needed[0].union(needed[1]).is_empty() {
                continue;
            }
            let s = &self.splats[entry.rank()];
            if let Some(prepared) = prepare(simd, s, self.place, needed) {
                let prepared: SplatInTile<S> = prepared;
                return Some((pair, s, prepared, prepared.groups[self.blending as usize]));
            }
        }
        None
    }
}

/// Adds the values of a tile's splats to `blended`, `[GROUPS, C]`.
#[simd]
pub(super) fn blend_tile<S: Simd>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    request: &BlendRequest<'_>,
    blended: &mut [Lanes],
) {
    let rule = BlendingRule::new(simd);
    let channels = request.channels;
    let mut drawn = DrawnSplats::new(splats, entries, place, request.blending);
    while let Some((_, s, prepared, groups)) = drawn.next(simd) {
        let strength = splat(simd, s.strength(request.blending));
        let values = request.of(s.gaussian as usize);
        for group in groups {
            let at = prepared.footprint(simd, group);
            let step = rule.step(simd, strength * at.peak, &mut drawn.transmittance[group]);
            let sums = &mut blended[group * channels..(group + 1) * channels];
            for (sum, value) in sums.iter_mut().zip(values) {
                step.weight.mul_add(splat(simd, *value), load(simd, sum)).store_array(sum);
            }
            drawn.alive.finish(group, step.finished);
        }
    }
}
