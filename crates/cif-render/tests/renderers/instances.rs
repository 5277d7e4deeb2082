//! The instance pass: hand-checked pixel, K-free against dense K, identities of the calibration gradient.

use crate::support::{Cotangents, Mismatches};
use cif_geometry::PixelGrid;
use cif_render::reference::cross_entropy::{instance_loss, pixel_loss};
use cif_render::reference::dense::{
    dense_cross_entropy, instance_image, rasterize_dense, rasterize_dense_backward,
};
use cif_render::reference::rasterize::{
    InstanceCotangent, PixelCotangents, RasterGradients, rasterize, rasterize_backward,
};
use cif_render::reference::{IdentityProbabilities, InstanceTarget, Scene, Splat2d, count_identities};
use cif_render::synthetic::{SyntheticConfig, generate};
use cif_render::{GeometryPath, InstanceNormalisation, InstanceSettings, RenderSettings};
use cif_render::{cpu::IdentityCounts, reference};

/// A splat with unit conic that pixel (0, 0) sees at a given sigma.
fn splat_at(sigma: f64, occupancy: f64, depth: f64) -> Option<Splat2d<f64>> {
    Some(Splat2d {
        mean2d: [0.5 + (2.0 * sigma).sqrt(), 0.5],
        factor: [1.0, 0.0, 1.0],
        depth,
        sort_key: depth,
        color: [0.0; 3],
        color_clamped: [false; 3],
        opacity: 0.0,
        occupancy,
        radius: 3.0,
        extents: [4.0, 4.0],
    })
}

fn identities(values: [f64; 3]) -> IdentityProbabilities<f64> {
    // Label 0 with the given probability, label 1 with the rest.
    IdentityProbabilities {
        row_offsets: vec![0, 2, 4, 6],
        labels: vec![0, 1, 0, 1, 0, 1],
        values: values.iter().flat_map(|p| [*p, 1.0 - *p]).collect(),
        labelled_shares: vec![1.0; 3],
    }
}

fn instance_backward(
    splats: &[Option<Splat2d<f64>>],
    order: &[u32],
    target: InstanceTarget<'_, f64>,
    geometry: GeometryPath,
) -> (f64, RasterGradients<f64>) {
    let (width, height) = (target.labels.width, target.labels.height);
    let pixels = rasterize(splats, order, width, height, Some(&target));
    let loss = instance_loss(&pixels, &target);
    let v_color = PixelGrid::filled(width, height, [0.0; 3]);
    let cotangents = PixelCotangents { color: &v_color, depth: None, alpha: None };
    let pixel_weight = 1.0 / loss.labelled_pixels.max(1) as f64;
    let instances = InstanceCotangent { target, pixel_weight, geometry };
    let gradients = rasterize_backward(splats, order, [0.0; 3], &pixels, &cotangents, Some(&instances));
    (loss.mean, gradients)
}

fn assert_close(what: &str, actual: f64, expected: f64) {
    assert!((actual - expected).abs() < 1e-9, "{what}: {actual} instead of {expected}");
}

#[test]
fn golden_pixel() {
    let occupancies = [0.5, 0.4, 0.8];
    let splats: Vec<_> = [0.0, 0.5, 1.0]
        .into_iter()
        .zip(occupancies)
        .zip([1.0, 2.0, 3.0])
        .map(|((s, o), z)| splat_at(s, o, z))
        .collect();
    let (identities, labels) = (identities([0.9, 0.2, 0.6]), PixelGrid::filled(1, 1, 1));
    let expected = [
        (InstanceNormalisation::None, 0.614092413, [0.663180773, 0.005249610, 0.123575386]),
        (InstanceNormalisation::Coverage, 0.303151379, [0.298472026, -0.111576700, -0.028522702]),
    ];
    for (normalisation, loss, q) in expected {
        let target = InstanceTarget { labels: &labels, identities: &identities, normalisation };
        let state = &rasterize(&splats, &[0, 1, 2], 1, 1, Some(&target)).pixels[0];
        assert_close("M_y", state.label_probability, 0.541131797);
        assert_close("S_end", state.instance_transmittance, 0.267242917);
        assert_close("loss", pixel_loss(state, normalisation), loss);
        let (_, gradients) = instance_backward(&splats, &[0, 1, 2], target, GeometryPath::Full);
        for i in 0..3 {
            assert_close("q", -gradients.splats[i].log_occupancy, q[i]);
            assert_close("r", gradients.label_mass[2 * i], [0.831590386, 0.044834228, 0.123575386][i]);
        }
        if normalisation == InstanceNormalisation::None {
            // Row 7 of methods reference 7: nothing follows the last contributor, so that q = r exactly.
            assert_eq!(-gradients.splats[2].log_occupancy, gradients.label_mass[4]);
            let v_logit = [0, 1, 2].map(|i| (1.0 - occupancies[i]) * gradients.splats[i].log_occupancy);
            for (actual, expected) in v_logit.into_iter().zip([-0.331590386, -0.003149766, -0.024715077]) {
                assert_close("dl/dh", actual, expected);
            }
        }
    }
}

