//! Volume conservation. Source: methods reference 6.3 and 6.4.

/// `-log(1 - sigmoid(r))`.
fn softplus(r: f64) -> f64 {
    r.max(0.0) + (-r.abs()).exp().ln_1p()
}

/// Inverse of [`softplus`].
fn inverse_softplus(u: f64) -> f64 {
    if u > 15.0 {
        u + (-(-u).exp()).ln_1p()
    } else if u < 1e-4 {
        u.ln() + u / 2.0
    } else {
        u.exp_m1().ln()
    }
}

/// Logit of the probability x' with `(1 - x')^(replicas + 1) = 1 - x`, so that a Gaussian and its replicas
/// cover together what it covered alone. No round trip through x: exact at both ends. No replicas: unchanged.
#[must_use]
pub fn conserved_logit(logit: f64, replicas: u32) -> f64 {
    if replicas == 0 { logit } else { inverse_softplus(softplus(logit) / f64::from(replicas + 1)) }
}

/// Nodes of the integral and where they end, standard deviations.
const NODES: u32 = 65;
const REACH: f64 = 6.0;

/// `1 / sqrt(2 pi)` times the integral over x of `1 - (1 - o exp(-x^2 / 2))^copies`: what `copies` coincident
/// Gaussians of opacity o cover along a line.
#[must_use]
pub fn footprint_integral(opacity: f64, copies: u32) -> f64 {
    let step = 2.0 * REACH / f64::from(NODES - 1);
    let sum: f64 = (0..NODES)
        .map(|k| {
            let x = -REACH + f64::from(k) * step;
            -(f64::from(copies) * (-opacity * (-0.5 * x * x).exp()).ln_1p()).exp_m1()
        })
        .sum();
    sum * step / (2.0 * std::f64::consts::PI).sqrt()
}

/// Factor of the scales that conserves the integral too: the old opacity over the integral of the copies.
#[must_use]
pub fn scale_correction(old_opacity: f64, new_opacity: f64, copies: u32) -> f64 {
    old_opacity / footprint_integral(new_opacity, copies)
}

#[cfg(test)]
mod tests {
    use cif_geometry::scalar::{logit, sigmoid};

    use super::*;

    #[test]
    fn known_values() {
        // Values of methods reference 6.3, rows 1 and 2.
        for (r, expected) in [(-12.0, -13.386_297), (0.0, -1.664_913), (40.0, 9.999_955)] {
            let value = conserved_logit(r, 3);
            assert!((value - expected).abs() < 2e-6, "{r}: {value}");
        }
    }

    #[test]
    fn row_1_and_2_coverage_is_conserved_at_both_ends() {
        // `1 - (1 - x')^(n + 1)` against x, from logits in double precision and rounded to single.
        let mut of_path = [("f64", 0.0_f64, 1e-9), ("f32", 0.0_f64, 2e-5)];
        for (row, logits) in [(1, [-30.0, -14.0, -9.0, -4.0]), (2, [4.0, 9.0, 14.0, 16.0])] {
            of_path.iter_mut().for_each(|(_, worst, _)| *worst = 0.0);
            for (r, n) in logits.into_iter().flat_map(|r| [1_u32, 3, 50].map(|n| (r, n))) {
                let after = |logit: f64| f64::from(n + 1) * softplus(logit);
                let new = conserved_logit(r, n);
                for ((_, worst, _), logit) in of_path.iter_mut().zip([new, f64::from(new as f32)]) {
                    // Both sides as -log(1 - x): near 1 nothing else has digits left.
                    *worst = worst.max((after(logit) / softplus(r) - 1.0).abs());
                }
            }
            for (path, worst, limit) in of_path {
                crate::measured::worst(row, path, "coverage", worst, limit);
            }
        }
    }

    #[test]
    fn nothing_changes_without_replicas() {
        // Row 3: bit for bit.
        for r in [-30.0, -3.3, 0.1, 12.7, 80.0] {
            assert_eq!(conserved_logit(r, 0).to_bits(), f64::to_bits(r));
        }
    }

    #[test]
    fn coverage_is_conserved_and_events_compose() {
        for r in [-14.0, -9.0, -4.0, -0.5, 0.0, 2.0, 6.0] {
            for n in [1_u32, 2, 7, 50] {
                let x = sigmoid(conserved_logit(r, n));
                let after = (f64::from(n + 1) * (-x).ln_1p()).exp_m1() / (-sigmoid(r));
                assert!((after - 1.0).abs() < 1e-6, "{r} {n}: {after}");
            }
            let twice = conserved_logit(conserved_logit(r, 1), 2);
            assert!((twice - conserved_logit(r, 5)).abs() < 1e-6 * (1.0 + r.abs()), "{r}: {twice}");
        }
    }

    #[test]
    fn footprint_integrals() {
        // Values of methods reference 6.4; opacities before the event.
        for (old, copies, expected) in
            [(0.9, 2, 1.036_940_6), (0.5, 5, 0.540_594_4), (0.99, 10, 1.483_478_8), (0.99, 51, 1.541_757_3)]
        {
            let new = sigmoid(conserved_logit(logit(old), copies - 1));
            let d = footprint_integral(new, copies);
            assert!((d - expected).abs() < 1e-6, "{old} {copies}: {d}");
            let corrected = scale_correction(old, new, copies) * d;
            assert!((corrected - old).abs() < 1e-9);
        }
    }

    #[test]
    fn row_32_the_integral_equals_the_alternating_sum() {
        let (o, n) = (0.3_f64, 12_u32);
        let (mut sum, mut binomial) = (0.0, 1.0);
        for m in 1..=n {
            binomial *= f64::from(n - m + 1) / f64::from(m);
            let sign = if m % 2 == 1 { 1.0 } else { -1.0 };
            sum += sign * binomial * o.powi(m as i32) / f64::from(m).sqrt();
        }
        crate::measured::worst(32, "f64", "integral", (footprint_integral(o, n) - sum).abs(), 1e-7);
    }
}
