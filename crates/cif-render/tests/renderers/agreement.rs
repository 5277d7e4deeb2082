//! Pictures, counts and single properties of renderers, against the reference in double precision on the same fields;
//! `views.rs` has whole training views.

use cif_field::Field;
use cif_field::parameters::{MEANS, OCCUPANCY_LOGITS, SH_COEFFICIENTS, TABLE};
use cif_geometry::PixelGrid;
use cif_render::cpu::{IdentityCounts, Renderer, SimdLevel};
use cif_render::reference::dense::rasterize_dense;
use cif_render::reference::{self, Scene};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use cif_render::{BlendRequest, Blending, Channels, Gradients, RenderSettings, RenderedImage};

use crate::renderers::{Path, RenderView, fast_gradient, forward_and_backward, on_processor, on_reference};
use crate::support::{Cotangents, Mismatches, Worst, pixel_discontinuity, render};
use crate::views::{BAND, CHANNELS, Expected, ONE_DECISION, Tolerances, config, settings};

/// Every level of vector instructions that this processor has.
fn levels() -> Vec<SimdLevel> {
    SimdLevel::available()
}

#[test]
fn rows_that_stand_still_are_not_deformed() {
    let config = SyntheticConfig { heads: Some(ALL_HEADS), ..config() };
    // More rows than a task takes, and a list that ends before they do.
    let mut field = generate(&SyntheticConfig { gaussians: 2_500, ..config }).field;
    let still: Vec<bool> = (0..2_400).map(|row| row % 5 != 1 && row / 300 != 3).collect();
    let moved = field.deformed(0.3);
    field.deformation.as_mut().unwrap().still.clone_from(&still);
    for simd in levels() {
        let posed = Renderer::new(simd).deform(&field, 0.3);
        for row in 0..field.len() {
            if still.get(row) == Some(&true) {
                assert_eq!(posed.means[row], field.gaussians.means[row], "row {row}");
                assert_eq!(posed.log_scales[row], field.gaussians.log_scales[row], "row {row}");
                assert_eq!(posed.sh_coefficients[row], field.gaussians.sh_coefficients[row], "row {row}");
                continue;
            }
            for axis in 0..3 {
                let (a, e) = (posed.means[row][axis], moved.means[row][axis]);
                assert!((a - e).abs() < 1e-4, "row {row}: {a} {e}");
            }
            assert_ne!(posed.means[row], field.gaussians.means[row], "row {row} moves");
        }
    }
}

#[test]
fn what_does_not_run_costs_nothing() {
    let mut scene = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..config() });
    let n = scene.field.len();
    // A quarter of the Gaussians moves, another lies behind the camera; labels are in one corner.
    let behind = scene.camera.camera_from_world.inverse().apply(glam::DVec3::new(0.0, 0.0, -3.0));
    for row in (1..n).step_by(4) {
        scene.field.gaussians.means[row] = behind.as_vec3().to_array();
    }
    let deformation = scene.field.deformation.as_mut().unwrap();
    deformation.still = (0..n).map(|row| row % 4 != 0).collect();
    let width = scene.labels.width as usize;
    for (position, label) in scene.labels.pixels.iter_mut().enumerate() {
        *label = u16::from(position % width < 16 && position / width < 16);
    }
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let mut run = |scene: &SyntheticScene, settings: &RenderSettings| {
        let mut gradients = Gradients::zeros(&scene.field);
        let labels = Some(&scene.labels);
        let forward = renderer.forward(&scene.field, &scene.camera, scene.time, settings, labels);
        renderer.backward(&scene.field, &forward.color, 1.0, &mut gradients);
        renderer.statistics()
    };
    let seen = run(&scene, &settings());
    assert_eq!(seen.deformed, n.div_ceil(4));
    assert!(seen.deformed_backward > 0 && seen.deformed_backward <= seen.deformed);
    assert!(seen.visible > 0 && seen.visible <= n - n / 4, "{seen:?}");
    assert_eq!((seen.labelled_tiles, seen.identity_rows), (1, seen.visible));
    assert!(seen.instance_pairs > 0 && seen.instance_pairs < seen.evaluated_pairs / 4, "{seen:?}");

    let colour = run(&scene, &RenderSettings { instances: None, ..settings() });
    assert_eq!((colour.labelled_tiles, colour.identity_rows, colour.instance_pairs), (0, 0, 0));
    scene.labels.pixels.fill(0);
    let unlabelled = run(&scene, &settings());
    assert_eq!((unlabelled.labelled_tiles, unlabelled.instance_pairs), (0, 0));
    scene.field.deformation.as_mut().unwrap().still.fill(true);
    let still = run(&scene, &settings());
    assert_eq!((still.deformed, still.deformed_backward), (0, 0));
    scene.field.deformation = None;
    assert_eq!(run(&scene, &settings()).deformed, 0);
}

