//! SA4D: identity codes from a network of place and time, blended like colour and classified per pixel.
//!
//! Source: Ji et al., Segment Any 4D Gaussians, 2024, and its released code; methods reference 8.2. Place and time are
//! encoded by sines and cosines, and a network of four layers maps them to a code. The loss is that of Gaussian
//! Grouping, with the neighbour term at every step. The reconstruction is frozen, as published.
//!
//! Deviations: the classes are the instances of the capture and one for unlabelled pixels, instead of 256; all
//! Gaussians are drawn from for the neighbour term, where the published training draws from at most 300 000. All
//! cameras train, where the released code trains on one on Neu3D (`cam16`): `head.camera` names one. What its paper
//! does after training, for editing, is left out. Rows of the scene have the label that most of 16 times, evenly
//! spread, give them (ours).
//!
//! Constants: 10 frequencies for the canonical place in world units and 4 for the time; layers 72-256-256-256-16 with
//! Xavier-uniform weights of gain 1 and biases below 1 / sqrt(inputs); rates 5e-4; published steps 5 000; epsilon of
//! Adam 1e-15.

mod network;

use cif_field::Field;
use cif_field::parameters::Parameter;

use self::network::{CODE, Network};
use super::classifier::{Classifier, biases, neighbours, weights};
use super::head::{HeadLoss, HeadStep, HeadValues, HeadView, ValueHead};
use super::labels::largest;
use super::tensors::{HeadTensors, shared};

/// Rate of network and classifier.
const RATE: f32 = 5e-4;

/// Most times that rows of the scene are decoded at.
const TIMES_OF_ROWS: usize = 16;

const PART: &str = "sa4d";

/// Weights and biases of the network, layer by layer.
const NETWORK: Parameter = shared(PART, "network", &[]);

const CLASSIFIER: Classifier = Classifier {
    weights: weights(PART, &[CODE]),
    biases: biases(PART),
    unlabelled_is_class: true,
    divides: true,
};

/// A network from place and time to codes, and a classifier.
#[derive(Clone, Debug, Default)]
pub struct Sa4d {
    network: Network,
    /// The only camera that trains; all do where it is empty.
    camera: String,
}

impl Sa4d {
    /// Trained on the frames of one camera, or of all where its name is empty.
    #[must_use]
    pub fn new(camera: &str) -> Self {
        Self { network: Network::default(), camera: camera.to_owned() }
    }
}

impl ValueHead for Sa4d {
    fn parameters(&self) -> Vec<Parameter> {
        vec![NETWORK, CLASSIFIER.weights, CLASSIFIER.biases]
    }

    fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32> {
        if *parameter == NETWORK { Network::start(seed) } else { CLASSIFIER.start(parameter, field, seed) }
    }

    fn rate(&self, _parameter: &Parameter, _step: u32, _steps: u32) -> f32 {
        RATE
    }

    fn trains_on(&self, camera: &str) -> bool {
        self.camera.is_empty() || self.camera == camera
    }

    fn channels(&self, _field: &Field) -> usize {
        CODE
    }

    fn values(&self, tensors: &HeadTensors, field: &Field, time: f64) -> Vec<f32> {
        self.network.codes(tensors.values(&NETWORK), &field.gaussians.means, time)
    }

    fn values_of(&self, tensors: &HeadTensors, field: &Field, time: f64, rows: &[u32]) -> HeadValues {
        let places: Vec<[f32; 3]> = rows.iter().map(|row| field.gaussians.means[*row as usize]).collect();
        let (codes, layers) = self.network.codes_and_layers(tensors.values(&NETWORK), &places, time);
        let mut values = vec![0.0; field.len() * CODE];
        for (row, code) in rows.iter().zip(codes.chunks_exact(CODE)) {
            values[*row as usize * CODE..][..CODE].copy_from_slice(code);
        }
        HeadValues { values, layers: (rows.to_vec(), layers) }
    }

    fn values_backward(
        &self,
        tensors: &mut HeadTensors,
        _: &Field,
        HeadValues { layers: (rows, layers), .. }: &HeadValues,
        v_values: &[f32],
    ) {
        // Most that is drawn lies behind what is seen, and has no gradient.
        let v_code = |place: &usize| &v_values[rows[*place] as usize * CODE..][..CODE];
        let places: Vec<usize> =
            (0..rows.len()).filter(|place| v_code(place).iter().any(|v| *v != 0.0)).collect();
        let v_codes: Vec<f32> = places.iter().flat_map(v_code).copied().collect();
        let (network, gradients) = tensors.values_and_gradients(&NETWORK);
        self.network.backward(network, layers, &places, &v_codes, gradients);
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
        neighbours(step)
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

    fn label_of_rows(&self, tensors: &HeadTensors, field: &Field) -> Vec<u16> {
        let times = &field.timeline.times;
        let count = times.len().clamp(1, TIMES_OF_ROWS);
        let mut votes = vec![vec![0.0; field.instances.len() + 1]; field.len()];
        for k in 0..count {
            let time = times.get((2 * k + 1) * times.len() / (2 * count)).copied().unwrap_or(0.0);
            let codes = self.values(tensors, field, time);
            for (votes, code) in votes.iter_mut().zip(codes.chunks_exact(CODE)) {
                votes[usize::from(CLASSIFIER.decode(tensors, code).0)] += 1.0;
            }
        }
        votes.into_iter().map(|votes| largest(votes).map_or(0, |(label, _)| label as u16)).collect()
    }
}

#[cfg(test)]
mod tests;
