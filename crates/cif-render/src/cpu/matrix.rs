//! Row-major matrix products through `matrixmultiply`, with their lengths checked.

#![allow(
    unsafe_code,
    reason = "the one door to matrixmultiply's pointer interface; lengths are checked here"
)]

/// A row-major matrix, possibly read transposed.
#[derive(Clone, Copy)]
pub(super) struct Operand<'a> {
    values: &'a [f32],
    rows: usize,
    columns: usize,
    transposed: bool,
}

impl<'a> Operand<'a> {
    /// `[rows, columns]`.
    pub(super) fn new(values: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(values.len(), rows * columns, "matrix length");
        Self { values, rows, columns, transposed: false }
    }

    /// The transpose.
    pub(super) fn t(self) -> Self {
        Self { transposed: !self.transposed, ..self }
    }

    /// Rows, columns, row stride, column stride as read.
    fn shape(&self) -> (usize, usize, isize, isize) {
        if self.transposed {
            (self.columns, self.rows, 1, self.columns as isize)
        } else {
            (self.rows, self.columns, self.columns as isize, 1)
        }
    }
}

/// `out = a b + beta out`, out row-major.
pub(super) fn multiply_into(a: Operand<'_>, b: Operand<'_>, beta: f32, out: &mut [f32]) {
    let (m, k, row_a, column_a) = a.shape();
    let (k_b, n, row_b, column_b) = b.shape();
    assert_eq!(k, k_b, "inner dimensions");
    assert_eq!(out.len(), m * n, "output length");
    // SAFETY: the constructors and the asserts above make every strided access of the three operands fall
    // inside its slice; `out` is borrowed mutably, so it overlaps neither input.
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.values.as_ptr(),
            row_a,
            column_a,
            b.values.as_ptr(),
            row_b,
            column_b,
            beta,
            out.as_mut_ptr(),
            n as isize,
            1,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_transposes() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let b = [1.0, -1.0, 0.5, 2.0, 0.0, 3.0];
        let mut out = [1.0; 4];
        multiply_into(Operand::new(&a, 2, 3), Operand::new(&b, 2, 3).t(), 0.0, &mut out);
        assert_eq!(out, [0.5, 11.0, 2.0, 26.0]);
        let mut out = [1.0; 9];
        multiply_into(Operand::new(&a, 2, 3).t(), Operand::new(&b, 2, 3), 1.0, &mut out);
        assert_eq!(out[0], 1.0 + 1.0 + 8.0);
        assert_eq!(out[8], 1.0 + 1.5 + 18.0);
    }
}