#[test]
fn coverage_and_its_gradients() {
    let settings = RenderSettings { instances: None, ..settings() };
    let mut expected = Expected::of("coverage", &config(), &settings, |_| {});
    let mut cotangents = Cotangents::random(4, config().width, config().height);
    (cotangents.color, cotangents.depth) = (expected.cotangents.color.clone(), None);
    cotangents.instance_weight = 0.0;
    let alpha = cotangents.alpha.as_mut().unwrap();
    for (v, near) in alpha.pixels.iter_mut().zip(&expected.band) {
        *v *= f64::from(u8::from(!near));
    }
    let scene = Scene::<f64>::from_field(&expected.synthetic.field);
    expected.gradients = cotangents.backward(&scene, &expected.forward);
    let [reference, processor] = [on_reference as RenderView, on_processor]
        .map(|view| view(&expected.synthetic, &settings, &cotangents));
    for actual in reference.into_iter().chain(processor) {
        let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
        expected.compare(&actual, Tolerances::of(actual.path), &mut mismatches, &mut worst);
        mismatches.finish(&format!("coverage, {:?}", actual.path));
    }
    for simd in levels() {
        let mut renderer = Renderer::new(simd);
        let SyntheticScene { field, camera, time, .. } = &expected.synthetic;
        renderer.forward(field, camera, *time, &settings, None);
        let mut mismatches = Mismatches::default();
        for (position, alpha) in renderer.alpha().pixels.into_iter().enumerate() {
            let e = expected.forward.alpha.pixels[position];
            let tolerance =
                if expected.band[position] { ONE_DECISION } else { Tolerances::of(Path::Fast(simd)).color };
            mismatches.compare("coverage", position, e, f64::from(alpha), 0.0, tolerance);
        }
        mismatches.finish("coverage");
    }
}

#[test]
fn images_of_one_pixel() {
    // One pixel can only fail through its colour: gradients of 20 Gaussians stay mostly 0.
    let config = SyntheticConfig { width: 1, height: 1, gaussians: 20, screen_size: (0.1, 0.5), ..config() };
    let synthetic = generate(&config);
    let camera = &synthetic.camera;
    let expected = reference::render::<f64>(&synthetic.field, camera, 0.0, &settings(), CHANNELS);
    for (path, actual) in images_of(&synthetic, 0.0, &settings()) {
        for channel in 0..3 {
            let (a, e) = (actual.color.pixels[0][channel], expected.color.pixels[0][channel]);
            assert!((a - e).abs() < 2e-5, "{path:?}: {a} {e}");
        }
    }
}

#[test]
fn clamped_log_scales_have_no_gradient() {
    let mut scene = generate(&config());
    scene.field.gaussians.log_scales[0] = [12.0, -25.0, -2.0];
    scene.field.gaussians.log_scales[1] = [60.0, f32::MAX, -3.0];
    let cotangents = Cotangents::random(3, scene.camera.width, scene.camera.height);
    for simd in levels() {
        let mut gradients = Gradients::zeros(&scene.field);
        forward_and_backward(simd, &scene, &settings(), &cotangents, &mut gradients);
        let v = &gradients.gaussians.log_scales;
        assert!(gradients.radii[0] > 0.0 && gradients.radii[1] > 0.0, "both are drawn");
        assert_eq!([v[0][0], v[0][1], v[1][0], v[1][1]], [0.0; 4]);
        assert!(v.as_flattened().iter().all(|v| v.is_finite()));
    }
}

