//! 4D LangSplat: three language channels per Gaussian, learnt of feature maps, which answer questions pixel by
//! pixel.
//!
//! Source: Li et al., 4D LangSplat: 4D Language Gaussian Splatting via Multimodal Large Language Models, CVPR
//! 2025, and its released code; methods reference 8.6. Its time-agnostic field has a code of three channels per
//! Gaussian, constant in time and blended like colour. The loss is the mean over all pixels and channels of the
//! absolute difference from the map of the frame, where pixels without a feature count as agreeing, times 0.2.
//! A question is answered by [`relevance`].
//!
//! It distinguishes no instances: rows, labels and their scores do not exist for it.
//!
//! Deviations: the maps are given, one granularity of them (the published method makes maps at three
//! granularities of embeddings of masks, 512 numbers compressed to three by an autoencoder, and answers by the
//! granularity with the highest peak); the time-sensitive field, learnt of captions by a language model, is
//! left out; Gaussians stay as they were reconstructed, where the published method trains codes for 1 000 steps
//! on Gaussians that stand still and for 10 000 on those that move: all steps are of the second kind.
//!
//! Constants: codes from 0 at a rate of 2.5e-3 (epsilon of Adam 1e-15); weight 0.2; 10 000 steps published.

pub mod relevance;

use cif_field::Field;
use cif_field::parameters::Parameter;

use super::head::{HeadLoss, HeadView, Target, ValueHead};
use super::tensors::{HeadTensors, per_gaussian};

/// Channels of a code.
const CODE: usize = 3;

/// Rate of codes.
const RATE: f32 = 2.5e-3;

/// Weight of the absolute differences.
const WEIGHT: f64 = 0.2;

/// Codes of every Gaussian.
const CODES: Parameter = per_gaussian("lang_splat", "codes", &[CODE]);

/// Language channels per Gaussian.
#[derive(Clone, Copy, Debug, Default)]
pub struct LangSplat;

impl ValueHead for LangSplat {
    fn target(&self) -> Target {
        Target::Features
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![CODES]
    }

    fn start(&self, _parameter: &Parameter, field: &Field, _seed: u64) -> Vec<f32> {
        vec![0.0; field.len() * CODE]
    }

    fn rate(&self, _parameter: &Parameter, _step: u32, _steps: u32) -> f32 {
        RATE
    }

    fn codes(&self) -> Parameter {
        CODES
    }

    fn loss(
        &self,
        _tensors: &mut HeadTensors,
        view: &HeadView<'_>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss {
        let Some(features) = view.features else { return HeadLoss::default() };
        let share = WEIGHT / view.blended.values.len().max(1) as f64;
        let step = (f64::from(weight) * share) as f32;
        let mut sum = 0.0;
        let pixels = view.blended.pixels().zip(v_blended.chunks_exact_mut(CODE));
        for (feature, (blended, v)) in features.pixels.iter().zip(pixels) {
            if *feature == [0.0; CODE] {
                continue;
            }
            for k in 0..CODE {
                let difference = blended[k] - feature[k];
                sum += f64::from(difference.abs());
                // Where both are equal, the slope is 0.
                v[k] += if difference == 0.0 { 0.0 } else { step.copysign(difference) };
            }
        }
        HeadLoss { loss: share * sum, unsupported: 0.0 }
    }

    fn decode(&self, _tensors: &HeadTensors, _blended: &[f32]) -> (u16, f32) {
        (0, 0.0)
    }
}

#[cfg(test)]
mod tests;
