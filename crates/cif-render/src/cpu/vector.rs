//! Vector helpers: one vector holds eight horizontally adjacent pixels.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;

/// Pixels per vector.
pub(super) const LANES: usize = 8;

/// One value per pixel of a group.
pub(super) type Lanes = [f32; LANES];

#[inline(always)]
pub(super) fn splat<S: Simd>(simd: S, value: f32) -> f32x8<S> {
    f32x8::splat(simd, value)
}

#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, lanes: &Lanes) -> f32x8<S> {
    f32x8::load_array_ref(simd, lanes)
}

/// Sum of the lanes in a fixed order, the same for every instruction set.
#[inline(always)]
pub(super) fn sum<S: Simd>(vector: f32x8<S>) -> f32 {
    let l = vector.to_array();
    ((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7]))
}

/// `ln(2)^k / k!` for k = 6 down to 0.
const EXP2_COEFFICIENTS: [f32; 7] =
    [1.540_353e-4, 1.333_355_8e-3, 9.618_129e-3, 5.550_411e-2, 2.402_265e-1, std::f32::consts::LN_2, 1.0];

/// `2^x` for x in [-126, 0]; relative error below 2e-7. Source: Taylor polynomial of degree 6 on
/// [-1/2, 1/2], scaled by the exponent bits.
#[inline(always)]
pub(super) fn exp2<S: Simd>(simd: S, x: f32x8<S>) -> f32x8<S> {
    let x = x.max(splat(simd, -126.0));
    let whole = x.round_ties_even();
    let f = x - whole;
    let mut p = splat(simd, EXP2_COEFFICIENTS[0]);
    for coefficient in &EXP2_COEFFICIENTS[1..] {
        p = p.mul_add(f, splat(simd, *coefficient));
    }
    let exponent: fearless_simd::i32x8<S> = whole.to_int();
    let scale: f32x8<S> = ((exponent + 127) << 23).bitcast();
    p * scale
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;

    #[test]
    fn exp2_is_accurate_on_every_level() {
        for level in [Level::new(), Level::baseline()] {
            let mut worst = 0.0_f64;
            for k in 0..20_000 {
                let x = -8.0 * (k as f32) / 20_000.0;
                let got = dispatch!(level, simd => exp2(simd, splat(simd, x)).to_array())[3];
                let expected = f64::from(x).exp2();
                worst = worst.max((f64::from(got) / expected - 1.0).abs());
            }
            assert!(worst < 2.5e-7, "{level:?}: {worst}");
        }
    }

    #[test]
    fn exp2_underflows_quietly() {
        let got = dispatch!(Level::new(), simd => exp2(simd, splat(simd, -1e30)).to_array());
        assert!(got.iter().all(|v| *v >= 0.0 && *v < 1e-37));
    }
}
