//! Where the moved Gaussians come from.

use cif_field::{Deformation, Field, Gaussians, Heads, TrackGroup};
use cif_render::cpu::{Renderer, SimdLevel};

/// Gives the Gaussians of a field at a time. Rows keep their order and number.
pub trait MotionSource {
    /// All Gaussians at a normalised time in [0, 1], raw form, deformation added. Gaussians that are hidden at the
    /// time are given as if they were not: visibility is kept apart from motion.
    fn gaussians_at(&mut self, time: f64) -> Gaussians;

    /// True when anything can move at all.
    fn moves(&self) -> bool {
        true
    }

    /// True when any of these rows can move.
    fn moves_rows(&self, _rows: &[u32]) -> bool {
        self.moves()
    }

    /// True where rows of track groups follow these.
    fn follows_tracks(&self) -> bool {
        false
    }

    /// True where opacities can change over time.
    fn fades(&self) -> bool {
        self.moves()
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

impl FieldMotion<'_> {
    fn learns(&self, head: impl Fn(&Heads) -> bool) -> bool {
        self.field.deformation.as_ref().is_some_and(|deformation| head(&deformation.config.heads))
    }

    fn any_group(&self, holds: impl Fn(&TrackGroup) -> bool) -> bool {
        self.field.tracks.iter().flat_map(|tracks| &tracks.groups).any(holds)
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

    fn moves_rows(&self, rows: &[u32]) -> bool {
        rows.iter().any(|&row| {
            let tracks = self.field.tracks.as_ref();
            let group = tracks.and_then(|tracks| Some(&tracks.groups[tracks.group(row as usize)?]));
            let is_learned = |deformation: &Deformation| !deformation.is_still(row as usize);
            group.is_some_and(TrackGroup::moves)
                || group.is_none_or(|group| group.deformed)
                    && self.field.deformation.as_ref().is_some_and(is_learned)
        })
    }

    fn follows_tracks(&self) -> bool {
        true
    }

    fn fades(&self) -> bool {
        self.learns(|heads| heads.opacity) || self.any_group(|group| group.opacities.is_some())
    }

    fn recolors(&self) -> bool {
        self.learns(|heads| heads.sh) || self.any_group(|group| group.colors.is_some())
    }
}
