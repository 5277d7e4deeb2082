//! Products of the matrices of small networks: many rows by some columns. Where the right side is too large for the
//! first-level cache, as that of layers of a few hundred, its columns are packed panel by panel.
//!
//! All matrices are row-major. Vectors run over the columns of a product; columns beyond a multiple of
//! [`COLUMNS`] go one by one, so callers pad what is small. Every entry is summed in the order of the inner side,
//! whatever the tiles.

use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, f32x8, f32x16};
use fearless_simd_macros::simd;

/// Columns are padded to a multiple of this.
pub(super) const COLUMNS: usize = 8;

/// Rows that one tile of the product keeps in registers, and in twice as many registers.
const TILE_ROWS: usize = 6;
const LARGE_TILE_ROWS: usize = 8;

/// Columns of a wide tile.
const WIDE: usize = 16;

/// Entries of a right side from which on it is packed.
const PACKED: usize = 8_192;

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
    let mut packed = Vec::new();
    let mut column = 0;
    // Processors with vectors of 16 have 32 registers of them.
    if S::f32s::LEN >= WIDE {
        while column + 2 * WIDE <= columns {
            let right = panel::<{ 2 * WIDE }>(shape, right, column, &mut packed);
            wide_panel::<S, LARGE_TILE_ROWS, 2>(simd, shape, left, right, start, rectify, out, column);
            column += 2 * WIDE;
        }
    }
    while column + WIDE <= columns {
        let right = panel::<WIDE>(shape, right, column, &mut packed);
        wide_panel::<S, TILE_ROWS, 1>(simd, shape, left, right, start, rectify, out, column);
        column += WIDE;
    }
    if column + COLUMNS <= columns {
        let right = panel::<COLUMNS>(shape, right, column, &mut packed);
        narrow_panel::<S, TILE_ROWS, 1>(simd, shape, left, right, start, rectify, out, column);
        column += COLUMNS;
    }
    for column in column..columns {
        for row in 0..rows {
            single(shape, left, right, start, rectify, out, (row, column));
        }
    }
}

/// Some columns of the right side: those at the start of every `stride` values.
#[derive(Clone, Copy)]
struct Panel<'a> {
    values: &'a [f32],
    stride: usize,
}

/// `WIDTH` columns of the right side, packed where it is large.
#[inline(always)]
fn panel<'a, const WIDTH: usize>(
    Shape { rows, inner, columns }: Shape,
    right: &'a [f32],
    column: usize,
    packed: &'a mut Vec<f32>,
) -> Panel<'a> {
    if inner * columns < PACKED || rows <= LARGE_TILE_ROWS {
        return Panel { values: &right[column.min(right.len())..], stride: columns };
    }
    packed.clear();
    for row in right.chunks_exact(columns) {
        packed.extend_from_slice(&row[column..column + WIDTH]);
    }
    Panel { values: packed, stride: WIDTH }
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

/// Tiles of `R` rows by `W` vectors of columns, and all rows of such columns; the two widths differ in the vector type
/// alone.
macro_rules! tiles {
    ($panel:ident, $tile:ident, $vector:ident, $width:expr) => {
        #[inline(always)]
        fn $panel<S: Simd, const R: usize, const W: usize>(
            simd: S,
            shape: Shape,
            left: Left<'_>,
            right: Panel<'_>,
            start: Start<'_>,
            rectify: bool,
            out: &mut [f32],
            column: usize,
        ) {
            let whole_rows = shape.rows / R * R;
            for row in (0..whole_rows).step_by(R) {
                $tile::<S, R, W>(simd, shape, left, right, start, rectify, out, (row, column));
            }
            for row in whole_rows..shape.rows {
                $tile::<S, 1, W>(simd, shape, left, right, start, rectify, out, (row, column));
            }
        }

        #[inline(always)]
        fn $tile<S: Simd, const R: usize, const W: usize>(
            simd: S,
            shape: Shape,
            left: Left<'_>,
            right: Panel<'_>,
            start: Start<'_>,
            rectify: bool,
            out: &mut [f32],
            (row, column): (usize, usize),
        ) {
            let Shape { rows, inner, columns } = shape;
            let vector =
                |values: &[f32], w: usize| $vector::from_slice(simd, &values[w * $width..(w + 1) * $width]);
            let mut sums: [[$vector<S>; W]; R] = match start {
                Start::Bias(bias) => [std::array::from_fn(|w| vector(&bias[column..], w)); R],
                Start::Out => std::array::from_fn(|r| {
                    let at = (row + r) * columns + column;
                    std::array::from_fn(|w| vector(&out[at..], w))
                }),
            };
            // The last row of columns that are not packed ends with the right side.
            let right = right.values.chunks(right.stride).take(inner);
            match left {
                Left::Rows(values) => {
                    let values: [&[f32]; R] =
                        std::array::from_fn(|r| &values[(row + r) * inner..(row + r + 1) * inner]);
                    for (k, b) in right.enumerate() {
                        let b: [$vector<S>; W] = std::array::from_fn(|w| vector(b, w));
                        for r in 0..R {
                            let value = $vector::splat(simd, values[r][k]);
                            for w in 0..W {
                                sums[r][w] = b[w].mul_add(value, sums[r][w]);
                            }
                        }
                    }
                }
                Left::Columns(values) => {
                    for (values, b) in values.chunks_exact(rows).zip(right) {
                        let values: &[f32; R] = values[row..row + R].try_into().expect("a slice of R values");
                        let b: [$vector<S>; W] = std::array::from_fn(|w| vector(b, w));
                        for r in 0..R {
                            let value = $vector::splat(simd, values[r]);
                            for w in 0..W {
                                sums[r][w] = b[w].mul_add(value, sums[r][w]);
                            }
                        }
                    }
                }
            }
            let zero = $vector::splat(simd, 0.0);
            for (r, sums) in sums.into_iter().enumerate() {
                for (w, sum) in sums.into_iter().enumerate() {
                    let at = (row + r) * columns + column + w * $width;
                    let sum = if rectify { sum.max(zero) } else { sum };
                    sum.store_slice(&mut out[at..at + $width]);
                }
            }
        }
    };
}

tiles!(wide_panel, wide_tile, f32x16, WIDE);
tiles!(narrow_panel, narrow_tile, f32x8, COLUMNS);

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
                [(1, 1, 8), (7, 5, 24), (13, 64, 64), (6, 3, 16), (64, 19, 8), (9, 4, 29), (19, 130, 88)]
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
