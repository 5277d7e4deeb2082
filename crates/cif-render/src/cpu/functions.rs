//! Elementary functions of vectors, the same for every instruction set but for fused products.

use fearless_simd::prelude::*;
use fearless_simd::{f32x16, i32x16};

use super::pixels::splat;

/// `2^x` on [-1/2, 1/2], highest power first: of smallest relative error among polynomials that are 1 at 0, so that what
/// remains is rounding.
const EXP2_COEFFICIENTS: [f32; 7] = [
    1.535_335_2e-4,
    1.339_887_2e-3,
    9.618_437e-3,
    5.550_332_4e-2,
    2.402_264_8e-1,
    std::f32::consts::LN_2,
    1.0,
];

/// `1 / k!` for k = 7 down to 0.
const EXP_COEFFICIENTS: [f32; 8] =
    [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];

/// ln 2 in two parts: products of the first with whole numbers below 2^12 are exact.
const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];

/// `(ln(1 + x) - x + x^2 / 2) / x^3` on [sqrt(1/2) - 1, sqrt(2) - 1], highest power first. Source: Cephes, `logf`.
const LN_COEFFICIENTS: [f32; 9] = [
    7.037_683_6e-2,
    -1.151_461e-1,
    1.167_699_9e-1,
    -1.242_014_1e-1,
    1.424_932_3e-1,
    -1.666_805_8e-1,
    2.000_071_5e-1,
    -2.499_999_4e-1,
    3.333_333e-1,
];

/// A polynomial by its coefficients, highest power first.
#[inline(always)]
fn polynomial<S: Simd, const N: usize>(simd: S, x: f32x16<S>, coefficients: &[f32; N]) -> f32x16<S> {
    let mut value = splat(simd, coefficients[0]);
    for coefficient in &coefficients[1..] {
        value = value.mul_add(x, splat(simd, *coefficient));
    }
    value
}

/// `2^-x` for x in [0, 126]; relative error below 1e-7. A polynomial on [-1/2, 1/2], scaled by the exponent bits.
#[inline(always)]
pub(super) fn exp2_negative<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let x = x.min(splat(simd, 126.0));
    let whole = x.round_ties_even();
    let exponent: i32x16<S> = whole.to_int();
    let scale: f32x16<S> = ((127 - exponent) << 23).bitcast();
    polynomial(simd, whole - x, &EXP2_COEFFICIENTS) * scale
}

/// `e^x` for x in [-87, 88], beyond which it is that of the end; relative error below 2e-7. Source: Taylor polynomial
/// of degree 7 on [-ln(2) / 2, ln(2) / 2], scaled by the exponent bits.
#[inline(always)]
pub(super) fn exp<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let x = x.max(splat(simd, -87.0)).min(splat(simd, 88.0));
    let whole = (x * splat(simd, std::f32::consts::LOG2_E)).round_ties_even();
    let rest = whole.mul_add(splat(simd, -LN_2[0]), x);
    let rest = whole.mul_add(splat(simd, -LN_2[1]), rest);
    let exponent: i32x16<S> = whole.to_int();
    let scale: f32x16<S> = ((exponent + 127) << 23).bitcast();
    polynomial(simd, rest, &EXP_COEFFICIENTS) * scale
}

/// Natural logarithm of x from 1e-30 on, below which it is that of 1e-30; error below 2e-7, or 2e-7 of the value.
/// Source: Cephes, `logf`.
#[inline(always)]
pub(super) fn ln<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let bits: i32x16<S> = x.max(splat(simd, 1e-30)).bitcast();
    // Halves in [sqrt(1/2), sqrt(2)) come out of bits counted from those of sqrt(1/2).
    let from = bits - 0x3f35_04f3;
    let exponent = from >> 23;
    let mantissa: f32x16<S> = ((from & 0x007f_ffff) + 0x3f35_04f3).bitcast();
    let whole: f32x16<S> = exponent.to_float();
    let x = mantissa - splat(simd, 1.0);
    let squared = x * x;
    let value = polynomial(simd, x, &LN_COEFFICIENTS) * x * squared;
    let value = whole.mul_add(splat(simd, LN_2[1]), value);
    let value = squared.mul_add(splat(simd, -0.5), value);
    whole.mul_add(splat(simd, LN_2[0]), x + value)
}

