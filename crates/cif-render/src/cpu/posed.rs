//! The Gaussians of a view by row, at its time.

use cif_field::gaussians::SH_FLOATS;
use cif_field::{Field, Gaussians};

use super::pixels::Lanes;

/// Posed parameters by row, falling back to the canonical ones where nothing moves.
pub(super) struct PosedView<'a> {
    field: &'a Field,
    moved: &'a Gaussians,
}

/// True for rows whose colours may be moved: by the deformation, or by the pose of their group.
pub(super) fn has_posed_colors(field: &Field, row: usize) -> bool {
    deforms_colors(field) || field.tracks.as_ref().is_some_and(|tracks| tracks.group(row).is_some())
}

/// True when a deformation may move the colours of every row.
pub(super) fn deforms_colors(field: &Field) -> bool {
    field.deformation.as_ref().is_some_and(|deformation| deformation.config.heads.sh)
}

impl<'a> PosedView<'a> {
    /// Of a field, and what `pose` made of it.
    pub(super) fn new(field: &'a Field, moved: &'a Gaussians) -> Self {
        Self { field, moved }
    }

    /// Raw parameters of a Gaussian: mean, log-scale, quaternion, logits of opacity and occupancy, then zeros.
    #[inline(always)]
    pub(super) fn row(&self, row: usize) -> Lanes {
        let (canonical, moved) = (&self.field.gaussians, self.moved);
        let occupancy = *moved.occupancy_logits.get(row).unwrap_or(&canonical.occupancy_logits[row]);
        let from = if moved.means.is_empty() { canonical } else { moved };
        let ([x, y, z], [sx, sy, sz]) = (from.means[row], from.log_scales[row]);
        let ([qw, qx, qy, qz], opacity) = (from.quaternions[row], from.opacity_logits[row]);
        [x, y, z, sx, sy, sz, qw, qx, qy, qz, opacity, occupancy, 0.0, 0.0, 0.0, 0.0]
    }

    /// Coefficients of spherical harmonics of a Gaussian.
    #[inline(always)]
    pub(super) fn sh(&self, row: usize) -> &'a [f32; SH_FLOATS] {
        match self.moved.sh_coefficients.get(row) {
            Some(sh) if has_posed_colors(self.field, row) => sh,
            _ => &self.field.gaussians.sh_coefficients[row],
        }
    }
}
