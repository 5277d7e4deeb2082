//! Gradient of one tile, front to back: transmittances are replayed as the forward pass made them and never
//! divided. Source: methods reference 3.2 and 4.2.
//!
//! Colour: with `Q = v_C . C_out` (background included), the gradient of a blending weight is
//! `v_alpha_i = T_i e_i - (Q - E_i) / (1 - alpha_i)`, where `e_i = v_C . c_i` and `E_i` is the running sum of
//! `T alpha e` through i; `Q - E_i` is kept as one running remainder. Coverage is one more channel, in which every
//! Gaussian is 1 and the background 0.
//!
//! Instances: `r_i = W_i p_i / M`, remainder `1 - c_i`, `q_i = r_i - b_i (1 - c_i) / (1 - b_i)`. Behind the last
//! Gaussian that supports a pixel's label both are 0: there the instance pass of a group ends.

use fearless_simd::f32x16;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::bin::TileEntry;
use super::labels::{IdentityRows, TileLabels};
use super::pixels::{LANES, Lanes, load, splat, splat_each, sum, sum_each};
use super::project::Splat;
use super::project_backward::SplatGradient;
use super::tile::{
    Aligned, BlendingRule, Footprint, GROUPS, Groups, MetGroups, SplatInTile, TilePixels, TilePlace, live,
};
use crate::GeometryPath;

/// Undoes the scale of [`Splat::binary_factor`] in a product of two values that carry it.
const FROM_BINARY: f32 = 2.0 * std::f32::consts::LN_2;

/// A tile with its splats, as the forward pass drew it.
#[derive(Clone, Copy)]
pub(super) struct DrawnTile<'a> {
    /// Splats of the view, in depth order.
    pub(super) splats: &'a [Splat],
    /// Those of the tile, front to back.
    pub(super) entries: &'a [TileEntry],
    /// Groups of pixels that each entry was evaluated at.
    pub(super) met: &'a [MetGroups],
    /// Where the tile lies in the image.
    pub(super) place: &'a TilePlace,
}

/// Cotangents of a tile's colours: gradients of the colour loss by them.
#[repr(C, align(64))]
pub(super) struct TileCotangents {
    /// dL/dcolour.
    pub(super) color: [TilePixels; 3],
    /// `v_C . C_out`, background included, and `v_A A`.
    pub(super) remainder: TilePixels,
    /// dL/dalpha, where there is one.
    pub(super) alpha: Option<Box<TilePixels>>,
}

/// Instance inputs of a tile.
#[repr(C, align(64))]
pub(super) struct TileInstances<'a> {
    /// 1 / M_y of each pixel, 0 where nothing flows.
    pub(super) inverse_probability: TilePixels,
    pub(super) labels: &'a TileLabels,
    pub(super) rows: IdentityRows<'a>,
    pub(super) geometry: GeometryPath,
    /// Loss weight of a pixel.
    pub(super) weight: f32,
    /// Of each group, one past the last entry that supports a label of it.
    pub(super) ends: [u32; GROUPS],
    /// Added to the remainder 1 - c_i under coverage normalisation: `S_end / A`.
    pub(super) coverage_ratio: Option<Box<TilePixels>>,
}

/// Running state of the instance pass.
#[repr(C, align(64))]
struct Replay<'a> {
    transmittance: TilePixels,
    /// 1 - c_i.
    remainder: TilePixels,
    /// Of the splat, at the tile's labels.
    probabilities: Vec<f32>,
    /// Responsibility of the splat for each of the tile's labels.
    mass: Vec<Aligned<Lanes>>,
    instances: &'a TileInstances<'a>,
}

impl<'a> Replay<'a> {
    fn new(instances: &'a TileInstances<'a>) -> Self {
        let starts = |flows: &f32| if *flows != 0.0 { 1.0 } else { -1.0 };
        Self {
            transmittance: instances.inverse_probability.each_ref().map(|lanes| lanes.each_ref().map(starts)),
            remainder: [[1.0; LANES]; GROUPS],
            probabilities: vec![0.0; instances.labels.labels.len()],
            mass: vec![Aligned([0.0; LANES]); instances.labels.labels.len()],
            instances,
        }
    }
}

/// A splat as the cotangents of a tile see it.
struct Seen<S: Simd> {
    blending: BlendingRule<S>,
    one: f32x16<S>,
    zero: f32x16<S>,
    opacity: f32x16<S>,
    occupancy: f32x16<S>,
    color: [f32x16<S>; 3],
    /// Loss weight of a pixel, for all geometry and for means.
    weight: f32x16<S>,
    full_geometry: f32x16<S>,
    mean_geometry: f32x16<S>,
}