#[test]
fn k_free_equals_dense() {
    for normalisation in [InstanceNormalisation::None, InstanceNormalisation::Coverage] {
        for geometry in [GeometryPath::Full, GeometryPath::MeansOnly, GeometryPath::Off] {
            for (seed, instances) in [2, 3, 5, 8, 13, 21, 40].into_iter().enumerate() {
                let config = SyntheticConfig {
                    seed: 100 + seed as u64,
                    gaussians: 20,
                    instances,
                    width: 21,
                    height: 19,
                    ..SyntheticConfig::default()
                };
                let settings = InstanceSettings { normalisation, geometry, ..InstanceSettings::default() };
                compare_with_dense(&config, settings);
            }
        }
    }
}

fn compare_with_dense(config: &SyntheticConfig, instances: InstanceSettings) {
    let synthetic = generate(config);
    let scene = Scene::<f64>::from_field(&synthetic.field);
    let settings = RenderSettings { instances: Some(instances), ..RenderSettings::default() };
    let forward = crate::support::render(&scene, &synthetic, &settings);
    let identities = forward.identities.as_ref().expect("the scene has identities");
    let (splats, order, labels) = (&forward.splats, &forward.order, &synthetic.labels);
    let target = InstanceTarget { labels, identities, normalisation: instances.normalisation };
    let (loss, sparse) = instance_backward(splats, order, target, instances.geometry);

    let k = config.instances;
    let maps = rasterize_dense(splats, order, config.width, config.height, identities, k);
    let mut targets = vec![0.0; labels.pixels.len() * k];
    for (pixel, label) in labels.pixels.iter().enumerate() {
        if *label != 0 {
            targets[pixel * k + usize::from(*label) - 1] = 1.0;
        }
    }
    let (dense_loss, v_maps) = dense_cross_entropy(&maps, &targets, instances.normalisation);
    let dense = rasterize_dense_backward(splats, order, &maps, identities, &v_maps, instances.geometry);

    let mut mismatches = Mismatches::default();
    let mut compare = |what: &str, index: usize, expected: f64, actual: f64| {
        mismatches.compare(what, index, expected, actual, 1e-9, 1e-12);
    };
    compare("loss", 0, dense_loss, loss);
    for (i, (d, s)) in dense.splats.iter().zip(&sparse.splats).enumerate() {
        compare("log occupancy", i, d.log_occupancy, s.log_occupancy);
        for axis in 0..2 {
            compare("mean2d", i, d.mean2d[axis], s.mean2d[axis]);
        }
        for entry in 0..3 {
            compare("moments", i, d.moments[entry], s.moments[entry]);
        }
    }
    let from_dense = identities.softmax_backward(&dense.probabilities);
    let from_sparse = identities.calibration_backward(&sparse.label_mass);
    for (entry, (d, s)) in from_dense.iter().zip(&from_sparse).enumerate() {
        compare("log calibration", entry, *d, *s);
    }
    mismatches.finish(&format!("K = {k}, {instances:?}"));
}