#[test]
fn poison_never_spreads() {
    let poisons = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::MAX,
        f32::MIN,
        1e-40,
        0.0,
        1e20,
        -1e20,
        100.0,
        -100.0,
    ];
    let config = SyntheticConfig { gaussians: 6, width: 20, height: 18, ..config() };
    for poison in poisons {
        for group in 0..7 {
            let mut scene = generate(&config);
            let gaussians = &mut scene.field.gaussians;
            match group {
                0 => gaussians.means[0][0] = poison,
                1 => gaussians.means[0][2] = poison,
                2 => gaussians.log_scales[0][1] = poison,
                3 => gaussians.quaternions[0][3] = poison,
                4 => gaussians.opacity_logits[0] = poison,
                5 => gaussians.occupancy_logits[0] = poison,
                // A colour of 1e20 is drawn as asked; its gradient by the direction may overflow.
                _ if poison.abs() > 1e19 && poison.is_finite() => continue,
                _ => gaussians.sh_coefficients[0][7] = poison,
            }
            let cotangents = Cotangents::random(3, 20, 18);
            let mut gradients = Gradients::zeros(&scene.field);
            let forward =
                forward_and_backward(SimdLevel::Auto, &scene, &settings(), &cotangents, &mut gradients);
            let name = format!("group {group}, {poison}");
            assert!(forward.color.pixels.as_flattened().iter().all(|c| c.is_finite()), "{name}: colour");
            assert!(forward.instance_loss.is_finite(), "{name}: loss");
            for parameter in TABLE {
                let double = Scene::<f64>::from_field(&scene.field);
                for index in 0..double.parameters.len(parameter) {
                    assert!(
                        fast_gradient(&gradients, parameter, index).is_finite(),
                        "{name}: {} {index}",
                        parameter.name
                    );
                }
            }
            assert!(gradients.screen.as_flattened().iter().chain(&gradients.radii).all(|v| v.is_finite()));
        }
    }
}

/// A view with all its channels through every renderer but the reference.
fn images_of(scene: &SyntheticScene, time: f64, settings: &RenderSettings) -> Vec<(Path, RenderedImage)> {
    let (field, camera) = (&scene.field, &scene.camera);
    let of_level =
        |simd| (Path::Fast(simd), Renderer::new(simd).render(field, camera, time, settings, CHANNELS));
    let of_gpu: Option<(Path, RenderedImage)> = None;
    #[cfg(feature = "wgpu")]
    let of_gpu = of_gpu.or_else(|| {
        let device = crate::on_gpu::device()?;
        let mut renderer = cif_render::wgpu::GpuRenderer::new(&device.0, field).unwrap();
        Some((Path::Gpu, renderer.render(field, camera, time, settings, CHANNELS).unwrap()))
    });
    levels().into_iter().map(of_level).chain(of_gpu).collect()
}

#[test]
fn images() {
    for heads in [None, Some(ALL_HEADS)] {
        for instances in [1, 6, 37] {
            let synthetic = generate(&SyntheticConfig { instances, heads, ..config() });
            let (settings, scene) = (settings(), Scene::<f64>::from_field(&synthetic.field));
            let (camera, time) = (&synthetic.camera, synthetic.time);
            let forward = reference::forward(&scene, camera, time, &settings, None);
            let expected = reference::render::<f64>(&synthetic.field, camera, time, &settings, CHANNELS);
            let identities = forward.identities.as_ref().unwrap();
            let (width, height) = (camera.width, camera.height);
            let maps = rasterize_dense(&forward.splats, &forward.order, width, height, identities, instances);
            for (path, actual) in images_of(&synthetic, time, &settings) {
                let name = format!("images, K = {instances}, {heads:?}, {path:?}");
                // Of values in [0, 1], and of what is made of several of them.
                let (one, several, foreground) =
                    if path == Path::Gpu { (3e-5, 2e-4, 1e-4) } else { (2e-5, 1e-4, 1e-4) };
                let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
                let (a, e) = (actual.instances.as_ref().unwrap(), expected.instances.as_ref().unwrap());
                let depths = (actual.depth.as_ref().unwrap(), expected.depth.as_ref().unwrap());
                for position in 0..actual.color.pixels.len() {
                    let near = pixel_discontinuity(&forward, position, BAND).is_some();
                    let mut compare = |what: &str, e: f32, a: f32, tolerance: f64| {
                        mismatches.compare(what, position, e.into(), a.into(), 0.0, tolerance);
                        if !near {
                            worst.see(what, f64::from((e - a).abs()));
                        }
                    };
                    let tolerance = if near { ONE_DECISION } else { one };
                    for channel in 0..3 {
                        let (e, a) = (&expected.color.pixels[position], &actual.color.pixels[position]);
                        compare("colour", e[channel], a[channel], tolerance);
                    }
                    let at = |grid: &PixelGrid<f32>| grid.pixels[position];
                    compare("alpha", at(&expected.alpha), at(&actual.alpha), tolerance);
                    if near {
                        continue;
                    }
                    compare("depth", at(depths.1), at(depths.0), several);
                    compare("probability", at(&e.probability), at(&a.probability), one);
                    compare("coverage", at(&e.coverage), at(&a.coverage), one);
                    compare("foreground", at(&e.foreground), at(&a.foreground), foreground);
                    compare("entropy", at(&e.entropy), at(&a.entropy), several);
                    let mut row = maps.values[position * instances..(position + 1) * instances].to_vec();
                    row.sort_by(|a, b| b.total_cmp(a));
                    if row.len() < 2 || row[0] - row[1] > one / 2.0 {
                        let (e, a) = (e.label.pixels[position], a.label.pixels[position]);
                        compare("label", e.into(), a.into(), 0.0);
                    }
                }
                worst.report(&name);
                mismatches.finish(&name);
            }
        }
    }
}

