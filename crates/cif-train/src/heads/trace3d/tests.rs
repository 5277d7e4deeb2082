use super::*;
use crate::heads::testing::{check_gradients, field, labels, loss, tensors};

#[test]
fn gradients_are_those_of_double_precision() {
    let field = field(40);
    let labels = labels(&field).pixels;
    let mut tensors = tensors(&Trace3d, &field);
    // Nearer, so that codes of other labels are felt.
    tensors.values_mut(&CODES).iter_mut().for_each(|value| *value *= 0.3);
    let value = loss(&Trace3d, &mut tensors, &field);
    let oracle = |values: &[Vec<f64>]| {
        let rows: Vec<usize> = (0..labels.len()).filter(|row| labels[*row] != 0).collect();
        let code = |row: usize| &values[0][row * CODE..(row + 1) * CODE];
        let mut sum = 0.0;
        for a in &rows {
            let (mut same, mut all) = (0.0, 0.0);
            for b in &rows {
                let squared: f64 = code(*a).iter().zip(code(*b)).map(|(a, b)| (a - b).powi(2)).sum();
                let is_same = a != b && labels[*a] == labels[*b];
                let power = (-squared / if is_same { 100.0 } else { 1.0 }).exp().exp();
                all += power;
                same += if is_same { power } else { 0.0 };
            }
            sum -= (same / all).ln();
        }
        sum / rows.len() as f64
    };
    let start: Vec<f64> = tensors.values(&CODES).iter().map(|v| f64::from(*v)).collect();
    assert!((value / oracle(&[start]) - 1.0).abs() < 1e-5);
    check_gradients(&Trace3d, &mut tensors, 3, &oracle);
}

#[test]
fn parts_keep_their_published_lengths_and_shrink_together() {
    let all = HeadName::Trace3d.published_steps();
    let of = |steps: u32| -> Vec<(u32, Vec<Change>)> {
        let found = (1..=steps).map(|step| (step, changes(step, steps)));
        found.filter(|(_, changes)| !changes.is_empty()).collect()
    };
    let cycle = [Change::Split, Change::DeleteAmbiguous].to_vec();
    let expected: Vec<(u32, Vec<Change>)> = [(1, vec![Change::DeleteUnseen])]
        .into_iter()
        .chain([10, 1_210, 2_410, 3_610].map(|step| (step, cycle.clone())))
        .chain([(9_000, vec![Change::DeleteUnseen])])
        .collect();
    assert_eq!(of(all), expected);
    assert_eq!((Trace3d.phase(9_000, all), Trace3d.phase(9_001, all)), (Phase::Field, Phase::Head));
    let short = of(290);
    assert_eq!(short[0], (1, [&[Change::DeleteUnseen][..], &cycle].concat()));
    assert_eq!(short.iter().map(|(step, _)| *step).collect::<Vec<_>>(), [1, 13, 25, 37, 90]);
    assert!(of(2).is_empty() && Trace3d.phase(1, 2) == Phase::Head);
}

#[test]
fn pixels_have_the_label_of_the_nearest_known_mean() {
    let field = field(20);
    let mut tensors = tensors(&Trace3d, &field);
    assert_eq!(Trace3d.decode(&tensors, &[0.0; CODE]), (0, 0.0), "nothing is known yet");
    let k = field.instances.len();
    for (label, centroid) in tensors.values_mut(&CENTROIDS).chunks_exact_mut(CODE).enumerate() {
        centroid.fill(label as f32);
    }
    tensors.values_mut(&KNOWN)[..k - 1].fill(1.0);
    let (label, probability) = Trace3d.decode(&tensors, &[k as f32; CODE]);
    assert_eq!(usize::from(label), k - 1, "the last is not known");
    assert!(probability > 0.5 && probability <= 1.0);
}
