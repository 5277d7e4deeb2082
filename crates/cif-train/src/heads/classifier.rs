//! A linear classifier of blended codes, and the term by which Gaussians agree with their nearest neighbours. Source:
//! methods reference 8.1 (Ye et al., Gaussian Grouping, ECCV 2024, and its released code).

use cif_field::Field;
use cif_field::neighbours::NearestNeighbours;
use cif_field::parameters::Parameter;
use rand::seq::index::sample;
use rand::{Rng, RngExt};
use rayon::prelude::*;

use super::head::{HeadLoss, HeadStep, HeadView};
use super::labels::largest;
use super::tensors::{HeadTensors, shared};
use crate::random::{Purpose, stream};

/// Pixels that one task classifies.
const CHUNK: usize = 2_048;

/// Gaussians sampled for the neighbour term.
const SAMPLES: usize = 1_000;

/// Nearest neighbours of each, itself among them.
const NEIGHBOURS: usize = 5;

/// Weight of the neighbour term.
const NEIGHBOUR_WEIGHT: f64 = 2.0;

/// Added to probabilities before their logarithm.
const TINY: f64 = 1e-10;

/// A linear map with biases from codes to classes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Classifier {
    /// `[classes, width of a code]`.
    pub(super) weights: Parameter,
    /// `[classes]`.
    pub(super) biases: Parameter,
    /// True when pixels without a label are of a class of their own, the first; otherwise they do not count.
    pub(super) unlabelled_is_class: bool,
    /// True when the loss is divided by the logarithm of the number of classes.
    pub(super) divides: bool,
}

/// Weights of a classifier of codes of `shape`.
pub(super) const fn weights(part: &'static str, shape: &'static [usize]) -> Parameter {
    shared(part, "classifier_weights", shape)
}

/// Biases of a classifier.
pub(super) const fn biases(part: &'static str) -> Parameter {
    shared(part, "classifier_biases", &[])
}

/// Uniform numbers below a magnitude.
pub(super) fn uniform(count: usize, magnitude: f32, random: &mut impl Rng) -> Vec<f32> {
    (0..count).map(|_| random.random_range(-magnitude..magnitude)).collect()
}

/// Softmax of logits, in place.
fn softmax(logits: &mut [f32]) {
    let most = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0;
    for logit in logits.iter_mut() {
        *logit = (*logit - most).exp();
        sum += *logit;
    }
    logits.iter_mut().for_each(|logit| *logit /= sum);
}

/// Gradients by weights and biases.
struct Sums {
    weights: Vec<f32>,
    biases: Vec<f32>,
}

impl Sums {
    fn zeros(classes: usize, width: usize) -> Self {
        Self { weights: vec![0.0; classes * width], biases: vec![0.0; classes] }
    }

    /// Adds the gradient by logits of a code, and adds that by the code to `v_code`.
    fn add(&mut self, v_logits: &[f32], code: &[f32], weights: &[f32], v_code: &mut [f32]) {
        let rows = self.weights.chunks_exact_mut(code.len()).zip(weights.chunks_exact(code.len()));
        for (((v_weights, weights), v_bias), v) in rows.zip(&mut self.biases).zip(v_logits) {
            *v_bias += v;
            for k in 0..code.len() {
                v_weights[k] += v * code[k];
                v_code[k] += v * weights[k];
            }
        }
    }
}

impl Classifier {
    /// Width of a code.
    fn width(&self) -> usize {
        self.weights.width()
    }

    /// Number of classes.
    fn classes(&self, field: &Field) -> usize {
        field.instances.len() + usize::from(self.unlabelled_is_class)
    }

    /// Weights or biases at the start: uniform below `1 / sqrt(width)`, as linear layers start in the released code.
    pub(super) fn start(&self, parameter: &Parameter, field: &Field, seed: u64) -> Vec<f32> {
        let (count, purpose) = if *parameter == self.biases {
            (self.classes(field), Purpose::ClassifierBiases)
        } else {
            (self.classes(field) * self.width(), Purpose::Classifier)
        };
        uniform(count, 1.0 / (self.width() as f32).sqrt(), &mut stream(seed, purpose, 0))
    }

    fn logits(&self, tensors: &HeadTensors, code: &[f32], logits: &mut [f32]) {
        let rows = tensors.values(&self.weights).chunks_exact(self.width());
        for ((logit, weights), bias) in logits.iter_mut().zip(rows).zip(tensors.values(&self.biases)) {
            *logit = bias + weights.iter().zip(code).map(|(a, b)| a * b).sum::<f32>();
        }
    }

    /// Class of a label (dense index + 1, 0 for none).
    fn class_of(&self, label: u16) -> Option<usize> {
        if self.unlabelled_is_class { Some(usize::from(label)) } else { usize::from(label).checked_sub(1) }
    }

    /// Label of a code and its probability.
    pub(super) fn decode(&self, tensors: &HeadTensors, code: &[f32]) -> (u16, f32) {
        let mut scores = vec![0.0; tensors.values(&self.biases).len()];
        self.logits(tensors, code, &mut scores);
        softmax(&mut scores);
        let (class, probability) = largest(scores).unwrap_or_default();
        (class as u16 + u16::from(!self.unlabelled_is_class), probability)
    }

