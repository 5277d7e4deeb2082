use super::*;
use crate::heads::testing::{
    SEED, TIME, check_gradients, cross_entropy, field, labels, loss, neighbour_term, regulariser, tensors,
};

#[test]
fn gradients_are_those_of_double_precision() {
    let field = field(40);
    let classes = labels(&field).pixels;
    let mut tensors = tensors(&GaussianGrouping, &field);
    let value = loss(&GaussianGrouping, &mut tensors, &field);
    let oracle = |values: &[Vec<f64>]| cross_entropy(&values[0], &values[1], &values[2], &classes);
    check_gradients(&GaussianGrouping, &mut tensors, 7, &oracle);
    let parameters = GaussianGrouping.parameters();
    let start: Vec<Vec<f64>> =
        parameters.iter().map(|p| tensors.values(p).iter().map(|v| f64::from(*v)).collect()).collect();
    assert!((value / oracle(&start) - 1.0).abs() < 1e-5);

    // Fewer Gaussians than are sampled: all of them are.
    let positions = field.deformed(TIME).means;
    let value = regulariser(&GaussianGrouping, &mut tensors, &field, 10, &positions);
    let oracle = |values: &[Vec<f64>]| neighbour_term(&values[0], &values[1], &values[2], &positions);
    assert!((value / oracle(&start) - 1.0).abs() < 1e-4, "{value}");
    check_gradients(&GaussianGrouping, &mut tensors, 7, &oracle);
    let between = regulariser(&GaussianGrouping, &mut tensors, &field, 11, &positions);
    assert_eq!(between, 0.0, "every fifth");
}

#[test]
fn unlabelled_pixels_are_a_class_and_codes_start_within_their_range() {
    let field = field(40);
    let tensors = tensors(&GaussianGrouping, &field);
    assert_eq!(tensors.values(&CLASSIFIER.biases).len(), field.instances.len() + 1);
    let codes = tensors.values(&CODES);
    assert!(
        codes.iter().all(|code| code.abs() < 0.5 / BAND_0 as f32)
            && codes.iter().any(|code| code.abs() > 1.5)
    );
    assert_eq!(GaussianGrouping.start(&CODES, &field, SEED), GaussianGrouping.start(&CODES, &field, SEED));
    let labels = GaussianGrouping.label_of_rows(&tensors, &field);
    assert!(labels.iter().all(|label| usize::from(*label) <= field.instances.len()));
}
