//! Front-to-back blending of one tile: colour, depth and the instance probability of each pixel's own label
//! in one pass with two transmittances. Source: methods reference 3.1 and 4.2.

use fearless_simd::f32x16;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::labels::{IdentityRows, TileLabels};
use super::pixels::{LANES, load, splat, splat_each};
use super::project::Splat;
use super::tile::{
    BlendingRule, Footprint, GROUPS, Groups, MetGroups, SplatInTile, TilePixels, TilePlace, live, prepare,
};

/// Blended values of a tile.
#[derive(Clone, Debug)]
#[repr(C, align(64))]
pub(super) struct TileImage {
    pub(super) color: [TilePixels; 3],
    /// Weighted depth D.
    pub(super) depth: TilePixels,
    /// Colour transmittance at the end, positive for pixels of the image.
    pub(super) transmittance: TilePixels,
    /// Rendered probability M_y of the pixel's label.
    pub(super) label_probability: TilePixels,
    /// Instance transmittance at the end.
    pub(super) instance_transmittance: TilePixels,
    /// Of each group, one past the last entry that supports a label of it.
    pub(super) supported: [u32; GROUPS],
    /// Where each entry was met, up to the last that was; kept for gradients alone.
    pub(super) met: Vec<MetGroups>,
    /// Evaluated (pixel, splat) pairs.
    pub(super) evaluated: u64,
    /// Those of them evaluated for identities.
    pub(super) evaluated_instances: u64,
}

impl Default for TileImage {
    fn default() -> Self {
        let zero = [[0.0; LANES]; GROUPS];
        Self {
            color: [zero; 3],
            depth: zero,
            transmittance: zero,
            label_probability: zero,
            instance_transmittance: zero,
            supported: [0; GROUPS],
            met: Vec::new(),
            evaluated: 0,
            evaluated_instances: 0,
        }
    }
}

/// Instance transmittance at the start: 1 where a pixel carries a label, else -1.
pub(super) fn labelled_transmittance(labels: &TileLabels) -> TilePixels {
    let mut transmittance = [[-1.0; LANES]; GROUPS];
    for group in 0..GROUPS {
        for lane in labels.labelled_lanes(group) {
            transmittance[group][lane] = 1.0;
        }
    }
    transmittance
}

/// A splat as the pixels of a tile blend it.
struct Painted<'a, S: Simd> {
    blending: BlendingRule<S>,
    opacity: f32x16<S>,
    occupancy: f32x16<S>,
    color: [f32x16<S>; 3],
    depth: f32x16<S>,
    /// Of the splat, at the tile's labels.
    probabilities: &'a [f32],
}

impl<S: Simd> Painted<'_, S> {
    /// Blends the colour of a group, and says whether the group is finished.
    #[inline(always)]
    fn paint_color<const DEPTH: bool>(
        &self,
        simd: S,
        at: &Footprint<S>,
        group: usize,
        image: &mut TileImage,
    ) -> bool {
        let blended = self.blending.step(simd, self.opacity * at.peak, &mut image.transmittance[group]);
        for channel in 0..3 {
            let total = &mut image.color[channel][group];
            blended.weight.mul_add(self.color[channel], load(simd, total)).store_array(total);
        }
        if DEPTH {
            let total = &mut image.depth[group];
            blended.weight.mul_add(self.depth, load(simd, total)).store_array(total);
        }
        blended.finished
    }

    /// Blends the label probability of a group, and says whether the group is finished.
    #[inline(always)]
    fn paint_labels(
        &self,
        simd: S,
        at: &Footprint<S>,
        pair: usize,
        group: usize,
        labels: &TileLabels,
        image: &mut TileImage,
    ) -> bool {
        let transmittance = &mut image.instance_transmittance[group];
        let blended = self.blending.step(simd, self.occupancy * at.peak, transmittance);
        let (identity, supports) = labels.gather(simd, group, self.probabilities);
        let total = &mut image.label_probability[group];
        blended.weight.mul_add(identity, load(simd, total)).store_array(total);
        if supports {
            image.supported[group] = pair as u32 + 1;
        }
        blended.finished
    }
}

