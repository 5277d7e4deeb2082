//! The fast path: tiles, SIMD, threads.
//!
//! Results do not depend on the number of threads.

use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};

use crate::{Channels, Gradients, RenderSettings, RenderedImage};

/// Which vector instructions to use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SimdLevel {
    /// The widest the processor has.
    #[default]
    Auto,
    /// Baseline instructions of the target only.
    Portable,
}

/// Counts of one view, for cost tables.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewStatistics {
    /// Gaussians with a non-empty footprint in the view.
    pub visible: usize,
    /// (tile, Gaussian) pairs.
    pub tile_pairs: usize,
    /// (pixel, Gaussian) pairs whose footprint was evaluated in the forward pass.
    pub evaluated_pairs: u64,
}

/// What the forward pass of a training view returns.
#[derive(Clone, Debug)]
pub struct ForwardPass {
    /// Rendered colour on the background.
    pub color: PixelGrid<[f32; 3]>,
    /// Mean over labelled pixels of the instance loss; 0 without labelled pixels.
    pub instance_loss: f64,
    /// Labelled pixels of the view.
    pub labelled_pixels: usize,
    /// Labelled pixels whose label no covering Gaussian supports (methods reference 4.4).
    pub unsupported_pixels: usize,
    /// Counts.
    pub statistics: ViewStatistics,
}

/// Colour-weighted label mass per Gaussian (methods reference 5.1); add views, then normalise.
#[derive(Clone, Debug, PartialEq)]
pub struct IdentityCounts {
    /// Number of instances K.
    pub instances: usize,
    /// Mass n_i^k, `[N, K]`, over labelled pixels.
    pub label_mass: Vec<f64>,
    /// Mass d_i over all pixels used, `[N]`.
    pub total_mass: Vec<f64>,
}

/// Renders views; keeps scratch memory between calls.
pub struct Renderer {
    _private: (),
}

impl Renderer {
    /// A renderer with the given instructions; threads come from the current rayon pool.
    #[must_use]
    pub fn new(_simd: SimdLevel) -> Self {
        todo!()
    }

    /// Renders a view for looking at or measuring.
    pub fn render(
        &mut self,
        _field: &Field,
        _camera: &PinholeCamera,
        _time: f64,
        _settings: &RenderSettings,
        _channels: Channels,
    ) -> RenderedImage {
        todo!()
    }

    /// Forward pass of a training view; keeps on the renderer what [`Self::backward`] needs. `labels` hold
    /// dense index + 1, 0 = unlabelled; they are read only when `settings.instances` is set.
    pub fn forward(
        &mut self,
        _field: &Field,
        _camera: &PinholeCamera,
        _time: f64,
        _settings: &RenderSettings,
        _labels: Option<&PixelGrid<u16>>,
    ) -> ForwardPass {
        todo!()
    }

    /// Adds the gradients of the last forward pass: `v_color` is dL/dcolour per pixel, `instance_weight`
    /// multiplies the view's mean instance loss.
    pub fn backward(
        &mut self,
        _field: &Field,
        _v_color: &PixelGrid<[f32; 3]>,
        _instance_weight: f32,
        _gradients: &mut Gradients,
    ) {
        todo!()
    }

    /// Adds a view's colour-weighted label mass to `counts`.
    pub fn count_identities(
        &mut self,
        _field: &Field,
        _camera: &PinholeCamera,
        _time: f64,
        _settings: &RenderSettings,
        _labels: &PixelGrid<u16>,
        _counts: &mut IdentityCounts,
    ) {
        todo!()
    }

    /// The canonical Gaussians moved to a time: every array in raw form, deltas added (methods reference 2.3).
    pub fn deform(&mut self, _field: &Field, _time: f64) -> cif_field::Gaussians {
        todo!()
    }
}
