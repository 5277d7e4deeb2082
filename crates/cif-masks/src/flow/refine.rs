//! Variational refinement of a level.
//!
//! Source: Brox, Bruhn, Papenberg, Weickert, "High Accuracy Optical Flow Estimation Based on a Theory for Warping",
//! ECCV 2004, equations 4 to 11, with the normalisation of data terms and the weights that DIS (Kroeger et al. 2016)
//! uses: constancy of brightness and of its gradient, robust smoothness, one warp per level.

use super::{Flow, Level};
use crate::plane::{Plane, Tap};

/// Weight of smoothness.
const SMOOTHNESS: f32 = 20.0;

/// Weight of constant brightness.
const BRIGHTNESS: f32 = 5.0;

/// Weight of constant gradients.
const GRADIENT: f32 = 10.0;

/// Rounds in which the weights of the robust terms are computed anew.
const ROUNDS: usize = 3;

/// Sweeps of successive over-relaxation per round.
const SWEEPS: usize = 4;

/// Over-relaxation.
const RELAXATION: f32 = 1.6;

/// Square of what keeps robust weights finite.
const EPSILON: f32 = 1e-6;

/// Square of the gradient below which data terms fade.
const FLAT: f32 = 0.01;

/// A linear term in the step (a, b) at every pixel: `rest + along_x * a + along_y * b` is to be 0.
struct Term {
    rest: Vec<f32>,
    along_x: Vec<f32>,
    along_y: Vec<f32>,
    /// 1 / (|derivative|^2 + FLAT).
    norm: Vec<f32>,
}

impl Term {
    fn new(rest: Vec<f32>, along_x: Vec<f32>, along_y: Vec<f32>) -> Self {
        let norm = along_x.iter().zip(&along_y).map(|(x, y)| 1.0 / (x * x + y * y + FLAT)).collect();
        Self { rest, along_x, along_y, norm }
    }

    /// Normalised square of the term.
    fn square(&self, k: usize, step: [f32; 2]) -> f32 {
        let value = self.rest[k] + self.along_x[k] * step[0] + self.along_y[k] * step[1];
        value * value * self.norm[k]
    }

    fn add(&self, k: usize, weight: f32, system: &mut [f32; 5]) {
        let weight = weight * self.norm[k];
        let (x, y, rest) = (self.along_x[k], self.along_y[k], self.rest[k]);
        system[0] += weight * x * x;
        system[1] += weight * x * y;
        system[2] += weight * y * y;
        system[3] -= weight * x * rest;
        system[4] -= weight * y * rest;
    }
}

/// Moves the field towards smooth motion that keeps brightness and gradients.
pub(super) fn refine(first: &Level, second: &Level, field: &mut Flow) {
    let (width, height) = (field.u.width, field.u.height);
    let [brightness, gradient_x, gradient_y] = terms(first, second, field);
    let start = field.clone();
    let mut systems = vec![[0.0_f32; 5]; width * height];
    let (mut right, mut down) = (vec![0.0_f32; width * height], vec![0.0_f32; width * height]);
    for _ in 0..ROUNDS {
        for (k, system) in systems.iter_mut().enumerate() {
            let step = [field.u.data[k] - start.u.data[k], field.v.data[k] - start.v.data[k]];
            *system = [0.0; 5];
            brightness.add(k, 0.5 * BRIGHTNESS / (brightness.square(k, step) + EPSILON).sqrt(), system);
            let squares = gradient_x.square(k, step) + gradient_y.square(k, step);
            let weight = 0.5 * GRADIENT / (squares + EPSILON).sqrt();
            gradient_x.add(k, weight, system);
            gradient_y.add(k, weight, system);
        }
        smoothness(field, &mut right, &mut down);
        for _ in 0..SWEEPS {
            sweep(&start, &systems, &right, &down, field);
        }
    }
}

