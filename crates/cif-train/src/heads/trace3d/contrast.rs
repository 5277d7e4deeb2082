//! The contrastive loss of lifting: `-mean ln(sum of same e^kappa / sum of all e^kappa)` with `kappa = e^(-d^2 / tau)`
//! of the squared distance of two codes, tau being 100 within a label and 1 between labels. A pixel is none of its own
//! label's others, but one of all. Source: methods reference 8.5.
//!
//! Every pair is evaluated twice: once for the sums of the loss, and once, when these are known, for the gradient. Vectors
//! run over the codes that sums and gradients belong to, so that nothing is added up across lanes.

use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, f32x16, i32x16};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Temperature within a label, and between labels.
const SAME: f32 = 100.0;
const OTHER: f32 = 1.0;

/// Width of a code.
pub(super) const CODE: usize = 16;

/// Codes of a vector.
const LANES: usize = 16;

/// Terms that are added in single precision before their sum is in double.
const TERMS: usize = 64;

type Lanes = [f32; LANES];

/// `LANES` codes, channel by channel, with what a pass needs of each.
struct Group {
    channels: [Lanes; CODE],
    labels: Lanes,
    /// 1 / sum over all, and 1 / sum over its own label, once these are known.
    inverses: [Lanes; 2],
}

/// A code of the other side of pairs.
struct One<'a> {
    code: &'a [f32; CODE],
    label: f32,
    inverses: [f32; 2],
}

/// Kernels of pairs.
struct Kernels<S: Simd> {
    /// 1 / tau.
    inverse: f32x16<S>,
    kappa: f32x16<S>,
    /// `e^kappa`.
    power: f32x16<S>,
    /// 1 where both are of one label, else 0.
    same: f32x16<S>,
}

#[inline(always)]
fn splat<S: Simd>(simd: S, value: f32) -> f32x16<S> {
    f32x16::splat(simd, value)
}

/// `e^x` for x up to 1: degree 6 around whole powers of two; relative error below 3e-7 times the larger of 1 and |x|.
#[inline(always)]
fn exp<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let scaled = (x * std::f32::consts::LOG2_E).max(splat(simd, -126.0));
    let whole = scaled.round_ties_even();
    let f = (scaled - whole) * std::f32::consts::LN_2;
    let mut p = splat(simd, 1.0 / 720.0);
    for coefficient in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = p.mul_add(f, splat(simd, coefficient));
    }
    let exponent: i32x16<S> = whole.to_int();
    let scale: f32x16<S> = ((exponent + 127) << 23).bitcast();
    p * scale
}

#[inline(always)]
fn kernels<S: Simd>(simd: S, group: &Group, one: &One<'_>) -> Kernels<S> {
    // Two sums, which wait less for one another.
    let mut squared = [splat(simd, 0.0); 2];
    for (k, (channel, value)) in group.channels.iter().zip(one.code).enumerate() {
        let difference = f32x16::from_slice(simd, channel) - *value;
        squared[k % 2] = difference.mul_add(difference, squared[k % 2]);
    }
    let is_same = f32x16::from_slice(simd, &group.labels).simd_eq(splat(simd, one.label));
    let either = |same: f32, other: f32| is_same.select(splat(simd, same), splat(simd, other));
    let inverse = either(1.0 / SAME, 1.0 / OTHER);
    let kappa = exp(simd, -(squared[0] + squared[1]) * inverse);
    Kernels { inverse, kappa, power: exp(simd, kappa), same: either(1.0, 0.0) }
}

