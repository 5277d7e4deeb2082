use super::network::{WIDTHS, encode};
use super::*;
use crate::heads::testing::{
    TIME, check_gradients, cross_entropy, field, labels, loss, neighbour_term, step, tensors,
};

/// Codes in double precision, by the definition.
fn codes(network: &[f64], places: &[[f32; 3]]) -> Vec<f64> {
    let mut found = Vec::new();
    for place in places {
        let mut encoded = Vec::new();
        place.iter().for_each(|value| encode(f64::from(*value), 10, &mut encoded));
        encode(TIME, 4, &mut encoded);
        let mut values: Vec<f64> = encoded.into_iter().map(f64::from).collect();
        let mut rest = network;
        for (k, pair) in WIDTHS.windows(2).enumerate() {
            let (weights, others) = rest.split_at(pair[0] * pair[1]);
            let (biases, others) = others.split_at(pair[1]);
            rest = others;
            let rectify = |sum: f64| if k < 3 { sum.max(0.0) } else { sum };
            values = (0..pair[1])
                .map(|out| {
                    let of = |(inner, value): (usize, &f64)| value * weights[inner * pair[1] + out];
                    rectify(biases[out] + values.iter().enumerate().map(of).sum::<f64>())
                })
                .collect();
        }
        assert!(rest.is_empty());
        found.extend(values);
    }
    found
}

#[test]
fn gradients_are_those_of_double_precision() {
    let field = field(10);
    let (head, classes) = (Sa4d::default(), labels(&field).pixels);
    let means = field.gaussians.means.clone();
    let mut tensors = tensors(&head, &field);
    loss(&head, &mut tensors, &field);
    let oracle =
        |values: &[Vec<f64>]| cross_entropy(&codes(&values[0], &means), &values[1], &values[2], &classes);
    check_gradients(&head, &mut tensors, 1_511, &oracle);

    let step = step(&field);
    let positions = field.deformed(step.time).means;
    tensors.reset();
    assert!(head.regularise(&mut tensors, &HeadStep { step: 11, ..step }) > 0.0, "at every step");
    let oracle =
        |values: &[Vec<f64>]| neighbour_term(&codes(&values[0], &means), &values[1], &values[2], &positions);
    check_gradients(&head, &mut tensors, 1_511, &oracle);
}

#[test]
fn the_network_has_the_published_layers_and_codes_follow_the_time() {
    assert_eq!(WIDTHS, [72, 256, 256, 256, 16]);
    let field = field(300);
    let head = Sa4d::default();
    let tensors = tensors(&head, &field);
    assert_ne!(head.values(&tensors, &field, 0.1), head.values(&tensors, &field, 0.9));
    assert!(Sa4d::new("").trains_on("cam3") && !Sa4d::new("cam16").trains_on("cam3"));
    assert_eq!(head.label_of_rows(&tensors, &field).len(), 300);
}
