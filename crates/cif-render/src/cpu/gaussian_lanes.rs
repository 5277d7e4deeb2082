//! Small vectors and matrices of sixteen Gaussians at a time, a lane each.

use fearless_simd::f32x16;
use fearless_simd::prelude::*;

use super::pixels::{LANES, Lanes, load, splat};

/// A 3-vector of each lane.
pub(super) type Vector<S> = [f32x16<S>; 3];

/// `[row][column]` of each lane.
pub(super) type Matrix<S> = [[f32x16<S>; 3]; 3];

#[inline(always)]
pub(super) fn dot<S: Simd>(a: Vector<S>, b: Vector<S>) -> f32x16<S> {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}

#[inline(always)]
pub(super) fn cross<S: Simd>(a: Vector<S>, b: Vector<S>) -> Vector<S> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub(super) fn scaled<S: Simd>(a: Vector<S>, by: f32x16<S>) -> Vector<S> {
    [a[0] * by, a[1] * by, a[2] * by]
}

/// The same matrix for all lanes.
#[inline(always)]
pub(super) fn splat_matrix<S: Simd>(simd: S, [x, y, z]: [[f32; 3]; 3]) -> Matrix<S> {
    [splat_vector(simd, x), splat_vector(simd, y), splat_vector(simd, z)]
}

/// The same vector for all lanes.
#[inline(always)]
pub(super) fn splat_vector<S: Simd>(simd: S, [x, y, z]: [f32; 3]) -> Vector<S> {
    [splat(simd, x), splat(simd, y), splat(simd, z)]
}

/// The matrix times a vector.
#[inline(always)]
pub(super) fn transform<S: Simd>(m: &Matrix<S>, v: Vector<S>) -> Vector<S> {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// The transpose of the matrix times a vector.
#[inline(always)]
pub(super) fn transform_back<S: Simd>(m: &Matrix<S>, v: Vector<S>) -> Vector<S> {
    let [a, b, c] = [scaled(m[0], v[0]), scaled(m[1], v[1]), scaled(m[2], v[2])];
    [a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]]
}

/// Rows of sixteen values become their columns.
#[inline(always)]
pub(super) fn transpose<S: Simd>(simd: S, mut rows: [f32x16<S>; LANES]) -> [f32x16<S>; LANES] {
    // Each round moves the highest bit of a value's column to the lowest of its row.
    for _ in 0..LANES.ilog2() {
        let before = rows;
        for k in 0..LANES / 2 {
            let (low, high) = (before[k], before[k + LANES / 2]);
            rows[2 * k] = simd.zip_low_f32x16(low, high);
            rows[2 * k + 1] = simd.zip_high_f32x16(low, high);
        }
    }
    rows
}

/// Values by lane, sixteen each, as a vector per value.
#[inline(always)]
pub(super) fn load_lanes<S: Simd>(simd: S, lanes: &[Lanes; LANES]) -> [f32x16<S>; LANES] {
    let mut rows = [splat(simd, 0.0); LANES];
    for lane in 0..LANES {
        rows[lane] = load(simd, &lanes[lane]);
    }
    transpose(simd, rows)
}

/// The inverse of [`load_lanes`].
#[inline(always)]
pub(super) fn store_lanes<S: Simd>(simd: S, values: [f32x16<S>; LANES]) -> [Lanes; LANES] {
    let columns = transpose(simd, values);
    let mut lanes = [[0.0; LANES]; LANES];
    for lane in 0..LANES {
        columns[lane].store_array(&mut lanes[lane]);
    }
    lanes
}

#[cfg(test)]
mod tests {
    use fearless_simd::dispatch;

    use super::super::SimdLevel;
    use super::*;

    #[test]
    fn lanes_become_vectors_and_come_back() {
        let lanes: [Lanes; LANES] =
            std::array::from_fn(|lane| std::array::from_fn(|value| (16 * lane + value) as f32));
        for level in SimdLevel::levels() {
            let vectors = dispatch!(level, simd => load_lanes(simd, &lanes).map(|v| v.to_array()));
            for (value, vector) in vectors.iter().enumerate() {
                for (lane, found) in vector.iter().enumerate() {
                    assert_eq!(*found, (16 * lane + value) as f32, "{level:?}");
                }
            }
            let back = dispatch!(level, simd => {
                let vectors = load_lanes(simd, &lanes);
                store_lanes(simd, vectors)
            });
            assert_eq!(back, lanes);
        }
    }
}