/// The data terms of a level, with the second image warped by the field.
fn terms(first: &Level, second: &Level, field: &Flow) -> [Term; 3] {
    let (width, height) = (field.u.width, field.u.height);
    let pixels = width * height;
    let mut warped = [(); 3].map(|()| Vec::with_capacity(pixels));
    for y in 0..height {
        for x in 0..width {
            let k = y * width + x;
            let tap = Tap::new(width, height, x as f32 + field.u.data[k], y as f32 + field.v.data[k]);
            for (out, plane) in warped.iter_mut().zip([&second.brightness, &second.dx, &second.dy]) {
                out.push(tap.of(&plane.data));
            }
        }
    }
    let difference = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<f32>>();
    let middle = |a: &[f32], b: &[f32]| Plane {
        width,
        height,
        data: a.iter().zip(b).map(|(a, b)| 0.5 * (a + b)).collect(),
    };
    let dx = middle(&warped[1], &first.dx.data);
    let dy = middle(&warped[2], &first.dy.data);
    let (dxx, dxy) = super::derivatives(&dx);
    let (dyx, dyy) = super::derivatives(&dy);
    [
        Term::new(difference(&warped[0], &first.brightness.data), dx.data, dy.data),
        Term::new(difference(&warped[1], &first.dx.data), dxx.data, dxy.data),
        Term::new(difference(&warped[2], &first.dy.data), dyx.data, dyy.data),
    ]
}

/// Weights of the differences to the pixel to the right and to that below; 0 at the border.
fn smoothness(field: &Flow, right: &mut [f32], down: &mut [f32]) {
    let (width, height) = (field.u.width, field.u.height);
    let mut at = vec![EPSILON; width * height];
    for plane in [&field.u, &field.v] {
        for (y, at) in at.chunks_exact_mut(width).enumerate() {
            let (row, below) = (plane.row(y as isize), plane.row(y as isize + 1));
            for ((at, value), below) in at.iter_mut().zip(row).zip(below) {
                *at += (below - value) * (below - value);
            }
            for (at, pair) in at.iter_mut().zip(row.windows(2)) {
                *at += (pair[1] - pair[0]) * (pair[1] - pair[0]);
            }
        }
    }
    at.iter_mut().for_each(|value| *value = 0.5 * SMOOTHNESS / value.sqrt());
    for (right, at) in right.chunks_exact_mut(width).zip(at.chunks_exact(width)) {
        for (right, pair) in right.iter_mut().zip(at.windows(2)) {
            *right = 0.5 * (pair[0] + pair[1]);
        }
        right[width - 1] = 0.0;
    }
    let last = width * (height - 1);
    for (down, (value, below)) in down[..last].iter_mut().zip(at.iter().zip(&at[width..])) {
        *down = 0.5 * (value + below);
    }
    down[last..].fill(0.0);
}

/// One sweep of successive over-relaxation.
fn sweep(start: &Flow, systems: &[[f32; 5]], right: &[f32], down: &[f32], field: &mut Flow) {
    let (width, height) = (field.u.width, field.u.height);
    let (u, v) = (&mut field.u.data, &mut field.v.data);
    for y in 0..height {
        for x in 0..width {
            let k = y * width + x;
            // Beyond the border lies the pixel itself, with weight 0.
            let (left, above) = (if x > 0 { k - 1 } else { k }, if y > 0 { k - width } else { k });
            let (next, below) =
                (if x + 1 < width { k + 1 } else { k }, if y + 1 < height { k + width } else { k });
            let from_left = if x > 0 { right[k - 1] } else { 0.0 };
            let from_above = if y > 0 { down[k - width] } else { 0.0 };
            let sum = from_left + right[k] + from_above + down[k];
            let pull = |values: &[f32]| {
                from_left * values[left]
                    + right[k] * values[next]
                    + from_above * values[above]
                    + down[k] * values[below]
            };
            let (pull_u, pull_v) = (pull(u), pull(v));
            let [xx, xy, yy, bx, by] = systems[k];
            let (u0, v0) = (start.u.data[k], start.v.data[k]);
            let new_u = (bx + xx * u0 - xy * (v[k] - v0) + pull_u) / (xx + sum + 1e-6);
            u[k] += RELAXATION * (new_u - u[k]);
            let new_v = (by + yy * v0 - xy * (u[k] - u0) + pull_v) / (yy + sum + 1e-6);
            v[k] += RELAXATION * (new_v - v[k]);
        }
    }
}
