//! Gradients of every parameter, and what densification needs to know of a view.

use cif_field::parameters::{LOG_CALIBRATIONS, MLP, PLANES, Tensor, TensorMut};
use cif_field::{Field, Gaussians, Tracks};

use crate::poses::PoseGradient;

/// Accumulated over the views of a step; zeroed with [`Gradients::reset`].
#[derive(Clone, Debug, PartialEq)]
pub struct Gradients {
    /// Gradient of each array of [`Field::gaussians`], same shapes.
    pub gaussians: Gaussians,
    /// Gradient of `Deformation::planes`; empty without deformation.
    pub planes: Vec<f32>,
    /// Gradient of `Deformation::mlp`; empty without deformation.
    pub mlp: Vec<f32>,
    /// Gradient of each entry of `Identities::log_calibrations`; empty without identities.
    pub log_calibrations: Vec<f32>,
    /// Gradients by the poses of groups that move as a whole, group after group, by turns in the frame of the group
    /// and translations in the world, summed over views between two keys by their shares; empty without tracks.
    pub poses: Vec<PoseGradient>,
    /// Views of the step that each pose was a key of.
    pub pose_views: Vec<u32>,
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
        let poses = field.tracks.as_ref().map_or(0, Tracks::poses);
        Self {
            gaussians: Gaussians::zeros(n),
            planes: vec![0.0; field.deformation.as_ref().map_or(0, |d| d.planes.len())],
            mlp: vec![0.0; field.deformation.as_ref().map_or(0, |d| d.mlp.len())],
            log_calibrations: vec![0.0; field.identities.as_ref().map_or(0, |rows| rows.labels.len())],
            poses: vec![PoseGradient::default(); poses],
            pose_views: vec![0; poses],
            screen: vec![[0.0; 2]; n],
            radii: vec![0.0; n],
        }
    }

    /// The gradient of every learnable tensor, in the order of [`Field::tensors`].
    #[must_use]
    pub fn tensors(&self) -> Vec<Tensor<'_>> {
        let mut tensors = Vec::from(self.gaussians.tensors());
        tensors.push((PLANES, &self.planes));
        tensors.push((MLP, &self.mlp));
        tensors.push((LOG_CALIBRATIONS, &self.log_calibrations));
        tensors
    }

    /// As [`Self::tensors`], to be changed.
    pub fn tensors_mut(&mut self) -> Vec<TensorMut<'_>> {
        let mut tensors = Vec::from(self.gaussians.tensors_mut());
        tensors.push((PLANES, &mut self.planes));
        tensors.push((MLP, &mut self.mlp));
        tensors.push((LOG_CALIBRATIONS, &mut self.log_calibrations));
        tensors
    }

    /// Sets the gradients of poses to zero.
    pub fn reset_poses(&mut self) {
        self.poses.fill(PoseGradient::default());
        self.pose_views.fill(0);
    }

    /// Sets everything to zero; the shape is kept.
    pub fn reset(&mut self) {
        for (_, values) in self.tensors_mut() {
            values.fill(0.0);
        }
        self.reset_poses();
        self.screen.fill([0.0; 2]);
        self.radii.fill(0.0);
    }
}
