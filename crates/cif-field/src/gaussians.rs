//! Canonical Gaussians as a struct of arrays, in the raw form that the optimiser holds.

use cif_geometry::spherical_harmonics::COEFFICIENTS;

/// Floats of spherical harmonics per Gaussian: `[16, 3]`.
pub const SH_FLOATS: usize = COEFFICIENTS * 3;

/// N Gaussians; every array has N entries (times its row length).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Centres x, world, metres.
    pub means: Vec<[f32; 3]>,
    /// Raw log-scales s: the standard deviation along each axis is `exp(s)`, metres.
    pub log_scales: Vec<[f32; 3]>,
    /// Raw quaternions (w, x, y, z), not normalised.
    pub quaternions: Vec<[f32; 4]>,
    /// Raw opacity logits a.
    pub opacity_logits: Vec<f32>,
    /// Raw occupancy logits h.
    pub occupancy_logits: Vec<f32>,
    /// Spherical harmonics `[16, 3]`, coefficient-major, RGB inner; always degree 3 in storage.
    pub sh_coefficients: Vec<[f32; SH_FLOATS]>,
}

impl Gaussians {
    /// Number of Gaussians N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Rows `sources[0], sources[1], ...` as a new set; rows may repeat.
    ///
    /// # Panics
    /// When a source is out of range.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        fn pick<T: Copy>(values: &[T], sources: &[u32]) -> Vec<T> {
            sources.iter().map(|&row| values[row as usize]).collect()
        }
        Self {
            means: pick(&self.means, sources),
            log_scales: pick(&self.log_scales, sources),
            quaternions: pick(&self.quaternions, sources),
            opacity_logits: pick(&self.opacity_logits, sources),
            occupancy_logits: pick(&self.occupancy_logits, sources),
            sh_coefficients: pick(&self.sh_coefficients, sources),
        }
    }
}
