//! The contrastive loss of lifting: `-mean ln(sum of same e^kappa / sum of all e^kappa)` with `kappa = e^(-d^2 / tau)`
//! of the squared distance of two codes, tau being 100 within a label and 1 between labels. A pixel is none of its own
//! label's others, but one of all. Source: methods reference 8.5.

use rayon::prelude::*;

/// Temperature within a label, and between labels.
const SAME: f32 = 100.0;
const OTHER: f32 = 1.0;

/// Codes channel by channel, and their labels.
struct Codes<'a> {
    /// `[width, n]`.
    channels: Vec<f32>,
    /// `[n, width]`.
    rows: &'a [f32],
    labels: &'a [u16],
    width: usize,
}

impl Codes<'_> {
    /// Kernels of a code with all: `kappa` and `e^kappa`; and the inverse temperatures.
    fn kernels(&self, row: usize, [kappa, power, inverse]: [&mut [f32]; 3]) {
        let n = self.labels.len();
        kappa.fill(0.0);
        for (channel, value) in self.channels.chunks_exact(n).zip(&self.rows[row * self.width..]) {
            for (squared, other) in kappa.iter_mut().zip(channel) {
                let difference = value - other;
                *squared += difference * difference;
            }
        }
        let label = self.labels[row];
        for (inverse, other) in inverse.iter_mut().zip(self.labels) {
            *inverse = if *other == label { 1.0 / SAME } else { 1.0 / OTHER };
        }
        // Among its own label it is left out, and it is at no distance from itself either way.
        inverse[row] = 1.0 / OTHER;
        for ((kappa, power), inverse) in kappa.iter_mut().zip(power).zip(inverse) {
            *kappa = exp(-*kappa * *inverse);
            *power = exp(*kappa);
        }
    }
}

/// `e^x` for x up to 1: degree 6 around whole powers of two; relative error below 3e-7 times the
/// larger of 1 and |x|. Plain arithmetic, so that loops
/// over it become vector instructions.
fn exp(x: f32) -> f32 {
    let scaled = (x * std::f32::consts::LOG2_E).max(-126.0);
    let whole = (scaled + 12_582_912.0) - 12_582_912.0;
    let f = (scaled - whole) * std::f32::consts::LN_2;
    let mut p = 1.0 / 720.0;
    for coefficient in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = p * f + coefficient;
    }
    p * f32::from_bits((((whole as i32) + 127) << 23) as u32)
}

/// The loss of codes `[n, width]` with labels, and its gradient. A code without another of its label adds nothing.
pub(super) fn contrast(rows: &[f32], labels: &[u16], width: usize) -> (f64, Vec<f32>) {
    let n = labels.len();
    if n == 0 {
        return (0.0, Vec::new());
    }
    let mut channels = vec![0.0; rows.len()];
    for (row, code) in rows.chunks_exact(width).enumerate() {
        for (k, value) in code.iter().enumerate() {
            channels[k * n + row] = *value;
        }
    }
    let codes = Codes { channels, rows, labels, width };
    let scratch = || [vec![0.0_f32; n], vec![0.0_f32; n], vec![0.0_f32; n]];
    // Of every code, the sums over its own label and over all; none without another of its label.
    let sums: Vec<Option<(f64, f64)>> = (0..n)
        .into_par_iter()
        .map_init(scratch, |[kappa, power, inverse], row| {
            codes.kernels(row, [kappa, power, inverse]);
            let all: f64 = power.iter().map(|power| f64::from(*power)).sum();
            let of_label = power.iter().zip(labels).filter(|(_, label)| **label == labels[row]);
            let same: f64 = of_label.map(|(power, _)| f64::from(*power)).sum::<f64>() - f64::from(power[row]);
            let others = labels.iter().filter(|label| **label == labels[row]).count() > 1;
            others.then_some((same, all))
        })
        .collect();
    let loss = sums.iter().flatten().map(|(same, all)| -(same / all).ln()).sum::<f64>() / n as f64;
    // Of every code as one of the pair: 1 / all and 1 / same.
    let inverses: (Vec<f32>, Vec<f32>) = sums
        .iter()
        .map(|sums| sums.map_or((0.0, 0.0), |(same, all)| ((1.0 / all) as f32, (1.0 / same) as f32)))
        .unzip();
    let mut v_codes = vec![0.0; rows.len()];
    v_codes.par_chunks_mut(width).enumerate().for_each_init(scratch, |[kappa, power, inverse], (row, v)| {
        codes.kernels(row, [kappa, power, inverse]);
        let (of_all, of_same) = (inverses.0[row], inverses.1[row]);
        // In place of the kernels: how much each other code pulls or pushes.
        for other in 0..n {
            let mut v_kappa = of_all + inverses.0[other];
            if labels[other] == labels[row] {
                v_kappa -= of_same + inverses.1[other];
            }
            kappa[other] *= -2.0 * inverse[other] / n as f32 * v_kappa * power[other];
        }
        kappa[row] = 0.0;
        for ((v, channel), value) in
            v.iter_mut().zip(codes.channels.chunks_exact(n)).zip(&rows[row * width..])
        {
            *v = kappa.iter().zip(channel).map(|(pull, other)| pull * (value - other)).sum();
        }
    });
    (loss, v_codes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_accurate() {
        for k in 0..4_000 {
            let x = 1.0 - k as f32 * 0.02;
            let expected = f64::from(x).exp();
            let allowed = 3e-7 * f64::from(x.abs().max(1.0));
            assert!((f64::from(exp(x)) / expected - 1.0).abs() < allowed, "{x}");
        }
        assert!(exp(-1e30) < 1e-37 && exp(f32::NEG_INFINITY) < 1e-37);
    }
}
