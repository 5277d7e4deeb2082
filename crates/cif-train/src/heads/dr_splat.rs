//! Dr. Splat: labels of pixels registered directly on the Gaussians that show them, without training.
//!
//! Source: Kim et al., Dr. Splat: Directly Referring 3D Gaussian Splatting via Direct Language Embedding Registration,
//! CVPR 2025, and its released code; methods reference 8.4. Of every labelled training pixel, the k contributors with
//! the largest weights `T alpha` among the first 100 add these weights to a table of Gaussians and masks. A Gaussian
//! has the label of its largest sum; pixels blend one-hot labels by colour opacity.
//!
//! Deviations: a mask is its one-hot label instead of an embedding of its picture, so that nothing is quantised and
//! nothing is queried; views at all times count, with Gaussians where they are then. The rule of the published code
//! for Gaussians of little weight has no effect there, and is left out.
//!
//! Constants: k = 45, as in the published command (1 is the default of the code), of 100 contributors looked at.

use cif_field::Field;
use cif_field::parameters::{Activation, OnCopy, Parameter, Rows};
use cif_render::cpu::{ContributorMass, ContributorRule};

use super::head::{HeadLoss, HeadValues, HeadView, ValueHead};
use super::labels::largest;
use super::tensors::HeadTensors;
use super::views::TrainingViews;
use crate::error::TrainError;

/// Contributors of a pixel that count, in the published command.
pub(super) const CONTRIBUTORS: u32 = 45;

/// Contributors of a pixel that are looked at.
const FIRST: usize = 100;

/// Label of every Gaussian: dense index + 1, 0 for none.
const LABELS: Parameter = Parameter {
    name: "labels",
    part: "dr_splat",
    rate: "labels",
    rows: Rows::Gaussians,
    shape: &[],
    activation: Activation::Identity,
    on_copy: OnCopy::Same,
};

/// Labels counted over the strongest contributors of every pixel.
#[derive(Clone, Copy, Debug)]
pub struct DrSplat {
    strongest: usize,
}

impl DrSplat {
    /// With so many contributors of a pixel that count; 0 for the published number.
    #[must_use]
    pub fn new(contributors: u32) -> Self {
        Self { strongest: if contributors == 0 { CONTRIBUTORS } else { contributors } as usize }
    }

    fn rule(self) -> ContributorRule {
        ContributorRule { first: FIRST, strongest: self.strongest, mass: ContributorMass::Weight }
    }
}

impl ValueHead for DrSplat {
    fn parameters(&self) -> Vec<Parameter> {
        vec![LABELS]
    }

    fn start(&self, _parameter: &Parameter, field: &Field, _seed: u64) -> Vec<f32> {
        vec![0.0; field.len()]
    }

    fn rate(&self, _parameter: &Parameter, _step: u32, _steps: u32) -> f32 {
        0.0
    }

    fn channels(&self, field: &Field) -> usize {
        field.instances.len()
    }

    fn values(&self, tensors: &HeadTensors, field: &Field, _time: f64) -> Vec<f32> {
        let channels = self.channels(field);
        let mut values = vec![0.0; field.len() * channels];
        for (row, label) in values.chunks_exact_mut(channels).zip(tensors.values(&LABELS)) {
            // A file may say anything.
            if let Some(value) = (*label as usize).checked_sub(1).and_then(|label| row.get_mut(label)) {
                *value = 1.0;
            }
        }
        values
    }

    fn values_backward(&self, _: &mut HeadTensors, _: &Field, _: &HeadValues, _v_values: &[f32]) {}

    fn loss(
        &self,
        _tensors: &mut HeadTensors,
        _view: &HeadView<'_>,
        _weight: f32,
        _v_blended: &mut [f32],
    ) -> HeadLoss {
        HeadLoss::default()
    }

    fn decode(&self, _tensors: &HeadTensors, blended: &[f32]) -> (u16, f32) {
        match largest(blended.iter().copied()) {
            Some((label, share)) if share > 0.0 => (label as u16 + 1, share),
            _ => (0, 0.0),
        }
    }

    fn label_of_rows(&self, tensors: &HeadTensors, _field: &Field) -> Vec<u16> {
        tensors.values(&LABELS).iter().map(|label| *label as u16).collect()
    }

    fn begin(&self, tensors: &mut HeadTensors, views: &mut TrainingViews<'_>) -> Result<(), TrainError> {
        let counts = views.count(&self.rule())?;
        for (row, label) in tensors.values_mut(&LABELS).iter_mut().enumerate() {
            let best = counts.row(row).iter().copied().reduce(|a, b| if b.1 > a.1 { b } else { a });
            *label = best.map_or(0.0, |(instance, _)| f32::from(instance) + 1.0);
        }
        Ok(())
    }
}
