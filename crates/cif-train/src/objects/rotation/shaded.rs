//! The shaded model: paint that turns with the object, lit by spherical harmonics of the world normal.

use glam::DVec3;
use nalgebra::{SMatrix, SVector};

use super::evidence::Evidence;
use super::folds::{FEWEST, FOLDS, OBSERVED, folds, numbered};
use super::hull::{Course, Hit};

/// Spherical harmonics of degrees 1 and 2 of a unit normal, up to constant factors.
fn harmonics(n: DVec3) -> SVector<f64, 8> {
    SVector::from([
        n.x,
        n.y,
        n.z,
        n.x * n.y,
        n.y * n.z,
        n.x * n.z,
        n.x * n.x - n.y * n.y,
        3.0 * n.z * n.z - 1.0,
    ])
}

/// An observation of the shaded model: pixel, view, cell, logarithm of the brightness and harmonics of its normal.
struct Shaded {
    pixel: usize,
    look: usize,
    cell: usize,
    value: f64,
    light: SVector<f64, 8>,
}

/// Absolute residuals of the brightness under the shaded model on left-out pixels; light is fitted to all, within cells.
pub(super) fn shaded(
    evidence: &Evidence<'_>,
    hits: &[Option<Hit>],
    cells: usize,
    course: &Course,
) -> Vec<f32> {
    let mut found = vec![f32::NAN; hits.len()];
    let mut seen = Vec::new();
    let mut pixel = 0;
    for (look, shown) in evidence.looks.iter().enumerate() {
        let pose = course.get(&shown.view.time_index);
        for value in shown.pixels.iter().map(|pixel| pixel.value.x) {
            if let (Some(hit), Some(pose)) = (hits[pixel], pose) {
                let light = harmonics(pose.rotation * hit.normal);
                seen.push(Shaded { pixel, look, cell: hit.cell as usize, value, light });
            }
            pixel += 1;
        }
    }
    if seen.len() < FEWEST {
        return found;
    }
    let cells = numbered(seen.iter_mut().map(|o| &mut o.cell), cells);
    let Some(shading) = shading(&seen, cells) else { return found };
    let folds = folds(evidence);
    // Sums of unshaded values and counts by cell: of all, and of each fold.
    let mut all = vec![(0.0, 0.0); cells];
    let mut own = vec![vec![(0.0, 0.0); cells]; FOLDS];
    for o in &mut seen {
        o.value -= shading.dot(&o.light);
        for (sum, count) in [&mut all[o.cell], &mut own[folds[o.look]][o.cell]] {
            *sum += o.value;
            *count += 1.0;
        }
    }
    for o in &seen {
        let (own_sum, own_count) = own[folds[o.look]][o.cell];
        let (sum, count): (f64, f64) = (all[o.cell].0 - own_sum, all[o.cell].1 - own_count);
        if count >= OBSERVED {
            found[o.pixel] = ((o.value - sum / count) / (1.0 + 1.0 / count).sqrt()).abs() as f32;
        }
    }
    found
}

/// Coefficients of the light that explains most of the differences of brightness within cells.
fn shading(seen: &[Shaded], cells: usize) -> Option<SVector<f64, 8>> {
    let mut sums = vec![(0.0, 0.0, SVector::<f64, 8>::zeros()); cells];
    for o in seen {
        let (count, value, light) = &mut sums[o.cell];
        *count += 1.0;
        *value += o.value;
        *light += o.light;
    }
    let mut normal = SMatrix::<f64, 8, 8>::identity() * (1e-3 * seen.len() as f64);
    let mut right = SVector::<f64, 8>::zeros();
    for o in seen {
        let (count, value, light) = &sums[o.cell];
        if *count >= OBSERVED {
            let light = o.light - light / *count;
            normal += light * light.transpose();
            right += (o.value - value / *count) * light;
        }
    }
    Some(normal.cholesky()?.solve(&right))
}
