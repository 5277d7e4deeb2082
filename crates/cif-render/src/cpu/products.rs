//! Products of row-major matrices on the vector instructions of the processor, for networks that are no part of the
//! field: those of the deformation network.

use fearless_simd::Level;

use super::level::SimdLevel;
use super::matrix::{Left, Shape, Start, multiply};

/// The left side of a product of `[rows, inner]` with `[inner, columns]`.
#[derive(Clone, Copy, Debug)]
pub enum Side<'a> {
    /// `[rows, inner]`.
    Rows(&'a [f32]),
    /// Its transpose, `[inner, rows]`.
    Columns(&'a [f32]),
}

/// Computes products with some vector instructions.
#[derive(Clone, Copy, Debug)]
pub struct Products(Level);

impl Default for Products {
    fn default() -> Self {
        Self::new(SimdLevel::Auto)
    }
}

impl Products {
    /// With the instructions of a level, or the widest that there are.
    #[must_use]
    pub fn new(level: SimdLevel) -> Self {
        Self(level.level().unwrap_or_else(Level::new))
    }

    /// `out += left right` for `left` of `[rows, inner]` and `right` of `[inner, columns]`, the shape being `[rows,
    /// inner, columns]`. Fastest where `columns` is a multiple of 16.
    ///
    /// # Panics
    /// When a length differs from the shape.
    pub fn add(&self, [rows, inner, columns]: [usize; 3], left: Side<'_>, right: &[f32], out: &mut [f32]) {
        let left = match left {
            Side::Rows(values) => Left::Rows(values),
            Side::Columns(values) => Left::Columns(values),
        };
        multiply(self.0, Shape { rows, inner, columns }, left, right, Start::Out, false, out);
    }

    /// `out = bias + left right`, rectified (`max(0, .)`) on request.
    ///
    /// # Panics
    /// When a length differs from the shape.
    pub fn layer(
        &self,
        [rows, inner, columns]: [usize; 3],
        left: &[f32],
        right: &[f32],
        bias: &[f32],
        rectify: bool,
        out: &mut [f32],
    ) {
        let shape = Shape { rows, inner, columns };
        multiply(self.0, shape, Left::Rows(left), right, Start::Bias(bias), rectify, out);
    }
}
