//! Gaussians at the time of the view.

use cif_field::tracks::TracksAtTime;
use cif_field::{Deformation, Field, Gaussians};
use fearless_simd::Level;

use super::super::deform::{DeformationAtTime, begin};
use super::Renderer;

/// Highest degree of the spherical harmonics that Gaussians have.
const ALL_DEGREES: u8 = 3;

impl Renderer {
    /// The canonical Gaussians moved to a time: every array in raw form, deltas added (methods reference 2.3),
    /// then moved by their tracks.
    pub fn deform(&mut self, field: &Field, time: f64) -> Gaussians {
        self.posed_gaussians(field, field.tracks.as_ref().map(|tracks| tracks.at(time)), time)
    }

    /// As [`Self::deform`], with what is hidden at the time as if it were not.
    pub fn deform_unhidden(&mut self, field: &Field, time: f64) -> Gaussians {
        let tracks = field.tracks.as_ref().map(|tracks| tracks.at(time).unhidden());
        self.posed_gaussians(field, tracks, time)
    }

    fn posed_gaussians(&mut self, field: &Field, tracks: Option<TracksAtTime<'_>>, time: f64) -> Gaussians {
        let mut posed = Gaussians::default();
        pose(self.level, field, field.deformation.as_ref(), tracks, (time, ALL_DEGREES), &mut posed);
        posed.or(&field.gaussians)
    }
}

/// The one place where Gaussians are moved to a time: learned deltas, then tracks. Arrays that nothing moves, of
/// colours up to the degree of spherical harmonics that is drawn, are left empty.
pub(super) fn pose(
    level: Level,
    field: &Field,
    deformation: Option<&Deformation>,
    tracks: Option<TracksAtTime<'_>>,
    (time, sh_degree): (f64, u8),
    posed: &mut Gaussians,
) {
    let canonical = &field.gaussians;
    match deformation {
        Some(deformation) => DeformationAtTime::new(deformation, time).forward(level, canonical, posed),
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
