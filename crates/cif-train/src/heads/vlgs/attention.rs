//! Self-attention over the channels of a Gaussian, with a residual: `u = x + attention(x)`.
//!
//! A token per channel, `e_m = x_m a + E_m`, is turned into query, key and value; the mean of the values that the
//! query of a language channel attends to becomes one number by `w` and `b`. Parameters lie one after another: a, E,
//! query, key and value matrices (`[in, out]`), w, b.

use rayon::prelude::*;

use super::super::classifier::uniform;
use crate::random::{Purpose, stream};

/// Channels of colour and language.
pub(super) const TOKENS: usize = 6;

/// Language channels, the last ones.
pub(super) const LANGUAGE: usize = 3;

/// Width of a token.
const WIDTH: usize = 8;

/// Gaussians of a task.
const CHUNK: usize = 512;

type Token = [f32; WIDTH];
type Matrix = [Token; WIDTH];

/// The parameters, and gradients by them.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Parts {
    lift: Token,
    embeddings: [Token; TOKENS],
    /// Query, key, value.
    maps: [Matrix; 3],
    out: Token,
    bias: f32,
}

/// Number of parameters.
pub(super) const PARAMETERS: usize = WIDTH + TOKENS * WIDTH + 3 * WIDTH * WIDTH + WIDTH + 1;

impl Parts {
    const ZERO: Self = Self {
        lift: [0.0; WIDTH],
        embeddings: [[0.0; WIDTH]; TOKENS],
        maps: [[[0.0; WIDTH]; WIDTH]; 3],
        out: [0.0; WIDTH],
        bias: 0.0,
    };

    fn of(parameters: &[f32]) -> Self {
        let mut rows = parameters.chunks_exact(WIDTH);
        let mut next = || -> Token { rows.next().and_then(|row| row.try_into().ok()).unwrap_or_default() };
        Self {
            lift: next(),
            embeddings: std::array::from_fn(|_| next()),
            maps: std::array::from_fn(|_| std::array::from_fn(|_| next())),
            out: next(),
            bias: parameters[PARAMETERS - 1],
        }
    }

    fn to_vec(self) -> Vec<f32> {
        let mut parameters = self.lift.to_vec();
        parameters.extend(self.embeddings.as_flattened());
        self.maps.iter().for_each(|map| parameters.extend(map.as_flattened()));
        parameters.extend(self.out);
        parameters.push(self.bias);
        parameters
    }
}

/// Parameters at the start: uniform, as linear layers start by default.
pub(super) fn start(seed: u64) -> Vec<f32> {
    let mut random = stream(seed, Purpose::HeadNetwork, 0);
    let root = 1.0 / (WIDTH as f32).sqrt();
    let mut parameters = uniform(WIDTH, 1.0, &mut random);
    parameters.extend(uniform(PARAMETERS - WIDTH, root, &mut random));
    parameters
}

fn dot(a: &Token, b: &Token) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn add(to: &mut Token, factor: f32, token: &Token) {
    to.iter_mut().zip(token).for_each(|(to, value)| *to += factor * value);
}

fn map(token: &Token, matrix: &Matrix) -> Token {
    let mut mapped = [0.0; WIDTH];
    token.iter().zip(matrix).for_each(|(value, row)| add(&mut mapped, *value, row));
    mapped
}

/// Everything in between of one Gaussian.
struct Steps {
    tokens: [Token; TOKENS],
    /// Query, key, value of every token.
    mapped: [[Token; TOKENS]; 3],
    /// Of the language channels.
    attention: [[f32; TOKENS]; LANGUAGE],
    means: [Token; LANGUAGE],
    fused: [f32; LANGUAGE],
}

fn evaluate(parts: &Parts, x: &[f32; TOKENS]) -> Steps {
    let tokens: [Token; TOKENS] = std::array::from_fn(|m| {
        let mut token = parts.embeddings[m];
        add(&mut token, x[m], &parts.lift);
        token
    });
    let mapped: [[Token; TOKENS]; 3] =
        std::array::from_fn(|k| std::array::from_fn(|m| map(&tokens[m], &parts.maps[k])));
    let scale = 1.0 / (WIDTH as f32).sqrt();
    let attention: [[f32; TOKENS]; LANGUAGE] = std::array::from_fn(|m| {
        let query = &mapped[0][TOKENS - LANGUAGE + m];
        let scores: [f32; TOKENS] = std::array::from_fn(|n| scale * dot(query, &mapped[1][n]));
        let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let powers = scores.map(|score| (score - most).exp());
        let sum: f32 = powers.iter().sum();
        powers.map(|power| power / sum)
    });
    let means = attention.map(|attention| {
        let mut mean = [0.0; WIDTH];
        attention.iter().zip(&mapped[2]).for_each(|(share, value)| add(&mut mean, *share, value));
        mean
    });
    let fused = std::array::from_fn(|m| x[TOKENS - LANGUAGE + m] + dot(&means[m], &parts.out) + parts.bias);
    Steps { tokens, mapped, attention, means, fused }
}