/// Blends a tile. `labels` are read when `INSTANCES`; where entries were met is kept when `keeps_met`.
#[simd]
pub(super) fn rasterize_tile<S: Simd, const INSTANCES: bool, const DEPTH: bool>(
    simd: S,
    splats: &[Splat],
    entries: &[TileEntry],
    place: &TilePlace,
    labels: Option<(&TileLabels, IdentityRows<'_>)>,
    keeps_met: bool,
    image: &mut TileImage,
) {
    image.color = [[[0.0; LANES]; GROUPS]; 3];
    if DEPTH {
        image.depth = [[0.0; LANES]; GROUPS];
    }
    image.transmittance = place.initial_transmittance();
    (image.evaluated, image.evaluated_instances) = (0, 0);
    image.met.clear();
    let blending = BlendingRule::new(simd);
    let mut probabilities = Vec::new();
    let mut live_color = live(&image.transmittance);
    let mut live_instances = Groups::default();
    if INSTANCES && let Some((tile_labels, _)) = labels {
        image.label_probability = [[0.0; LANES]; GROUPS];
        image.supported = [0; GROUPS];
        image.instance_transmittance = labelled_transmittance(tile_labels);
        live_instances = live(&image.instance_transmittance);
        probabilities.resize(tile_labels.labels.len(), 0.0);
    }

    for (pair, entry) in entries.iter().enumerate() {
        if live_color.union(live_instances).is_empty() {
            break;
        }
        let needed = entry.needed::<INSTANCES>(live_color, live_instances);
        if needed[0].union(needed[1]).is_empty() {
            continue;
        }
        let s = &splats[entry.rank()];
        let Some(prepared) = prepare(simd, s, place, needed) else { continue };
        let prepared: SplatInTile<S> = prepared;
        let [in_color, in_instances] = prepared.groups;
        if keeps_met {
            image.met.resize(pair, MetGroups::default());
            image.met.push(MetGroups::new(prepared.groups));
        }
        image.evaluated += in_color.union(in_instances).pixels();
        if INSTANCES {
            image.evaluated_instances += in_instances.pixels();
        }
        if INSTANCES
            && !in_instances.is_empty()
            && let Some((tile_labels, rows)) = labels
        {
            rows.at_labels(s.gaussian, &tile_labels.labels, &mut probabilities);
        }
        let painted = Painted {
            blending,
            opacity: splat(simd, s.opacity),
            occupancy: splat(simd, s.occupancy),
            color: splat_each(simd, s.color),
            depth: splat(simd, s.depth),
            probabilities: &probabilities,
        };
        for group in in_color.without(in_instances) {
            let at = prepared.footprint(simd, group);
            live_color.finish(group, painted.paint_color::<DEPTH>(simd, &at, group, image));
        }
        if INSTANCES && let Some((tile_labels, _)) = labels {
            for group in in_color.both(in_instances) {
                let at = prepared.footprint(simd, group);
                live_color.finish(group, painted.paint_color::<DEPTH>(simd, &at, group, image));
                live_instances
                    .finish(group, painted.paint_labels(simd, &at, pair, group, tile_labels, image));
            }
            for group in in_instances.without(in_color) {
                let at = prepared.footprint(simd, group);
                live_instances
                    .finish(group, painted.paint_labels(simd, &at, pair, group, tile_labels, image));
            }
        }
    }
    for group in 0..GROUPS {
        load(simd, &image.transmittance[group]).abs().store_array(&mut image.transmittance[group]);
        if INSTANCES {
            let transmittance = &mut image.instance_transmittance[group];
            load(simd, transmittance).abs().store_array(transmittance);
        }
    }
}
