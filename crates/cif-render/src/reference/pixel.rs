//! A pixel after the forward pass, and the labels that it is compared with.

use cif_geometry::{PixelGrid, Real};

use super::identity_rows::IdentityProbabilities;
use crate::settings::InstanceNormalisation;

/// Labels, identities and normalisation for the instance pass of a training view.
#[derive(Clone, Copy, Debug)]
pub struct InstanceTarget<'a, R> {
    /// Dense instance index + 1 per pixel, 0 = unlabelled.
    pub labels: &'a PixelGrid<u16>,
    /// Identity distribution of every Gaussian.
    pub identities: &'a IdentityProbabilities<R>,
    /// Loss normalisation.
    pub normalisation: InstanceNormalisation,
}

/// A pixel after the forward pass.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelState<R> {
    /// Blended colour without background.
    pub color: [R; 3],
    /// Blended depth D, metres; the expected depth is `D / (1 - T)`.
    pub depth: R,
    /// Colour transmittance T behind the last contributor.
    pub transmittance: R,
    /// Position in the order after the last colour contributor; 0 for none.
    pub end: usize,
    /// M_y: rendered identity of the pixel's label.
    pub label_probability: R,
    /// Instance transmittance S behind the last contributor.
    pub instance_transmittance: R,
    /// Position in the order after the last instance contributor; 0 for none.
    pub instance_end: usize,
}

impl<R: Real> PixelState<R> {
    /// A pixel that nothing covers.
    #[must_use]
    pub fn empty() -> Self {
        Self {
            color: [R::zero(); 3],
            depth: R::zero(),
            transmittance: R::one(),
            end: 0,
            label_probability: R::zero(),
            instance_transmittance: R::one(),
            instance_end: 0,
        }
    }
}