#[test]
fn blended_values_and_ranks() {
    const RANKS: usize = 4;
    for instances in [1, 6, 37] {
        let synthetic = generate(&SyntheticConfig { instances, heads: Some(ALL_HEADS), ..config() });
        let (settings, scene) = (settings(), Scene::<f64>::from_field(&synthetic.field));
        let (camera, time) = (&synthetic.camera, synthetic.time);
        let forward = reference::forward(&scene, camera, time, &settings, None);
        let values: Vec<[f32; 2]> =
            (0..synthetic.field.gaussians.len()).map(|row| [row as f32 * 0.7 - 3.0, 1.0]).collect();
        let doubles: Vec<f64> = values.as_flattened().iter().map(|value| f64::from(*value)).collect();
        let both = [Blending::Color, Blending::Own];
        let expected = both.map(|blending| {
            let (width, height) = (camera.width, camera.height);
            let request = BlendRequest { values: &doubles[..], channels: 2, blending };
            reference::blend::blend(&forward.splats, &forward.order, width, height, &request)
        });
        let maps = rasterize_dense(
            &forward.splats,
            &forward.order,
            camera.width,
            camera.height,
            forward.identities.as_ref().unwrap(),
            instances,
        );
        let expected_ranks = reference::dense::instance_ranks(&maps, RANKS);
        for simd in levels() {
            let mut renderer = Renderer::new(simd);
            let image = renderer.render(&synthetic.field, camera, time, &settings, CHANNELS);
            let [blended, by_instances] = both.map(|blending| {
                renderer.blend(&BlendRequest { values: values.as_flattened(), channels: 2, blending })
            });
            let ranks = renderer.instance_ranks(synthetic.field.identities.as_ref().unwrap(), RANKS);
            let mut mismatches = Mismatches::default();
            let mut covered = 0;
            for position in 0..forward.pixels.pixels.len() {
                if pixel_discontinuity(&forward, position, BAND).is_some() {
                    continue;
                }
                let of = |image: &[f32]| [image[2 * position], image[2 * position + 1]];
                let (e, a) = (&expected[1].values[2 * position..], of(&by_instances.values));
                mismatches.compare("instance value", position, e[0], a[0].into(), 1e-5, 1e-4);
                let layers = image.instances.as_ref().unwrap();
                let coverage = f64::from(layers.coverage.pixels[position]);
                mismatches.compare("instance one", position, coverage, a[1].into(), 0.0, 2e-5);
                let (e, a) = (&expected[0].values[2 * position..], of(&blended.values));
                mismatches.compare("value", position, e[0], a[0].into(), 1e-5, 1e-4);
                // The blended 1 is alpha itself.
                let alpha = f64::from(image.alpha.pixels[position]);
                mismatches.compare("one", position, alpha, a[1].into(), 0.0, 2e-6);
                covered += usize::from(a[1] > 0.5);
                let mut row = maps.values[position * instances..(position + 1) * instances].to_vec();
                row.sort_by(|a, b| b.total_cmp(a));
                for rank in 0..RANKS {
                    let ((labels, masses), (e_labels, e_masses)) =
                        (&ranks.ranks[rank], &expected_ranks.ranks[rank]);
                    let (e, a) = (e_masses.pixels[position], masses.pixels[position]);
                    mismatches.compare("mass", position, e.into(), a.into(), 0.0, 2e-5);
                    let value = |index: usize| row.get(index).copied().unwrap_or(0.0);
                    let apart = value(rank) - value(rank + 1) > 1e-5
                        && (rank == 0 || value(rank - 1) - value(rank) > 1e-5);
                    if apart {
                        let (e, a) = (e_labels.pixels[position], labels.pixels[position]);
                        mismatches.compare("label", position, e.into(), a.into(), 0.0, 0.0);
                    }
                }
                let instances = image.instances.as_ref().unwrap();
                let first = (instances.label.pixels[position], instances.probability.pixels[position]);
                assert_eq!(first, (ranks.ranks[0].0.pixels[position], ranks.ranks[0].1.pixels[position]));
            }
            assert!(covered > 20, "{covered} pixels are covered");
            mismatches.finish(&format!("blended values and ranks, K = {instances}, {simd:?}"));
        }
    }
}