/// Sums of `e^kappa` of the codes of a group over all codes, and over those of their own label, themselves among these.
#[simd]
fn sums<S: Simd>(simd: S, group: &Group, ones: &[One<'_>]) -> [[f64; LANES]; 2] {
    let mut sums = [[0.0; LANES]; 2];
    for ones in ones.chunks(TERMS) {
        let mut terms = [splat(simd, 0.0); 2];
        for one in ones {
            let Kernels { power, same, .. } = kernels(simd, group, one);
            terms[0] += power;
            terms[1] = power.mul_add(same, terms[1]);
        }
        for (sums, terms) in sums.iter_mut().zip(terms) {
            sums.iter_mut().zip(terms.to_array()).for_each(|(sum, term)| *sum += f64::from(term));
        }
    }
    sums
}

/// Gradient of the loss times the number of codes by the codes of a group, channel by channel.
#[simd]
fn gradient<S: Simd>(simd: S, group: &Group, ones: &[One<'_>]) -> [Lanes; CODE] {
    let [of_all, of_same] = group.inverses.map(|inverses| f32x16::from_slice(simd, &inverses));
    let mut sums = [splat(simd, 0.0); CODE];
    for one in ones {
        let Kernels { inverse, kappa, power, same } = kernels(simd, group, one);
        let v_kappa = (of_all + one.inverses[0]) - same * (of_same + one.inverses[1]);
        // How much the other code pulls or pushes; at no distance from itself, a code does neither.
        let pull = inverse * v_kappa * (kappa * power) * -2.0;
        for ((sum, channel), value) in sums.iter_mut().zip(&group.channels).zip(one.code) {
            *sum = pull.mul_add(f32x16::from_slice(simd, channel) - *value, *sum);
        }
    }
    sums.map(|sum| sum.to_array())
}

/// The loss of codes with labels, and its gradient. A code without another of its label adds nothing.
pub(super) fn contrast(level: Level, codes: &[[f32; CODE]], labels: &[u16]) -> (f64, Vec<[f32; CODE]>) {
    let n = codes.len();
    let mut groups: Vec<Group> = codes
        .chunks(LANES)
        .zip(labels.chunks(LANES))
        .map(|(codes, labels)| Group {
            channels: std::array::from_fn(|k| {
                std::array::from_fn(|lane| codes.get(lane).map_or(0.0, |code| code[k]))
            }),
            labels: std::array::from_fn(|lane| labels.get(lane).map_or(0.0, |label| f32::from(*label))),
            inverses: [[0.0; LANES]; 2],
        })
        .collect();
    let one = |(code, label)| One { code, label: f32::from(label), inverses: [0.0; 2] };
    let mut ones: Vec<One<'_>> = codes.iter().zip(labels.iter().copied()).map(one).collect();
    let sums: Vec<[[f64; LANES]; 2]> =
        groups.par_iter().map(|group| dispatch!(level, simd => sums(simd, group, &ones))).collect();
    // Between itself and itself, at no distance, the kernel is 1.
    let itself = f64::from(dispatch!(level, simd => exp(simd, splat(simd, 1.0)).to_array())[0]);
    let mut loss = 0.0;
    for (row, one) in ones.iter_mut().enumerate() {
        let (group, lane) = (row / LANES, row % LANES);
        let [all, same] = sums[group].map(|sums| sums[lane]);
        // Every power is 1 or more.
        let same = same - itself;
        if same > 0.5 {
            loss -= (same / all).ln();
            one.inverses = [(1.0 / all) as f32, (1.0 / same) as f32];
            for (of_group, inverse) in groups[group].inverses.iter_mut().zip(one.inverses) {
                of_group[lane] = inverse;
            }
        }
    }
    let gradients: Vec<[Lanes; CODE]> =
        groups.par_iter().map(|group| dispatch!(level, simd => gradient(simd, group, &ones))).collect();
    let of_row = |row: usize| {
        let gradient = &gradients[row / LANES];
        std::array::from_fn(|k| gradient[k][row % LANES] / n as f32)
    };
    (loss / n.max(1) as f64, (0..n).map(of_row).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_accurate() {
        for level in [Level::new(), Level::baseline()] {
            let of = |x: f32| dispatch!(level, simd => exp(simd, splat(simd, x)).to_array())[3];
            for k in 0..4_000 {
                let x = 1.0 - k as f32 * 0.02;
                let expected = f64::from(x).exp();
                let allowed = 3e-7 * f64::from(x.abs().max(1.0));
                assert!((f64::from(of(x)) / expected - 1.0).abs() < allowed, "{x}");
            }
            assert!(of(-1e30) < 1e-37 && of(f32::NEG_INFINITY) < 1e-37);
        }
    }
}
