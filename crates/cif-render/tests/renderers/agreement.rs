//! Every renderer against the reference in double precision, on the same fields.
//!
//! Pixels where some weight or transmittance meets a threshold (1/255, 0.99, 1e-4) to within a relative 1e-3
//! form the boundary band: the two precisions may decide differently there. They take part in the comparison of
//! images with the tolerance that one decision can cost, and not in gradients (no cotangent, no label).

use cif_field::parameters::{MEANS, OCCUPANCY_LOGITS, SH_COEFFICIENTS, TABLE};
use cif_field::{Field, Heads, SortMetric};
use cif_geometry::PixelGrid;
use cif_render::cpu::{IdentityCounts, Renderer, SimdLevel};
use cif_render::reference::dense::rasterize_dense;
use cif_render::reference::rasterize::{footprint, weight};
use cif_render::reference::{self, Forward, Scene, SceneGradients};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use cif_render::{
    BlendRequest, Blending, Channels, GeometryPath, Gradients, InstanceNormalisation, InstanceSettings,
    OccupancySource, RenderSettings, RenderedImage,
};

use crate::renderers::{Path, Seen, everywhere, fast_gradient, forward_and_backward, on_processor};
use crate::support::{Cotangents, Mismatches, Worst, pixel_discontinuity, render};

/// Relative width of the boundary band: above the rounding of a weight in single precision.
pub(crate) const BAND: f64 = 1e-3;

/// Largest change of a pixel by one decision at a threshold: 1/255 of the largest colour here (about 3).
const ONE_DECISION: f64 = 0.013;

pub(crate) const CHANNELS: Channels = Channels { depth: true, instances: true };

/// Every level of vector instructions that this processor has.
fn levels() -> Vec<SimdLevel> {
    SimdLevel::available()
}

pub(crate) fn settings() -> RenderSettings {
    RenderSettings {
        background: [0.2, 0.5, 0.9],
        instances: Some(InstanceSettings::default()),
        ..RenderSettings::default()
    }
}

/// Many small Gaussians over several tiles, also partial ones.
pub(crate) fn config() -> SyntheticConfig {
    SyntheticConfig {
        seed: 11,
        gaussians: 250,
        instances: 6,
        width: 71,
        height: 53,
        screen_size: (0.01, 0.08),
        ..SyntheticConfig::default()
    }
}

/// Largest differences that are allowed.
#[derive(Clone, Copy)]
pub(crate) struct Tolerances {
    /// Of a colour channel outside the boundary band.
    pub(crate) color: f64,
    /// Of a gradient, relative.
    pub(crate) gradient: f64,
    /// Of a gradient, over the largest of its parameter.
    pub(crate) smallest_gradient: f64,
    /// Of a gradient by a projected centre, relative.
    pub(crate) screen: f64,
}

impl Tolerances {
    /// On the GPU those of the worst errors seen on lavapipe (Mesa 22.3.6, LLVM 15), with a margin of at least three:
    /// WGSL allows exp, log and division a few units in the last place.
    pub(crate) fn of(path: Path) -> Self {
        match path {
            Path::Single | Path::Fast(_) => {
                Self { color: 2e-5, gradient: 1e-3, smallest_gradient: 1e-5, screen: 1e-3 }
            }
            Path::Gpu => Self { color: 3e-5, gradient: 2e-3, smallest_gradient: 2e-5, screen: 2e-3 },
        }
    }
}

/// The view of the reference, with cotangents and labels away from the boundary band.
pub(crate) struct Expected {
    pub(crate) synthetic: SyntheticScene,
    pub(crate) band: Vec<bool>,
    pub(crate) cotangents: Cotangents,
    pub(crate) forward: Forward<f64>,
    pub(crate) gradients: SceneGradients<f64>,
}

impl Expected {
    pub(crate) fn of(
        name: &str,
        config: &SyntheticConfig,
        settings: &RenderSettings,
        edit: impl Fn(&mut SyntheticScene),
    ) -> Self {
        let mut synthetic = generate(config);
        edit(&mut synthetic);
        let double = Scene::<f64>::from_field(&synthetic.field);
        let unmasked = render(&double, &synthetic, settings);
        let band: Vec<bool> = (0..unmasked.pixels.pixels.len())
            .map(|position| pixel_discontinuity(&unmasked, position, BAND).is_some())
            .collect();
        let share = band.iter().filter(|near| **near).count() as f64 / band.len() as f64;
        assert!(share < 0.5, "{name}: {share} of the pixels lie in the boundary band");
        let mut cotangents = Cotangents::random(3, config.width, config.height);
        (cotangents.depth, cotangents.alpha) = (None, None);
        for (position, near) in band.iter().enumerate() {
            if *near {
                cotangents.color.pixels[position] = [0.0; 3];
                synthetic.labels.pixels[position] = 0;
            }
        }
        let forward = render(&double, &synthetic, settings);
        let gradients = cotangents.backward(&double, &forward);
        Self { synthetic, band, cotangents, forward, gradients }
    }

