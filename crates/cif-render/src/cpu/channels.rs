//! Loops over the feature channels of plane nodes, eight at a time with a scalar tail.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;

use super::vector::{LANES, splat, sum};

/// Length of the part that vectors cover.
#[inline(always)]
fn whole(channels: usize) -> usize {
    channels / LANES * LANES
}

#[inline(always)]
fn at<S: Simd>(simd: S, values: &[f32], c: usize) -> f32x8<S> {
    f32x8::from_slice(simd, &values[c..c + LANES])
}

/// `out = sum_k weights[k] nodes[k]`, and `product *= out`.
#[inline(always)]
pub(super) fn blend<S: Simd, const K: usize>(
    simd: S,
    weights: [f32; K],
    nodes: [&[f32]; K],
    out: &mut [f32],
    product: &mut [f32],
) {
    let channels = out.len();
    let vectors = weights.map(|weight| splat(simd, weight));
    for c in (0..whole(channels)).step_by(LANES) {
        let mut value = at(simd, nodes[0], c) * vectors[0];
        for k in 1..K {
            value = at(simd, nodes[k], c).mul_add(vectors[k], value);
        }
        value.store_slice(&mut out[c..c + LANES]);
        (at(simd, product, c) * value).store_slice(&mut product[c..c + LANES]);
    }
    for c in whole(channels)..channels {
        let value: f32 = (0..K).map(|k| weights[k] * nodes[k][c]).sum();
        out[c] = value;
        product[c] *= value;
    }
}

/// `out *= running` when `scales`, else `out = running`; then `running *= values`.
#[inline(always)]
pub(super) fn running_product<S: Simd>(
    simd: S,
    scales: bool,
    values: &[f32],
    running: &mut [f32],
    out: &mut [f32],
) {
    let channels = out.len();
    for c in (0..whole(channels)).step_by(LANES) {
        let r = at(simd, running, c);
        let o = if scales { at(simd, out, c) * r } else { r };
        o.store_slice(&mut out[c..c + LANES]);
        (r * at(simd, values, c)).store_slice(&mut running[c..c + LANES]);
    }
    for c in whole(channels)..channels {
        out[c] = if scales { out[c] * running[c] } else { running[c] };
        running[c] *= values[c];
    }
}

/// `sum_c gradient[c] ((upper0 - lower0) w0 + (upper1 - lower1) w1)[c]`.
#[inline(always)]
pub(super) fn slope<S: Simd, const K: usize>(
    simd: S,
    gradient: &[f32],
    differences: [(&[f32], &[f32], f32); K],
) -> f32 {
    let channels = gradient.len();
    let mut total = splat(simd, 0.0);
    for c in (0..whole(channels)).step_by(LANES) {
        let mut difference = splat(simd, 0.0);
        for (upper, lower, weight) in differences {
            difference = (at(simd, upper, c) - at(simd, lower, c)).mul_add(splat(simd, weight), difference);
        }
        total = difference.mul_add(at(simd, gradient, c), total);
    }
    let mut total = sum(total);
    for c in whole(channels)..channels {
        total += gradient[c] * differences.iter().map(|(u, l, w)| (u[c] - l[c]) * w).sum::<f32>();
    }
    total
}

/// `target += weight values`.
#[inline(always)]
pub(super) fn add_scaled<S: Simd>(simd: S, weight: f32, values: &[f32], target: &mut [f32]) {
    let channels = values.len();
    let vector = splat(simd, weight);
    for c in (0..whole(channels)).step_by(LANES) {
        at(simd, values, c).mul_add(vector, at(simd, target, c)).store_slice(&mut target[c..c + LANES]);
    }
    for c in whole(channels)..channels {
        target[c] += weight * values[c];
    }
}
