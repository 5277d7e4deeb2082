//! Adam over flat parameter groups. Source: Kingma and Ba 2015, with the constants and the row handling of
//! methods reference 1.1 and 7 (rows 24 to 26).
//!
//! Every float is updated from its own gradient and moments alone, so results do not depend on the number of
//! threads, nor on the vector instructions, which the widest are taken of. Gradients are set to zero once used.

pub(crate) mod planes;
mod regularizer;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

pub use planes::{PlaneWeights, step_planes};
pub use regularizer::plane_penalty;

/// Decay of the first moment.
pub const BETA_1: f32 = 0.9;

/// Decay of the second moment.
pub const BETA_2: f32 = 0.999;

/// Added to the root of the second moment, as in every trainer of Gaussians.
pub const EPSILON: f32 = 1e-15;

/// Floats that one task updates; small enough that they stay in the first-level cache between the check for
/// finite gradients and the update.
const CHUNK: usize = 2_048;

/// A gradient was not finite; the floats next to it were left as they were.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotFinite;

/// Moments of one parameter group of `[rows, width]` floats.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moments {
    /// Decaying mean of the gradient.
    pub first: Vec<f32>,
    /// Decaying mean of the squared gradient.
    pub second: Vec<f32>,
    /// Floats per row.
    pub width: usize,
    /// Steps done.
    pub steps: u32,
}

/// Rates inside a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RowRates {
    /// One rate for all floats.
    Uniform(f32),
    /// The first `split` floats at `base`, those up to `active` at `rest`; the others have had no gradient
    /// yet and stay.
    Split {
        /// Rate of the first floats.
        base: f32,
        /// Rate of the floats after them.
        rest: f32,
        /// Number of first floats.
        split: usize,
        /// Number of floats that move at all.
        active: usize,
    },
}

/// Longest row with different rates: the spherical harmonics.
const MAX_SPLIT_WIDTH: usize = 48;

/// Bias corrections of the moments, equal for all floats of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BiasCorrection {
    /// `1 / (1 - beta_1^t)`.
    pub(crate) first: f32,
    /// `1 / sqrt(1 - beta_2^t)`.
    pub(crate) second: f32,
}

impl BiasCorrection {
    pub(crate) fn after(steps: u32) -> Self {
        let power = |beta: f32| f64::from(beta).powf(f64::from(steps));
        Self {
            first: (1.0 / (1.0 - power(BETA_1))) as f32,
            second: (1.0 / (1.0 - power(BETA_2)).sqrt()) as f32,
        }
    }
}

impl Moments {
    /// Zero moments of `rows * width` floats.
    #[must_use]
    pub fn zeros(rows: usize, width: usize) -> Self {
        Self { first: vec![0.0; rows * width], second: vec![0.0; rows * width], width, steps: 0 }
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.first.len() / self.width.max(1)
    }

    /// One step: moves `parameters` against `gradients`, which become zero. With `visible`, only rows with a
    /// positive entry there change.
    ///
    /// # Errors
    /// When a gradient is not finite.
    ///
    /// # Panics
    /// When the lengths differ from the group's.
    pub fn step(
        &mut self,
        parameters: &mut [f32],
        gradients: &mut [f32],
        rates: RowRates,
        visible: Option<&[f32]>,
    ) -> Result<(), NotFinite> {
        self.step_with(parameters, gradients, rates, EPSILON, visible)
    }

    /// As [`Self::step`], with an epsilon of its own.
    ///
    /// # Errors
    /// When a gradient is not finite.
    ///
    /// # Panics
    /// When the lengths differ from the group's.
    pub fn step_with(
        &mut self,
        parameters: &mut [f32],
        gradients: &mut [f32],
        rates: RowRates,
        epsilon: f32,
        visible: Option<&[f32]>,
    ) -> Result<(), NotFinite> {
        assert_eq!(parameters.len(), self.first.len(), "parameters and moments differ in length");
        assert_eq!(gradients.len(), self.first.len(), "gradients and moments differ in length");
        self.steps += 1;
        let bias = BiasCorrection::after(self.steps);
        let level = Level::new();
        let width = self.width.max(1);
        let chunk_rows = (CHUNK / width).max(1);
        parameters
            .par_chunks_mut(chunk_rows * width)
            .zip(gradients.par_chunks_mut(chunk_rows * width))
            .zip(self.first.par_chunks_mut(chunk_rows * width))
            .zip(self.second.par_chunks_mut(chunk_rows * width))
            .enumerate()
            .map(|(chunk, (((p, g), m), v))| {
                let visible = visible.map(|visible| &visible[chunk * chunk_rows..]);
                let rows = RowSlices { parameters: p, gradients: g, first: m, second: v, width };
                dispatch!(level, _simd => step_rows(rows, rates, visible, bias, epsilon))
            })
            .reduce(|| Ok(()), Result::and)
    }

    /// Zeroes the moments of a row.
    pub fn reset_row(&mut self, row: usize) {
        let range = row * self.width..(row + 1) * self.width;
        self.first[range.clone()].fill(0.0);
        self.second[range].fill(0.0);
    }

    /// Zeroes all moments; the step count stays.
    pub fn reset_all(&mut self) {
        self.first.fill(0.0);
        self.second.fill(0.0);
    }

    /// Makes the rows those of `origins`: a row of the old group, or a fresh one.
    pub fn gather(&mut self, origins: &[Option<u32>]) {
        let width = self.width;
        let pick = |values: &[f32]| {
            let mut picked = vec![0.0; origins.len() * width];
            for (target, origin) in picked.chunks_exact_mut(width).zip(origins) {
                if let Some(origin) = origin {
                    let start = *origin as usize * width;
                    target.copy_from_slice(&values[start..start + width]);
                }
            }
            picked
        };
        (self.first, self.second) = (pick(&self.first), pick(&self.second));
    }
}

