//! Vectors of feature channels.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;

/// Channels per vector.
pub(super) const LANES: usize = 8;

#[inline(always)]
pub(super) fn splat<S: Simd>(simd: S, value: f32) -> f32x8<S> {
    f32x8::splat(simd, value)
}

/// Sum of the lanes in a fixed order, the same for every instruction set.
#[inline(always)]
pub(super) fn sum<S: Simd>(vector: f32x8<S>) -> f32 {
    let l = vector.to_array();
    ((l[0] + l[4]) + (l[2] + l[6])) + ((l[1] + l[5]) + (l[3] + l[7]))
}