/// The logistic function, accurate at both ends.
#[inline(always)]
pub(super) fn sigmoid<S: Simd>(simd: S, logit: f32x16<S>) -> f32x16<S> {
    let one = splat(simd, 1.0);
    let small = exp(simd, -logit.abs());
    let large = one / (one + small);
    logit.simd_ge(splat(simd, 0.0)).select(large, small * large)
}

#[cfg(test)]
mod tests {
    use fearless_simd::dispatch;

    use super::super::SimdLevel;
    use super::super::pixels::{Lanes, load};
    use super::*;

    /// Largest error of `found` over a range, each value in a lane of its own.
    fn worst(low: f32, high: f32, found: impl Fn(&Lanes) -> Lanes, error: impl Fn(f32, f32) -> f64) -> f64 {
        let mut worst = 0.0_f64;
        for k in 0..5_000 {
            let x: Lanes = std::array::from_fn(|lane| {
                low + (high - low) * (k * 16 + (lane * 5 + k) % 16) as f32 / 80_000.0
            });
            for (x, found) in x.into_iter().zip(found(&x)) {
                worst = worst.max(error(x, found));
            }
        }
        worst
    }

    /// Relative error.
    fn relative(expected: f64, found: f32) -> f64 {
        (f64::from(found) / expected - 1.0).abs()
    }

    #[test]
    fn functions_are_accurate_on_every_level() {
        for level in SimdLevel::levels() {
            let exp2 = |x: &Lanes| dispatch!(level, simd => exp2_negative(simd, load(simd, x)).to_array());
            let error = worst(0.0, 8.0, exp2, |x, found| relative(f64::from(-x).exp2(), found));
            assert!(error < 1.5e-7, "{level:?}: 2^-x {error}");
            let exps = |x: &Lanes| dispatch!(level, simd => exp(simd, load(simd, x)).to_array());
            let error = worst(-30.0, 30.0, exps, |x, found| relative(f64::from(x).exp(), found));
            assert!(error < 2.5e-7, "{level:?}: e^x {error}");
            let sigmoids = |x: &Lanes| dispatch!(level, simd => sigmoid(simd, load(simd, x)).to_array());
            let error = |x: f32, found| relative(1.0 / (1.0 + f64::from(-x).exp()), found);
            let error = worst(-30.0, 30.0, sigmoids, error);
            assert!(error < 5e-7, "{level:?}: logistic function {error}");
            let lns = |x: &Lanes| dispatch!(level, simd => ln(simd, load(simd, x)).to_array());
            let error = |x: f32, found: f32| {
                let expected = f64::from(x).ln();
                (f64::from(found) - expected).abs() / expected.abs().max(1.0)
            };
            let error = worst(1e-6, 3.0, lns, error).max(worst(1.0, 400.0, lns, error));
            assert!(error < 2e-7, "{level:?}: ln x {error}");
        }
    }

    #[test]
    fn functions_are_quiet_at_the_ends() {
        for level in SimdLevel::levels() {
            let ends = |x: f32| {
                dispatch!(level, simd => {
                    let x = splat(simd, x);
                    [exp2_negative(simd, x), exp(simd, -x), sigmoid(simd, -x), sigmoid(simd, x), ln(simd, -x)]
                        .map(|values| values.to_array()[3])
                })
            };
            for x in [1e30, f32::INFINITY] {
                let [exp2, exp, low, high, ln] = ends(x);
                assert!((0.0..1e-37).contains(&exp2) && (0.0..1e-37).contains(&exp), "{level:?}");
                assert!((0.0..1e-37).contains(&low) && high == 1.0, "{level:?}");
                assert!((ln + 69.07).abs() < 0.01, "{level:?}: {ln}");
            }
        }
    }
}
