//! Variational refinement of a level.
//!
//! Source: Brox, Bruhn, Papenberg, Weickert, "High Accuracy Optical Flow Estimation Based on a Theory for Warping",
//! ECCV 2004, equations 4 to 11, with the normalisation of data terms and the weights that DIS (Kroeger et al. 2016)
//! uses: constancy of brightness and of its gradient, robust smoothness, one warp per level.

use super::field::Flow;
use super::pyramid::{Level, derivatives};
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
    let mut equations = vec![Equation::default(); width * height];
    let mut weights = Smoothness::new(width, height);
    for _ in 0..ROUNDS {
        weights.update(field);
        for (k, equation) in equations.iter_mut().enumerate() {
            let from = [start.u.data[k], start.v.data[k]];
            let step = [field.u.data[k] - from[0], field.v.data[k] - from[1]];
            let mut system = [0.0; 5];
            brightness.add(k, 0.5 * BRIGHTNESS / (brightness.square(k, step) + EPSILON).sqrt(), &mut system);
            let squares = gradient_x.square(k, step) + gradient_y.square(k, step);
            let weight = 0.5 * GRADIENT / (squares + EPSILON).sqrt();
            gradient_x.add(k, weight, &mut system);
            gradient_y.add(k, weight, &mut system);
            *equation = Equation::new(system, from, weights.sum(k));
        }
        for _ in 0..SWEEPS {
            sweep(&equations, &weights, field);
        }
    }
}

/// The two linear equations of a pixel, without what its neighbours pull.
#[derive(Clone, Copy, Default)]
struct Equation {
    /// Right sides of the equations of u and of v.
    rest: [f32; 2],
    /// Factor of the other component in either equation.
    cross: f32,
    /// Relaxation by the factors of the components.
    rate: [f32; 2],
}

impl Equation {
    /// `system` is for steps from the displacement `from`: xx, xy, yy, and the right sides.
    fn new([xx, xy, yy, bx, by]: [f32; 5], [u, v]: [f32; 2], smoothness: f32) -> Self {
        let rate = |own: f32| RELAXATION / (own + smoothness + 1e-6);
        Self { rest: [bx + xx * u + xy * v, by + yy * v + xy * u], cross: xy, rate: [rate(xx), rate(yy)] }
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
    let (dxx, dxy) = derivatives(&dx);
    let (dyx, dyy) = derivatives(&dy);
    [
        Term::new(difference(&warped[0], &first.brightness.data), dx.data, dy.data),
        Term::new(difference(&warped[1], &first.dx.data), dxx.data, dxy.data),
        Term::new(difference(&warped[2], &first.dy.data), dyx.data, dyy.data),
    ]
}

/// Weights of the differences between neighbouring pixels.
struct Smoothness {
    width: usize,
    /// Weight between a pixel and the one before it in its row, 0 where there is none; one more at the end.
    across: Vec<f32>,
    /// Weight between a pixel and the one above, 0 where there is none; one row more at the end.
    down: Vec<f32>,
    /// Weight of every pixel.
    at: Vec<f32>,
}

impl Smoothness {
    fn new(width: usize, height: usize) -> Self {
        let pixels = width * height;
        Self { width, across: vec![0.0; pixels + 1], down: vec![0.0; pixels + width], at: vec![0.0; pixels] }
    }

    /// The weights for a field.
    fn update(&mut self, field: &Flow) {
        let width = self.width;
        self.at.fill(EPSILON);
        for plane in [&field.u, &field.v] {
            for (y, at) in self.at.chunks_exact_mut(width).enumerate() {
                let (row, below) = (plane.row(y as isize), plane.row(y as isize + 1));
                for ((at, value), below) in at.iter_mut().zip(row).zip(below) {
                    *at += (below - value) * (below - value);
                }
                for (at, pair) in at.iter_mut().zip(row.windows(2)) {
                    *at += (pair[1] - pair[0]) * (pair[1] - pair[0]);
                }
            }
        }
        self.at.iter_mut().for_each(|value| *value = 0.5 * SMOOTHNESS / value.sqrt());
        for (across, at) in self.across.chunks_exact_mut(width).zip(self.at.chunks_exact(width)) {
            for (across, pair) in across[1..].iter_mut().zip(at.windows(2)) {
                *across = 0.5 * (pair[0] + pair[1]);
            }
        }
        let inner = self.at.len();
        for (down, (value, below)) in
            self.down[width..inner].iter_mut().zip(self.at.iter().zip(&self.at[width..]))
        {
            *down = 0.5 * (value + below);
        }
    }

    /// Sum of the weights between a pixel and its neighbours.
    fn sum(&self, k: usize) -> f32 {
        self.across[k] + self.across[k + 1] + self.down[k] + self.down[k + self.width]
    }
}

/// One sweep of successive over-relaxation: first the pixels of one colour of a chessboard, then those of the other,
/// whose neighbours are all of the first. None of a colour waits for another.
fn sweep(equations: &[Equation], weights: &Smoothness, field: &mut Flow) {
    let (width, height) = (field.u.width, field.u.height);
    let (u, v) = (&mut field.u.data, &mut field.v.data);
    let last = equations.len() - 1;
    for color in 0..2 {
        for y in 0..height {
            for x in ((y + color) % 2..width).step_by(2) {
                let k = y * width + x;
                // Beyond the border any pixel stands in, with weight 0.
                let (left, next) = (k.saturating_sub(1), (k + 1).min(last));
                let (above, below) = (k.saturating_sub(width), (k + width).min(last));
                let (from_left, from_next) = (weights.across[k], weights.across[k + 1]);
                let (from_above, from_below) = (weights.down[k], weights.down[k + width]);
                let pull = |values: &[f32]| {
                    from_left * values[left]
                        + from_next * values[next]
                        + from_above * values[above]
                        + from_below * values[below]
                };
                let equation = &equations[k];
                let (own_u, own_v) = (u[k], v[k]);
                let right_u = equation.rest[0] - equation.cross * own_v + pull(u);
                let new_u = (1.0 - RELAXATION) * own_u + equation.rate[0] * right_u;
                let right_v = equation.rest[1] - equation.cross * new_u + pull(v);
                u[k] = new_u;
                v[k] = (1.0 - RELAXATION) * own_v + equation.rate[1] * right_v;
            }
        }
    }
}