    /// Compares colour, loss and gradients of a training view.
    pub(crate) fn compare(
        &self,
        actual: &Seen,
        tolerances: Tolerances,
        mismatches: &mut Mismatches,
        worst: &mut Worst,
    ) {
        self.compare_pixels(actual, tolerances.color, mismatches, worst);
        if let Some((mean, labelled, unsupported)) = actual.loss {
            let loss = &self.forward.loss;
            mismatches.compare("loss", 0, loss.mean, mean, 1e-4, 1e-9);
            let counts = [(loss.labelled_pixels, labelled), (loss.unsupported_pixels, unsupported)];
            for (index, (e, a)) in counts.into_iter().enumerate() {
                mismatches.compare("pixel counts", index, e as f64, a as f64, 0.0, 0.0);
            }
        }
        self.compare_gradients(actual, tolerances, mismatches, worst);
        self.compare_screen(actual, tolerances, mismatches);
    }

    fn compare_pixels(&self, actual: &Seen, tolerance: f64, mismatches: &mut Mismatches, worst: &mut Worst) {
        for (position, color) in actual.colors.iter().enumerate() {
            let near = self.band[position];
            let mut compare = |what: &str, e: f64, a: f64, tolerance: f64| {
                mismatches.compare(what, position, e, a, 0.0, tolerance);
                if !near {
                    worst.see(what, (e - a).abs());
                }
            };
            for (e, a) in self.forward.color.pixels[position].iter().zip(color) {
                compare("colour", *e, *a, if near { ONE_DECISION } else { tolerance });
            }
            if let (Some(blended), false) = (&actual.blended, near) {
                let state = &self.forward.pixels.pixels[position];
                let [transmittance, depth, label, instance] = blended[position];
                compare("transmittance", state.transmittance, transmittance, tolerance);
                compare("depth", state.depth, depth, 10.0 * tolerance);
                compare("label probability", state.label_probability, label, tolerance);
                compare("instance transmittance", state.instance_transmittance, instance, tolerance);
            }
        }
    }

    fn compare_gradients(
        &self,
        actual: &Seen,
        tolerances: Tolerances,
        mismatches: &mut Mismatches,
        worst: &mut Worst,
    ) {
        let parameters = &self.gradients.parameters;
        for parameter in TABLE {
            let values: Vec<f64> =
                (0..parameters.len(parameter)).map(|index| parameters.get(parameter, index)).collect();
            // Sums of terms of both signs are as exact as their largest term, not as their result.
            let largest = values.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
            let absolute = tolerances.smallest_gradient * largest + 1e-9;
            for (index, e) in values.into_iter().enumerate() {
                let a = actual.gradient(parameter, index);
                mismatches.compare(parameter.name, index, e, a, tolerances.gradient, absolute);
                if largest > 0.0 {
                    worst.see(
                        &format!("gradient of {} over the largest", parameter.name),
                        (e - a).abs() / largest,
                    );
                }
            }
        }
    }

    fn compare_screen(&self, actual: &Seen, tolerances: Tolerances, mismatches: &mut Mismatches) {
        let screen = &self.gradients.screen;
        let largest = screen.as_flattened().iter().fold(0.0_f64, |largest, v| largest.max(v.abs()));
        let absolute = tolerances.smallest_gradient * largest;
        for (index, (e, a)) in screen.iter().zip(&actual.screen).enumerate() {
            for axis in 0..2 {
                mismatches.compare("screen", index, e[axis], a[axis], tolerances.screen, absolute);
            }
        }
        let pixels = &self.forward.pixels;
        for (index, splat) in self.forward.splats.iter().enumerate() {
            // A splat whose box meets the image without reaching any pixel may count as invisible.
            let Some(splat) = splat else { continue };
            let drawn = (0..pixels.pixels.len() as u32).any(|position| {
                let pixel = [position % pixels.width, position / pixels.width];
                weight(splat.opacity.max(splat.occupancy), footprint(splat, pixel).peak).is_some()
            });
            if drawn || actual.radii[index] > 0.0 {
                mismatches.compare("radius", index, splat.radius, actual.radii[index], 1e-4, 0.0);
            }
        }
    }
}

