//! Where the moved Gaussians come from.

use cif_field::{Field, Gaussians};
use cif_render::cpu::{Renderer, SimdLevel};

/// Gives the Gaussians of a field at a time. Rows keep their order and number.
pub trait MotionSource {
    /// All Gaussians at a normalised time in [0, 1], raw form, deformation added. Gaussians that are hidden at the
    /// time are given as if they were not: visibility is told apart from motion.
    fn gaussians_at(&mut self, time: f64) -> Gaussians;

    /// True when anything can move at all.
    fn moves(&self) -> bool {
        true
    }

    /// True where colours change over time, other than by turning with a track.
    fn recolors(&self) -> bool {
        false
    }
}

impl<F: FnMut(f64) -> Gaussians> MotionSource for F {
    fn gaussians_at(&mut self, time: f64) -> Gaussians {
        self(time)
    }
}

/// The learned and the recorded motion of a field.
pub struct FieldMotion<'a> {
    field: &'a Field,
    renderer: Option<Renderer>,
}

impl<'a> FieldMotion<'a> {
    /// Motion of a field; a field without either stands still.
    #[must_use]
    pub fn new(field: &'a Field) -> Self {
        let posed = field.deformation.is_some() || field.tracks.is_some();
        let renderer = posed.then(|| Renderer::new(SimdLevel::Auto));
        Self { field, renderer }
    }
}

impl MotionSource for FieldMotion<'_> {
    fn gaussians_at(&mut self, time: f64) -> Gaussians {
        match &mut self.renderer {
            Some(renderer) => renderer.deform_unhidden(self.field, time),
            None => self.field.gaussians.clone(),
        }
    }

    fn moves(&self) -> bool {
        self.field.moves()
    }

    fn recolors(&self) -> bool {
        let learned = self.field.deformation.as_ref().is_some_and(|deformation| deformation.config.heads.sh);
        let mut groups = self.field.tracks.iter().flat_map(|tracks| &tracks.groups);
        learned || groups.any(|group| group.colors.is_some())
    }
}
