//! The network of SA4D: an encoding of place and time, and four layers with rectifiers between them.

use cif_render::cpu::{Products, Side};
use rayon::prelude::*;

use super::super::classifier::uniform;
use super::super::head::Layers;
use crate::random::{Purpose, stream};

/// Width of a code.
pub(super) const CODE: usize = 16;

/// Frequencies of the place and of the time.
const PLACE_FREQUENCIES: usize = 10;
const TIME_FREQUENCIES: usize = 4;

/// Encoded values: raw ones, and a sine and a cosine per frequency.
const INPUTS: usize = 3 * (1 + 2 * PLACE_FREQUENCIES) + 1 + 2 * TIME_FREQUENCIES;

/// Widths from layer to layer.
pub(super) const WIDTHS: [usize; 5] = [INPUTS, 256, 256, 256, CODE];

/// Layers.
const LAYERS: usize = WIDTHS.len() - 1;

/// Places that are evaluated together.
const CHUNK: usize = 128;

/// Most places whose layers are kept for the backward pass, which takes 840 values each.
const KEPT: usize = 1 << 16;

/// Most tasks of a backward pass, each with gradients of its own; fixed, so that sums do not depend on threads.
const TASKS: usize = 16;

/// Weights `[inputs, outputs]` and biases of a layer.
fn layer(network: &[f32], index: usize) -> (&[f32], &[f32]) {
    let before: usize = (0..index).map(|k| (WIDTHS[k] + 1) * WIDTHS[k + 1]).sum();
    let (inputs, outputs) = (WIDTHS[index], WIDTHS[index + 1]);
    network[before..before + (inputs + 1) * outputs].split_at(inputs * outputs)
}

fn layer_mut(network: &mut [f32], index: usize) -> (&mut [f32], &mut [f32]) {
    let before: usize = (0..index).map(|k| (WIDTHS[k] + 1) * WIDTHS[k + 1]).sum();
    let (inputs, outputs) = (WIDTHS[index], WIDTHS[index + 1]);
    network[before..before + (inputs + 1) * outputs].split_at_mut(inputs * outputs)
}

/// A value with its sines and cosines at powers of two.
pub(super) fn encode(value: f64, frequencies: usize, out: &mut Vec<f32>) {
    out.push(value as f32);
    for k in 0..frequencies {
        let (sine, cosine) = (value * f64::from(1_u32 << k)).sin_cos();
        out.extend([sine as f32, cosine as f32]);
    }
}

/// Inputs of some places at a time, `[places, INPUTS]`.
fn inputs(places: &[[f32; 3]], time: f64) -> Vec<f32> {
    let mut encoded = Vec::with_capacity(places.len() * INPUTS);
    for place in places {
        for value in place {
            encode(f64::from(*value), PLACE_FREQUENCIES, &mut encoded);
        }
        encode(time, TIME_FREQUENCIES, &mut encoded);
    }
    encoded
}

/// The layers, evaluated on the vector instructions of the processor.
#[derive(Clone, Debug, Default)]
pub(super) struct Network {
    products: Products,
}

impl Network {
    /// Weights and biases at the start.
    pub(super) fn start(seed: u64) -> Vec<f32> {
        let mut random = stream(seed, Purpose::HeadNetwork, 0);
        let mut network = Vec::new();
        for pair in WIDTHS.windows(2) {
            let (inputs, outputs) = (pair[0], pair[1]);
            let bound = (6.0 / (inputs + outputs) as f32).sqrt();
            network.extend(uniform(inputs * outputs, bound, &mut random));
            network.extend(uniform(outputs, 1.0 / (inputs as f32).sqrt(), &mut random));
        }
        network
    }

    /// Values of all layers by those of the first, the codes last.
    fn evaluate(&self, network: &[f32], inputs: Vec<f32>) -> Layers {
        let rows = inputs.len() / INPUTS;
        let mut values = vec![inputs];
        for k in 0..LAYERS {
            let (weights, biases) = layer(network, k);
            let mut out = vec![0.0; rows * WIDTHS[k + 1]];
            let shape = [rows, WIDTHS[k], WIDTHS[k + 1]];
            self.products.layer(shape, &values[k], weights, biases, k + 1 < LAYERS, &mut out);
            values.push(out);
        }
        values
    }

