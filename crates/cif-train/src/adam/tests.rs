use cif_field::{DeformationConfig, Heads, TimeEncoding};

use super::*;

fn single(gradient: f32, steps: u32, rate: f32) -> f32 {
    let mut moments = Moments::zeros(1, 1);
    let mut p = [0.0];
    for _ in 0..steps {
        moments.step(&mut p, &mut [gradient], RowRates::Uniform(rate), None).unwrap();
    }
    p[0]
}

#[test]
fn matches_the_textbook_update_in_double_precision() {
    let mut moments = Moments::zeros(1, 1);
    let mut p = [0.5_f32];
    let (mut m, mut v, mut expected) = (0.0_f64, 0.0_f64, 0.5_f64);
    for t in 1..=50 {
        let g = (f64::from(t) * 0.7).sin() * 1e-3;
        moments.step(&mut p, &mut [g as f32], RowRates::Uniform(1e-2), None).unwrap();
        m = 0.9 * m + 0.1 * g;
        v = 0.999 * v + 0.001 * g * g;
        let (m_hat, v_hat) = (m / (1.0 - 0.9_f64.powi(t)), v / (1.0 - 0.999_f64.powi(t)));
        expected -= 1e-2 * m_hat / (v_hat.sqrt() + 1e-15);
        assert!((f64::from(p[0]) - expected).abs() < 2e-6, "step {t}: {} vs {expected}", p[0]);
    }
}

#[test]
fn first_step_is_the_rate_and_gradients_become_zero() {
    let mut moments = Moments::zeros(3, 1);
    let (mut p, mut g) = ([0.0; 3], [3.0, -1e-6, 0.0]);
    moments.step(&mut p, &mut g, RowRates::Uniform(0.05), None).unwrap();
    assert!((p[0] + 0.05).abs() < 1e-6 && (p[1] - 0.05).abs() < 1e-6 && p[2] == 0.0, "{p:?}");
    assert_eq!(g, [0.0; 3]);
}

#[test]
fn row_25_vanishing_gradients_do_not_step_arbitrarily() {
    // Row 25: the square of the gradient underflows.
    for gradient in [1e-22, 1e-20, 3e-21] {
        let moved = single(gradient, 100, 0.01);
        crate::measured::worst(
            25,
            "f32",
            "steps beyond the rate",
            f64::from(moved.abs() - 1.0).max(0.0),
            0.01,
        );
        assert!(single(gradient, 1, 0.01).abs() <= 0.0101);
    }
    assert_eq!(single(1e-22, 100, 0.01), 0.0);
}

#[test]
fn row_24_reset_moments_do_not_undo_an_opacity_reset() {
    // Row 24: large negative momentum (opacity rising), then a reset to 0.01 with zeroed moments.
    let mut moments = Moments::zeros(1, 1);
    let mut p = [0.0];
    for _ in 0..200 {
        moments.step(&mut p, &mut [-1.0], RowRates::Uniform(0.05), None).unwrap();
    }
    p[0] = cif_geometry::scalar::logit(0.01_f32);
    moments.reset_all();
    moments.step(&mut p, &mut [0.0], RowRates::Uniform(0.05), None).unwrap();
    let opacity = cif_geometry::scalar::sigmoid(p[0]);
    crate::measured::worst(24, "f32", "opacity beyond the reset", f64::from(opacity - 0.01).max(0.0), 5e-4);
}

#[test]
fn row_26_fresh_rows_step_by_3_16_times_the_rate() {
    // Row 26.
    let mut moments = Moments::zeros(2, 1);
    let mut p = [0.0; 2];
    for _ in 0..5_000 {
        moments.step(&mut p, &mut [1.0, 1.0], RowRates::Uniform(1e-3), None).unwrap();
    }
    moments.reset_row(1);
    let before = p;
    moments.step(&mut p, &mut [1.0, 1.0], RowRates::Uniform(1e-3), None).unwrap();
    let factor = (before[1] - p[1]) / 1e-3;
    crate::measured::worst(26, "f32", "first step", (factor - 3.162).abs().into(), 0.02);
    assert!(((before[0] - p[0]) / 1e-3 - 1.0).abs() < 0.02);
}

