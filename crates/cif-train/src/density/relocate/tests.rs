use cif_field::{Instance, SortMetric, Timeline};
use rand::SeedableRng;
use rand_pcg::Pcg64;

use cif_field::Gaussians;

use super::*;

/// 40 Gaussians, even rows of instance 0, odd rows of instance 1; occupancy grows with the row.
fn field() -> Field {
    let n = 40;
    let instance = |id: u16| Instance {
        id,
        label: format!("thing {id}"),
        category: "thing".into(),
        taxonomies: Default::default(),
    };
    Field {
        gaussians: Gaussians {
            means: (0..n).map(|k| [k as f32, 0.0, 0.0]).collect(),
            log_scales: vec![[-3.0, -2.0, -4.0]; n],
            quaternions: vec![[1.0, 0.2, 0.0, 0.1]; n],
            opacity_logits: (0..n).map(|k| k as f32 * 0.1 - 1.0).collect(),
            occupancy_logits: (0..n).map(|k| k as f32 * 0.2 - 4.0).collect(),
            sh_coefficients: (0..n).map(|k| [k as f32; 48]).collect(),
        },
        deformation: None,
        tracks: None,
        identities: Some(Identities {
            row_offsets: (0..=n as u32).map(|k| 2 * k).collect(),
            labels: (0..2 * n).map(|k| (k % 2) as u16).collect(),
            log_estimates: (0..2 * n)
                .map(|k| if (k / 2) % 2 == k % 2 { 0.9_f32.ln() } else { 0.1_f32.ln() })
                .collect(),
            log_calibrations: (0..2 * n).map(|k| k as f32 * 1e-3).collect(),
            owners: Vec::new(),
        }),
        instances: vec![instance(3), instance(9)],
        timeline: Timeline { times: vec![0.0], frames_per_second: 24.0 },
        cameras: vec![],
        sh_degree: 0,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

fn context<'a>(config: &'a ResampleConfig, unseen: &'a [bool]) -> ResampleContext<'a> {
    ResampleContext {
        config,
        unseen,
        label_pixels: &[],
        opacity_is_occupancy: false,
        occupancy_is_constant: false,
        occupancy_floor: 0.005,
    }
}

#[test]
fn a_plan_shares_pairs_equally_inside_instances() {
    let config = ResampleConfig { rate: 0.25, ..ResampleConfig::default() };
    let unseen = vec![false; 40];
    let plan = choose(&field(), &context(&config, &unseen), &mut Pcg64::seed_from_u64(1));
    assert_eq!((plan.pairs.len(), plan.labels), (10, 2));
    let weak: std::collections::BTreeSet<u32> = plan.pairs.iter().map(|p| p.weak).collect();
    assert_eq!(weak.len(), 10, "no row is weak twice");
    assert!(plan.pairs.iter().all(|p| !weak.contains(&p.source)), "no weak row is a source");
    assert_eq!(weak.iter().filter(|row| *row % 2 == 0).count(), 5);
}

/// Instance 0 has the first `members` rows, instance 1 all others.
fn divided(members: usize) -> Field {
    let mut scene = field();
    let rows = scene.identities.as_mut().unwrap();
    for row in 0..40 {
        let own = usize::from(row >= members);
        rows.log_estimates[2 * row + own] = 0.9_f32.ln();
        rows.log_estimates[2 * row + 1 - own] = 0.1_f32.ln();
    }
    scene
}

#[test]
fn draws_beyond_the_weak_share_are_dropped_or_shared_and_one_member_stays() {
    let weak_of = |weak_share: f32, excess: Excess, weak_set: WeakSet| {
        let config = ResampleConfig { rate: 0.5, weak_share, excess, weak_set, ..ResampleConfig::default() };
        let plan = choose(&divided(6), &context(&config, &[false; 40]), &mut Pcg64::seed_from_u64(1));
        let of_first = plan.pairs.iter().filter(|pair| pair.weak < 6).count();
        (of_first, plan.pairs.len())
    };
    assert_eq!(weak_of(0.5, Excess::Drop, WeakSet::Members), (3, 13));
    assert_eq!(weak_of(0.5, Excess::Share, WeakSet::Members), (3, 20));
    assert_eq!(weak_of(1.0, Excess::Drop, WeakSet::Members), (5, 15));
    assert_eq!(weak_of(1.0, Excess::Share, WeakSet::Members), (5, 20));
    assert_eq!(weak_of(1.0, Excess::Drop, WeakSet::Literal).1, 20, "all Gaussians are candidates");
}

#[test]
fn what_draws_the_surroundings_of_an_instance_stays() {
    let mut scene = field();
    // Of both instances; hardly occupied, but half of them opaque.
    scene.gaussians.occupancy_logits[..20].fill(-6.0);
    for (row, logit) in scene.gaussians.opacity_logits[..20].iter_mut().enumerate() {
        *logit = if row < 10 { 4.0 } else { -6.0 };
    }
    let opaque = |weakness: Weakness| {
        let config = ResampleConfig { rate: 0.1, weakness, ..ResampleConfig::default() };
        let plans = (0..50)
            .map(|seed| choose(&scene, &context(&config, &[false; 40]), &mut Pcg64::seed_from_u64(seed)));
        plans.map(|plan| plan.pairs.iter().filter(|pair| pair.weak < 10).count()).sum::<usize>()
    };
    // Four of 40 per event.
    assert!((70..130).contains(&opaque(Weakness::Occupancy)), "{}", opaque(Weakness::Occupancy));
    assert!(opaque(Weakness::Visibility) < 5, "{}", opaque(Weakness::Visibility));
}

#[test]
fn flagged_rows_are_never_sources() {
    let config = ResampleConfig { rate: 0.25, ..ResampleConfig::default() };
    let unseen: Vec<bool> = (0..40).map(|k| k >= 20).collect();
    for seed in 0..20 {
        let plan = choose(&field(), &context(&config, &unseen), &mut Pcg64::seed_from_u64(seed));
        assert!(!plan.pairs.is_empty());
        assert!(plan.pairs.iter().all(|p| p.source < 20));
    }
}

#[test]
fn instances_with_one_member_take_no_part() {
    let mut scene = field();
    let rows = scene.identities.as_mut().unwrap();
    for row in 1..40 {
        rows.log_estimates[2 * row] = 0.9_f32.ln();
        rows.log_estimates[2 * row + 1] = 0.1_f32.ln();
    }
    rows.log_estimates[0] = 0.1_f32.ln();
    rows.log_estimates[1] = 0.9_f32.ln();
    let config = ResampleConfig { rate: 0.25, ..ResampleConfig::default() };
    let plan = choose(&scene, &context(&config, &[false; 40]), &mut Pcg64::seed_from_u64(1));
    assert_eq!((plan.pairs.len(), plan.labels), (10, 1));
    assert!(plan.pairs.iter().all(|p| p.weak != 0));
}

#[test]
fn relocation_copies_everything_and_conserves_coverage() {
    let before = field();
    let mut after = before.clone();
    let plan = Relocations {
        pairs: vec![Pair { weak: 0, source: 38 }, Pair { weak: 2, source: 38 }, Pair { weak: 1, source: 39 }],
        labels: 2,
    };
    let config = ResampleConfig::default();
    let relocated = apply(&mut after, &plan, &context(&config, &[false; 40]), &mut Pcg64::seed_from_u64(1));
    assert_eq!((relocated.weak, relocated.sources), (vec![0, 2, 1], vec![38, 39]));
    let (a, b) = (&after.gaussians, &before.gaussians);
    for (weak, source, copies) in [(0, 38, 3.0), (2, 38, 3.0), (1, 39, 2.0)] {
        assert_eq!(a.sh_coefficients[weak], b.sh_coefficients[source]);
        assert_eq!(a.quaternions[weak], b.quaternions[source]);
        assert_eq!(a.log_scales[weak], b.log_scales[source]);
        assert_eq!(a.opacity_logits[weak], a.opacity_logits[source]);
        assert_ne!(a.means[weak], b.means[source], "replicas at the same place would never part");
        for (new, old) in [(&a.opacity_logits, &b.opacity_logits), (&a.occupancy_logits, &b.occupancy_logits)]
        {
            let left = |logit: f32| 1.0 - f64::from(sigmoid(logit));
            let (together, alone) = (left(new[source]).powf(copies), left(old[source]));
            assert!((together - alone).abs() < 1e-6, "{together} {alone}");
        }
        let distance: f32 = (0..3).map(|k| (a.means[weak][k] - b.means[source][k]).powi(2)).sum::<f32>();
        assert!(distance.sqrt() <= (-2.0_f32).exp(), "half of at most two standard deviations");
    }
    assert_eq!(a.means[5], b.means[5]);
    let rows = after.identities.unwrap();
    let old = before.identities.unwrap();
    assert_eq!(rows.log_calibrations[rows.range(0)], old.log_calibrations[old.range(38)]);
    assert_eq!(relocated.entry_origins[..2], [None, None]);
    assert_eq!(relocated.entry_origins[6..8], [Some(6), Some(7)]);
    assert_eq!(relocated.entry_origins[76..78], [Some(76), Some(77)]);
}

#[test]
fn faint_sources_stop_at_the_floor_and_are_counted() {
    let mut scene = field();
    scene.gaussians.occupancy_logits[38] = logit(0.006);
    let plan = Relocations { pairs: vec![Pair { weak: 0, source: 38 }], labels: 1 };
    let config = ResampleConfig::default();
    let relocated = apply(&mut scene, &plan, &context(&config, &[false; 40]), &mut Pcg64::seed_from_u64(1));
    assert_eq!(relocated.floored, 1);
    assert!((sigmoid(scene.gaussians.occupancy_logits[38]) - 0.005).abs() < 1e-6);
}

#[test]
fn constant_occupancy_is_left_alone() {
    let mut scene = field();
    scene.gaussians.occupancy_logits.fill(logit(0.02));
    let plan = Relocations { pairs: vec![Pair { weak: 0, source: 38 }], labels: 1 };
    let config = ResampleConfig::default();
    let context = ResampleContext { occupancy_is_constant: true, ..context(&config, &[false; 40]) };
    apply(&mut scene, &plan, &context, &mut Pcg64::seed_from_u64(1));
    assert!(scene.gaussians.occupancy_logits.iter().all(|h| *h == logit(0.02)));
}

#[test]
fn the_scale_correction_conserves_the_footprint() {
    let mut scene = field();
    let before = scene.clone();
    let plan =
        Relocations { pairs: vec![Pair { weak: 0, source: 39 }, Pair { weak: 1, source: 39 }], labels: 1 };
    let config = ResampleConfig { scale_correction: ScaleCorrection::Mcmc, ..ResampleConfig::default() };
    apply(&mut scene, &plan, &context(&config, &[false; 40]), &mut Pcg64::seed_from_u64(1));
    let shrink = f64::from(scene.gaussians.log_scales[39][0] - before.gaussians.log_scales[39][0]).exp();
    let old = sigmoid(f64::from(before.gaussians.opacity_logits[39]));
    let new = sigmoid(f64::from(scene.gaussians.opacity_logits[39]));
    assert!((footprint_integral(new, 3) * shrink - old).abs() < 1e-4);
    assert_eq!(scene.gaussians.log_scales[0], scene.gaussians.log_scales[39]);
}

#[test]
fn the_same_stream_gives_the_same_event() {
    let config = ResampleConfig { rate: 0.25, weak_set: WeakSet::Literal, ..ResampleConfig::default() };
    let run = || {
        let mut scene = field();
        let mut rng = Pcg64::seed_from_u64(8);
        let context = context(&config, &[false; 40]);
        let plan = choose(&scene, &context, &mut rng);
        let relocated = apply(&mut scene, &plan, &context, &mut rng);
        (scene, plan, relocated)
    };
    let (a, b) = (run(), run());
    assert_eq!(a, b);
    assert!(!a.1.pairs.is_empty());
}
