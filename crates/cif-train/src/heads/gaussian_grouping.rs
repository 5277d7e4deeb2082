//! Gaussian Grouping: an identity code per Gaussian, blended like colour and classified per pixel.
//!
//! Source: Ye et al., Gaussian Grouping: Segment and Edit Anything in 3D Scenes, ECCV 2024, and its released code;
//! methods reference 8.1. Codes are constant in time. The loss is the mean cross-entropy over all pixels, unlabelled
//! ones being of a class like any other, divided by the logarithm of the number of classes; every fifth step also has
//! the neighbour term of [`super::classifier`].
//!
//! Deviations: the classes are the instances of the capture and one for unlabelled pixels, instead of 256; Gaussians
//! stay as they were reconstructed, where the published method trains them with their codes for 30 000 steps;
//! neighbours are those at the time of the step's first view. Where published training draws from at most 200 000
//! Gaussians, all are drawn from.
//!
//! Constants: codes of 16 from (U(0, 1) - 0.5) / 0.2821 (the first spherical harmonic) at a rate of 2.5e-3 (epsilon of
//! Adam 1e-15); classifier at 5e-4 (1e-8); 1 000 samples, 5 neighbours, weight 2.

use cif_field::Field;
use cif_field::parameters::Parameter;
use cif_geometry::spherical_harmonics::BAND_0;
use rand::RngExt;

use super::classifier::{Classifier, biases, neighbours, weights};
use super::head::{HeadLoss, HeadStep, HeadView, ValueHead};
use super::tensors::{HeadTensors, per_gaussian};
use crate::adam::EPSILON;
use crate::random::{Purpose, stream};

/// Width of a code.
const CODE: usize = 16;

/// Steps between neighbour terms.
const NEIGHBOURS_EVERY: u32 = 5;

/// Rates and epsilons.
const CODE_RATE: f32 = 2.5e-3;
const CLASSIFIER_RATE: f32 = 5e-4;
const CLASSIFIER_EPSILON: f32 = 1e-8;

const PART: &str = "gaussian_grouping";

/// Codes of every Gaussian.
const CODES: Parameter = per_gaussian(PART, "codes", &[CODE]);

const CLASSIFIER: Classifier = Classifier {
    weights: weights(PART, &[CODE]),
    biases: biases(PART),
    unlabelled_is_class: true,
    divides: true,
};

/// A code per Gaussian and a classifier.
#[derive(Clone, Copy, Debug, Default)]
pub struct GaussianGrouping;

impl ValueHead for GaussianGrouping {
    fn parameters(&self) -> Vec<Parameter> {
        vec![CODES, CLASSIFIER.weights, CLASSIFIER.biases]
    }

    fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32> {
        if *parameter != CODES {
            return CLASSIFIER.start(parameter, field, seed);
        }
        let mut random = stream(seed, Purpose::Codes, 0);
        (0..field.len() * CODE).map(|_| (random.random::<f32>() - 0.5) / BAND_0 as f32).collect()
    }

    fn rate(&self, parameter: &Parameter, _step: u32, _steps: u32) -> f32 {
        if *parameter == CODES { CODE_RATE } else { CLASSIFIER_RATE }
    }

    fn epsilon(&self, parameter: &Parameter) -> f32 {
        if *parameter == CODES { EPSILON } else { CLASSIFIER_EPSILON }
    }

    fn codes(&self) -> Parameter {
        CODES
    }

    fn loss(
        &self,
        tensors: &mut HeadTensors,
        view: &HeadView<'_>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss {
        CLASSIFIER.loss(tensors, view, weight, v_blended)
    }

    fn compared(&self, step: &HeadStep<'_>) -> Vec<[u32; 2]> {
        if step.step.is_multiple_of(NEIGHBOURS_EVERY) { neighbours(step) } else { Vec::new() }
    }

    fn regularise(
        &self,
        tensors: &mut HeadTensors,
        pairs: &[[u32; 2]],
        values: &[f32],
        v_values: &mut [f32],
    ) -> f64 {
        CLASSIFIER.neighbour_term(tensors, pairs, values, v_values)
    }

    fn decode(&self, tensors: &HeadTensors, blended: &[f32]) -> (u16, f32) {
        CLASSIFIER.decode(tensors, blended)
    }
}

#[cfg(test)]
mod tests;