/// Gradient of a splat, per lane.
pub(super) struct Sums<S: Simd> {
    color: [f32x16<S>; 3],
    pub(super) opacity: f32x16<S>,
    pub(super) responsibility: f32x16<S>,
    /// Moments of v_sigma by u: first for the mean, second for the covariance.
    first: [f32x16<S>; 2],
    second: [f32x16<S>; 3],
}

impl<S: Simd> Sums<S> {
    #[inline(always)]
    pub(super) fn zero(zero: f32x16<S>) -> Self {
        Self { color: [zero; 3], opacity: zero, responsibility: zero, first: [zero; 2], second: [zero; 3] }
    }

    /// Adds the moments of a group: `v_sigma` for the covariance, `v_sigma_mean` for the mean.
    #[inline(always)]
    pub(super) fn add_moments(&mut self, at: &Footprint<S>, v_sigma: f32x16<S>, v_sigma_mean: f32x16<S>) {
        let (v0, v1) = (v_sigma * at.u0, v_sigma * at.u1);
        self.first[0] = v_sigma_mean.mul_add(at.u0, self.first[0]);
        self.first[1] = v_sigma_mean.mul_add(at.u1, self.first[1]);
        self.second[0] = v0.mul_add(at.u0, self.second[0]);
        self.second[1] = v0.mul_add(at.u1, self.second[1]);
        self.second[2] = v1.mul_add(at.u1, self.second[2]);
    }

    #[inline(always)]
    pub(super) fn finish(self, simd: S, splat: &Splat) -> SplatGradient {
        let [l00, l01, l11] = splat.binary_factor();
        let [u0, u1, u00, u01] =
            sum_each(simd, [self.first[0], self.first[1], self.second[0], self.second[1]]);
        let [red, green, blue, opacity] =
            sum_each(simd, [self.color[0], self.color[1], self.color[2], self.opacity]);
        SplatGradient {
            mean: [l00 * u0, l01 * u0 + l11 * u1].map(|v| FROM_BINARY * v),
            moments: [u00, u01, sum(simd, self.second[2])].map(|v| FROM_BINARY * v),
            color: [red, green, blue],
            opacity,
            responsibility: sum(simd, self.responsibility),
        }
    }
}

impl<S: Simd> Seen<S> {
    /// Adds the colour gradients of a group; returns v_sigma and whether the group is finished.
    #[inline(always)]
    fn color_backward(
        &self,
        simd: S,
        at: &Footprint<S>,
        group: usize,
        transmittance: &mut TilePixels,
        cotangents: &mut TileCotangents,
        sums: &mut Sums<S>,
    ) -> (f32x16<S>, bool) {
        let unclamped = self.opacity * at.peak;
        let blended = self.blending.step(simd, unclamped, &mut transmittance[group]);
        let [red, green, blue] = &cotangents.color;
        let v_c = [load(simd, &red[group]), load(simd, &green[group]), load(simd, &blue[group])];
        let mut e = v_c[0].mul_add(self.color[0], v_c[1].mul_add(self.color[1], v_c[2] * self.color[2]));
        if let Some(alpha) = &cotangents.alpha {
            e += load(simd, &alpha[group]);
        }
        for channel in 0..3 {
            sums.color[channel] = blended.weight.mul_add(v_c[channel], sums.color[channel]);
        }
        let remainder = &mut cotangents.remainder[group];
        let v_alpha = self.blending.backward(simd, &blended, unclamped, e, remainder);
        sums.opacity = at.peak.mul_add(v_alpha, sums.opacity);
        (-(blended.alpha * v_alpha), blended.finished)
    }

    /// Adds the responsibilities of a group; returns the weighted q and whether the group is finished.
    #[inline(always)]
    fn instances_backward(
        &self,
        simd: S,
        at: &Footprint<S>,
        pair: usize,
        group: usize,
        replay: &mut Replay<'_>,
        sums: &mut Sums<S>,
    ) -> (f32x16<S>, bool) {
        let instances = replay.instances;
        let labels = instances.labels;
        let unclamped = self.occupancy * at.peak;
        let blended = self.blending.step(simd, unclamped, &mut replay.transmittance[group]);
        let (identity, _) = labels.gather(simd, group, &replay.probabilities);
        let r = blended.weight * (identity * load(simd, &instances.inverse_probability[group]));
        // 1 - c_i, clamped against rounding at the tail.
        let remainder = (load(simd, &replay.remainder[group]) - r).max(self.zero);
        remainder.store_array(&mut replay.remainder[group]);
        let (hidden, settled) = match &instances.coverage_ratio {
            Some(ratio) => (remainder + load(simd, &ratio[group]), blended.finished),
            None => (remainder, blended.finished || pair + 1 >= instances.ends[group] as usize),
        };
        let q = r - blended.alpha * hidden / (self.one - blended.alpha);
        let flows = blended.drawn & self.blending.unclamped(unclamped);
        let q = flows.select(q, self.zero) * self.weight;
        sums.responsibility += q;
        match labels.uniform[group] {
            Some(slot) => {
                let Aligned(mass) = &mut replay.mass[slot as usize];
                (load(simd, mass) + r).store_array(mass);
            }
            None => {
                for (lane, r) in r.to_array().into_iter().enumerate() {
                    replay.mass[labels.slots[group][lane] as usize].0[lane] += r;
                }
            }
        }
        (q, settled)
    }
}