#[test]
fn split_rates_and_inactive_floats() {
    let mut moments = Moments::zeros(100, 48);
    let (mut p, mut g) = (vec![0.0; 4800], vec![1.0; 4800]);
    let rates = RowRates::Split { base: 0.1, rest: 0.01, split: 3, active: 12 };
    moments.step(&mut p, &mut g, rates, None).unwrap();
    for row in p.chunks(48) {
        assert!(row[..3].iter().all(|v| (v + 0.1).abs() < 1e-6));
        assert!(row[3..12].iter().all(|v| (v + 0.01).abs() < 1e-6));
        assert!(row[12..].iter().all(|v| *v == 0.0));
    }
    // Moments of what does not move stay as well, whatever its gradients; of 12 floats as of 27 and all 48.
    let mut alone = Moments::zeros(1, 48);
    let (mut p, mut g) = ([0.0; 48], [0.5; 48]);
    for active in [48, 12, 27] {
        let before = alone.clone();
        let rates = RowRates::Split { base: 0.1, rest: 0.01, split: 3, active };
        g.fill(0.5);
        alone.step(&mut p, &mut g, rates, None).unwrap();
        let moved = |k: usize| (alone.first[k], alone.second[k]) != (before.first[k], before.second[k]);
        assert!((0..48).all(|k| moved(k) == (k < active)), "{active}");
        assert_eq!(g, [0.0; 48]);
    }
}

#[test]
fn invisible_rows_keep_still_only_when_asked() {
    for asked in [false, true] {
        let mut moments = Moments::zeros(2, 3);
        let mut p = [0.0; 6];
        moments.step(&mut p, &mut [1.0; 6], RowRates::Uniform(0.1), None).unwrap();
        let before = p;
        let mut g = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0];
        let visible = [5.0, 0.0];
        moments.step(&mut p, &mut g, RowRates::Uniform(0.1), asked.then_some(&visible[..])).unwrap();
        assert_eq!(before[3..] == p[3..], asked);
        assert_ne!(before[..3], p[..3]);
    }
}

#[test]
fn a_gradient_that_is_not_finite_is_reported_and_not_applied() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for at in [0, 17, 9_999] {
            let mut moments = Moments::zeros(10_000, 1);
            let (mut p, mut g) = (vec![0.0; 10_000], vec![1e30; 10_000]);
            g[at] = bad;
            assert_eq!(moments.step(&mut p, &mut g, RowRates::Uniform(0.1), None), Err(NotFinite));
            assert!(p.iter().all(|v| v.is_finite()));
            assert_eq!(p[at], 0.0);
        }
    }
}