    /// Mean cross-entropy of the pixels of a view, and its gradient times `weight`. See
    /// [`super::ValueHead::loss`].
    pub(super) fn loss(
        &self,
        tensors: &mut HeadTensors,
        view: &HeadView<'_>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss {
        let (classes, width) = (tensors.values(&self.biases).len(), self.width());
        let labels = &view.labels.pixels;
        let pixels = labels.iter().filter(|label| self.class_of(**label).is_some()).count();
        if pixels == 0 || classes < 2 {
            return HeadLoss::default();
        }
        let divisor = if self.divides { (classes as f64).ln() } else { 1.0 };
        let share = (f64::from(weight) / (pixels as f64 * divisor)) as f32;
        let of_chunks: Vec<(f64, Sums)> = view
            .blended
            .values
            .par_chunks(CHUNK * width)
            .zip(labels.par_chunks(CHUNK))
            .zip(v_blended.par_chunks_mut(CHUNK * width))
            .map(|((codes, labels), v_codes)| {
                let (mut loss, mut sums) = (0.0, Sums::zeros(classes, width));
                let mut scores = vec![0.0; classes];
                let of_pixels = codes.chunks_exact(width).zip(labels).zip(v_codes.chunks_exact_mut(width));
                for ((code, label), v_code) in of_pixels {
                    let Some(class) = self.class_of(*label) else { continue };
                    self.logits(tensors, code, &mut scores);
                    softmax(&mut scores);
                    loss -= f64::from(scores[class].max(f32::MIN_POSITIVE)).ln();
                    scores[class] -= 1.0;
                    scores.iter_mut().for_each(|score| *score *= share);
                    sums.add(&scores, code, tensors.values(&self.weights), v_code);
                }
                (loss, sums)
            })
            .collect();
        let loss: f64 = of_chunks.iter().map(|(loss, _)| loss).sum();
        of_chunks.iter().for_each(|(_, sums)| self.add(tensors, sums));
        HeadLoss { loss: loss / (pixels as f64 * divisor), unsupported: 0.0 }
    }

    fn add(&self, tensors: &mut HeadTensors, sums: &Sums) {
        tensors.add_gradients(&self.weights, &sums.weights);
        tensors.add_gradients(&self.biases, &sums.biases);
    }

    /// The neighbour term on pairs of [`neighbours`]: divergence of the classes of the first of each from those of the
    /// second, a mean over pairs, divided by the number of classes, times 2. Its value; its gradients by the codes of all
    /// Gaussians, `[N, width]`, and by weights and biases are added.
    pub(super) fn neighbour_term(
        &self,
        tensors: &mut HeadTensors,
        pairs: &[[u32; 2]],
        codes: &[f32],
        v_codes: &mut [f32],
    ) -> f64 {
        let (classes, width) = (tensors.values(&self.biases).len(), self.width());
        let mut rows: Vec<u32> = pairs.as_flattened().to_vec();
        rows.sort_unstable();
        rows.dedup();
        let code = |row: &u32| *row as usize * width..(*row as usize + 1) * width;
        let mut probabilities = vec![0.0_f32; rows.len() * classes];
        for (scores, row) in probabilities.chunks_exact_mut(classes).zip(&rows) {
            self.logits(tensors, &codes[code(row)], scores);
            softmax(scores);
        }
        let logarithms: Vec<f64> = probabilities.iter().map(|p| (f64::from(*p) + TINY).ln()).collect();
        let share = NEIGHBOUR_WEIGHT / (classes as f64 * pairs.len().max(1) as f64);
        let mut v_probabilities = vec![0.0_f64; probabilities.len()];
        let mut divergence = 0.0;
        let place = |row: u32| rows.binary_search(&row).map_or(0, |at| at * classes);
        for pair in pairs {
            let [a, b] = pair.map(place);
            for k in 0..classes {
                let (p, q) = (f64::from(probabilities[a + k]), f64::from(probabilities[b + k]));
                let difference = logarithms[a + k] - logarithms[b + k];
                divergence += p * difference;
                v_probabilities[a + k] += share * (difference + p / (p + TINY));
                v_probabilities[b + k] -= share * p / (q + TINY);
            }
        }
        let mut sums = Sums::zeros(classes, width);
        let mut v_logits = vec![0.0; classes];
        let of_rows = probabilities.chunks_exact(classes).zip(v_probabilities.chunks_exact(classes));
        for (row, (p, v)) in rows.iter().zip(of_rows) {
            let mean: f64 = p.iter().zip(v).map(|(p, v)| f64::from(*p) * v).sum();
            for k in 0..classes {
                v_logits[k] = (f64::from(p[k]) * (v[k] - mean)) as f32;
            }
            let weights = tensors.values(&self.weights);
            sums.add(&v_logits, &codes[code(row)], weights, &mut v_codes[code(row)]);
        }
        self.add(tensors, &sums);
        share * divergence
    }
}

/// Pairs of the neighbour term: 1 000 random Gaussians, each with those that are nearest to it at the time of the step.
pub(super) fn neighbours(step: &HeadStep<'_>) -> Vec<[u32; 2]> {
    let positions = (step.positions)();
    let n = positions.len();
    let index = NearestNeighbours::new(&positions);
    let mut random = stream(step.seed, Purpose::HeadSamples, 0);
    let samples: Vec<usize> = sample(&mut random, n, SAMPLES.min(n)).into_vec();
    samples
        .par_iter()
        .flat_map_iter(|row| {
            let near = index.nearest(positions[*row].map(f64::from), NEIGHBOURS);
            near.into_iter().map(move |found| [*row as u32, found.row])
        })
        .collect()
}
