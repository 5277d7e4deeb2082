//! Values of a joint over time: each time is looked at with the joint at every value, and the sequence of least loss
//! is taken.

use std::collections::BTreeMap;

use super::super::sequence::{least, unwind};
use super::body::Body;
use super::guesses::JointValues;

/// Loss per step between values of neighbouring times, of the mean loss of a time.
const MOVING: f64 = 0.005;

/// The sequence of values whose loss is least over the views, and its mean loss per view.
pub(super) fn search(
    body: &Body<'_>,
    times: &BTreeMap<usize, Vec<usize>>,
    tried: &JointValues,
    level: usize,
) -> (BTreeMap<usize, f64>, f64) {
    let JointValues { values, is_round } = tried;
    let mut shape = body.shape.copied();
    let count = values.len();
    let mut table: Vec<Vec<f64>> = Vec::with_capacity(times.len());
    for views in times.values() {
        let mut mean = |value: &f64| -> f64 {
            let of = views.iter().map(|view| body.loss_with(&mut shape, *view, level, Some(*value)));
            of.sum::<f64>() / views.len().max(1) as f64
        };
        table.push(values.iter().map(&mut mean).collect());
    }
    let smallest = |row: &Vec<f64>| row.iter().copied().fold(f64::INFINITY, f64::min);
    let typical = table.iter().map(smallest).sum::<f64>() / table.len().max(1) as f64;
    let apart = |a: usize, b: usize| {
        let steps = a.abs_diff(b);
        if *is_round { steps.min(count - steps) } else { steps }
    };
    let (places, sum) = least(&table, |_, from, to| MOVING * typical * apart(from, to) as f64);
    let total = sum / table.len().max(1) as f64;
    let mut found: BTreeMap<usize, f64> =
        times.keys().copied().zip(places.iter().map(|place| values[*place])).collect();
    if *is_round {
        unwind(found.values_mut());
    }
    (found, total)
}
