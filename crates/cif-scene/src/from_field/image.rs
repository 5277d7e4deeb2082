//! How much of a picture a Gaussian may fill.

use cif_field::Field;

/// Image of a Gaussian seen from its broad side: opacity times area, world units.
pub(super) fn image(field: &Field, row: usize) -> f64 {
    let [x, y, z] = field.gaussians.log_scales[row].map(f64::from);
    f64::from(field.gaussians.opacity(row)) * (x + y).max(y + z).max(x + z).exp()
}