fn check(
    name: &str,
    config: &SyntheticConfig,
    settings: &RenderSettings,
    edit: impl Fn(&mut SyntheticScene),
) {
    check_within(Tolerances::of, name, config, settings, edit);
}

/// Colour, loss and gradients of a training view through every renderer.
fn check_within(
    tolerances: impl Fn(Path) -> Tolerances,
    name: &str,
    config: &SyntheticConfig,
    settings: &RenderSettings,
    edit: impl Fn(&mut SyntheticScene),
) {
    let expected = Expected::of(name, config, settings, edit);
    for actual in everywhere(&expected.synthetic, settings, &expected.cotangents) {
        let name = format!("{name}, {:?}", actual.path);
        let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
        expected.compare(&actual, tolerances(actual.path), &mut mismatches, &mut worst);
        worst.tell(&name);
        mismatches.finish(&name);
    }
}

#[test]
fn static_scene() {
    check("static", &config(), &settings(), |_| {});
}

#[test]
fn deformed_scene() {
    let config = SyntheticConfig { heads: Some(ALL_HEADS), ..config() };
    check("deformed", &config, &settings(), |_| {});
    check("not deformed", &config, &RenderSettings { deform: false, ..settings() }, |_| {});
    let heads = Heads { opacity: false, sh: false, ..ALL_HEADS };
    check("three heads", &SyntheticConfig { heads: Some(heads), ..config }, &settings(), |_| {});
}