impl RowRates {
    /// True when some float moves.
    #[must_use]
    pub fn move_anything(self) -> bool {
        self.fastest() > 0.0
    }

    /// Largest rate; NaN only where all are.
    #[must_use]
    pub fn fastest(self) -> f32 {
        match self {
            Self::Uniform(rate) => rate,
            Self::Split { base, rest, .. } => base.max(rest),
        }
    }

    fn pattern(self) -> [f32; MAX_SPLIT_WIDTH] {
        match self {
            Self::Uniform(rate) => [rate; MAX_SPLIT_WIDTH],
            Self::Split { base, rest, split, active } => std::array::from_fn(|k| match k {
                _ if k >= active => 0.0,
                _ if k < split => base,
                _ => rest,
            }),
        }
    }
}

/// Some rows of a parameter group, `[rows, width]` each.
struct RowSlices<'a> {
    /// Values.
    parameters: &'a mut [f32],
    /// Gradients, which become zero.
    gradients: &'a mut [f32],
    /// First moments.
    first: &'a mut [f32],
    /// Second moments.
    second: &'a mut [f32],
    /// Floats per row.
    width: usize,
}

/// A step of some rows. With `visible`, only rows with a positive entry there change.
#[inline(always)]
fn step_rows(
    rows: RowSlices<'_>,
    rates: RowRates,
    visible: Option<&[f32]>,
    bias: BiasCorrection,
    epsilon: f32,
) -> Result<(), NotFinite> {
    let RowSlices { parameters: p, gradients: g, first: m, second: v, width } = rows;
    if !all_finite(g) {
        return Err(NotFinite);
    }
    match rates {
        RowRates::Uniform(rate) if visible.is_none() => update(p, g, m, v, rate, bias, epsilon),
        _ => {
            let pattern = rates.pattern();
            let rows = p.chunks_mut(width).zip(g.chunks(width));
            let rows = rows.zip(m.chunks_mut(width)).zip(v.chunks_mut(width));
            for (row, (((p, g), m), v)) in rows.enumerate() {
                if visible.is_some_and(|visible| visible[row] <= 0.0) {
                    continue;
                }
                match rates {
                    RowRates::Uniform(rate) => update(p, g, m, v, rate, bias, epsilon),
                    RowRates::Split { active, .. } => {
                        // Whole vectors: what is left over would go float by float.
                        let n = active.next_multiple_of(LANES).min(width);
                        let (p, g, m, v) = (&mut p[..n], &g[..n], &mut m[..n], &mut v[..n]);
                        match active < n {
                            true => update_with_rates::<true>(p, g, m, v, &pattern[..n], bias, epsilon),
                            false => update_with_rates::<false>(p, g, m, v, &pattern[..n], bias, epsilon),
                        }
                    }
                }
            }
        }
    }
    g.fill(0.0);
    Ok(())
}

/// True when every value is finite: a product with zero is zero for those alone.
#[inline(always)]
fn all_finite(values: &[f32]) -> bool {
    let mut lanes = [0.0_f32; 16];
    let blocks = values.chunks_exact(16);
    let mut rest = 0.0;
    for value in blocks.remainder() {
        rest += value * 0.0;
    }
    for block in blocks {
        for (lane, value) in lanes.iter_mut().zip(block) {
            *lane += value * 0.0;
        }
    }
    (lanes.iter().sum::<f32>() + rest) == 0.0
}

/// Floats of the widest vectors.
const LANES: usize = 16;

/// The step of one float. Below the smallest normal second moment the ratio would be noise: no step (row 25).
#[inline(always)]
fn move_by(p: &mut f32, g: f32, m: &mut f32, v: &mut f32, rate: f32, second: f32, epsilon: f32) {
    *m = BETA_1 * *m + (1.0 - BETA_1) * g;
    *v = BETA_2 * *v + (1.0 - BETA_2) * g * g;
    let step = rate * *m / (v.sqrt() * second + epsilon);
    *p -= if *v >= f32::MIN_POSITIVE { step } else { 0.0 };
}

#[inline(always)]
fn update(
    p: &mut [f32],
    g: &[f32],
    m: &mut [f32],
    v: &mut [f32],
    rate: f32,
    bias: BiasCorrection,
    epsilon: f32,
) {
    let rate = rate * bias.first;
    for (((p, g), m), v) in p.iter_mut().zip(g).zip(m.iter_mut()).zip(v.iter_mut()) {
        move_by(p, *g, m, v, rate, bias.second, epsilon);
    }
}

/// Each float at a rate of its own; where some `STAY`, everything of a float at rate 0 does.
#[inline(always)]
fn update_with_rates<const STAY: bool>(
    p: &mut [f32],
    g: &[f32],
    m: &mut [f32],
    v: &mut [f32],
    rates: &[f32],
    bias: BiasCorrection,
    epsilon: f32,
) {
    for ((((p, g), m), v), rate) in p.iter_mut().zip(g).zip(m.iter_mut()).zip(v.iter_mut()).zip(rates) {
        let before = (*m, *v);
        move_by(p, *g, m, v, rate * bias.first, bias.second, epsilon);
        if STAY {
            (*m, *v) = if *rate > 0.0 { (*m, *v) } else { before };
        }
    }
}

#[cfg(test)]
mod tests;
