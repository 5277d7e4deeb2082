//! Properties of the method on a tiny capture (methods reference 13).

use crate::support::{Scene, capture, small_config, train};
use cif_dataset::{Dataset, Split};
use cif_field::{Field, Gaussians, Identities, Instance, SortMetric, Timeline};
use cif_geometry::scalar::{logit, sigmoid};
use cif_geometry::{PinholeCamera, PixelGrid, RigidTransform};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, Gradients, InstanceSettings, RenderSettings};
use cif_train::adam::{Moments, RowRates};
use cif_train::config::{ResampleConfig, ScaleCorrection};
use cif_train::density::relocate::{Pair, Relocations, ResampleContext, apply, footprint_integral};
use glam::{DMat3, DVec2, DVec3};
use rand::SeedableRng;

/// A trained static field with estimated identities, and its capture.
fn estimated(folder: &std::path::Path) -> (Field, Dataset) {
    let dataset = capture(folder, Scene { times: 1, views: 5, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (0, 200, 0);
    let trainer = train(dataset.clone(), config);
    let mut field = trainer.into_field();
    field.gaussians.occupancy_logits.fill(logit(0.3));
    (field, dataset)
}

/// Views with dense labels.
fn views(dataset: &Dataset) -> Vec<(PinholeCamera, PixelGrid<u16>)> {
    let indices = (0..dataset.frames.len()).filter(|k| dataset.frames[*k].split == Split::Train);
    indices
        .map(|k| {
            let mask = dataset.load_frame(k, [1.0; 3]).unwrap().mask.unwrap();
            let dense = mask.map(|id| match id {
                0 => 0,
                id => dataset.instances.iter().position(|i| i.id == *id).unwrap() as u16 + 1,
            });
            (dataset.frames[k].camera, dense)
        })
        .collect()
}

/// Gradients of the instance loss alone, mean over all labelled pixels of all views; and the share of
/// labelled pixels that are supported.
fn instance_gradients(field: &Field, views: &[(PinholeCamera, PixelGrid<u16>)]) -> (Gradients, f64) {
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let settings =
        RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::of_field(field) };
    let labelled: usize = views.iter().map(|(_, l)| l.pixels.iter().filter(|v| **v != 0).count()).sum();
    let mut gradients = Gradients::zeros(field);
    let mut unsupported = 0;
    for (camera, labels) in views {
        let pass = renderer.forward(field, camera, 0.0, &settings, Some(labels));
        unsupported += pass.unsupported_pixels;
        let none = PixelGrid::filled(camera.width, camera.height, [0.0; 3]);
        let weight = pass.labelled_pixels as f32 / labelled as f32;
        renderer.backward(field, &none, weight, &mut gradients);
    }
    (gradients, 1.0 - unsupported as f64 / labelled as f64)
}

/// The field with one more label in every row, of probability 1e-3, that no mask shows. All other
/// probabilities shrink alike, so responsibilities stay; its gradient is p R and gives away R.
fn with_probe(field: &Field) -> Field {
    let rows = field.identities.as_ref().unwrap();
    let log_p = |entry: usize, p: &[f32]| p[entry].max(1e-30).ln();
    let p = rows.probabilities();
    let mut probed = Identities {
        row_offsets: vec![0],
        labels: vec![],
        log_estimates: vec![],
        log_calibrations: vec![],
        owners: vec![],
    };
    for row in 0..rows.len() {
        for entry in rows.range(row) {
            probed.labels.push(rows.labels[entry]);
            probed.log_estimates.push(log_p(entry, &p));
        }
        probed.labels.push(field.instances.len() as u16);
        probed.log_estimates.push((1e-3_f32).ln());
        probed.row_offsets.push(probed.labels.len() as u32);
    }
    probed.log_calibrations = vec![0.0; probed.labels.len()];
    let mut field = field.clone();
    field.identities = Some(probed);
    field.instances.push(Instance {
        id: 60_000,
        label: "probe".into(),
        category: "probe".into(),
        taxonomies: Default::default(),
    });
    field
}

/// Responsibility R per Gaussian, and the share rho / R per identity entry (without the probe).
fn responsibilities(field: &Field, views: &[(PinholeCamera, PixelGrid<u16>)]) -> (Vec<f64>, Vec<f64>, f64) {
    let probed = with_probe(field);
    let (gradients, supported) = instance_gradients(&probed, views);
    let rows = probed.identities.as_ref().unwrap();
    let p = rows.probabilities();
    let (mut totals, mut shares) = (Vec::new(), Vec::new());
    for row in 0..rows.len() {
        let range = rows.range(row);
        let probe = range.end - 1;
        let total = f64::from(gradients.log_calibrations[probe]) / f64::from(p[probe]);
        totals.push(total);
        for entry in range.start..probe {
            let rho = f64::from(p[entry]) * total - f64::from(gradients.log_calibrations[entry]);
            shares.push(rho / total.max(1e-30));
        }
    }
    (totals, shares, supported)
}

#[test]
fn responsibilities_add_up_and_calibration_gradients_have_no_gauge_part() {
    let folder = tempfile::tempdir().unwrap();
    let (field, dataset) = estimated(folder.path());
    let views = views(&dataset);
    let (totals, _, supported) = responsibilities(&field, &views);
    // Weights are one over the labelled pixels.
    let mass: f64 = totals.iter().sum();
    assert!((mass - supported).abs() < 1e-4 * supported, "{mass} of {supported}");
    let (gradients, _) = instance_gradients(&field, &views);
    let rows = field.identities.as_ref().unwrap();
    for row in 0..rows.len() {
        let entries = &gradients.log_calibrations[rows.range(row)];
        let sum: f32 = entries.iter().sum();
        let largest = entries.iter().fold(0.0_f32, |a, b| a.max(b.abs()));
        assert!(sum.abs() <= 1e-4 * largest + 1e-9, "row {row}: {sum} of {largest}");
    }
}

#[test]
fn calibration_ends_at_the_shares_of_responsibility() {
    let folder = tempfile::tempdir().unwrap();
    let (mut field, dataset) = estimated(folder.path());
    let views = views(&dataset);
    let entries = field.identities.as_ref().unwrap().labels.len();
    let mut moments = Moments::zeros(entries, 1);
    for step in 0..500 {
        let (mut gradients, _) = instance_gradients(&field, &views);
        let rate = cif_train::schedule::log_linear([0.1, 0.002], step, 500);
        let rows = field.identities.as_mut().unwrap();
        moments
            .step(&mut rows.log_calibrations, &mut gradients.log_calibrations, RowRates::Uniform(rate), None)
            .unwrap();
    }
    let (totals, shares, _) = responsibilities(&field, &views);
    let rows = field.identities.as_ref().unwrap();
    let p = rows.probabilities();
    let mut sorted = totals.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let (mut checked, mut close) = (0, 0);
    for row in (0..rows.len()).filter(|row| totals[*row] > median && rows.range(*row).len() > 1) {
        for entry in rows.range(row) {
            let difference = (f64::from(p[entry]) - shares[entry]).abs();
            // Rows whose share nears 0 or 1 creep: the gradient vanishes with the share.
            assert!(difference < 1e-2, "row {row}: {} against {}", p[entry], shares[entry]);
            checked += 1;
            close += usize::from(difference < 1e-3);
        }
    }
    assert!(checked > 20, "only {checked} entries checked");
    assert!(close * 20 >= checked * 19, "{close} of {checked} entries within 1e-3");
}

/// One Gaussian in front of the camera, on a pixel centre, and others out of sight.
fn one_in_view(others: usize) -> (Field, PinholeCamera) {
    let n = others + 1;
    let mut means = vec![[0.0, 0.0, -50.0]; n];
    means[0] = [0.0, 0.0, 2.0];
    let gaussians = Gaussians {
        means,
        log_scales: vec![[(0.2_f32).ln(); 3]; n],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![logit(0.9); n],
        occupancy_logits: vec![logit(0.4); n],
        sh_coefficients: vec![[0.2; 48]; n],
    };
    let field = Field {
        gaussians,
        deformation: None,
        tracks: None,
        identities: Some(Identities {
            row_offsets: (0..=n as u32).collect(),
            labels: vec![0; n],
            log_estimates: vec![0.0; n],
            log_calibrations: vec![0.0; n],
            owners: Vec::new(),
        }),
        instances: vec![Instance {
            id: 1,
            label: "one".into(),
            category: "one".into(),
            taxonomies: Default::default(),
        }],
        timeline: Timeline { times: vec![0.0], frames_per_second: 24.0 },
        cameras: vec![],
        sh_degree: 0,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    };
    let camera = PinholeCamera {
        width: 33,
        height: 33,
        focal_px: DVec2::splat(30.0),
        principal_px: DVec2::splat(16.5),
        camera_from_world: RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
    };
    (field, camera)
}

#[test]
fn relocation_conserves_what_is_rendered() {
    for (replicas, correction) in [
        (1, ScaleCorrection::Off),
        (4, ScaleCorrection::Off),
        (1, ScaleCorrection::Mcmc),
        (4, ScaleCorrection::Mcmc),
    ] {
        let (mut field, camera) = one_in_view(replicas);
        let mut renderer = Renderer::new(SimdLevel::Auto);
        let settings = RenderSettings::of_field(&field);
        let channels = Channels { depth: false, instances: true };
        let before = renderer.render(&field, &camera, 0.0, &settings, channels);
        let config =
            ResampleConfig { offset: 0.0, scale_correction: correction, ..ResampleConfig::default() };
        let context = ResampleContext {
            config: &config,
            unseen: &vec![false; replicas + 1],
            label_pixels: &[],
            opacity_is_occupancy: false,
            occupancy_is_constant: false,
            occupancy_floor: 0.005,
        };
        let pairs = (1..=replicas as u32).map(|weak| Pair { weak, source: 0 }).collect();
        let plan = Relocations { pairs, labels: 1 };
        apply(&mut field, &plan, &context, &mut rand_pcg::Pcg64::seed_from_u64(0));
        let after = renderer.render(&field, &camera, 0.0, &settings, channels);
        let centre = |image: &PixelGrid<f32>| *image.at(16, 16);
        assert!((centre(&before.alpha) - 0.9).abs() < 1e-4);
        assert!((centre(&before.alpha) - centre(&after.alpha)).abs() < 1e-5);
        let (old, new) = (before.instances.unwrap(), after.instances.unwrap());
        assert!((centre(&old.coverage) - centre(&new.coverage)).abs() < 1e-5);
        if correction == ScaleCorrection::Mcmc {
            let shrink = f64::from(field.gaussians.log_scales[0][0]).exp() / 0.2;
            let opacity = sigmoid(f64::from(field.gaussians.opacity_logits[0]));
            let integral = footprint_integral(opacity, replicas as u32 + 1) * shrink;
            assert!((integral - 0.9).abs() < 1e-4, "{integral}");
        }
    }
}

#[test]
fn ablations_change_what_they_say() {
    use cif_train::Ablation::{ConstantOccupancy, NoCalibration, NoResampling, OpacityOccupancy};
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 3, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (40, 60, 50);
    for ablation in [ConstantOccupancy, OpacityOccupancy, NoCalibration, NoResampling] {
        let mut config = config.clone();
        config.instance.ablate = [ablation].into();
        let mut resampled = false;
        let mut trainer = cif_train::Trainer::new(dataset.clone(), config).unwrap();
        trainer
            .run(&mut |event, _| {
                resampled |= matches!(event, cif_train::TrainEvent::Resampled { .. });
                cif_train::Control::Continue
            })
            .unwrap();
        let field = trainer.into_field();
        assert_eq!(resampled, ablation != NoResampling);
        let rows = field.identities.as_ref().unwrap();
        assert_eq!(rows.log_calibrations.iter().all(|mu| *mu == 0.0), ablation == NoCalibration);
        let constant = field.gaussians.occupancy_logits.iter().all(|h| *h == logit(0.02));
        assert_eq!(constant, ablation == ConstantOccupancy, "{ablation:?}");
        field.validate().unwrap();
    }
}
