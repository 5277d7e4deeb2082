//! Heads: what the instance stage learns about instances, and how pixels tell it back.
//!
//! The head of the paper is [`Cif`]. A head of another system declares tensors of its own ([`Parameter`]s, beside the
//! table of the field), the C values that they give every Gaussian, a loss on these values blended over a view, and
//! how a blended pixel decodes to a label. Its tensors follow the Gaussians when these are cloned, split, pruned or
//! relocated, are saved with the run, and are stepped by the same optimiser, whichever engine blends.
//!
//! Source: methods reference 8.

mod cif;
mod tensors;

use std::sync::Arc;

use cif_field::parameters::Parameter;
use cif_field::{Field, Identities};
use cif_geometry::PixelGrid;
use cif_render::{BlendedImage, Blending, InstanceImage, InstanceSettings};

pub use self::cif::Cif;
pub use self::tensors::HeadTensors;
use crate::config::TrainConfig;

/// Way from the Gaussians to the labels of pixels.
pub enum Pass<'a> {
    /// The identity rows of the field, whose blending and loss the renderers do in one pass, free of the number of
    /// instances. Rows are estimated before the stage, and Gaussians may be relocated in it.
    Identities(InstanceSettings),
    /// Values of the head, blended as they are.
    Values(&'a dyn ValueHead),
}

/// A head of the instance stage.
pub trait Head: Send + Sync {
    /// Name in saved runs and messages.
    fn name(&self) -> &'static str;

    /// Its way from the Gaussians to the labels of pixels.
    fn pass(&self, config: &TrainConfig) -> Pass<'_>;
}

/// Loss of a head on a view, summed over the labelled pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HeadLoss {
    /// The loss.
    pub sum: f64,
    /// Labelled pixels that nothing of the head covers.
    pub unsupported: f64,
}

/// A head that blends values of its own. Gradients reach its tensors; the Gaussians are what they are.
pub trait ValueHead: Send + Sync {
    /// Tensors: with a row per Gaussian, or of a fixed size.
    fn parameters(&self) -> Vec<Parameter>;

    /// Values of one of them at the start of the instance stage, whole rows.
    fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32>;

    /// Learning rate of one of them at a step (from 1) of the `steps` of the stage.
    fn rate(&self, parameter: &Parameter, step: u32, steps: u32) -> f32;

    /// Number of values C per Gaussian.
    fn channels(&self, field: &Field) -> usize;

    /// Weights that the values are blended with.
    fn blending(&self) -> Blending;

    /// The values at a time, `[N, C]`.
    fn values(&self, tensors: &HeadTensors, field: &Field, time: f64) -> Vec<f32>;

    /// Adds the gradients of its tensors by those of the values, `[N, C]`.
    fn values_backward(&self, tensors: &mut HeadTensors, field: &Field, time: f64, v_values: &[f32]);

    /// Loss of a view. `v_blended`, `[height, width, C]` and zero, becomes its gradient times `weight` by the blended
    /// values; gradients by tensors that the loss itself uses are added. Labels are dense indices + 1, 0 where there
    /// is none.
    fn loss(
        &self,
        tensors: &mut HeadTensors,
        blended: &BlendedImage,
        labels: &PixelGrid<u16>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss;

    /// A regulariser of a step, whose gradients are added; its value.
    fn regularise(&self, _tensors: &mut HeadTensors, _field: &Field, _seed: u64) -> f64 {
        0.0
    }

    /// Label of a pixel (dense index + 1, 0 for none) and its probability, by its blended values.
    fn decode(&self, tensors: &HeadTensors, blended: &[f32]) -> (u16, f32);

    /// Label of every Gaussian (dense index + 1, 0 for none), for export.
    fn label_of_rows(&self, tensors: &HeadTensors, field: &Field) -> Vec<u16>;
}

/// A head that blends values of its own.
pub(crate) fn value_head<'a>(head: &'a Arc<dyn Head>, config: &TrainConfig) -> Option<&'a dyn ValueHead> {
    match head.pass(config) {
        Pass::Identities(_) => None,
        Pass::Values(head) => Some(head),
    }
}

/// Instance outputs of blended values.
pub(crate) fn instance_image(
    head: &dyn ValueHead,
    tensors: &HeadTensors,
    blended: &BlendedImage,
    alpha: &PixelGrid<f32>,
) -> InstanceImage {
    let decoded: Vec<(u16, f32)> = blended.pixels().map(|pixel| head.decode(tensors, pixel)).collect();
    let (width, height) = (blended.width, blended.height);
    let grid = |values: Vec<f32>| PixelGrid::from_pixels(width, height, values);
    let probability: Vec<f32> = decoded.iter().map(|(_, probability)| *probability).collect();
    let entropy = |p: &f32| if *p > 0.0 { -p * p.ln() } else { 0.0 };
    InstanceImage {
        label: PixelGrid::from_pixels(width, height, decoded.iter().map(|(label, _)| *label).collect()),
        entropy: grid(probability.iter().map(entropy).collect()),
        foreground: grid(probability.clone()),
        probability: grid(probability),
        coverage: alpha.clone(),
    }
}

/// Identity rows that say what a head says of every Gaussian.
pub(crate) fn identities(labels: &[u16]) -> Identities {
    let mut identities = Identities::empty();
    for label in labels {
        identities.push_certain(label.checked_sub(1));
    }
    identities
}
