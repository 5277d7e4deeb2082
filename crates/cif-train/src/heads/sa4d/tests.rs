use super::network::{WIDTHS, encode};
use super::*;
use crate::heads::testing::{
    TIME, check_gradients, cross_entropy, field, labels, loss, neighbour_term, regulariser, tensors,
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

    let positions = field.deformed(TIME).means;
    assert!(regulariser(&head, &mut tensors, &field, 11, &positions) > 0.0, "at every step");
    let oracle =
        |values: &[Vec<f64>]| neighbour_term(&codes(&values[0], &means), &values[1], &values[2], &positions);
    check_gradients(&head, &mut tensors, 1_511, &oracle);
}

#[test]
fn some_rows_have_the_values_that_all_have_and_gradients_need_no_kept_layers() {
    let field = field(300);
    let head = Sa4d::default();
    let mut tensors = tensors(&head, &field);
    let all = head.values(&tensors, &field, TIME);
    let rows: Vec<u32> = (0..300).filter(|row| row % 3 != 1).collect();
    let mut some = head.values_of(&tensors, &field, TIME, &rows);
    for (row, (code, expected)) in some.values.chunks_exact(CODE).zip(all.chunks_exact(CODE)).enumerate() {
        let expected = if row % 3 == 1 { &[0.0; CODE] } else { expected };
        assert_eq!(code, expected, "row {row}");
    }
    // Gradients in some of the rows, so that others are passed over.
    let v_values: Vec<f32> = (0..300 * CODE)
        .map(|k| if (k / CODE).is_multiple_of(6) { (k % 7) as f32 - 3.0 } else { 0.0 })
        .collect();
    let mut gradients = [true, false].map(|keeps| {
        some.layers.1.iter_mut().for_each(|layers| layers.truncate(if keeps { usize::MAX } else { 1 }));
        tensors.reset();
        head.values_backward(&mut tensors, &field, &some, &v_values);
        tensors.values_and_gradients(&NETWORK).1.to_vec()
    });
    assert_eq!(gradients[0], gradients[1]);
    tensors.reset();
    let every: Vec<u32> = (0..300).collect();
    let some = head.values_of(&tensors, &field, TIME, &every);
    head.values_backward(&mut tensors, &field, &some, &v_values);
    let of_all = tensors.values_and_gradients(&NETWORK).1;
    gradients[0].iter_mut().zip(of_all).for_each(|(a, b)| *a -= *b);
    assert!(gradients[0].iter().all(|v| *v == 0.0), "only rows with a gradient count");
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
