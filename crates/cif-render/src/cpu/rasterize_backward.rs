//! Gradient of one tile, front to back: transmittances are replayed as the forward pass made them and never
//! divided. Source: methods reference 3.2 and 4.2.
//!
//! Colour: with `Q = v_C . C_out` (background included), the gradient of a blending weight is
//! `v_alpha_i = T_i e_i - (Q - E_i) / (1 - alpha_i)`, where `e_i = v_C . c_i` and `E_i` is the running sum of
//! `T alpha e` through i; `Q - E_i` is kept as one running remainder.
//!
//! Instances: `r_i = W_i p_i / M`, remainder `1 - c_i`, `q_i = r_i - b_i (1 - c_i) / (1 - b_i)`.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::project::{Splat, SplatGradient};
use super::rasterize::{GROUPS, IdentityRows, TileLabels, TilePixels, TilePlace, prepare, slot_values};
use super::vector::{LANES, load, splat, sum};
use crate::GeometryPath;
use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE};

/// What a tile's pixels ask of the splats.
pub(super) struct TileCotangents {
    /// dL/dcolour.
    pub(super) color: [TilePixels; 3],
    /// `v_C . C_out`, background included.
    pub(super) remainder: TilePixels,
    /// Loss weight of each pixel over its M_y: `weight / M_y`, 0 where nothing flows.
    pub(super) weight_over_probability: TilePixels,
    /// Loss weight of each pixel, 0 where nothing flows.
    pub(super) weight: TilePixels,
    /// Added to the remainder 1 - c_i: `S_end / A` under coverage normalisation, else 0.
    pub(super) coverage_ratio: TilePixels,
}

/// Instance inputs of a tile.
pub(super) struct TileInstances<'a> {
    pub(super) labels: &'a TileLabels,
    pub(super) rows: IdentityRows<'a>,
    pub(super) geometry: GeometryPath,
}

