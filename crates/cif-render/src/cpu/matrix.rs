//! Products of the small matrices of the deformation network: many rows by a few dozen columns, the right
//! side small enough for the first-level cache, so that nothing needs packing.
//!
//! All matrices are row-major. Vectors run over the columns of a product; columns beyond a multiple of
//! [`COLUMNS`] go one by one, so callers pad what is small.

use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, f32x8, f32x16};
use fearless_simd_macros::simd;

/// Columns are padded to a multiple of this.
pub(super) const COLUMNS: usize = 8;

/// Rows that one tile of the product keeps in registers.
const TILE_ROWS: usize = 6;

/// Columns of a wide tile.
const WIDE: usize = 16;

/// The left side of a product.
#[derive(Clone, Copy)]
pub(super) enum Left<'a> {
    /// `[rows, inner]`.
    Rows(&'a [f32]),
    /// The transpose of `[inner, rows]`.
    Columns(&'a [f32]),
}

/// Initial value to which a product is added.
#[derive(Clone, Copy)]
pub(super) enum Start<'a> {
    /// The same row of numbers everywhere.
    Bias(&'a [f32]),
    /// The values that `out` holds.
    Out,
}

/// Sizes of a product: `[rows, inner] [inner, columns]`.
#[derive(Clone, Copy)]
pub(super) struct Shape {
    pub(super) rows: usize,
    pub(super) inner: usize,
    pub(super) columns: usize,
}

/// `out = start + left right`, rectified (`max(0, .)`) on request.
///
/// # Panics
/// When a length differs from the shape.
pub(super) fn multiply(
    level: Level,
    shape: Shape,
    left: Left<'_>,
    right: &[f32],
    start: Start<'_>,
    rectify: bool,
    out: &mut [f32],
) {
    let Shape { rows, inner, columns } = shape;
    let (Left::Rows(values) | Left::Columns(values)) = left;
    assert_eq!(values.len(), rows * inner, "left side length");
    assert_eq!(right.len(), inner * columns, "right side length");
    assert_eq!(out.len(), rows * columns, "output length");
    if let Start::Bias(bias) = start {
        assert_eq!(bias.len(), columns, "bias length");
    }
    dispatch!(level, simd => multiply_tiles(simd, shape, left, right, start, rectify, out));
}

#[simd]
fn multiply_tiles<S: Simd>(
    simd: S,
    shape: Shape,
    left: Left<'_>,
    right: &[f32],
    start: Start<'_>,
    rectify: bool,
    out: &mut [f32],
) {
    let Shape { rows, columns, .. } = shape;
    let whole_rows = rows / TILE_ROWS * TILE_ROWS;
    let wide = columns / WIDE * WIDE;
    // Two vectors beside each other share what is read of the left side, where registers hold their sums.
    let paired = if has_many_registers(simd) { columns / (2 * WIDE) * (2 * WIDE) } else { 0 };
    for column in (0..paired).step_by(2 * WIDE) {
        for row in (0..whole_rows).step_by(TILE_ROWS) {
            wide_tile::<S, TILE_ROWS, 2>(simd, shape, left, right, start, rectify, out, (row, column));
        }
        for row in whole_rows..rows {
            wide_tile::<S, 1, 2>(simd, shape, left, right, start, rectify, out, (row, column));
        }
    }
    for column in (paired..wide).step_by(WIDE) {
        for row in (0..whole_rows).step_by(TILE_ROWS) {
            wide_tile::<S, TILE_ROWS, 1>(simd, shape, left, right, start, rectify, out, (row, column));
        }
        for row in whole_rows..rows {
            wide_tile::<S, 1, 1>(simd, shape, left, right, start, rectify, out, (row, column));
        }
    }
    let narrow = columns / COLUMNS * COLUMNS;
    if wide < narrow {
        for row in (0..whole_rows).step_by(TILE_ROWS) {
            narrow_tile::<S, TILE_ROWS, 1>(simd, shape, left, right, start, rectify, out, (row, wide));
        }
        for row in whole_rows..rows {
            narrow_tile::<S, 1, 1>(simd, shape, left, right, start, rectify, out, (row, wide));
        }
    }
    for column in narrow..columns {
        for row in 0..rows {
            single(shape, left, right, start, rectify, out, (row, column));
        }
    }
}

/// True with vectors of 16 and 32 registers for them.
#[inline(always)]
fn has_many_registers<S: Simd>(simd: S) -> bool {
    match simd.level() {
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        Level::Avx512(_) => true,
        _ => false,
    }
}

/// One entry of a product.
fn single(
    shape: Shape,
    left: Left<'_>,
    right: &[f32],
    start: Start<'_>,
    rectify: bool,
    out: &mut [f32],
    (row, column): (usize, usize),
) {
    let Shape { rows, inner, columns } = shape;
    let at = row * columns + column;
    let mut sum = match start {
        Start::Bias(bias) => bias[column],
        Start::Out => out[at],
    };
    for k in 0..inner {
        let value = match left {
            Left::Rows(values) => values[row * inner + k],
            Left::Columns(values) => values[k * rows + row],
        };
        sum += value * right[k * columns + column];
    }
    out[at] = if rectify { sum.max(0.0) } else { sum };
}

/// One tile of `R` rows by `C` vectors of columns; the two widths differ in the vector type alone.
macro_rules! tile {
    ($name:ident, $vector:ident, $width:expr) => {
        #[inline(always)]
        fn $name<S: Simd, const R: usize, const C: usize>(
            simd: S,
            shape: Shape,
            left: Left<'_>,
            right: &[f32],
            start: Start<'_>,
            rectify: bool,
            out: &mut [f32],
            (row, column): (usize, usize),
        ) {
            let Shape { rows, inner, columns } = shape;
            let zero = $vector::splat(simd, 0.0);
            let mut sums = [[zero; C]; R];
            for r in 0..R {
                let (from, at) = match start {
                    Start::Bias(bias) => (bias, column),
                    Start::Out => (&*out, (row + r) * columns + column),
                };
                for c in 0..C {
                    sums[r][c] = $vector::from_slice(simd, &from[at + c * $width..at + (c + 1) * $width]);
                }
            }
            let right = right.chunks_exact(columns);
            match left {
                Left::Rows(values) => {
                    let values: [&[f32]; R] =
                        std::array::from_fn(|r| &values[(row + r) * inner..(row + r + 1) * inner]);
                    for (k, right) in right.take(inner).enumerate() {
                        let right = &right[column..column + C * $width];
                        for c in 0..C {
                            let b = $vector::from_slice(simd, &right[c * $width..(c + 1) * $width]);
                            for r in 0..R {
                                sums[r][c] = b.mul_add($vector::splat(simd, values[r][k]), sums[r][c]);
                            }
                        }
                    }
                }
                Left::Columns(values) => {
                    for (values, right) in values.chunks_exact(rows).zip(right) {
                        let values: &[f32; R] = values[row..row + R].try_into().expect("a slice of R values");
                        let right = &right[column..column + C * $width];
                        for c in 0..C {
                            let b = $vector::from_slice(simd, &right[c * $width..(c + 1) * $width]);
                            for r in 0..R {
                                sums[r][c] = b.mul_add($vector::splat(simd, values[r]), sums[r][c]);
                            }
                        }
                    }
                }
            }
            for r in 0..R {
                for c in 0..C {
                    let at = (row + r) * columns + column + c * $width;
                    let sum = if rectify { sums[r][c].max(zero) } else { sums[r][c] };
                    sum.store_slice(&mut out[at..at + $width]);
                }
            }
        }
    };
}

tile!(wide_tile, f32x16, WIDE);
tile!(narrow_tile, f32x8, COLUMNS);

/// The transpose of `[rows, columns]`, each of its rows padded with zeros to `padded` entries.
pub(super) fn transpose(values: &[f32], rows: usize, columns: usize, padded: usize) -> Vec<f32> {
    let mut transposed = vec![0.0; columns * padded];
    for row in 0..rows {
        for column in 0..columns {
            transposed[column * padded + row] = values[row * columns + column];
        }
    }
    transposed
}

/// The next multiple of [`COLUMNS`].
pub(super) fn padded(columns: usize) -> usize {
    columns.next_multiple_of(COLUMNS)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, seed: u32) -> Vec<f32> {
        (0..count as u32)
            .map(|k| (k.wrapping_mul(2_654_435_761).wrapping_add(seed) >> 16) as f32 / 32_768.0 - 1.0)
            .collect()
    }

    #[test]
    fn products_equal_plain_sums_on_every_level() {
        for level in [Level::new(), Level::baseline()] {
            for (rows, inner, columns) in
                [(1, 1, 8), (7, 5, 24), (13, 64, 64), (6, 3, 16), (64, 19, 8), (9, 4, 29)]
            {
                let (a, b, bias) =
                    (numbers(rows * inner, 1), numbers(inner * columns, 2), numbers(columns, 3));
                let shape = Shape { rows, inner, columns };
                let mut from_rows = vec![0.0; rows * columns];
                multiply(level, shape, Left::Rows(&a), &b, Start::Bias(&bias), false, &mut from_rows);
                let transposed = transpose(&a, rows, inner, rows);
                let mut from_columns = bias.repeat(rows);
                multiply(level, shape, Left::Columns(&transposed), &b, Start::Out, true, &mut from_columns);
                for row in 0..rows {
                    for column in 0..columns {
                        let expected: f64 = f64::from(bias[column])
                            + (0..inner)
                                .map(|k| f64::from(a[row * inner + k]) * f64::from(b[k * columns + column]))
                                .sum::<f64>();
                        let at = row * columns + column;
                        assert!(
                            (f64::from(from_rows[at]) - expected).abs() < 1e-5,
                            "{level:?} {row} {column}"
                        );
                        assert!((f64::from(from_columns[at]) - expected.max(0.0)).abs() < 1e-5);
                    }
                }
            }
        }
    }

    #[test]
    fn transposes_are_padded_with_zeros() {
        assert_eq!(
            transpose(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 2, 3, 3),
            [1.0, 4.0, 0.0, 2.0, 5.0, 0.0, 3.0, 6.0, 0.0]
        );
        assert_eq!((padded(3), padded(8), padded(48)), (8, 8, 48));
    }
}
