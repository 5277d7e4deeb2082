//! The instance loss: cross-entropy of one-hot labels. Source: methods reference 4.1, 4.3, 4.4.

use cif_geometry::{PixelGrid, Real};

use super::constant;
use super::pixel::{InstanceTarget, PixelState};
use crate::constants::MIN_LABEL_PROBABILITY;
use crate::image::UNLABELLED;
use crate::settings::InstanceNormalisation;

/// The loss of a view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InstanceLoss<R> {
    /// Mean over the labelled pixels; 0 when there are none.
    pub mean: R,
    /// Labelled pixels.
    pub labelled_pixels: usize,
    /// Labelled pixels whose label no covering Gaussian supports: they count with the loss at the floor and
    /// carry no gradient.
    pub unsupported_pixels: usize,
}

/// The probability whose logarithm is taken: M_y, or `M_y / A`.
fn probability<R: Real>(state: &PixelState<R>, normalisation: InstanceNormalisation) -> R {
    match normalisation {
        InstanceNormalisation::None => state.label_probability,
        InstanceNormalisation::Coverage if state.instance_end == 0 => R::zero(),
        InstanceNormalisation::Coverage => {
            state.label_probability / (R::one() - state.instance_transmittance)
        }
    }
}

/// True when a labelled pixel carries a gradient.
#[must_use]
pub fn is_supported<R: Real>(state: &PixelState<R>, normalisation: InstanceNormalisation) -> bool {
    probability(state, normalisation) >= constant(MIN_LABEL_PROBABILITY)
}

/// Loss of one labelled pixel.
#[must_use]
pub fn pixel_loss<R: Real>(state: &PixelState<R>, normalisation: InstanceNormalisation) -> R {
    -probability(state, normalisation).max(constant(MIN_LABEL_PROBABILITY)).ln()
}

/// Loss of a view from its forward pass.
#[must_use]
pub fn instance_loss<R: Real>(
    pixels: &PixelGrid<PixelState<R>>,
    target: &InstanceTarget<'_, R>,
) -> InstanceLoss<R> {
    let mut loss = InstanceLoss { mean: R::zero(), labelled_pixels: 0, unsupported_pixels: 0 };
    let mut sum = R::zero();
    for (state, label) in pixels.pixels.iter().zip(&target.labels.pixels) {
        if *label == UNLABELLED {
            continue;
        }
        loss.labelled_pixels += 1;
        loss.unsupported_pixels += usize::from(!is_supported(state, target.normalisation));
        sum += pixel_loss(state, target.normalisation);
    }
    if loss.labelled_pixels > 0 {
        loss.mean = sum / R::of(loss.labelled_pixels as f64);
    }
    loss
}
