//! The Gaussians of a view by row, at its time.

use cif_field::Gaussians;
use cif_field::gaussians::SH_FLOATS;

use super::pixels::Lanes;

/// Posed parameters by row, falling back to the canonical ones where nothing moves.
pub(super) struct PosedView<'a> {
    canonical: &'a Gaussians,
    moved: &'a Gaussians,
}

impl<'a> PosedView<'a> {
    pub(super) fn new(canonical: &'a Gaussians, moved: &'a Gaussians) -> Self {
        Self { canonical, moved }
    }

    /// Raw parameters of a Gaussian: mean, log-scale, quaternion, logits of opacity and occupancy, then zeros.
    #[inline(always)]
    pub(super) fn row(&self, row: usize) -> Lanes {
        let (canonical, moved) = (self.canonical, self.moved);
        let occupancy = *moved.occupancy_logits.get(row).unwrap_or(&canonical.occupancy_logits[row]);
        let from = if moved.means.is_empty() { canonical } else { moved };
        let ([x, y, z], [sx, sy, sz]) = (from.means[row], from.log_scales[row]);
        let ([qw, qx, qy, qz], opacity) = (from.quaternions[row], from.opacity_logits[row]);
        [x, y, z, sx, sy, sz, qw, qx, qy, qz, opacity, occupancy, 0.0, 0.0, 0.0, 0.0]
    }

    /// Coefficients of spherical harmonics of a Gaussian.
    #[inline(always)]
    pub(super) fn sh(&self, row: usize) -> &'a [f32; SH_FLOATS] {
        self.moved.sh_coefficients.get(row).unwrap_or(&self.canonical.sh_coefficients[row])
    }
}