#[test]
fn only_the_asked_channels_come_back() {
    let synthetic = generate(&config());
    let image = Renderer::new(SimdLevel::Auto).render(
        &synthetic.field,
        &synthetic.camera,
        0.0,
        &settings(),
        Channels::default(),
    );
    assert!(image.depth.is_none() && image.instances.is_none());
}

#[test]
fn label_mass() {
    for heads in [None, Some(ALL_HEADS)] {
        let config = SyntheticConfig { heads, ..config() };
        let synthetic = generate(&config);
        let scene = Scene::<f64>::from_field(&synthetic.field);
        let (camera, time, labels) = (&synthetic.camera, synthetic.time, &synthetic.labels);
        let settings = RenderSettings { instances: None, ..settings() };
        let mut expected = IdentityCounts::zeros(config.gaussians, config.instances);
        reference::count_identities(&scene, camera, time, &settings, labels, &mut expected);
        for simd in levels() {
            let mut actual = IdentityCounts::zeros(config.gaussians, config.instances);
            let mut renderer = Renderer::new(simd);
            // Twice: masses add.
            for _ in 0..2 {
                renderer.count_identities(&synthetic.field, camera, time, &settings, labels, &mut actual);
            }
            let mut mismatches = Mismatches::default();
            // A few decisions at 1/255 of a pixel each may differ in this many pixels.
            let tolerance = 6.0 / 255.0;
            for index in 0..config.gaussians {
                for label in 0..config.instances as u16 {
                    let (e, a) = (expected.label_mass(index, label), actual.label_mass(index, label));
                    mismatches.compare("label mass", index, e, a / 2.0, 1e-3, tolerance);
                }
                let (e, a) = (expected.total_mass(index), actual.total_mass(index));
                mismatches.compare("total mass", index, e, a / 2.0, 1e-3, tolerance);
            }
            mismatches.finish("label mass");
        }
    }
}

