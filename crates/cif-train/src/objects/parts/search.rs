//! Values of a joint over time: each time is looked at with the joint at every value, and the sequence of least loss
//! is taken.

use std::collections::BTreeMap;

use super::body::Body;

/// Loss per step between values of neighbouring times, of the mean loss of a time.
const MOVING: f64 = 0.005;

/// The sequence of values whose loss is least over the views, and its mean loss per view.
pub(super) fn search(
    body: &Body<'_>,
    times: &BTreeMap<usize, Vec<usize>>,
    (values, is_round): (&[f64], bool),
    level: usize,
) -> (BTreeMap<usize, f64>, f64) {
    let mut shape = body.shape.copied();
    let count = values.len();
    let mut table: Vec<Vec<f64>> = Vec::with_capacity(times.len());
    for views in times.values() {
        let mut mean = |value: &f64| -> f64 {
            let of = views.iter().map(|view| body.loss_with(&mut shape, *view, level, *value));
            of.sum::<f64>() / views.len().max(1) as f64
        };
        table.push(values.iter().map(&mut mean).collect());
    }
    let least = |row: &Vec<f64>| row.iter().copied().fold(f64::INFINITY, f64::min);
    let typical = table.iter().map(least).sum::<f64>() / table.len().max(1) as f64;
    let apart = |a: usize, b: usize| {
        let steps = a.abs_diff(b);
        if is_round { steps.min(count - steps) } else { steps }
    };
    // Least sum up to each time by the value there, and the value before it.
    let mut sums: Vec<f64> = vec![0.0; count];
    let mut before: Vec<Vec<usize>> = Vec::with_capacity(table.len());
    for (k, row) in table.iter().enumerate() {
        let reach = |to: usize| {
            let cost = |from: usize| sums[from] + MOVING * typical * apart(from, to) as f64;
            let best = (0..count).min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(to);
            if k == 0 { (0.0, to) } else { (cost(best), best) }
        };
        let reached: Vec<(f64, usize)> = (0..count).map(reach).collect();
        sums = reached.iter().zip(row).map(|((sum, _), loss)| sum + loss).collect();
        before.push(reached.into_iter().map(|(_, from)| from).collect());
    }
    let mut at = (0..count).min_by(|a, b| sums[*a].total_cmp(&sums[*b])).unwrap_or(0);
    let total = sums[at] / table.len().max(1) as f64;
    let mut found = BTreeMap::new();
    for (time, from) in times.keys().zip(&before).rev() {
        found.insert(*time, values[at]);
        at = from[at];
    }
    if is_round {
        unwind(&mut found);
    }
    (found, total)
}

/// Takes whole turns out of the steps between neighbouring times.
fn unwind(values: &mut BTreeMap<usize, f64>) {
    let mut last: Option<f64> = None;
    for value in values.values_mut() {
        if let Some(last) = last {
            *value += ((last - *value) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
        }
        last = Some(*value);
    }
}
