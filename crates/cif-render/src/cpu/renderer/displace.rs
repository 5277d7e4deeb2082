//! Motion without pictures: Gaussians at a time, and the gradients of the deformation by where it puts the centres.

use cif_field::parameters::SH_COEFFICIENTS;
use cif_field::tracks::TracksAtTime;
use cif_field::{Field, Gaussians};

use super::super::deform::DeformationAtTime;
use super::super::posed::has_posed_colors;
use super::pose::pose;
use super::state::Renderer;
use crate::Gradients;

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
        let deformation =
            field.deformation.as_ref().map(|deformation| DeformationAtTime::new(deformation, time));
        pose(self.level, field, deformation, tracks, ALL_DEGREES, &mut posed);
        let (colors, canonical) = (posed.sh_coefficients.iter_mut(), &field.gaussians.sh_coefficients);
        for (row, (posed, canonical)) in colors.zip(canonical).enumerate() {
            if !has_posed_colors(field, row) {
                *posed = *canonical;
            }
        }
        posed.or(&field.gaussians)
    }

    /// Centres at the time of the last forward pass or [`Self::displace`]; empty where nothing moves.
    #[must_use]
    pub fn posed_means(&self) -> &[[f32; 3]] {
        &self.tape.posed.means
    }

    /// Moves the Gaussians to a time without drawing them, for [`Self::posed_means`].
    pub fn displace(&mut self, field: &Field, time: f64) {
        if let Some(deformation) = &field.deformation {
            let posed = &mut self.tape.posed;
            DeformationAtTime::new(deformation, time).forward(self.level, &field.gaussians, posed);
        }
    }

    /// Adds the gradients of the deformation alone, from those by what it adds to the centres, `[N, 3]`.
    pub fn displace_backward(
        &mut self,
        field: &Field,
        time: f64,
        v_displacements: Vec<[f32; 3]>,
        gradients: &mut Gradients,
    ) {
        let Some(deformation) = &field.deformation else { return };
        let n = v_displacements.len();
        let active: Vec<u32> =
            deformation.moving_rows(n).filter(|row| v_displacements[*row as usize] != [0.0; 3]).collect();
        let moves_sh = deformation.config.heads.sh;
        let zeros = Gaussians::zeros_of(n, |parameter| moves_sh || *parameter != SH_COEFFICIENTS);
        let v_posed = Gaussians { means: v_displacements, ..zeros };
        DeformationAtTime::new(deformation, time).backward(
            self.level,
            &field.gaussians,
            &active,
            &v_posed,
            &mut self.deform_scratch,
            &mut gradients.planes,
            &mut gradients.mlp,
            &mut gradients.gaussians.means,
        );
    }
}