/// As many instances as masks can name: nothing grows with N x K, which would be 8 GB here.
#[test]
fn label_mass_of_the_longest_table() {
    const INSTANCES: usize = 65_535;
    let config = SyntheticConfig { gaussians: 16_000, screen_size: (0.005, 0.02), ..config() };
    let mut synthetic = generate(&config);
    // Labels from the whole range: the last one, and 37 others.
    for (position, label) in synthetic.labels.pixels.iter_mut().enumerate() {
        *label = 65_535 - (position % 38 * 1700) as u16;
    }
    let (camera, labels) = (&synthetic.camera, &synthetic.labels);
    let settings = RenderSettings { instances: None, ..settings() };
    for simd in levels() {
        let mut renderer = Renderer::new(simd);
        let mut counts = IdentityCounts::zeros(config.gaussians, INSTANCES);
        renderer.count_identities(&synthetic.field, camera, 0.0, &settings, labels, &mut counts);
        let met: usize = (0..config.gaussians).map(|row| counts.row(row).len()).sum();
        assert!(met > 1000 && met < 38 * config.gaussians, "{met} entries, {simd:?}");
        assert!((0..config.gaussians).any(|row| counts.label_mass(row, 65_534) > 0.0));
        for row in 0..config.gaussians {
            // Every pixel is labelled, so that all mass is label mass.
            let labelled: f64 = counts.row(row).iter().map(|(_, mass)| mass).sum();
            assert!((labelled - counts.total_mass(row)).abs() <= 1e-5 * labelled + 1e-9, "row {row}");
            assert!(counts.row(row).windows(2).all(|pair| pair[0].0 < pair[1].0), "ascending labels");
        }
    }
}

#[test]
fn deformed_parameters() {
    let synthetic = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..config() });
    let scene = Scene::<f64>::from_field(&synthetic.field);
    for simd in levels() {
        for time in [0.0, 0.37, 1.0] {
            let moved = Renderer::new(simd).deform(&synthetic.field, time);
            let mut mismatches = Mismatches::default();
            for index in 0..moved.len() {
                let expected = reference::deform::deform(&scene, index, time, true).gaussian;
                let mut compare = |what: &str, e: &[f64], a: &[f32]| {
                    for (e, a) in e.iter().zip(a) {
                        mismatches.compare(what, index, *e, f64::from(*a), 1e-5, 1e-5);
                    }
                };
                compare("mean", &expected.mean, &moved.means[index]);
                compare("log-scale", &expected.log_scale, &moved.log_scales[index]);
                compare("quaternion", &expected.quaternion, &moved.quaternions[index]);
                compare("opacity", &[expected.opacity_logit], &[moved.opacity_logits[index]]);
                compare("occupancy", &[expected.occupancy_logit], &[moved.occupancy_logits[index]]);
                compare("harmonics", &expected.sh, &moved.sh_coefficients[index]);
            }
            mismatches.finish("deform");
        }
    }
}

#[test]
fn gradients_of_views_add_up() {
    let synthetic = generate(&config());
    let cotangents = Cotangents::random(3, synthetic.camera.width, synthetic.camera.height);
    let mut once = Gradients::zeros(&synthetic.field);
    forward_and_backward(SimdLevel::Auto, &synthetic, &settings(), &cotangents, &mut once);
    let mut twice = Gradients::zeros(&synthetic.field);
    for _ in 0..2 {
        forward_and_backward(SimdLevel::Auto, &synthetic, &settings(), &cotangents, &mut twice);
    }
    for parameter in [MEANS, SH_COEFFICIENTS, OCCUPANCY_LOGITS] {
        for index in 0..once.gaussians.len() {
            assert_eq!(
                2.0 * fast_gradient(&once, parameter, index),
                fast_gradient(&twice, parameter, index),
                "{} {index}",
                parameter.name
            );
        }
    }
    assert_eq!(once.radii, twice.radii, "radii take the maximum");
}

#[test]
fn empty_scenes() {
    for (gaussians, labelled) in [(0, true), (3, false)] {
        let mut synthetic = generate(&SyntheticConfig { gaussians, ..config() });
        if !labelled {
            synthetic.labels.pixels.fill(0);
        }
        // Everything behind the camera.
        let behind = synthetic.camera.centre() - synthetic.camera.forward();
        synthetic.field.gaussians.means.fill(behind.as_vec3().to_array());
        let cotangents = Cotangents::random(3, synthetic.camera.width, synthetic.camera.height);
        let mut gradients = Gradients::zeros(&synthetic.field);
        let forward =
            forward_and_backward(SimdLevel::Auto, &synthetic, &settings(), &cotangents, &mut gradients);
        assert!(forward.color.pixels.iter().all(|color| *color == settings().background));
        assert_eq!(forward.statistics.visible, 0);
        assert_eq!(forward.labelled_pixels, forward.unsupported_pixels);
        assert_eq!(labelled, forward.labelled_pixels > 0);
        let expected = if labelled { -f64::from(1e-8_f32).ln() } else { 0.0 };
        assert!((forward.instance_loss - expected).abs() < 1e-5);
        assert_eq!(gradients, Gradients::zeros(&synthetic.field));
    }
}

