//! Smoothing of the path of an object's centre.

use std::collections::BTreeMap;

use glam::DVec3;
use nalgebra::{DMatrix, DVector};

use super::view::ObjectView;

/// Weight of squared second differences, in steps of a 60th of the sequence.
const SMOOTHNESS: f64 = 20.0;

/// Weight of a time whose masks are cut by the border.
const CUT: f64 = 0.05;

/// The path that stays near `raw` where the object is well seen, and bends little; `times` of the whole sequence.
pub(super) fn smooth(
    raw: &BTreeMap<usize, DVec3>,
    views: &[ObjectView],
    times: usize,
) -> BTreeMap<usize, DVec3> {
    let keys: Vec<usize> = raw.keys().copied().collect();
    let n = keys.len();
    if n < 3 {
        return raw.clone();
    }
    let mut matrix = DMatrix::<f64>::zeros(n, n);
    let mut targets = [(); 3].map(|()| DVector::<f64>::zeros(n));
    for (k, time) in keys.iter().enumerate() {
        let of = || views.iter().filter(|view| view.time_index == *time);
        let seen = of().map(|view| view.visible).fold(0.0, f64::max);
        let cut = if of().any(|view| view.cut) { CUT } else { 1.0 };
        let weight = seen * seen * cut + 1e-4;
        matrix[(k, k)] += weight;
        for (axis, target) in targets.iter_mut().enumerate() {
            target[k] = weight * raw[time][axis];
        }
    }
    let stiffness = SMOOTHNESS * (times as f64 / 60.0).powi(4);
    for k in 1..n - 1 {
        let (before, after) = ((keys[k] - keys[k - 1]) as f64, (keys[k + 1] - keys[k]) as f64);
        let scale = 2.0 / (before + after);
        let row =
            [(k - 1, scale / before), (k, -scale * (1.0 / before + 1.0 / after)), (k + 1, scale / after)];
        for (i, a) in row {
            for (j, b) in row {
                matrix[(i, j)] += stiffness * a * b;
            }
        }
    }
    let Some(solver) = matrix.cholesky() else { return raw.clone() };
    let solved = targets.map(|target| solver.solve(&target));
    let place = |k: usize| DVec3::from(std::array::from_fn(|axis| solved[axis][k]));
    keys.iter().enumerate().map(|(k, time)| (*time, place(k))).collect()
}
