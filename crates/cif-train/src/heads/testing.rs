//! Heads without a renderer: every Gaussian is a pixel of its own.

use cif_field::Field;
use cif_field::parameters::Parameter;
use cif_geometry::PixelGrid;
use cif_render::BlendedImage;
use cif_render::synthetic::{SyntheticConfig, generate};

use super::{HeadStep, HeadTensors, HeadValues, HeadView, ValueHead, tensors_at_start};

/// A moving field of so many Gaussians.
pub(crate) fn field(gaussians: usize) -> Field {
    generate(&SyntheticConfig { gaussians, ..SyntheticConfig::default() }).field
}

/// Labels of the pixels, unlabelled ones among them.
pub(crate) fn labels(field: &Field) -> PixelGrid<u16> {
    let count = field.instances.len() as u16 + 1;
    let labels = (0..field.len() as u16).map(|row| row * 7 % 5 % count).collect();
    PixelGrid::from_pixels(field.len() as u32, 1, labels)
}

/// Features of the pixels, some without.
pub(crate) fn features(field: &Field) -> PixelGrid<[f32; 3]> {
    let feature = |row: usize| match row % 6 {
        5 => [0.0; 3],
        _ => [0, 1, 2].map(|k| ((row * 5 + k * 3) % 7) as f32 / 3.5 - 0.9),
    };
    PixelGrid::from_pixels(field.len() as u32, 1, (0..field.len()).map(feature).collect())
}

/// Tensors at the start of the stage.
pub(crate) fn tensors(head: &dyn ValueHead, field: &Field) -> HeadTensors {
    tensors_at_start(head, field, 5)
}

/// The time that is trained, and the names of random choices.
pub(crate) const TIME: f64 = 0.4;
pub(crate) const SEED: u64 = 11;

/// Loss of a view of the values, and the gradients of the tensors that it leaves.
pub(crate) fn loss(head: &dyn ValueHead, tensors: &mut HeadTensors, field: &Field) -> f64 {
    tensors.reset();
    let values = every_value(head, tensors, field);
    let channels = head.channels(field);
    let blended =
        BlendedImage { width: field.len() as u32, height: 1, channels, values: values.values.clone() };
    let labels = labels(field);
    let mut v_values = vec![0.0; blended.values.len()];
    let view = HeadView { blended: &blended, labels: &labels, features: Some(&features(field)), seed: SEED };
    let loss = head.loss(tensors, &view, 1.0, &mut v_values);
    head.values_backward(tensors, field, &values, &v_values);
    loss.loss
}

fn every_value(head: &dyn ValueHead, tensors: &HeadTensors, field: &Field) -> HeadValues {
    let rows: Vec<u32> = (0..field.len() as u32).collect();
    head.values_of(tensors, field, TIME, &rows)
}

/// Value of the regulariser of a step, and the gradients of the tensors that it leaves.
pub(crate) fn regulariser(
    head: &dyn ValueHead,
    tensors: &mut HeadTensors,
    field: &Field,
    step: u32,
    positions: &[[f32; 3]],
) -> f64 {
    tensors.reset();
    let values = every_value(head, tensors, field);
    let mut v_values = vec![0.0; values.values.len()];
    let positions = &|| positions.to_vec();
    let pairs = head.compared(&HeadStep { positions, step, steps: 100, seed: SEED });
    let value = head.regularise(tensors, &pairs, &values.values, &mut v_values);
    head.values_backward(tensors, field, &values, &v_values);
    value
}

/// Holds gradients of some tensors to central differences of an `oracle` in double precision, which takes the values
/// of all parameters in their order. `every` skips entries of large tensors.
pub(crate) fn check_gradients(
    head: &dyn ValueHead,
    tensors: &mut HeadTensors,
    every: usize,
    oracle: &dyn Fn(&[Vec<f64>]) -> f64,
) {
    let parameters: Vec<Parameter> = head.parameters();
    let mut values: Vec<Vec<f64>> = parameters
        .iter()
        .map(|parameter| tensors.values(parameter).iter().map(|v| f64::from(*v)).collect())
        .collect();
    for (k, parameter) in parameters.iter().enumerate() {
        let gradients: Vec<f64> =
            tensors.values_and_gradients(parameter).1.iter().map(|v| f64::from(*v)).collect();
        let largest = gradients.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
        if head.rate(parameter, 1, 100) == 0.0 {
            continue;
        }
        assert!(largest > 0.0, "{} has a gradient", parameter.name);
        for at in (0..gradients.len()).step_by(every) {
            let here = values[k][at];
            let width = 1e-4 * here.abs().max(1e-2);
            let mut at_offset = |offset: f64| {
                values[k][at] = here + offset;
                oracle(&values)
            };
            let difference = (at_offset(width) - at_offset(-width)) / (2.0 * width);
            values[k][at] = here;
            let error = (gradients[at] - difference).abs();
            let name = parameter.name;
            assert!(error < 1e-3 * largest, "{name}[{at}]: {} and {difference}", gradients[at]);
        }
    }
}

/// Softmax of `weights code + biases` in double precision.
pub(crate) fn probabilities(weights: &[f64], biases: &[f64], code: &[f64]) -> Vec<f64> {
    let logits: Vec<f64> = weights
        .chunks_exact(code.len())
        .zip(biases)
        .map(|(row, bias)| bias + row.iter().zip(code).map(|(a, b)| a * b).sum::<f64>())
        .collect();
    let sum: f64 = logits.iter().map(|logit| logit.exp()).sum();
    logits.iter().map(|logit| logit.exp() / sum).collect()
}

/// Mean cross-entropy of codes of pixels with classes, divided by the logarithm of their number.
pub(crate) fn cross_entropy(codes: &[f64], weights: &[f64], biases: &[f64], classes: &[u16]) -> f64 {
    let width = weights.len() / biases.len();
    let of_pixels = codes.chunks_exact(width).zip(classes);
    let sum: f64 =
        of_pixels.map(|(code, class)| -probabilities(weights, biases, code)[usize::from(*class)].ln()).sum();
    sum / classes.len() as f64 / (biases.len() as f64).ln()
}

/// The neighbour term of codes of all Gaussians over given pairs, in double precision.
pub(crate) fn neighbour_term(codes: &[f64], weights: &[f64], biases: &[f64], positions: &[[f32; 3]]) -> f64 {
    let width = weights.len() / biases.len();
    let code = |row: usize| &codes[row * width..(row + 1) * width];
    let squared = |a: usize, b: usize| -> f64 {
        (0..3).map(|k| (f64::from(positions[a][k]) - f64::from(positions[b][k])).powi(2)).sum()
    };
    let (mut sum, mut pairs) = (0.0, 0);
    for a in 0..positions.len() {
        let mut order: Vec<usize> = (0..positions.len()).collect();
        order.sort_by(|b, c| squared(a, *b).total_cmp(&squared(a, *c)).then(b.cmp(c)));
        for b in order.into_iter().take(5) {
            let (p, q) = (probabilities(weights, biases, code(a)), probabilities(weights, biases, code(b)));
            sum += p.iter().zip(&q).map(|(p, q)| p * ((p + 1e-10).ln() - (q + 1e-10).ln())).sum::<f64>();
            pairs += 1;
        }
    }
    2.0 * sum / f64::from(pairs) / biases.len() as f64
}
