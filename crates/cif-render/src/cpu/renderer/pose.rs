//! Gaussians at the time of the view.

use cif_field::tracks::TracksAtTime;
use cif_field::{Field, Gaussians};
use fearless_simd::Level;

use super::super::deform::{DeformationAtTime, begin};

/// The one place where Gaussians are moved to a time: learned deltas, then tracks. Arrays that nothing moves, of
/// colours up to the degree of spherical harmonics that is drawn, are left empty.
pub(super) fn pose(
    level: Level,
    field: &Field,
    deformation: Option<DeformationAtTime<'_>>,
    tracks: Option<TracksAtTime<'_>>,
    sh_degree: u8,
    posed: &mut Gaussians,
) {
    let canonical = &field.gaussians;
    match &deformation {
        Some(deformation) => deformation.forward(level, canonical, posed),
        None => *posed = Gaussians::default(),
    }
    let Some(tracks) = tracks.filter(TracksAtTime::changes_anything) else { return };
    if deformation.is_none() {
        begin(canonical, false, posed);
    }
    posed.occupancy_logits.clone_from(&canonical.occupancy_logits);
    if posed.sh_coefficients.is_empty() && tracks.changes_colors(sh_degree) {
        posed.sh_coefficients.clone_from(&canonical.sh_coefficients);
    }
    tracks.apply(canonical, posed.rows_mut());
}
