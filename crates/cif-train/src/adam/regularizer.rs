//! Value of the plane regularisers. Source: methods reference 1.4 and 7 (row 37).

use cif_field::deformation::{DeformationConfig, is_time_plane};

use super::PlaneWeights;

/// `L_reg`: weighted second differences along rows of all planes, and the distance of the time planes from 1.
/// Summed in double precision.
#[must_use]
pub fn plane_penalty(planes: &[f32], config: &DeformationConfig, weights: &PlaneWeights) -> f64 {
    let (levels, _) = config.plane_layout();
    let channels = config.channels as usize;
    let mut penalty = 0.0;
    for level in &levels {
        for (plane, layout) in level.iter().enumerate() {
            let n = layout.columns * channels;
            let values = &planes[layout.offset..layout.offset + layout.rows * n];
            let mut squares = 0.0_f64;
            for row in 0..layout.rows.saturating_sub(2) {
                for k in row * n..(row + 1) * n {
                    let e =
                        f64::from(values[k + 2 * n]) - 2.0 * f64::from(values[k + n]) + f64::from(values[k]);
                    squares += e * e;
                }
            }
            let differences = (layout.counted_rows.saturating_sub(2) * n).max(1) as f64;
            if is_time_plane(plane) {
                let distance: f64 = values.iter().map(|p| (1.0 - f64::from(*p)).abs()).sum();
                penalty += f64::from(weights.time_smoothness) * squares / differences
                    + f64::from(weights.time_sparsity) * distance / (layout.counted_rows * n) as f64;
            } else {
                penalty += f64::from(weights.smoothness) * squares / differences;
            }
        }
    }
    penalty
}
