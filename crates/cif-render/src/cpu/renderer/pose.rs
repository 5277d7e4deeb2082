//! Gaussians at the time of the view.

use cif_field::gaussians::SH_FLOATS;
use cif_field::tracks::TracksAtTime;
use cif_field::{Field, Gaussians};
use fearless_simd::Level;
use rayon::prelude::*;

use super::super::deform::{DeformationAtTime, begin};
use super::super::posed::{deforms_colors, has_posed_colors};
use super::state::CHUNK;

/// The one place where Gaussians are moved to a time: learned deltas, then tracks. Arrays that nothing moves, of
/// colours up to the degree of spherical harmonics that is drawn, are left empty. Of colours that groups alone move, rows
/// without a group keep what they had: most of a scene, which is not worth copying for every view.
pub(super) fn pose(
    level: Level,
    field: &Field,
    deformation: Option<DeformationAtTime<'_>>,
    tracks: Option<TracksAtTime<'_>>,
    sh_degree: u8,
    posed: &mut Gaussians,
) {
    let canonical = &field.gaussians;
    let mut colors =
        if deforms_colors(field) { Vec::new() } else { std::mem::take(&mut posed.sh_coefficients) };
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
        colors.resize(canonical.len(), [0.0; SH_FLOATS]);
        let rows = colors.par_iter_mut().zip(&canonical.sh_coefficients).with_min_len(CHUNK).enumerate();
        rows.filter(|(row, _)| has_posed_colors(field, *row))
            .for_each(|(_, (posed, canonical))| *posed = *canonical);
        posed.sh_coefficients = colors;
    }
    tracks.apply(canonical, posed.rows_mut());
}