#[test]
fn gathered_rows_keep_their_moments_and_fresh_ones_have_none() {
    let mut moments = Moments::zeros(3, 2);
    moments.first = (0..6).map(|k| k as f32).collect();
    moments.second = (10..16).map(|k| k as f32).collect();
    moments.steps = 9;
    moments.gather(&[Some(2), None, Some(0), Some(0)]);
    assert_eq!(moments.first, [4.0, 5.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
    assert_eq!(moments.second, [14.0, 15.0, 0.0, 0.0, 10.0, 11.0, 10.0, 11.0]);
}

fn small_planes(encoding: TimeEncoding) -> DeformationConfig {
    DeformationConfig {
        spatial_resolution: [21, 5, 18],
        time_resolution: 41,
        multipliers: vec![1, 2],
        channels: 3,
        width: 4,
        heads: Heads { position: true, scale: false, rotation: false, opacity: false, sh: false },
        time_encoding: encoding,
    }
}

fn wavy(floats: usize) -> Vec<f32> {
    (0..floats).map(|k| 1.0 + 0.4 * (k as f32 * 0.37).sin() + 0.01 * (k % 7) as f32).collect()
}

const WEIGHTS: PlaneWeights = PlaneWeights { smoothness: 0.3, time_smoothness: 0.7, time_sparsity: 0.2 };

#[test]
fn regulariser_gradient_matches_central_differences() {
    for encoding in [TimeEncoding::Compact, TimeEncoding::Compat] {
        let config = small_planes(encoding);
        let (_, floats) = config.plane_layout();
        let start = wavy(floats);
        // With zero moments, the first moment after one step is a tenth of the gradient.
        let mut moments = Moments::zeros(floats, 1);
        let (mut planes, mut gradients) = (start.clone(), vec![0.0; floats]);
        step_planes(&mut moments, &mut planes, &mut gradients, &config, &WEIGHTS, 1e-3, &mut Vec::new())
            .unwrap();
        for k in (0..floats).step_by(13) {
            let h = 2.0_f32.powi(-10);
            let mut moved = start.clone();
            moved[k] = start[k] + h;
            let upper = plane_penalty(&moved, &config, &WEIGHTS);
            moved[k] = start[k] - h;
            let lower = plane_penalty(&moved, &config, &WEIGHTS);
            let numerical = (upper - lower) / (2.0 * f64::from(h));
            let analytic = f64::from(moments.first[k]) * 10.0;
            if (start[k] - 1.0).abs() > h {
                let tolerance = 2e-4 * numerical.abs() + 1e-7;
                assert!((numerical - analytic).abs() < tolerance, "{k}: {numerical} vs {analytic}");
            }
        }
    }
}

#[test]
fn the_fused_sweep_equals_gradient_then_step() {
    let config = small_planes(TimeEncoding::Compact);
    let (_, floats) = config.plane_layout();
    let data: Vec<f32> = (0..floats).map(|k| 1e-3 * (k as f32 * 0.11).cos()).collect();
    let mut fused = (Moments::zeros(floats, 1), wavy(floats));
    let mut plain = fused.clone();
    for _ in 0..3 {
        step_planes(&mut fused.0, &mut fused.1, &mut data.clone(), &config, &WEIGHTS, 1e-2, &mut Vec::new())
            .unwrap();
        let mut probe = Moments::zeros(floats, 1);
        let mut total = data.clone();
        let mut unused = plain.1.clone();
        step_planes(&mut probe, &mut unused, &mut vec![0.0; floats], &config, &WEIGHTS, 0.0, &mut Vec::new())
            .unwrap();
        for (t, m) in total.iter_mut().zip(&probe.first) {
            *t += m / (1.0 - BETA_1);
        }
        plain.0.step(&mut plain.1, &mut total, RowRates::Uniform(1e-2), None).unwrap();
    }
    for (a, b) in fused.1.iter().zip(&plain.1) {
        assert!((a - b).abs() < 1e-4, "{a} {b}");
    }
}

#[test]
fn planes_at_one_feel_no_sparsity() {
    let config = small_planes(TimeEncoding::Compact);
    let (_, floats) = config.plane_layout();
    let mut planes = vec![1.0; floats];
    let mut moments = Moments::zeros(floats, 1);
    step_planes(&mut moments, &mut planes, &mut vec![0.0; floats], &config, &WEIGHTS, 1e-2, &mut Vec::new())
        .unwrap();
    assert!(planes.iter().all(|p| *p == 1.0));
    assert_eq!(plane_penalty(&planes, &config, &WEIGHTS), 0.0);
}

#[test]
fn row_37_penalties_of_large_planes_are_summed_in_double_precision() {
    let config = DeformationConfig {
        spatial_resolution: [256; 3],
        channels: 8,
        ..small_planes(TimeEncoding::Compact)
    };
    let (levels, floats) = config.plane_layout();
    // Every second row lies 2^-10 higher: all second differences are plus or minus 2^-9, exactly.
    let mut planes = vec![1.0_f32; floats];
    for layout in levels.iter().flatten() {
        let row_len = layout.columns * config.channels as usize;
        for row in (0..layout.rows).step_by(2) {
            let start = layout.offset + row * row_len;
            planes[start..start + row_len].fill(1.0 + 1.0 / 1024.0);
        }
    }
    assert!(floats > 1_000_000, "{floats}");
    let weights = PlaneWeights { smoothness: 1.0, time_smoothness: 0.0, time_sparsity: 0.0 };
    // The mean of equal squares, times three planes on each level.
    let expected = (1.0_f64 / 512.0).powi(2) * 3.0 * levels.len() as f64;
    let penalty = plane_penalty(&planes, &config, &weights);
    crate::measured::worst(37, "f64", "mean", (penalty / expected - 1.0).abs(), 1e-9);
    // A sum in single precision would not pass.
    let tenths: f32 = (0..floats).map(|_| 0.1_f32).sum();
    assert!((f64::from(tenths) / (0.1 * floats as f64) - 1.0).abs() > 1e-6);
}