#[test]
fn gaussians_that_stand_still() {
    let config = SyntheticConfig { heads: Some(ALL_HEADS), ..config() };
    for every in [1, 2, 7] {
        check(&format!("every {every}th stands still"), &config, &settings(), |scene| {
            let n = scene.field.len();
            let deformation = scene.field.deformation.as_mut().unwrap();
            deformation.still = (0..n).map(|row| row % every == 0).collect();
        });
    }
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
fn colour_only() {
    let settings = RenderSettings { instances: None, ..settings() };
    check("colour only", &SyntheticConfig { instances: 0, ..config() }, &settings, |_| {});
    check("colour only, identities unused", &config(), &settings, |_| {});
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
    for actual in on_processor(&expected.synthetic, &settings, &cotangents) {
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
fn every_image_setting() {
    check("antialiased", &config(), &RenderSettings { antialiased: true, ..settings() }, |_| {});
    check("another low pass", &config(), &RenderSettings { low_pass: 0.05, ..settings() }, |_| {});
    let by_distance = RenderSettings { sort_metric: SortMetric::Distance, ..settings() };
    check("distance", &config(), &by_distance, |_| {});
    for sh_degree in 0..3 {
        check("degree", &config(), &RenderSettings { sh_degree, ..settings() }, |_| {});
    }
}

#[test]
fn every_instance_setting() {
    for normalisation in [InstanceNormalisation::None, InstanceNormalisation::Coverage] {
        for geometry in [GeometryPath::Full, GeometryPath::MeansOnly, GeometryPath::Off] {
            for occupancy in [OccupancySource::Own, OccupancySource::Opacity] {
                let instances = InstanceSettings { occupancy, geometry, normalisation };
                let settings = RenderSettings { instances: Some(instances), ..settings() };
                check(&format!("{instances:?}"), &config(), &settings, |_| {});
            }
        }
    }
}

#[test]
fn few_and_many_instances() {
    for instances in [1, 2, 9, 40, 300] {
        let config = SyntheticConfig { instances, ..config() };
        check(&format!("K = {instances}"), &config, &settings(), |scene| {
            // Labels that change at every pixel: far more than 8 in a tile.
            for (position, label) in scene.labels.pixels.iter_mut().enumerate() {
                *label = (position * 7 % (instances + 1)) as u16;
            }
        });
    }
}

#[test]
fn large_saturated_gaussians_and_stops() {
    let config = SyntheticConfig { gaussians: 60, screen_size: (0.1, 0.5), ..config() };
    check("saturated", &config, &settings(), |scene| {
        scene.field.gaussians.opacity_logits.fill(5.5);
        scene.field.gaussians.occupancy_logits.fill(6.0);
    });
}

#[test]
fn faint_but_occupied_gaussians_are_not_cut() {
    // The extent must follow max(o, pi).
    check("faint colour", &config(), &settings(), |scene| {
        scene.field.gaussians.opacity_logits.iter_mut().step_by(2).for_each(|logit| *logit = -7.0);
    });
    check("faint occupancy", &config(), &settings(), |scene| {
        scene.field.gaussians.occupancy_logits.iter_mut().step_by(2).for_each(|logit| *logit = -7.0);
    });
}

#[test]
fn small_and_odd_images() {
    for (width, height) in [(1, 1), (16, 16), (17, 33), (15, 2), (130, 3)] {
        let config = SyntheticConfig { width, height, gaussians: 20, screen_size: (0.1, 0.5), ..config() };
        let name = format!("{width} x {height}");
        // One pixel can only fail through its colour: gradients of 20 Gaussians stay mostly 0.
        if width * height > 16 {
            check(&name, &config, &settings(), |_| {});
            continue;
        }
        let synthetic = generate(&config);
        let camera = &synthetic.camera;
        let expected = reference::render::<f64>(&synthetic.field, camera, 0.0, &settings(), CHANNELS);
        for (path, actual) in images_of(&synthetic, 0.0, &settings()) {
            for channel in 0..3 {
                let (a, e) = (actual.color.pixels[0][channel], expected.color.pixels[0][channel]);
                assert!((a - e).abs() < 2e-5, "{name}, {path:?}: {a} {e}");
            }
        }
    }
}

#[test]
fn needles() {
    // 40 times as long as wide on screen: the gradient of the covariance, X V X, loses the square of that ratio
    // in single precision. Worst seen 0.8 %, and 0.6 % in the single-precision reference.
    let tolerances = |path| Tolerances { gradient: 2e-2, ..Tolerances::of(path) };
    check_within(tolerances, "needles", &config(), &settings(), |scene| {
        for log_scale in scene.field.gaussians.log_scales.iter_mut().step_by(5) {
            *log_scale = [log_scale[0] + 1.5, -9.0, -9.0];
        }
    });
}

#[test]
fn clamps_of_projection() {
    check("clamps", &config(), &settings(), |scene| {
        let gaussians = &mut scene.field.gaussians;
        // Colour below 0 on one channel, and centres outside the field of view whose tails reach in.
        gaussians.sh_coefficients.iter_mut().step_by(3).for_each(|sh| sh[1] = -2.5);
        let world_from_camera = scene.camera.camera_from_world.inverse();
        for index in 0..20 {
            let angle = f64::from(index) * 0.314 + 0.1;
            let point =
                glam::DVec3::new(1.9 * angle.cos(), 1.6 * angle.sin(), 1.0) * (2.5 + 0.05 * f64::from(index));
            gaussians.means[index as usize] = world_from_camera.apply(point).as_vec3().to_array();
            gaussians.log_scales[index as usize] = [0.2, 0.0, -0.4];
        }
    });
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
    let mut all: Vec<(Path, RenderedImage)> = levels().into_iter().map(of_level).collect();
    #[cfg(feature = "wgpu")]
    if let Some(device) = crate::on_gpu::device() {
        let mut renderer = cif_render::wgpu::GpuRenderer::new(&device.0, field).unwrap();
        all.push((Path::Gpu, renderer.render(field, camera, time, settings, CHANNELS).unwrap()));
    }
    all
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
                worst.tell(&name);
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

/// Rows of identities longer than the eight entries that the GPU sums side by side.
#[test]
fn long_identity_rows() {
    let config = SyntheticConfig { instances: 21, ..config() };
    check("long rows", &config, &settings(), |scene| {
        let rows = scene.field.identities.as_mut().unwrap();
        let n = rows.len();
        rows.row_offsets = (0..=n as u32).map(|row| 21 * row).collect();
        rows.labels = (0..n).flat_map(|_| 0..21).collect();
        rows.log_estimates =
            (0..21 * n).map(|entry| (1.0 / 30.0 + (entry % 5) as f32 * 0.005).ln()).collect();
        rows.log_calibrations = (0..21 * n).map(|entry| (entry % 7) as f32 * 0.1 - 0.3).collect();
    });
}

/// The antialiasing factor is part of the instance gradient when occupancy is the opacity.
#[test]
fn antialiased_opacity_as_occupancy() {
    let instances = InstanceSettings { occupancy: OccupancySource::Opacity, ..InstanceSettings::default() };
    let settings = RenderSettings { antialiased: true, instances: Some(instances), ..settings() };
    check("antialiased, opacity as occupancy", &config(), &settings, |_| {});
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