/// Every output of every entry point.
#[derive(Debug, PartialEq)]
struct Outputs {
    color: PixelGrid<[f32; 3]>,
    loss: f64,
    gradients: Gradients,
    image: cif_render::RenderedImage,
    counts: IdentityCounts,
    moved: cif_field::Gaussians,
}

fn run_on(threads: usize, simd: SimdLevel, scene: &SyntheticScene) -> Outputs {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started");
    pool.install(|| {
        let (field, camera, time): (&Field, _, _) = (&scene.field, &scene.camera, scene.time);
        let cotangents = Cotangents::random(3, camera.width, camera.height);
        let mut gradients = Gradients::zeros(field);
        let forward = forward_and_backward(simd, scene, &settings(), &cotangents, &mut gradients);
        let mut renderer = Renderer::new(simd);
        let mut counts = IdentityCounts::zeros(field.gaussians.len(), field.instances.len());
        renderer.count_identities(field, camera, time, &settings(), &scene.labels, &mut counts);
        Outputs {
            color: forward.color,
            loss: forward.instance_loss,
            gradients,
            image: renderer.render(field, camera, time, &settings(), CHANNELS),
            counts,
            moved: renderer.deform(field, time),
        }
    })
}

#[test]
fn threads_do_not_change_a_bit() {
    let config = SyntheticConfig { gaussians: 3000, heads: Some(ALL_HEADS), ..config() };
    let synthetic = generate(&config);
    for simd in levels() {
        let one = run_on(1, simd, &synthetic);
        for threads in [2, 3, 8] {
            assert!(run_on(threads, simd, &synthetic) == one, "{threads} threads differ from one, {simd:?}");
        }
        let mut other = synthetic.clone();
        other.field.gaussians.means[0][0] += 1e-3;
        assert!(run_on(1, simd, &other) != one, "the comparison must be able to fail");
    }
}

/// A Gaussian whose occupancy logit is not a number draws nothing.
#[test]
fn occupancy_that_is_not_a_number() {
    let mut scene = generate(&config());
    scene.field.gaussians.occupancy_logits[0] = f32::NAN;
    let v = gradients_of(&scene).gaussians.occupancy_logits[0];
    assert!(v.is_finite(), "the gradient {v} is not finite");
}

/// A Gaussian whose colour is not a number draws nothing.
#[test]
fn colour_that_is_not_a_number() {
    let mut scene = generate(&config());
    scene.field.gaussians.sh_coefficients[0][7] = f32::NAN;
    let v = gradients_of(&scene).gaussians.means[0][0];
    assert!(v.is_finite(), "the gradient {v} is not finite");
}

fn gradients_of(scene: &SyntheticScene) -> Gradients {
    let cotangents = Cotangents::random(3, scene.camera.width, scene.camera.height);
    let mut gradients = Gradients::zeros(&scene.field);
    forward_and_backward(SimdLevel::Auto, scene, &settings(), &cotangents, &mut gradients);
    gradients
}

/// Needles hundreds of pixels long: a determinant from the rounded covariance would cancel (`hard_cases.rs`, row 13).
#[test]
fn long_needles() {
    let mut scene = generate(&SyntheticConfig { gaussians: 50, ..config() });
    for log_scale in scene.field.gaussians.log_scales.iter_mut().step_by(5) {
        *log_scale = [log_scale[0] + 6.0, -9.0, -9.0];
    }
    let expected = render(&Scene::<f64>::from_field(&scene.field), &scene, &settings());
    let actual = Renderer::new(SimdLevel::Auto).forward(
        &scene.field,
        &scene.camera,
        scene.time,
        &settings(),
        Some(&scene.labels),
    );
    let mut differences: Vec<f64> = (0..actual.color.pixels.len())
        .map(|position| {
            (f64::from(actual.color.pixels[position][1]) - expected.color.pixels[position][1]).abs()
        })
        .collect();
    differences.sort_by(f64::total_cmp);
    let high = differences[differences.len() * 99 / 100];
    assert!(high < 1e-4, "one pixel in a hundred is {high} away from the reference");
}