/// Adds the gradients by the parameters; returns those by the language channels.
fn backward_of(parts: &Parts, x: &[f32; TOKENS], v_fused: &[f32], sums: &mut Parts) -> [f32; LANGUAGE] {
    let steps = evaluate(parts, x);
    let mut v_mapped = [[[0.0; WIDTH]; TOKENS]; 3];
    let scale = 1.0 / (WIDTH as f32).sqrt();
    for m in 0..LANGUAGE {
        let (query, v) = (TOKENS - LANGUAGE + m, v_fused[m]);
        sums.bias += v;
        add(&mut sums.out, v, &steps.means[m]);
        let v_mean = parts.out.map(|out| v * out);
        let attention = &steps.attention[m];
        let v_attention: [f32; TOKENS] = std::array::from_fn(|n| dot(&v_mean, &steps.mapped[2][n]));
        let mean: f32 = attention.iter().zip(&v_attention).map(|(share, v)| share * v).sum();
        for n in 0..TOKENS {
            add(&mut v_mapped[2][n], attention[n], &v_mean);
            let v_score = scale * attention[n] * (v_attention[n] - mean);
            add(&mut v_mapped[0][query], v_score, &steps.mapped[1][n]);
            add(&mut v_mapped[1][n], v_score, &steps.mapped[0][query]);
        }
    }
    let mut v_x = [0.0; LANGUAGE];
    for n in 0..TOKENS {
        let mut v_token = [0.0; WIDTH];
        for k in 0..3 {
            let v = &v_mapped[k][n];
            for i in 0..WIDTH {
                v_token[i] += dot(&parts.maps[k][i], v);
                add(&mut sums.maps[k][i], steps.tokens[n][i], v);
            }
        }
        add(&mut sums.lift, x[n], &v_token);
        add(&mut sums.embeddings[n], 1.0, &v_token);
        if let Some(m) = n.checked_sub(TOKENS - LANGUAGE) {
            v_x[m] = v_fused[m] + dot(&parts.lift, &v_token);
        }
    }
    v_x
}

/// Fused language channels of N Gaussians, `[N, 3]`, whose channels `of` gives.
pub(super) fn fuse(parameters: &[f32], n: usize, of: impl Fn(usize) -> [f32; TOKENS] + Sync) -> Vec<f32> {
    let parts = Parts::of(parameters);
    let mut fused = vec![0.0; n * LANGUAGE];
    fused.par_chunks_mut(LANGUAGE).enumerate().for_each(|(row, out)| {
        out.copy_from_slice(&evaluate(&parts, &of(row)).fused);
    });
    fused
}

/// Gradients by the language channels, `[N, 3]`, and by the parameters.
pub(super) fn backward(
    parameters: &[f32],
    of: impl Fn(usize) -> [f32; TOKENS] + Sync,
    v_fused: &[f32],
) -> (Vec<f32>, Vec<f32>) {
    let parts = Parts::of(parameters);
    let mut v_codes = vec![0.0; v_fused.len()];
    let sums: Vec<Parts> = v_codes
        .par_chunks_mut(CHUNK * LANGUAGE)
        .zip(v_fused.par_chunks(CHUNK * LANGUAGE))
        .enumerate()
        .map(|(chunk, (v_codes, v_fused))| {
            let mut sums = Parts::ZERO;
            let rows = v_codes.chunks_exact_mut(LANGUAGE).zip(v_fused.chunks_exact(LANGUAGE));
            for (row, (v_code, v)) in rows.enumerate() {
                // What no pixel shows has no gradient.
                if v.iter().any(|v| *v != 0.0) {
                    let x = of(chunk * CHUNK + row);
                    v_code.copy_from_slice(&backward_of(&parts, &x, v, &mut sums));
                }
            }
            sums
        })
        .collect();
    let mut v_parameters = vec![0.0; PARAMETERS];
    for sums in sums {
        v_parameters.iter_mut().zip(sums.to_vec()).for_each(|(total, v)| *total += v);
    }
    (v_codes, v_parameters)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_come_back_in_their_order() {
        let parameters = start(3);
        assert_eq!(parameters.len(), PARAMETERS);
        assert_eq!(Parts::of(&parameters).to_vec(), parameters);
    }
}
