//! 3 x 3 matrices `[row][column]` and the few products that projection needs.

use cif_geometry::Real;

pub(super) type Matrix<R> = [[R; 3]; 3];

pub(super) fn dot<R: Real>(a: [R; 3], b: [R; 3]) -> R {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn apply<R: Real>(m: &Matrix<R>, v: [R; 3]) -> [R; 3] {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

pub(super) fn transpose<R: Real>(m: &Matrix<R>) -> Matrix<R> {
    std::array::from_fn(|r| std::array::from_fn(|c| m[c][r]))
}

pub(super) fn multiply<R: Real>(a: &Matrix<R>, b: &Matrix<R>) -> Matrix<R> {
    let columns = transpose(b);
    std::array::from_fn(|r| std::array::from_fn(|c| dot(a[r], columns[c])))
}

/// `m diag(d)`.
pub(super) fn scale_columns<R: Real>(m: &Matrix<R>, d: [R; 3]) -> Matrix<R> {
    std::array::from_fn(|r| std::array::from_fn(|c| m[r][c] * d[c]))
}

/// `a b - c d` to within two units in the last place (Kahan): the rounding error of `c d` is recovered with a
/// fused multiply-add.
pub(super) fn difference_of_products<R: Real>(a: R, b: R, c: R, d: R) -> R {
    let product = c * d;
    let error = c.mul_add(d, -product);
    a.mul_add(b, -product) - error
}

/// Cross product, each entry to within two units in the last place.
pub(super) fn cross<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [
        difference_of_products(a[1], b[2], a[2], b[1]),
        difference_of_products(a[2], b[0], a[0], b[2]),
        difference_of_products(a[0], b[1], a[1], b[0]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_area_of_needles_keeps_its_digits() {
        // Rows that are parallel to 1 part in 1e4: products of about 1e6 cancel to about 1e2.
        let a = [812.3_f32, -301.7, 499.2];
        let b = [812.31_f32, -301.75, 499.3];
        let normal = cross(a.map(f64::from), b.map(f64::from));
        let exact = dot(normal, normal);
        let normal = cross(a, b);
        let relative = (f64::from(dot(normal, normal)) - exact).abs() / exact;
        assert!(relative < 1e-5, "{relative}");
        // The textbook form is useless here, which is why it is not used.
        let naive = dot(a, a) * dot(b, b) - dot(a, b) * dot(a, b);
        assert!((f64::from(naive) - exact).abs() / exact > 1e-2, "{naive} {exact}");
    }

    #[test]
    fn products_agree_with_glam() {
        let a = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.5], [7.0, -8.0, 9.0]];
        let b = [[0.5, -1.0, 2.0], [3.0, 0.25, 1.0], [-2.0, 1.0, 4.0]];
        let expected =
            glam::DMat3::from_cols_array_2d(&transpose(&a)) * glam::DMat3::from_cols_array_2d(&transpose(&b));
        let product = multiply(&a, &b);
        for r in 0..3 {
            for c in 0..3 {
                assert!((product[r][c] - expected.col(c)[r]).abs() < 1e-12_f64);
            }
        }
    }
}