/// Writes one gradient per entry, given where the forward pass met it; `label_mass` gets `[entries, labels]` weighted
/// responsibilities.
#[simd]
pub(super) fn rasterize_tile_backward<S: Simd, const INSTANCES: bool>(
    simd: S,
    tile: DrawnTile<'_>,
    cotangents: &mut TileCotangents,
    instances: Option<&TileInstances<'_>>,
    gradients: &mut [SplatGradient],
    label_mass: &mut [f32],
) {
    let DrawnTile { splats, entries, met, place } = tile;
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let blending = BlendingRule::new(simd);
    let mut transmittance = Aligned(place.initial_transmittance());
    let mut live_color = live(&transmittance.0);
    let mut live_instances = Groups::default();
    let mut replay = instances.filter(|_| INSTANCES).map(Replay::new);
    if let Some(replay) = &replay {
        live_instances = live(&replay.transmittance);
    }
    let (full_geometry, mean_geometry) = match instances.map(|instances| instances.geometry) {
        Some(GeometryPath::Full) => (one, one),
        Some(GeometryPath::MeansOnly) => (zero, one),
        Some(GeometryPath::Off) | None => (zero, zero),
    };
    let moves_geometry = instances.is_some_and(|instances| instances.geometry != GeometryPath::Off);
    let weight = instances.map_or(0.0, |instances| instances.weight);

    for (pair, (entry, met)) in entries.iter().zip(met).enumerate() {
        if live_color.union(live_instances).is_empty() {
            break;
        }
        let [in_color, in_instances] = met.live::<INSTANCES>(live_color, live_instances);
        if in_color.union(in_instances).is_empty() {
            continue;
        }
        let s = &splats[entry.rank()];
        let prepared: SplatInTile<S> = SplatInTile::new(simd, s, place, [in_color, in_instances]);
        let seen = Seen {
            blending,
            one,
            zero,
            opacity: splat(simd, s.opacity),
            occupancy: splat(simd, s.occupancy),
            color: splat_each(simd, s.color),
            weight: splat(simd, weight),
            full_geometry,
            mean_geometry,
        };
        let mut sums = Sums::zero(zero);
        for group in in_color.without(in_instances) {
            let at = prepared.footprint(simd, group);
            let (v_sigma, finished) =
                seen.color_backward(simd, &at, group, &mut transmittance.0, cotangents, &mut sums);
            live_color.finish(group, finished);
            sums.add_moments(&at, v_sigma, v_sigma);
        }
        if INSTANCES
            && !in_instances.is_empty()
            && let Some(replay) = &mut replay
        {
            let labels = &replay.instances.labels.labels;
            replay.instances.rows.at_labels(s.gaussian, labels, &mut replay.probabilities);
            replay.mass.fill(Aligned([0.0; LANES]));
            for group in in_color.both(in_instances) {
                let at = prepared.footprint(simd, group);
                let (v_sigma, finished) =
                    seen.color_backward(simd, &at, group, &mut transmittance.0, cotangents, &mut sums);
                live_color.finish(group, finished);
                let (q, finished) = seen.instances_backward(simd, &at, pair, group, replay, &mut sums);
                live_instances.finish(group, finished);
                let v_sigma_mean = q.mul_add(seen.mean_geometry, v_sigma);
                sums.add_moments(&at, q.mul_add(seen.full_geometry, v_sigma), v_sigma_mean);
            }
            for group in in_instances.without(in_color) {
                let at = prepared.footprint(simd, group);
                let (q, finished) = seen.instances_backward(simd, &at, pair, group, replay, &mut sums);
                live_instances.finish(group, finished);
                if moves_geometry {
                    sums.add_moments(&at, q * seen.full_geometry, q * seen.mean_geometry);
                }
            }
            let slots = replay.mass.len();
            for (out, mass) in label_mass[pair * slots..(pair + 1) * slots].iter_mut().zip(&replay.mass) {
                *out = weight * sum(simd, load(simd, &mass.0));
            }
        }
        gradients[pair] = sums.finish(simd, s);
    }
}
