//! VLGS: language channels fused with colour by attention, blended by an opacity of their own.
//!
//! A re-implementation: there is no public code. Source: Peng et al., 3D Vision-Language Gaussian Splatting, ICLR
//! 2025; methods reference 8.3. Every Gaussian has three colour and three language channels; self-attention over the
//! six mixes them, with a residual; language is blended with a learnable opacity of its own (the semantic indicator)
//! that has its own transmittance, and classified per pixel. Between two views of the same time, a camera at a random
//! place in between is supervised with the labels of both, weighted by how alike their images are.
//!
//! Deviations: instances of the capture instead of language embeddings; the reconstruction is frozen, so that
//! attention changes language alone; labels of unlabelled pixels do not count; blended cameras need two training views
//! of one time and size, and are left out elsewhere, because what moved in between has no common target.
//!
//! Constants of the paper: 3 + 3 channels; weight 1.2 of blended cameras. Ours, because it does not give them: tokens
//! of 8 (a shared linear map of the channel and an embedding per channel), one head; language channels from N(0, 1) /
//! 10 at a rate of 2.5e-3; attention 1e-3, classifier 5e-3; opacities start at 0.1 with a rate of 0.01; ratios of
//! blended cameras from U(0.3, 0.7).

mod attention;

use cif_field::Field;
use cif_field::parameters::Parameter;
use cif_geometry::spherical_harmonics::BAND_0;
use cif_render::Blending;
use rand_distr::{Distribution, StandardNormal};

use self::attention::{LANGUAGE, TOKENS};
use super::classifier::{Classifier, biases, weights};
use super::head::{CameraBlending, HeadLoss, HeadValues, HeadView, OwnOpacity, ValueHead};
use super::tensors::{HeadTensors, per_gaussian, shared};
use crate::random::{Purpose, stream};

/// Standard deviation of language channels at the start.
const SPREAD: f32 = 0.1;

/// Rates.
const CODE_RATE: f32 = 2.5e-3;
const ATTENTION_RATE: f32 = 1e-3;
const CLASSIFIER_RATE: f32 = 5e-3;

const PART: &str = "vlgs";

/// Language channels of every Gaussian.
const CODES: Parameter = per_gaussian(PART, "codes", &[LANGUAGE]);

/// Parameters of the attention, see [`attention`].
const ATTENTION: Parameter = shared(PART, "attention", &[]);

const CLASSIFIER: Classifier = Classifier {
    weights: weights(PART, &[LANGUAGE]),
    biases: biases(PART),
    unlabelled_is_class: false,
    divides: false,
};

/// Language channels fused with colour, with an opacity of their own.
#[derive(Clone, Copy, Debug, Default)]
pub struct Vlgs;

/// Colour and language channels of a Gaussian.
fn channels(field: &Field, codes: &[f32], row: usize) -> [f32; TOKENS] {
    let color = &field.gaussians.sh_coefficients[row];
    std::array::from_fn(|k| match k.checked_sub(TOKENS - LANGUAGE) {
        None => 0.5 + BAND_0 as f32 * color[k],
        Some(k) => codes[row * LANGUAGE + k],
    })
}

impl ValueHead for Vlgs {
    fn parameters(&self) -> Vec<Parameter> {
        vec![CODES, ATTENTION, CLASSIFIER.weights, CLASSIFIER.biases]
    }

    fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32> {
        if *parameter == CODES {
            let mut random = stream(seed, Purpose::Codes, 0);
            let mut normal = || -> f32 { StandardNormal.sample(&mut random) };
            (0..field.len() * LANGUAGE).map(|_| SPREAD * normal()).collect()
        } else if *parameter == ATTENTION {
            attention::start(seed)
        } else {
            CLASSIFIER.start(parameter, field, seed)
        }
    }

    fn rate(&self, parameter: &Parameter, _step: u32, _steps: u32) -> f32 {
        match parameter.name {
            "codes" => CODE_RATE,
            "attention" => ATTENTION_RATE,
            _ => CLASSIFIER_RATE,
        }
    }

    fn own_opacity(&self) -> Option<OwnOpacity> {
        Some(OwnOpacity { start: 0.1, rate: 0.01 })
    }

    fn camera_blending(&self) -> Option<CameraBlending> {
        Some(CameraBlending { weight: 1.2, ratio: [0.3, 0.7] })
    }

    fn channels(&self, _field: &Field) -> usize {
        LANGUAGE
    }

    fn blending(&self) -> Blending {
        Blending::Own
    }

    fn values(&self, tensors: &HeadTensors, field: &Field, _time: f64) -> Vec<f32> {
        let codes = tensors.values(&CODES);
        attention::fuse(tensors.values(&ATTENTION), field.len(), |row| channels(field, codes, row))
    }

    fn values_backward(&self, tensors: &mut HeadTensors, field: &Field, _: &HeadValues, v_values: &[f32]) {
        let codes = tensors.values(&CODES);
        let of = |row: usize| channels(field, codes, row);
        let (v_codes, v_attention) = attention::backward(tensors.values(&ATTENTION), of, v_values);
        tensors.add_gradients(&CODES, &v_codes);
        tensors.add_gradients(&ATTENTION, &v_attention);
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

    fn decode(&self, tensors: &HeadTensors, blended: &[f32]) -> (u16, f32) {
        CLASSIFIER.decode(tensors, blended)
    }
}

#[cfg(test)]
mod tests;