#[test]
fn soft_labels_match_differences() {
    // One-hot targets never exercise several channels of a pixel at once.
    let config = SyntheticConfig { gaussians: 5, instances: 4, width: 9, height: 7, ..Default::default() };
    let synthetic = generate(&config);
    let scene = Scene::<f64>::from_field(&synthetic.field);
    let settings =
        RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() };
    let targets: Vec<f64> = (0..9 * 7 * 4).map(|i| f64::from((i * 37) % 11) / 20.0).collect();
    for normalisation in [InstanceNormalisation::None, InstanceNormalisation::Coverage] {
        let value = |scene: &Scene<f64>| {
            let forward = crate::support::render(scene, &synthetic, &settings);
            let identities = forward.identities.clone().unwrap();
            let maps = rasterize_dense(&forward.splats, &forward.order, 9, 7, &identities, 4);
            let (loss, v_maps) = dense_cross_entropy(&maps, &targets, normalisation);
            (loss, v_maps, maps, identities, forward)
        };
        let (_, v_maps, maps, identities, forward) = value(&scene);
        let gradients = rasterize_dense_backward(
            &forward.splats,
            &forward.order,
            &maps,
            &identities,
            &v_maps,
            GeometryPath::Full,
        );
        let v_mu = identities.softmax_backward(&gradients.probabilities);
        let mut mismatches = Mismatches::default();
        for entry in 0..v_mu.len() {
            let at = |offset: f64| {
                let mut scene = scene.clone();
                scene.parameters.log_calibrations[entry] += offset;
                value(&scene).0
            };
            let numerical = (at(1e-5) - at(-1e-5)) / 2e-5;
            mismatches.compare("log calibration", entry, numerical, v_mu[entry], 1e-6, 1e-9);
        }
        for gaussian in 0..5 {
            let at = |offset: f64| {
                let mut scene = scene.clone();
                scene.parameters.gaussians[gaussian].occupancy_logit += offset;
                value(&scene).0
            };
            let numerical = (at(1e-6) - at(-1e-6)) / 2e-6;
            let analytic = forward.splats[gaussian]
                .as_ref()
                .map_or(0.0, |splat| (1.0 - splat.occupancy) * gradients.splats[gaussian].log_occupancy);
            mismatches.compare("occupancy logit", gaussian, numerical, analytic, 1e-6, 1e-8);
        }
        mismatches.finish("soft labels");
    }
}

#[test]
fn responsibilities_add_up_to_the_supported_pixels() {
    for seed in 0..5 {
        let config = SyntheticConfig {
            seed,
            gaussians: 15,
            instances: 4,
            width: 30,
            height: 22,
            ..Default::default()
        };
        let synthetic = generate(&config);
        let scene = Scene::<f64>::from_field(&synthetic.field);
        let settings =
            RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() };
        let forward = crate::support::render(&scene, &synthetic, &settings);
        let mut cotangents = Cotangents::random(seed, 30, 22);
        cotangents.instance_weight = forward.loss.labelled_pixels as f64;
        let gradients = cotangents.backward(&scene, &forward);
        let supported = (forward.loss.labelled_pixels - forward.loss.unsupported_pixels) as f64;
        let mass: f64 = gradients.raster.label_mass.iter().sum();
        assert!(supported > 0.0 && (mass - supported).abs() < 1e-4 * supported, "{mass} {supported}");
        let identities = forward.identities.unwrap();
        for row in 0..15 {
            let sum: f64 =
                identities.range(row).map(|entry| gradients.parameters.log_calibrations[entry]).sum();
            let mass: f64 = identities.range(row).map(|entry| gradients.raster.label_mass[entry]).sum();
            assert!(sum.abs() < 1e-12 * (1.0 + mass), "row {row} sums to {sum}");
        }
    }
}

#[test]
fn a_single_label_needs_no_calibration() {
    // Rows of one entry have probability exactly 1 and no gradient (methods reference 7, row 4).
    let config = SyntheticConfig { instances: 1, ..SyntheticConfig::default() };
    let synthetic = generate(&config);
    let scene = Scene::<f32>::from_field(&synthetic.field);
    let settings =
        RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() };
    let forward = crate::support::render(&scene, &synthetic, &settings);
    assert!(forward.identities.as_ref().unwrap().values.iter().all(|p| *p == 1.0));
    let gradients = Cotangents::random(1, config.width, config.height).backward(&scene, &forward);
    assert!(gradients.parameters.log_calibrations.iter().all(|v| *v == 0.0));
}

#[test]
fn tiny_label_probabilities_keep_their_gradient() {
    // Row 5: with every p^y scaled by 1e-6 the responsibilities are the same ratios.
    let splats: Vec<_> = [(0.0, 0.5), (0.5, 0.4), (1.0, 0.8)]
        .into_iter()
        .enumerate()
        .map(|(z, (sigma, occupancy))| splat_at(sigma, occupancy, z as f64))
        .collect();
    let labels = PixelGrid::filled(1, 1, 1);
    let q = |scale: f64| {
        let mut identities = identities([0.9, 0.2, 0.6]);
        for value in identities.values.iter_mut().step_by(2) {
            *value *= scale;
        }
        let target = InstanceTarget {
            labels: &labels,
            identities: &identities,
            normalisation: InstanceNormalisation::None,
        };
        instance_backward(&splats, &[0, 1, 2], target, GeometryPath::Full).1
    };
    for (a, b) in q(1.0).splats.iter().zip(q(1e-6).splats) {
        assert!((a.log_occupancy - b.log_occupancy).abs() < 1e-12);
    }
    // Below the floor the pixel is unsupported: it has a loss and no gradient.
    assert!(q(1e-9).splats.iter().all(|v| v.log_occupancy == 0.0 && v.mean2d == [0.0; 2]));
}

