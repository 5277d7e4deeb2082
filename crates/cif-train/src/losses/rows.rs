//! Rows of pixel values: their sums, and what 8-bit values stand for.

/// Values per vector.
pub(super) const LANES: usize = 16;

/// Sum over a row, in single precision per lane: a lane has few enough values that it is as good as exact.
#[inline(always)]
pub(super) fn row_sum(values: &[f32], of: impl Fn(f32) -> f32) -> f64 {
    let mut lanes = [0.0_f32; LANES];
    let (vectors, rest) = values.as_chunks::<LANES>();
    for vector in vectors {
        for (lane, value) in lanes.iter_mut().zip(vector) {
            *lane += of(*value);
        }
    }
    for (lane, value) in lanes.iter_mut().zip(rest) {
        *lane += of(*value);
    }
    lanes.into_iter().map(f64::from).sum()
}

/// An 8-bit value in [0, 1].
#[inline(always)]
pub(super) fn unit(value: u8) -> f32 {
    f32::from(value) / 255.0
}
