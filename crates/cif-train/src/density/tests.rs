use rand::SeedableRng;

use cif_render::Gradients;
use rand_distr::{Distribution, StandardNormal};

use super::super::rearrangement::in_world;
use super::*;

const EXTENT: f32 = 1.0;

/// Rows 0 to 3: small, large, small without gradient, small and transparent.
fn scene() -> (Gaussians, DensifyStatistics) {
    let mut gaussians = Gaussians {
        means: (0..4).map(|k| [k as f32, 0.0, 0.0]).collect(),
        log_scales: vec![[(0.005_f32).ln(); 3]; 4],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; 4],
        opacity_logits: vec![0.0, 0.0, 0.0, logit(0.001)],
        occupancy_logits: vec![-1.0, -2.0, -3.0, -4.0],
        sh_coefficients: (0..4).map(|k| [k as f32; 48]).collect(),
    };
    gaussians.log_scales[1] = [(0.5_f32).ln(), (0.001_f32).ln(), (0.001_f32).ln()];
    let mut statistics = DensifyStatistics::zeros(4);
    statistics.count = vec![2, 2, 2, 0];
    statistics.gradient = vec![6e-4, 8e-4, 3e-4, 0.0];
    (gaussians, statistics)
}

fn rng() -> rand_pcg::Pcg64 {
    rand_pcg::Pcg64::seed_from_u64(5)
}

#[test]
fn small_ones_are_cloned_and_large_ones_split() {
    let (gaussians, statistics) = scene();
    let config = DensifyConfig::default();
    let result = add_gaussians(&gaussians, &statistics, &config, EXTENT, &mut rng()).unwrap();
    assert_eq!((result.cloned, result.split, result.pruned), (1, 1, 0));
    assert_eq!(result.origins, [Some(0), Some(2), Some(3), None, None, None]);
    let set = &result.gaussians;
    assert_eq!(set.means[3], gaussians.means[0]);
    assert_eq!(set.sh_coefficients[3], gaussians.sh_coefficients[0]);
    for child in 4..6 {
        assert_eq!(set.occupancy_logits[child], -2.0);
        let shrunk = gaussians.log_scales[1][0] - 1.6_f32.ln();
        assert!((set.log_scales[child][0] - shrunk).abs() < 1e-6);
        let offset = [set.means[child][0] - 1.0, set.means[child][1], set.means[child][2]];
        assert!(offset[0].abs() > offset[1].abs().max(offset[2].abs()), "{offset:?}");
    }
    assert_ne!(set.means[4], set.means[5]);
}

#[test]
fn children_scatter_like_the_gaussian_they_replace() {
    let mut gaussians = scene().0.gather(&[1]);
    gaussians.quaternions[0] = [0.5_f32.sqrt(), 0.0, 0.0, 0.5_f32.sqrt()];
    let (mut along_y, mut rng) = (0.0_f64, rng());
    for _ in 0..4_000 {
        let xi = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
        let offset = in_world(&gaussians, 0, xi);
        assert!(offset[0].abs() < 0.01, "a quarter turn about z moves the long axis to y");
        along_y += f64::from(offset[1]) * f64::from(offset[1]) / 4_000.0;
    }
    assert!((along_y.sqrt() - 0.5).abs() < 0.02, "{along_y}");
}

#[test]
fn the_cap_takes_the_strongest_and_nothing_happens_at_the_cap() {
    let (gaussians, statistics) = scene();
    let config = DensifyConfig { max_gaussians: 5, ..DensifyConfig::default() };
    let result = add_gaussians(&gaussians, &statistics, &config, EXTENT, &mut rng()).unwrap();
    assert_eq!((result.cloned, result.split, result.gaussians.len()), (0, 1, 5));
    let full = DensifyConfig { max_gaussians: 4, ..DensifyConfig::default() };
    assert!(add_gaussians(&gaussians, &statistics, &full, EXTENT, &mut rng()).is_none());
}

#[test]
fn pruning_needs_enough_gaussians_and_large_ones_go_only_after_a_reset() {
    let (gaussians, mut statistics) = scene();
    statistics.radius[2] = 30.0;
    let parity = DensifyConfig { prune_min_n: 4, ..DensifyConfig::default() };
    let rows = |opacities_were_reset: bool| Rows {
        gaussians: &gaussians,
        statistics: &statistics,
        contributions: None,
        made_for: &[0; 4],
        extent: EXTENT,
        opacities_were_reset,
    };
    assert!(prune(&rows(true), &parity).is_none());
    let config = DensifyConfig::default();
    let before = prune(&rows(false), &config).unwrap();
    assert_eq!((before.pruned, before.origins), (1, vec![Some(0), Some(1), Some(2)]));
    let after = prune(&rows(true), &config).unwrap();
    assert_eq!((after.pruned, after.origins), (3, vec![Some(0)]));
}

#[test]
fn the_last_of_an_object_stay_and_are_drawn() {
    let opacities = [0.9, 0.003, 0.001, 0.004, 0.002, 0.001, 0.001];
    let gaussians = Gaussians { opacity_logits: opacities.map(logit).to_vec(), ..scene().0.gather(&[0; 7]) };
    let statistics = DensifyStatistics::zeros(7);
    let kept = |made_for: &[u32]| {
        let rows = Rows {
            gaussians: &gaussians,
            statistics: &statistics,
            contributions: None,
            made_for,
            extent: EXTENT,
            opacities_were_reset: false,
        };
        prune(&rows, &DensifyConfig { prune_min_n: 0, ..DensifyConfig::default() }).unwrap()
    };
    assert_eq!(kept(&[0; 7]).parents, [0]);
    // Of one object one stays anyway; the three most opaque of the others stay with it. Another has one in all.
    let change = kept(&[1, 1, 1, 1, 1, 1, 2]);
    assert_eq!(change.parents, [0, 1, 3, 4, 6]);
    let least = DensifyConfig::default().prune_opacity;
    for (kept, before) in change.gaussians.opacity_logits.iter().zip([0.9, least, least, least, least]) {
        assert!((sigmoid(*kept) - before).abs() < 1e-6, "{}", sigmoid(*kept));
    }
}

#[test]
fn statistics_count_visible_steps_only() {
    let field_like = Gradients {
        gaussians: Gaussians::default(),
        log_calibrations: vec![],
        planes: vec![],
        mlp: vec![],
        screen: vec![[3.0, 4.0], [1.0, 0.0]],
        radii: vec![7.0, 0.0],
        poses: Vec::new(),
        pose_views: Vec::new(),
    };
    let mut statistics = DensifyStatistics::zeros(2);
    statistics.add(&field_like);
    statistics.add(&field_like);
    assert_eq!((statistics.gradient, statistics.count), (vec![10.0, 0.0], vec![2, 0]));
    assert_eq!(statistics.radius, [7.0, 0.0]);
}

#[test]
fn a_reset_caps_opacities_and_lifts_none() {
    let (mut gaussians, _) = scene();
    reset_opacities(&mut gaussians, 0.01);
    assert!((sigmoid(gaussians.opacity_logits[0]) - 0.01).abs() < 1e-6);
    assert!((sigmoid(gaussians.opacity_logits[3]) - 0.001).abs() < 1e-6);
}