/// Writes one gradient per entry of `ranks`; `label_mass` gets `[ranks, labels]` weighted responsibilities.
#[simd]
pub(super) fn rasterize_tile_backward<S: Simd, const INSTANCES: bool>(
    simd: S,
    splats: &[Splat],
    ranks: &[u32],
    place: &TilePlace,
    cotangents: &mut TileCotangents,
    instances: Option<&TileInstances<'_>>,
    gradients: &mut [SplatGradient],
    label_mass: &mut [f32],
) {
    let zero = splat(simd, 0.0);
    let one = splat(simd, 1.0);
    let min_alpha = splat(simd, MIN_ALPHA);
    let max_alpha = splat(simd, MAX_ALPHA);
    let min_transmittance = splat(simd, MIN_TRANSMITTANCE);
    let mut transmittance = place.initial_transmittance();
    let (mut live_color, mut live_instances) = (0_u32, 0_u32);
    for group in 0..GROUPS {
        live_color |= u32::from(transmittance[group].iter().any(|t| *t > 0.0)) << group;
    }
    let mut instance_transmittance = [[-1.0_f32; LANES]; GROUPS];
    let mut instance_remainder = [[1.0_f32; LANES]; GROUPS];
    let mut slot_probabilities = Vec::new();
    let mut slot_mass: Vec<[f32; LANES]> = Vec::new();
    if INSTANCES && let Some(instances) = instances {
        for group in 0..GROUPS {
            for lane in 0..LANES {
                if instances.labels.labelled[group] >> lane & 1 == 1 && cotangents.weight[group][lane] != 0.0
                {
                    instance_transmittance[group][lane] = 1.0;
                    live_instances |= 1 << group;
                }
            }
        }
        slot_probabilities.resize(instances.labels.labels.len(), 0.0);
        slot_mass.resize(instances.labels.labels.len(), [0.0; LANES]);
    }
    let (full_geometry, mean_geometry) = match instances.map(|instances| instances.geometry) {
        Some(GeometryPath::Full) => (one, one),
        Some(GeometryPath::MeansOnly) => (zero, one),
        Some(GeometryPath::Off) | None => (zero, zero),
    };

    for (pair, &rank) in ranks.iter().enumerate() {
        if live_color | live_instances == 0 {
            break;
        }
        let s = &splats[rank as usize];
        let prepared = prepare::<S, INSTANCES>(simd, s, place);
        let instance_groups = prepared.groups[1] & live_instances;
        let mut groups = prepared.groups[0] & live_color | instance_groups;
        if groups == 0 {
            continue;
        }
        let touches_instances = INSTANCES && instance_groups != 0;
        if touches_instances && let Some(instances) = instances {
            instances.rows.at_labels(s.gaussian, &instances.labels.labels, &mut slot_probabilities);
            slot_mass.fill([0.0; LANES]);
        }
        let opacity = splat(simd, s.opacity);
        let occupancy = splat(simd, s.occupancy);
        let color = s.color.map(|c| splat(simd, c));
        let mut v_color = [zero; 3];
        let (mut v_opacity, mut v_responsibility) = (zero, zero);
        // Moments of v_sigma: first for the mean, second for the conic.
        let (mut v_x, mut v_y, mut v_xx, mut v_xy, mut v_yy) = (zero, zero, zero, zero, zero);
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let (dx, dy) = prepared.offset(group);
            let (p, valid) = prepared.footprint(simd, dx, dy);
            let mut v_sigma = zero;
            let mut v_sigma_mean = zero;

            let unclamped = opacity * p;
            let alpha = unclamped.min(max_alpha);
            let t = load(simd, &transmittance[group]);
            let draws = valid & alpha.simd_ge(min_alpha) & t.simd_gt(zero);
            if draws.to_bitmask() != 0 {
                let rest = one - alpha;
                let next = t * rest;
                let stops = draws & next.simd_lt(min_transmittance);
                let blends = draws & !stops;
                let weight = blends.select(t * alpha, zero);
                let v_c = [
                    load(simd, &cotangents.color[0][group]),
                    load(simd, &cotangents.color[1][group]),
                    load(simd, &cotangents.color[2][group]),
                ];
                let e = v_c[0].mul_add(color[0], v_c[1].mul_add(color[1], v_c[2] * color[2]));
                for channel in 0..3 {
                    v_color[channel] = weight.mul_add(v_c[channel], v_color[channel]);
                }
                let remainder = load(simd, &cotangents.remainder[group]) - weight * e;
                remainder.store_array(&mut cotangents.remainder[group]);
                let v_alpha = t.mul_add(e, -(remainder / rest));
                let flows = blends & unclamped.simd_le(max_alpha);
                let v_alpha = flows.select(v_alpha, zero);
                v_opacity = p.mul_add(v_alpha, v_opacity);
                v_sigma = -(alpha * v_alpha);
                v_sigma_mean = v_sigma;
                let t = stops.select(-t, blends.select(next, t));
                t.store_array(&mut transmittance[group]);
                if stops.to_bitmask() != 0 && t.simd_gt(zero).to_bitmask() == 0 {
                    live_color &= !(1 << group);
                }
            }

            if INSTANCES
                && instance_groups >> group & 1 == 1
                && let Some(instances) = instances
            {
                let unclamped = occupancy * p;
                let b = unclamped.min(max_alpha);
                let t = load(simd, &instance_transmittance[group]);
                let draws = valid & b.simd_ge(min_alpha) & t.simd_gt(zero);
                if draws.to_bitmask() != 0 {
                    let rest = one - b;
                    let next = t * rest;
                    let stops = draws & next.simd_lt(min_transmittance);
                    let blends = draws & !stops;
                    let identity = slot_values(simd, instances.labels, group, &slot_probabilities);
                    let weight = load(simd, &cotangents.weight[group]);
                    // The pixel's loss weight times r_i.
                    let r = blends.select(
                        t * b * identity * load(simd, &cotangents.weight_over_probability[group]),
                        zero,
                    );
                    let remainder = load(simd, &instance_remainder[group]);
                    // 1 - c_i, in units of the loss weight on use; clamped against rounding at the tail.
                    let share = weight.simd_gt(zero).select(r / weight, zero);
                    let remainder = (remainder - share).max(zero);
                    remainder.store_array(&mut instance_remainder[group]);
                    let hidden = remainder + load(simd, &cotangents.coverage_ratio[group]);
                    let q = r - weight * b * hidden / rest;
                    let q = (blends & unclamped.simd_le(max_alpha)).select(q, zero);
                    v_responsibility += q;
                    v_sigma = q.mul_add(full_geometry, v_sigma);
                    v_sigma_mean = q.mul_add(mean_geometry, v_sigma_mean);
                    match instances.labels.uniform[group] {
                        Some(slot) => {
                            let mass = &mut slot_mass[slot as usize];
                            (load(simd, mass) + r).store_array(mass);
                        }
                        None => {
                            for (lane, r) in r.to_array().into_iter().enumerate() {
                                slot_mass[instances.labels.slots[group][lane] as usize][lane] += r;
                            }
                        }
                    }
                    let t = stops.select(-t, blends.select(next, t));
                    t.store_array(&mut instance_transmittance[group]);
                    if stops.to_bitmask() != 0 && t.simd_gt(zero).to_bitmask() == 0 {
                        live_instances &= !(1 << group);
                    }
                }
            }

            let dy = splat(simd, dy);
            let first = v_sigma * dx;
            v_x = v_sigma_mean.mul_add(dx, v_x);
            v_y = v_sigma_mean.mul_add(dy, v_y);
            v_xx = first.mul_add(dx, v_xx);
            v_xy = first.mul_add(dy, v_xy);
            v_yy = (v_sigma * dy).mul_add(dy, v_yy);
        }
        let [x00, x01, x11] = s.conic;
        let (sum_x, sum_y) = (sum(v_x), sum(v_y));
        gradients[pair] = SplatGradient {
            mean: [x00 * sum_x + x01 * sum_y, x01 * sum_x + x11 * sum_y],
            conic: [0.5 * sum(v_xx), sum(v_xy), 0.5 * sum(v_yy)],
            color: v_color.map(|v: f32x8<S>| sum(v)),
            opacity: sum(v_opacity),
            responsibility: sum(v_responsibility),
        };
        if touches_instances {
            let slots = slot_mass.len();
            for (out, mass) in label_mass[pair * slots..(pair + 1) * slots].iter_mut().zip(&slot_mass) {
                *out = sum(load(simd, mass));
            }
        }
    }
}