    /// Codes of some places at a time, `[places, CODE]`.
    pub(super) fn codes(&self, network: &[f32], places: &[[f32; 3]], time: f64) -> Vec<f32> {
        let codes =
            |places: &[[f32; 3]]| self.evaluate(network, inputs(places, time)).pop().unwrap_or_default();
        let chunks: Vec<Vec<f32>> = places.par_chunks(CHUNK).map(codes).collect();
        chunks.concat()
    }

    /// The same, and what [`Self::backward`] needs of them: the layers of every chunk, of which many places keep the
    /// inputs alone.
    pub(super) fn codes_and_layers(
        &self,
        network: &[f32],
        places: &[[f32; 3]],
        time: f64,
    ) -> (Vec<f32>, Vec<Layers>) {
        let chunks = places.par_chunks(CHUNK).map(|of_chunk| {
            let mut layers = self.evaluate(network, inputs(of_chunk, time));
            let codes = layers.pop().unwrap_or_default();
            layers.truncate(if places.len() <= KEPT { LAYERS } else { 1 });
            (codes, layers)
        });
        let (codes, layers): (Vec<Vec<f32>>, Vec<Layers>) = chunks.unzip();
        (codes.concat(), layers)
    }

    /// Adds the gradients of weights and biases by those of the codes of some of the places that `layers` are of.
    pub(super) fn backward(
        &self,
        network: &[f32],
        layers: &[Layers],
        places: &[usize],
        v_codes: &[f32],
        gradients: &mut [f32],
    ) {
        let transposed: Vec<Vec<f32>> = (0..LAYERS)
            .map(|k| {
                let (weights, _) = layer(network, k);
                let (inputs, outputs) = (WIDTHS[k], WIDTHS[k + 1]);
                (0..outputs * inputs).map(|at| weights[at % inputs * outputs + at / inputs]).collect()
            })
            .collect();
        let of_task = places.len().div_ceil(TASKS).next_multiple_of(CHUNK);
        let sums: Vec<Vec<f32>> = places
            .par_chunks(of_task.max(CHUNK))
            .zip(v_codes.par_chunks(of_task.max(CHUNK) * CODE))
            .map(|(places, v_codes)| {
                let mut sums = vec![0.0; network.len()];
                for (places, v_codes) in places.chunks(CHUNK).zip(v_codes.chunks(CHUNK * CODE)) {
                    let layers = self.gather(network, layers, places);
                    self.backward_chunk(&transposed, &layers, v_codes, &mut sums);
                }
                sums
            })
            .collect();
        for sums in sums {
            gradients.iter_mut().zip(sums).for_each(|(total, v)| *total += v);
        }
    }

    /// Values of the layers at some places, but for the codes.
    fn gather(&self, network: &[f32], layers: &[Layers], places: &[usize]) -> Layers {
        let of_layer = |k: usize| {
            let mut values = Vec::with_capacity(places.len() * WIDTHS[k]);
            for place in places {
                let first = place % CHUNK * WIDTHS[k];
                values.extend_from_slice(&layers[place / CHUNK][k][first..first + WIDTHS[k]]);
            }
            values
        };
        match layers.first() {
            Some(kept) if kept.len() == LAYERS => (0..LAYERS).map(of_layer).collect(),
            _ => self.evaluate(network, of_layer(0)),
        }
    }

    fn backward_chunk(
        &self,
        transposed: &[Vec<f32>],
        values: &[Vec<f32>],
        v_codes: &[f32],
        gradients: &mut [f32],
    ) {
        let rows = v_codes.len() / CODE;
        let mut v_out = v_codes.to_vec();
        for k in (0..LAYERS).rev() {
            let (inputs, outputs) = (WIDTHS[k], WIDTHS[k + 1]);
            let (v_weights, v_biases) = layer_mut(gradients, k);
            self.products.add([inputs, rows, outputs], Side::Columns(&values[k]), &v_out, v_weights);
            for row in v_out.chunks_exact(outputs) {
                v_biases.iter_mut().zip(row).for_each(|(total, v)| *total += v);
            }
            if k == 0 {
                break;
            }
            let mut v_in = vec![0.0; rows * inputs];
            self.products.add([rows, outputs, inputs], Side::Rows(&v_out), &transposed[k], &mut v_in);
            for (v, value) in v_in.iter_mut().zip(&values[k]) {
                if *value <= 0.0 {
                    *v = 0.0;
                }
            }
            v_out = v_in;
        }
    }
}