#[test]
fn the_image_of_the_golden_pixel() {
    let splats: Vec<_> = [(0.0, 0.5), (0.5, 0.4), (1.0, 0.8)]
        .into_iter()
        .enumerate()
        .map(|(z, (sigma, occupancy))| splat_at(sigma, occupancy, z as f64))
        .collect();
    let maps = rasterize_dense(&splats, &[0, 1, 2], 1, 1, &identities([0.9, 0.2, 0.6]), 2);
    let image = instance_image(&maps);
    assert_eq!(image.label.pixels, [1]);
    assert!((f64::from(image.probability.pixels[0]) - 0.541131797).abs() < 1e-7);
    assert!((f64::from(image.coverage.pixels[0]) - 0.732757083).abs() < 1e-7);
    let share: f64 = 0.541131797 / 0.732757083;
    let entropy = -share * share.ln() - (1.0 - share) * (1.0 - share).ln();
    assert!((f64::from(image.entropy.pixels[0]) - entropy).abs() < 1e-7);
    // Equal shares: the lowest index wins. Nothing there: unlabelled.
    let tie = instance_image(&rasterize_dense(&splats[..1], &[0], 1, 1, &identities([0.5, 0.2, 0.6]), 2));
    assert_eq!(tie.label.pixels, [1]);
    let empty = instance_image(&rasterize_dense(&splats[..1], &[], 1, 1, &identities([0.5, 0.2, 0.6]), 2));
    assert_eq!((empty.label.pixels[0], empty.coverage.pixels[0], empty.entropy.pixels[0]), (0, 0.0, 0.0));
}

#[test]
fn label_mass_of_a_view() {
    let config = SyntheticConfig { gaussians: 10, instances: 3, ..SyntheticConfig::default() };
    let synthetic = generate(&config);
    let scene = Scene::<f64>::from_field(&synthetic.field);
    let settings = RenderSettings::default();
    let count = |labels: &PixelGrid<u16>, scene: &Scene<f64>| {
        let n = scene.parameters.gaussians.len();
        let mut counts = IdentityCounts::zeros(n, 3);
        count_identities(scene, &synthetic.camera, 0.0, &settings, labels, &mut counts);
        counts
    };
    let counts = count(&synthetic.labels, &scene);
    // Weights are shares of a pixel: each covered pixel hands out exactly 1.
    let forward = reference::forward(&scene, &synthetic.camera, 0.0, &settings, None);
    let covered = forward.alpha.pixels.iter().filter(|alpha| **alpha >= 1e-3).count() as f64;
    let total_mass = |counts: &IdentityCounts| (0..10).map(|i| counts.total_mass(i)).sum::<f64>();
    let label_mass =
        |counts: &IdentityCounts| (0..10).flat_map(|i| counts.row(i)).map(|(_, mass)| mass).sum::<f64>();
    assert!((total_mass(&counts) - covered).abs() < 1e-9 * covered);
    let labelled = forward
        .alpha
        .pixels
        .iter()
        .zip(&synthetic.labels.pixels)
        .filter(|(alpha, label)| **alpha >= 1e-3 && **label != 0)
        .count() as f64;
    assert!((label_mass(&counts) - labelled).abs() < 1e-9 * labelled);
    // With one label everywhere, n_i = d_i.
    let counts = count(&PixelGrid::filled(config.width, config.height, 2), &scene);
    for i in 0..10 {
        assert_eq!(counts.label_mass(i, 1), counts.total_mass(i));
        assert!(counts.row(i).iter().all(|(label, _)| *label == 1));
    }
    // Labels that the table does not know are not counted anywhere, and do not panic.
    let counts = count(&PixelGrid::filled(config.width, config.height, 9), &scene);
    assert!(label_mass(&counts) == 0.0 && total_mass(&counts) > 0.0);
}
