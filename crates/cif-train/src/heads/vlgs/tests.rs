use super::attention::PARAMETERS;
use super::*;
use crate::heads::testing::{check_gradients, field, labels, loss, probabilities, tensors};

/// Fused language channels of a Gaussian in double precision, by the definition.
fn fused(parameters: &[f64], x: &[f64]) -> Vec<f64> {
    const D: usize = 8;
    assert_eq!(parameters.len(), PARAMETERS);
    let (lift, rest) = parameters.split_at(D);
    let (embeddings, rest) = rest.split_at(6 * D);
    let (maps, rest) = rest.split_at(3 * D * D);
    let (out, bias) = rest.split_at(D);
    let mapped = |which: usize, m: usize| -> Vec<f64> {
        let token = |i: usize| x[m] * lift[i] + embeddings[m * D + i];
        (0..D).map(|j| (0..D).map(|i| token(i) * maps[(which * D + i) * D + j]).sum()).collect()
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    (3..6)
        .map(|m| {
            let query = mapped(0, m);
            let powers: Vec<f64> =
                (0..6).map(|n| (dot(&query, &mapped(1, n)) / (D as f64).sqrt()).exp()).collect();
            let sum: f64 = powers.iter().sum();
            let attended: f64 = (0..6).map(|n| powers[n] / sum * dot(&mapped(2, n), out)).sum();
            x[m] + attended + bias[0]
        })
        .collect()
}

#[test]
fn gradients_are_those_of_double_precision() {
    let field = field(30);
    let labels = labels(&field).pixels;
    let mut tensors = tensors(&Vlgs, &field);
    loss(&Vlgs, &mut tensors, &field);
    let oracle = |values: &[Vec<f64>]| {
        let (mut sum, mut count) = (0.0, 0.0);
        for row in (0..field.len()).filter(|row| labels[*row] != 0) {
            let colors = &field.gaussians.sh_coefficients[row][..3];
            let mut x: Vec<f64> = colors.iter().map(|c| 0.5 + BAND_0 * f64::from(*c)).collect();
            x.extend(&values[0][row * 3..row * 3 + 3]);
            let code = fused(&values[1], &x);
            sum -= probabilities(&values[2], &values[3], &code)[usize::from(labels[row]) - 1].ln();
            count += 1.0;
        }
        sum / count
    };
    check_gradients(&Vlgs, &mut tensors, 3, &oracle);
}

#[test]
fn unlabelled_pixels_are_no_class() {
    let field = field(30);
    let tensors = tensors(&Vlgs, &field);
    assert_eq!(tensors.values(&CLASSIFIER.biases).len(), field.instances.len());
    assert!(Vlgs.label_of_rows(&tensors, &field).iter().all(|label| *label > 0));
}
