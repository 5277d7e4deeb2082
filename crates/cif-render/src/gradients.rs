//! Gradients of every parameter, and what densification needs to know of a view.

use cif_field::{Field, Gaussians};

/// Accumulated over the views of a step; zeroed with [`Gradients::reset`].
#[derive(Clone, Debug, PartialEq)]
pub struct Gradients {
    /// Gradient of each array of [`Field::gaussians`], same shapes.
    pub gaussians: Gaussians,
    /// Gradient of each entry of `Identities::log_calibrations`; empty without identities.
    pub log_calibrations: Vec<f32>,
    /// Gradient of `Deformation::planes`; empty without deformation.
    pub planes: Vec<f32>,
    /// Gradient of `Deformation::mlp`; empty without deformation.
    pub mlp: Vec<f32>,
    /// Gradient of the projected centre, scaled to normalised device coordinates: (W / 2 v_x, H / 2 v_y),
    /// summed over the views. `[N]`.
    pub screen: Vec<[f32; 2]>,
    /// Largest screen radius seen, pixels (3 standard deviations of the larger axis); 0 where not visible in
    /// any view. `[N]`.
    pub radii: Vec<f32>,
}

impl Gradients {
    /// Zeros in the shape of a field.
    #[must_use]
    pub fn zeros(field: &Field) -> Self {
        let n = field.gaussians.len();
        Self {
            gaussians: Gaussians {
                means: vec![[0.0; 3]; n],
                log_scales: vec![[0.0; 3]; n],
                quaternions: vec![[0.0; 4]; n],
                opacity_logits: vec![0.0; n],
                occupancy_logits: vec![0.0; n],
                sh_coefficients: vec![[0.0; cif_field::gaussians::SH_FLOATS]; n],
            },
            log_calibrations: vec![0.0; field.identities.as_ref().map_or(0, |rows| rows.labels.len())],
            planes: vec![0.0; field.deformation.as_ref().map_or(0, |d| d.planes.len())],
            mlp: vec![0.0; field.deformation.as_ref().map_or(0, |d| d.mlp.len())],
            screen: vec![[0.0; 2]; n],
            radii: vec![0.0; n],
        }
    }

    /// Sets everything to zero; the shape is kept.
    pub fn reset(&mut self) {
        self.gaussians.means.fill([0.0; 3]);
        self.gaussians.log_scales.fill([0.0; 3]);
        self.gaussians.quaternions.fill([0.0; 4]);
        self.gaussians.opacity_logits.fill(0.0);
        self.gaussians.occupancy_logits.fill(0.0);
        self.gaussians.sh_coefficients.fill([0.0; cif_field::gaussians::SH_FLOATS]);
        self.log_calibrations.fill(0.0);
        self.planes.fill(0.0);
        self.mlp.fill(0.0);
        self.screen.fill([0.0; 2]);
        self.radii.fill(0.0);
    }
}
