//! Vectors of pixels: sixteen neighbours, two rows of eight.

use fearless_simd::prelude::*;
use fearless_simd::{f32x4, f32x16};

/// Pixels per vector.
pub(super) const LANES: usize = 16;

/// One value per pixel of a group.
pub(super) type Lanes = [f32; LANES];

#[inline(always)]
pub(super) fn splat<S: Simd>(simd: S, value: f32) -> f32x16<S> {
    f32x16::splat(simd, value)
}

#[inline(always)]
pub(super) fn splat_each<S: Simd>(simd: S, [a, b, c]: [f32; 3]) -> [f32x16<S>; 3] {
    [splat(simd, a), splat(simd, b), splat(simd, c)]
}

#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, lanes: &Lanes) -> f32x16<S> {
    f32x16::load_array_ref(simd, lanes)
}

/// Four partial sums of four lanes each, the same for every instruction set.
#[inline(always)]
fn quarter<S: Simd>(simd: S, vector: f32x16<S>) -> f32x4<S> {
    let (low, high) = simd.split_f32x16(vector);
    let (low, high) = simd.split_f32x8(low + high);
    low + high
}

/// Sum of the lanes in a fixed order.
#[inline(always)]
pub(super) fn sum<S: Simd>(simd: S, vector: f32x16<S>) -> f32 {
    let [a, b, c, d] = quarter(simd, vector).to_array();
    (a + c) + (b + d)
}

/// Sums of the lanes of four vectors, in the order of [`sum`].
#[inline(always)]
pub(super) fn sum_each<S: Simd>(simd: S, vectors: [f32x16<S>; 4]) -> [f32; 4] {
    // No `map`: its closures would not be compiled for the instructions.
    let [a, b, c, d] = vectors;
    let (a, b, c, d) = (quarter(simd, a), quarter(simd, b), quarter(simd, c), quarter(simd, d));
    // (a0 + a2, b0 + b2, a1 + a3, b1 + b3), likewise c and d; then the two halves.
    let ab = simd.zip_low_f32x4(a, b) + simd.zip_high_f32x4(a, b);
    let cd = simd.zip_low_f32x4(c, d) + simd.zip_high_f32x4(c, d);
    let [a, c, b, d] = (simd.zip_low_f32x4(ab, cd) + simd.zip_high_f32x4(ab, cd)).to_array();
    [a, b, c, d]
}

#[cfg(test)]
mod tests {
    use fearless_simd::dispatch;

    use super::super::SimdLevel;
    use super::*;

    #[test]
    fn sums_take_every_lane_once_in_one_order() {
        let lanes: [Lanes; 4] =
            std::array::from_fn(|k| std::array::from_fn(|lane| 1.0 / (1 + lane + 100 * k) as f32));
        let expected = lanes.map(|l| {
            let eight: [f32; 8] = std::array::from_fn(|k| l[k] + l[k + 8]);
            let four: [f32; 4] = std::array::from_fn(|k| eight[k] + eight[k + 4]);
            (four[0] + four[2]) + (four[1] + four[3])
        });
        for level in SimdLevel::levels() {
            let each = dispatch!(level, simd => sum_each(simd, lanes.map(|l| load(simd, &l))));
            let single = dispatch!(level, simd => lanes.map(|l| sum(simd, load(simd, &l))));
            assert_eq!((each, single), (expected, expected), "{level:?}");
        }
    }
}
