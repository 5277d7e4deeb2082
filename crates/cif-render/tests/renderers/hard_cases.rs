//! Numerically hard cases of rendering, through every renderer in both directions; numbers are rows of methods
//! reference 7. `tests/README.md` lists them with the worst errors that these tests print.

use cif_field::parameters::{LOG_SCALES, MLP, OCCUPANCY_LOGITS, OPACITY_LOGITS, PLANES, Parameter, TABLE};
use cif_field::{Field, Identities};
use cif_geometry::scalar::{logit, sigmoid};
use cif_geometry::{PinholeCamera, PixelGrid, Real};
use cif_render::cpu::{IdentityCounts, Renderer, SimdLevel};
use cif_render::reference::project::{project, project_backward};
use cif_render::reference::rasterize::{footprint, weight};
use cif_render::reference::{self, Forward, Scene, SceneGradients, Splat2d, SplatGradient, View};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use cif_render::{InstanceSettings, RenderSettings};
use proptest::prelude::*;

use crate::renderers::{Path, Seen, everywhere};
use crate::support::{ABSOLUTE, Case, Cotangents, STEP, pixel_discontinuity, plain_camera, render};

fn settings() -> RenderSettings {
    RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() }
}

/// One isotropic Gaussian on the axis of [`plain_camera`], 2 m away, one label.
fn one() -> Field {
    let mut field =
        generate(&SyntheticConfig { gaussians: 1, instances: 1, ..SyntheticConfig::default() }).field;
    field.gaussians.means[0] = [0.0, 0.0, 2.0];
    field.gaussians.log_scales[0] = [-2.0; 3];
    field
}

fn run<R: Real>(field: &Field, settings: &RenderSettings) -> (Forward<R>, SceneGradients<R>) {
    let camera = plain_camera(16, 16, 20.0);
    let scene = Scene::<R>::from_field(field);
    let labels = PixelGrid::filled(16, 16, 1);
    let forward = reference::forward(&scene, &camera, 0.5, settings, Some(&labels));
    let gradients = Cotangents::random(5, 16, 16).backward(&scene, &forward);
    (forward, gradients)
}

fn assert_finite<R: Real>(name: &str, (forward, gradients): &(Forward<R>, SceneGradients<R>)) {
    let pixels = forward.color.pixels.as_flattened().iter().chain(&forward.depth.pixels);
    assert!(pixels.chain([&forward.loss.mean]).all(|value| value.is_finite()), "{name}: image");
    for parameter in TABLE {
        for index in 0..gradients.parameters.len(parameter) {
            let v = gradients.parameters.get(parameter, index);
            assert!(v.is_finite(), "{name}: {} {index} is {v}", parameter.name);
        }
    }
}

/// Implementation that computed a number, a column of the table in `tests/README.md`.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Column {
    /// Reference in double precision.
    F64,
    /// Reference in single precision.
    F32,
    /// Fast path at any level.
    Fast,
    /// GPU.
    Gpu,
}

impl Column {
    fn of(path: Path) -> Self {
        match path {
            Path::Single => Self::F32,
            Path::Fast(_) => Self::Fast,
            Path::Gpu => Self::Gpu,
        }
    }
}

/// Which way, a half of a cell of the table.
#[derive(Clone, Copy)]
enum Way {
    Forward,
    Backward,
}

/// Prints the worst error of a case for the table in `tests/README.md`, and holds it to its limit.
fn worst(row: u32, path: Column, way: Way, what: &str, error: f64, limit: f64) {
    let path = ["f64", "f32", "fast", "gpu"][path as usize];
    let way = ["forward", "backward"][way as usize];
    println!("hard case {row} | {path} | {way} | {what} | {error:.1e} | {limit:.0e}");
    assert!(error <= limit, "row {row}, {what}, {path} {way}: {error:e} is above {limit:e}");
}

/// A field in the view of [`plain_camera`], 16 pixels wide and high, all of label 1.
fn plain(field: &Field) -> SyntheticScene {
    let (camera, labels) = (plain_camera(16, 16, 20.0), PixelGrid::filled(16, 16, 1));
    SyntheticScene { field: field.clone(), camera, labels, time: 0.5 }
}

fn assert_seen_finite(name: &str, field: &Field, seen: &Seen) {
    let path = seen.path;
    assert!(seen.colors.as_flattened().iter().all(|value| value.is_finite()), "{name}, {path:?}: colour");
    assert!(seen.loss.is_none_or(|loss| loss.0.is_finite()), "{name}, {path:?}: loss");
    let parameters = Scene::<f32>::from_field(field).parameters;
    for parameter in TABLE {
        let mut values = (0..parameters.len(parameter)).map(|index| seen.gradient(parameter, index));
        assert!(values.all(|value| value.is_finite()), "{name}: {} of {path:?}", parameter.name);
    }
    let screen = seen.screen.as_flattened().iter().chain(&seen.radii);
    assert!(screen.into_iter().all(|v| v.is_finite()), "{name}, {path:?}: screen");
}

/// Largest errors of a view: of colours, and of gradients as a share of the largest of their parameter.
#[derive(Clone, Default)]
struct Errors {
    /// Of the `f64` reference against central differences of its loss.
    differences: Option<f64>,
    /// Of every renderer against the `f64` reference, forward and backward.
    of: Vec<(Column, [f64; 2])>,
}

/// Most Gaussians whose every parameter is moved for central differences.
const FEW: usize = 8;

/// Relative distance of a weight or a transmittance from a threshold within which they may decide differently.
const MARGIN: f64 = 1e-3;

/// Measures a view against the `f64` reference, and that against central differences where asked to. Pixels at a
/// threshold, where two may decide differently, take no part.
fn errors(
    name: &str,
    field: &Field,
    settings: &RenderSettings,
    (camera, time): (&PinholeCamera, f64),
    with_differences: bool,
) -> Errors {
    let (width, height) = (camera.width, camera.height);
    let labels = PixelGrid::filled(width, height, 1);
    let mut view = SyntheticScene { field: field.clone(), camera: *camera, labels, time };
    let scene = Scene::<f64>::from_field(field);
    let unmasked = reference::forward(&scene, camera, time, settings, Some(&view.labels));
    let mut cotangents = Cotangents::random(5, width, height);
    (cotangents.depth, cotangents.alpha) = (None, None);
    // What is too faint for any weight by less than the margin is drawn or not.
    let mut raised = scene.clone();
    for (row, _) in unmasked.splats.iter().enumerate().filter(|(_, splat)| splat.is_none()) {
        for logits in [OPACITY_LOGITS, OCCUPANCY_LOGITS] {
            *raised.parameters.get_mut(logits, row) += MARGIN;
        }
    }
    let raised = reference::forward(&raised, camera, time, settings, Some(&view.labels));
    let meets = |position| {
        [&unmasked, &raised].into_iter().any(|seen| pixel_discontinuity(seen, position, MARGIN).is_some())
    };
    let band: Vec<bool> = (0..unmasked.pixels.pixels.len()).map(meets).collect();
    for (position, _) in band.iter().enumerate().filter(|(_, near)| **near) {
        cotangents.color.pixels[position] = [0.0; 3];
        view.labels.pixels[position] = 0;
    }
    let render = |scene: &Scene<f64>| reference::forward(scene, camera, time, settings, Some(&view.labels));
    let expected = render(&scene);
    let gradients = cotangents.backward(&scene, &expected).parameters;
    let of_color = |actual: &[[f64; 3]]| {
        let mut worst = 0.0_f64;
        for (position, (a, e)) in actual.iter().zip(&expected.color.pixels).enumerate() {
            for channel in 0..3 {
                let difference = (a[channel] - e[channel]).abs();
                // One decision at 1/255, of the largest colour here.
                assert!(difference < 0.02, "{name}: pixel {position} differs by {difference}");
                worst = worst.max(if band[position] { 0.0 } else { difference });
            }
        }
        worst
    };
    let largest_of = |parameter| {
        (0..gradients.len(parameter)).map(|k| gradients.get(parameter, k).abs()).fold(0.0, f64::max)
    };
    // A parameter whose gradient vanishes, such as the rotation of a sphere, is measured by the others.
    let floor = 1e-2 * TABLE.map(largest_of).into_iter().fold(1e-7, f64::max);
    let of_gradients =
        |parameters: &[Parameter], slack: f64, actual: &mut dyn FnMut(Parameter, usize) -> f64| {
            let mut worst = 0.0_f64;
            for parameter in parameters {
                let largest = largest_of(*parameter).max(floor);
                for index in 0..gradients.len(*parameter) {
                    let difference = (actual(*parameter, index) - gradients.get(*parameter, index)).abs();
                    worst = worst.max((difference - slack).max(0.0) / largest);
                }
            }
            worst
        };

    let mut found = Errors::default();
    for seen in everywhere(&view, settings, &cotangents) {
        assert_seen_finite(name, field, &seen);
        let backward = of_gradients(&TABLE, 0.0, &mut |parameter, index| seen.gradient(parameter, index));
        found.of.push((Column::of(seen.path), [of_color(&seen.colors), backward]));
    }
    if with_differences && field.len() <= FEW {
        let mut moved = scene.clone();
        let of_gaussians = TABLE.into_iter().filter(|parameter| !matches!(*parameter, PLANES | MLP));
        let of_gaussians: Vec<Parameter> = of_gaussians.collect();
        found.differences = Some(of_gradients(&of_gaussians, ABSOLUTE, &mut |parameter, index| {
            let value = scene.parameters.get(parameter, index);
            let mut at = |offset: f64| {
                *moved.parameters.get_mut(parameter, index) = value + offset;
                cotangents.loss(&render(&moved))
            };
            let slope = (at(STEP) - at(-STEP)) / ((value + STEP) - (value - STEP));
            *moved.parameters.get_mut(parameter, index) = value;
            slope
        }));
    }
    found
}

/// Holds all others to the `f64` reference, and that to differences, in a view of [`plain_camera`].
fn agrees(row: u32, what: &str, field: &Field, settings: &RenderSettings) {
    agrees_from(row, what, field, settings, (&plain_camera(16, 16, 20.0), 0.5));
}

/// The same in the view of a generated scene.
fn agrees_there(row: u32, what: &str, scene: &SyntheticScene, settings: &RenderSettings) {
    agrees_from(row, what, &scene.field, settings, (&scene.camera, scene.time));
}

fn agrees_from(row: u32, what: &str, field: &Field, settings: &RenderSettings, view: (&PinholeCamera, f64)) {
    let found = errors(what, field, settings, view, true);
    if let Some(differences) = found.differences {
        worst(row, Column::F64, Way::Backward, what, differences, 1e-5);
    }
    all_agree(row, what, &found);
}

/// Holds the others to the `f64` reference.
fn all_agree(row: u32, what: &str, found: &Errors) {
    for (column, [forward, backward]) in &found.of {
        worst(row, *column, Way::Forward, what, *forward, 1e-5);
        worst(row, *column, Way::Backward, what, *backward, 1e-3);
    }
}

/// Draws with every renderer, asserts that everything is finite, and returns what the double precision made of it.
fn finite(name: &str, field: &Field, settings: &RenderSettings) -> (Forward<f64>, SceneGradients<f64>) {
    for seen in everywhere(&plain(field), settings, &Cotangents::random(5, 16, 16)) {
        assert_seen_finite(name, field, &seen);
    }
    let double = run::<f64>(field, settings);
    assert_finite(name, &double);
    double
}

#[test]
fn row_8_transmittance_is_never_divided() {
    // The replay forms the same products in the same order: ends of the lists prove it bit for bit.
    let synthetic = generate(&SyntheticConfig { gaussians: 20, ..SyntheticConfig::default() });
    let scene = Scene::<f32>::from_field(&synthetic.field);
    let forward = render(&scene, &synthetic, &settings());
    for (position, state) in forward.pixels.pixels.iter().enumerate() {
        let pixel = [position as u32 % 32, position as u32 / 32];
        let mut transmittance = 1.0_f32;
        for &index in &forward.order[..state.end] {
            let Some(splat) = &forward.splats[index as usize] else { continue };
            let footprint = footprint(splat, pixel);
            let Some(alpha) = weight(splat.opacity, footprint.peak) else { continue };
            transmittance *= 1.0 - alpha.value;
        }
        assert_eq!(transmittance, state.transmittance);
    }
    agrees_there(8, "twenty Gaussians", &synthetic, &settings());
}

#[test]
fn row_9_no_gradient_beyond_the_cap() {
    // Pixel (8, 8) has its centre at the mean: P is 1 there and the weight is the opacity itself.
    let mut field = one();
    field.gaussians.means[0] = [0.05, 0.05, 2.0];
    field.gaussians.log_scales[0] = [-3.0; 3];
    let camera = plain_camera(16, 16, 20.0);
    let settings = RenderSettings { instances: None, ..settings() };
    let mut v_color = PixelGrid::filled(16, 16, [0.0; 3]);
    v_color.pixels[8 * 16 + 8] = [1.0, -0.5, 0.7];
    let mut at = |opacity: f32| {
        field.gaussians.opacity_logits[0] = logit(opacity);
        let scene = Scene::<f64>::from_field(&field);
        let forward = reference::forward(&scene, &camera, 0.0, &settings, None);
        let v = reference::backward(&scene, &forward, &v_color, None, None, 0.0).raster.splats[0].clone();
        (forward.pixels.at(8, 8).transmittance, v)
    };
    let (transmittance, v) = at(0.989);
    // The logit is a float of single precision.
    worst(9, Column::F64, Way::Forward, "remainder behind 0.989", (transmittance - 0.011).abs(), 1e-6);
    assert!(v.opacity != 0.0 && v.color[0] > 0.98);
    let (transmittance, v) = at(0.991);
    assert!((transmittance - 0.01).abs() < 1e-7, "{transmittance}");
    assert_eq!((v.opacity, v.mean2d, v.moments), (0.0, [0.0; 2], [0.0; 3]));
    assert!((v.color[0] - 0.99).abs() < 1e-6, "colour still flows, with the capped weight");
    for opacity in [0.989, 0.991, 0.9999, 1.0 - f32::EPSILON] {
        field.gaussians.opacity_logits[0] = logit(opacity);
        agrees(9, &format!("opacity {opacity}"), &field, &settings);
    }
}

#[test]
fn row_10_weights_below_one_step_are_not_drawn() {
    assert!(weight(1.0 / 255.0 - 1e-6, 1.0_f64).is_none());
    assert!(weight(1.0 / 255.0 + 1e-6, 1.0_f64).is_some());
    assert!(weight(f64::NAN, 1.0).is_none());
    // Row 36: far tails vanish by the same gate, whatever the processor does with denormals.
    assert!(weight(1.0_f32, (-90.0_f32).exp()).is_none());
    for opacity in [0.99, 1.01, 1.5] {
        let mut field = one();
        field.gaussians.log_scales[0] = [1.0; 3];
        field.gaussians.opacity_logits[0] = logit(opacity / 255.0);
        agrees(10, &format!("{opacity} steps of 1/255"), &field, &settings());
    }
    // Peaks that end far inside the image: most pixels lie in tails.
    let mut field = one();
    field.gaussians.log_scales[0] = [-3.5; 3];
    agrees(36, "a spot whose tails vanish", &field, &settings());
}

#[test]
fn row_11_the_stopping_splat_is_excluded() {
    // Three saturated layers: the second would bring T to 1e-4 (not below), the third below.
    let mut field = generate(&SyntheticConfig { gaussians: 3, instances: 1, ..Default::default() }).field;
    for i in 0..3 {
        field.gaussians.means[i] = [0.0, 0.0, 2.0 + i as f32];
        field.gaussians.log_scales[i] = [3.0; 3];
        field.gaussians.opacity_logits[i] = 20.0;
        field.gaussians.occupancy_logits[i] = 20.0;
    }
    let (forward, _) = finite("stop", &field, &settings());
    let state = forward.pixels.at(8, 8);
    assert!(state.end < 3 && state.transmittance >= f64::from(1e-4_f32), "{state:?}");
    assert_eq!(state.end, state.instance_end);
    // Away from the threshold itself: two layers leave 9e-4, a third would leave 2.7e-5.
    for i in 0..3 {
        field.gaussians.opacity_logits[i] = logit(0.97);
        field.gaussians.occupancy_logits[i] = logit(0.97);
    }
    let (forward, _) = finite("stop", &field, &settings());
    assert_eq!(forward.pixels.at(8, 8).end, 2);
    agrees(11, "two layers of three", &field, &settings());
}

#[test]
fn row_13_needles_keep_their_determinant() {
    // Aspect 1e4: 0.1 mm thin, 1 m long, diagonal in the image and tilted in depth.
    let mut field = one();
    field.gaussians.log_scales[0] = [0.0, -9.21, -9.21];
    field.gaussians.quaternions[0] = [0.8, 0.1, 0.35, 0.3];
    for focal in [20.0, 2000.0] {
        let camera = plain_camera(16, 16, focal);
        let settings = settings();
        let single = project(
            &Scene::<f32>::from_field(&field).parameters.gaussians[0],
            &View::from_camera(&camera),
            &settings,
        );
        let double = project(
            &Scene::<f64>::from_field(&field).parameters.gaussians[0],
            &View::from_camera(&camera),
            &settings,
        );
        let (single, double) = (single.unwrap(), double.unwrap());
        // det L = det C^-1/2, and each entry comes from det C.
        for k in 0..3 {
            let (a, b) = (f64::from(single.factor[k]), double.factor[k]);
            let what = format!("focal {focal}, entry {k} of the factor");
            worst(13, Column::F32, Way::Forward, &what, (a - b).abs() / b.abs(), 1e-5);
        }
    }
    agrees(13, "one needle", &field, &settings());
}

#[test]
fn row_13_images_of_needles_agree_in_both_precisions() {
    // Up to 600 px long and a fraction of a pixel wide, before the low pass.
    for growth in [1.5, 3.5, 6.0] {
        let config =
            SyntheticConfig { seed: 11, gaussians: 50, screen_size: (0.01, 0.08), ..Default::default() };
        let mut synthetic = generate(&config);
        for log_scale in synthetic.field.gaussians.log_scales.iter_mut().step_by(5) {
            *log_scale = [log_scale[0] + growth, -9.0, -9.0];
        }
        let single = render(&Scene::<f32>::from_field(&synthetic.field), &synthetic, &settings());
        let double = render(&Scene::<f64>::from_field(&synthetic.field), &synthetic, &settings());
        assert_eq!(single.order, double.order);
        let mut differences: Vec<f64> = (0..single.color.pixels.len())
            .map(|position| {
                (f64::from(single.color.pixels[position][1]) - double.color.pixels[position][1]).abs()
            })
            .collect();
        differences.sort_by(f64::total_cmp);
        // Not the maximum: single pixels may lie on a threshold.
        let high = differences[differences.len() * 99 / 100];
        let what = format!("needles grown by {growth}, 99 % of the pixels");
        worst(13, Column::F32, Way::Forward, &what, high, 1e-5);
    }
}

#[test]
fn row_14_huge_scales_are_clamped() {
    let mut field = one();
    for scale in [60.0, 1e30, f32::MAX] {
        field.gaussians.log_scales[0] = [scale, -60.0, 3.0];
        let (forward, gradients) = finite("huge", &field, &settings());
        assert!(forward.splats[0].is_some());
        // Row 15: no gradient where the clamp holds.
        assert_eq!(gradients.parameters.gaussians[0].log_scale[..2], [0.0, 0.0]);
    }
    field.gaussians.log_scales[0] = [60.0, -60.0, 3.0];
    let view = (&plain_camera(16, 16, 20.0), 0.5);
    for (column, [forward, _]) in errors("a scale of e^60", &field, &settings(), view, false).of {
        worst(14, column, Way::Forward, "a scale of e^60", forward, 1e-5);
    }
    field.gaussians.log_scales[0] = [f32::INFINITY, 0.0, 0.0];
    assert!(finite("infinite", &field, &settings()).0.splats[0].is_none());
}

#[test]
fn row_15_deformed_scales_are_clamped_too() {
    let mut scene = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..SyntheticConfig::default() });
    let layout = scene.field.deformation.as_ref().unwrap().config.mlp_layout();
    let mlp = &mut scene.field.deformation.as_mut().unwrap().mlp;
    mlp[layout.heads[1].output.biases.start] = 40.0;
    let double = Scene::<f64>::from_field(&scene.field);
    let forward = render(&double, &scene, &settings());
    assert!(forward.deformed[0].gaussian.log_scale[0] > 10.0);
    let gradients = Cotangents::random(1, 32, 24).backward(&double, &forward);
    assert_finite("spike", &(forward, gradients.clone()));
    assert!(gradients.parameters.gaussians.iter().all(|v| v.log_scale[0] == 0.0));
    assert!(gradients.parameters.gaussians.iter().any(|v| v.log_scale[1] != 0.0));
    let (width, height) = (scene.camera.width, scene.camera.height);
    let cotangents = Cotangents::random(1, width, height);
    for seen in everywhere(&scene, &settings(), &cotangents) {
        assert_seen_finite("spike", &scene.field, &seen);
        let along = |axis: usize| {
            let rows = 0..scene.field.len();
            rows.map(|row| seen.gradient(LOG_SCALES, 3 * row + axis)).collect::<Vec<f64>>()
        };
        assert!(along(0).iter().all(|v| *v == 0.0) && along(1).iter().any(|v| *v != 0.0), "{:?}", seen.path);
    }
    // A spike that the clamp does not reach is drawn alike.
    let mlp = &mut scene.field.deformation.as_mut().unwrap().mlp;
    mlp[layout.heads[1].output.biases.start] = 1.5;
    agrees_there(15, "scales moved by 1.5", &scene, &settings());
}

#[test]
fn row_16_through_the_near_plane() {
    let mut visible = 0;
    for step in 0..200 {
        let mut field = one();
        let z = 0.15 + step as f32 * 0.0005;
        field.gaussians.means[0] = [0.01, -0.02, z];
        let (forward, _) = finite("near plane", &field, &settings());
        assert_eq!(forward.splats[0].is_some(), z >= 0.2, "z = {z}");
        visible += usize::from(forward.splats[0].is_some());
        if step % 20 == 19 {
            agrees(16, &format!("z = {z:.4}"), &field, &settings());
        }
    }
    assert!(visible > 50 && visible < 150);
}

#[test]
fn row_16_huge_position_gradients_are_clipped_and_counted() {
    let field = one();
    let camera = plain_camera(16, 16, 20.0);
    let scene = Scene::<f64>::from_field(&field);
    let gaussian = &scene.parameters.gaussians[0];
    let view = View::from_camera(&camera);
    let settings = settings();
    let splat = project(gaussian, &view, &settings).unwrap();
    let v = SplatGradient { mean2d: [3e3, -4e3], ..SplatGradient::zero() };
    let result = project_backward(gaussian, &view, &settings, &splat, &v);
    let norm = result.gaussian.mean.iter().map(|v| v * v).sum::<f64>().sqrt();
    assert!(result.clipped && (norm - 1e4).abs() < 1e-6, "{norm}");
    let v = SplatGradient { mean2d: [3e2, -4e2], ..SplatGradient::zero() };
    assert!(!project_backward(gaussian, &view, &settings, &splat, &v).clipped);
}

#[test]
fn row_18_quaternion_norm_does_not_matter() {
    let mut field = one();
    field.gaussians.log_scales[0] = [-1.0, -2.0, -2.5];
    let quaternion = [0.8_f32, 0.1, -0.5, 0.3];
    let at = |factor: f32| {
        let mut field = field.clone();
        field.gaussians.quaternions[0] = quaternion.map(|c| c * factor);
        finite("quaternion norm", &field, &settings())
    };
    let (image, gradients) = at(1.0);
    for factor in [1e-3_f32, 1e3] {
        let (scaled, scaled_gradients) = at(factor);
        for (a, b) in image.color.pixels.as_flattened().iter().zip(scaled.color.pixels.as_flattened()) {
            assert!((a - b).abs() < 1e-6);
        }
        for k in 0..4 {
            let expected = gradients.parameters.gaussians[0].quaternion[k];
            let actual = scaled_gradients.parameters.gaussians[0].quaternion[k] * f64::from(factor);
            assert!((actual - expected).abs() < 1e-5, "{factor} {k}: {actual} {expected}");
        }
        let mut field = field.clone();
        field.gaussians.quaternions[0] = quaternion.map(|c| c * factor);
        agrees(18, &format!("norm times {factor}"), &field, &settings());
    }
    let (vanished, _) = at(1e-8);
    assert!(vanished.splats[0].is_none());
}

#[test]
fn row_19_at_the_camera_centre() {
    let mut field = one();
    field.gaussians.means[0] = [0.0; 3];
    let settings = RenderSettings { near: -1.0, ..settings() };
    // Even with the near plane out of the way nothing infinite appears.
    finite("centre", &field, &settings);
    field.gaussians.means[0] = [0.0, 0.0, 1e-7];
    finite("beside the centre", &field, &RenderSettings { near: 0.0, ..settings });
    field.gaussians.means[0] = [0.004, -0.003, 0.21];
    agrees(19, "just before the near plane, on the axis", &field, &settings);
}

#[test]
fn row_20_black_recovers_in_another_view() {
    let mut field = one();
    field.gaussians.sh_coefficients[0] = [0.0; 48];
    // Red is clamped from in front (z band), and not from the side.
    field.gaussians.sh_coefficients[0][0] = -1.7;
    field.gaussians.sh_coefficients[0][3 * 2] = -0.5;
    let (forward, gradients) = finite("black", &field, &settings());
    let splat = forward.splats[0].as_ref().unwrap();
    assert_eq!((splat.color_clamped, splat.color[0]), ([true, false, false], 0.0));
    let sh = gradients.parameters.gaussians[0].sh;
    assert!(sh.iter().step_by(3).all(|v| *v == 0.0), "no gradient on the clamped channel");
    assert!(sh.iter().skip(1).step_by(3).any(|v| *v != 0.0));
    field.gaussians.sh_coefficients[0][3 * 2] = 0.5;
    let (forward, gradients) = finite("grey", &field, &settings());
    assert!(!forward.splats[0].as_ref().unwrap().color_clamped[0]);
    assert!(gradients.parameters.gaussians[0].sh[0] != 0.0);
    for z_band in [-0.5, 0.5] {
        field.gaussians.sh_coefficients[0][3 * 2] = z_band;
        agrees(20, &format!("z band {z_band}"), &field, &settings());
    }
}

#[test]
fn row_21_a_zero_plane_still_learns() {
    let config = SyntheticConfig { heads: Some(ALL_HEADS), ..SyntheticConfig::default() };
    let mut scene = generate(&config);
    let deformation = scene.field.deformation.as_mut().unwrap();
    let layout = deformation.config.plane_layout().0[0].clone();
    let range = layout[3].offset..layout[4].offset;
    deformation.planes[range.clone()].fill(0.0);
    let double = Scene::<f64>::from_field(&scene.field);
    let forward = render(&double, &scene, &settings());
    let gradients = Cotangents::random(1, 32, 24).backward(&double, &forward);
    assert_finite("zero plane", &(forward, gradients.clone()));
    let planes = &gradients.parameters.planes;
    assert!(planes[range.clone()].iter().any(|v| *v != 0.0));
    let others = (0..layout[5].offset).filter(|node| !range.contains(node));
    assert!(others.into_iter().all(|node| planes[node] == 0.0), "the product of the others is 0");
    agrees_there(21, "a plane of zeros", &scene, &settings());
}

#[test]
fn row_22_lookup_at_the_last_node() {
    let mut scene = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..SyntheticConfig::default() });
    let bounds = scene.field.deformation.as_ref().unwrap().bounds;
    scene.field.gaussians.means[0] = bounds.high.as_vec3().to_array();
    scene.field.gaussians.means[1] = (bounds.high + 1.0).as_vec3().to_array();
    scene.time = 1.0;
    let double = Scene::<f64>::from_field(&scene.field);
    let forward = render(&double, &scene, &settings());
    let (corner, outside) = (&forward.deformed[0], &forward.deformed[1]);
    let (corner, outside) = (corner.tape.as_ref().unwrap(), outside.tape.as_ref().unwrap());
    let difference = corner.features.iter().zip(&outside.features).map(|(a, b)| (a - b).abs());
    worst(22, Column::F64, Way::Forward, "features at the corner", difference.fold(0.0, f64::max), 1e-5);
    let deformation = scene.field.deformation.as_ref().unwrap();
    let last: f32 = (0..6)
        .map(|plane| {
            let layout = &deformation.config.plane_layout().0[0][plane];
            let node = layout.rows * layout.columns - 1;
            deformation.planes[layout.offset + node * deformation.config.channels as usize]
        })
        .product();
    assert!((outside.features[0] - f64::from(last)).abs() < 1e-6);
    let gradients = Cotangents::random(1, 32, 24).backward(&double, &forward);
    assert_finite("corner", &(forward, gradients));
    // On the box itself its slope ends, which precisions decide differently.
    scene.field.gaussians.means[0] = (bounds.high + 0.5).as_vec3().to_array();
    let what = "at the last node";
    all_agree(22, what, &errors(what, &scene.field, &settings(), (&scene.camera, scene.time), false));
}

#[test]
fn row_42_occupancy_below_the_gate_has_no_gradient() {
    let mut field = one();
    field.gaussians.occupancy_logits[0] = logit(0.0038);
    let (forward, gradients) = finite("faint", &field, &settings());
    assert_eq!(forward.loss.unsupported_pixels, 256);
    assert_eq!(gradients.parameters.gaussians[0].occupancy_logit, 0.0);
    // The clamp of the optimiser keeps it at 0.005, where it can grow.
    field.gaussians.occupancy_logits[0] = logit(0.005);
    field.gaussians.log_scales[0] = [0.0; 3];
    let (_, gradients) = finite("faint", &field, &settings());
    assert!(gradients.parameters.gaussians[0].occupancy_logit < 0.0);
    agrees(42, "occupancy of 0.005", &field, &settings());
}

#[test]
fn row_4_probabilities_sum_to_one_whatever_their_logarithms() {
    // Supports of 1 to 4 labels; shares down to 1e-45, calibrations at their limits.
    let logs = [0.0_f32, -1e-3, -9.2, -40.0, -104.0, 0.693];
    let mut rows = Identities::default();
    for start in 0..logs.len() {
        for support in 1..=4_u16 {
            for label in 0..support {
                rows.labels.push(label);
                rows.log_estimates.push(logs[(start + 2 * usize::from(label)) % logs.len()]);
                rows.log_calibrations.push([10.0, -10.0, 0.3][(start + usize::from(label)) % 3]);
            }
            rows.row_offsets.push(rows.labels.len() as u32);
        }
    }
    let probabilities = rows.probabilities();
    let mut error = 0.0_f64;
    for row in 0..rows.len() {
        let range = rows.range(row);
        let sum: f64 = range.clone().map(|entry| f64::from(probabilities[entry])).sum();
        error = error.max((sum - 1.0).abs());
        if range.len() == 1 {
            assert_eq!(probabilities[range.start], 1.0, "a row of one label is certain");
        }
    }
    worst(4, Column::Fast, Way::Forward, "row sums", error, 4.0 * f64::from(f32::EPSILON));
    let several = generate(&SyntheticConfig { instances: 4, ..SyntheticConfig::default() });
    agrees_there(4, "rows of up to four labels", &several, &settings());
}

#[test]
fn row_5_tiny_probabilities_agree() {
    let mut scene = generate(&SyntheticConfig { instances: 2, ..SyntheticConfig::default() });
    let rows = scene.field.identities.as_mut().unwrap();
    for (label, estimate) in rows.labels.iter().zip(&mut rows.log_estimates) {
        // The label that every pixel carries here.
        *estimate -= if *label == 0 { 13.0 } else { 0.0 };
    }
    agrees_there(5, "probabilities of 2e-6", &scene, &settings());
}

#[test]
fn row_12_flat_and_long_footprints_agree() {
    let mut field = one();
    field.gaussians.quaternions[0] = [0.92, 0.05, 0.1, 0.37];
    field.gaussians.log_scales[0] = [-0.5, -9.0, -9.0];
    agrees(12, "a footprint 20 px long", &field, &settings());
    // Farther than the image reaches, the gradient of the length is what is left of the conic's: six digits of a
    // footprint 150 px long. In the frame of the factor it is a sum of its own.
    field.gaussians.log_scales[0] = [1.5, -9.0, -9.0];
    agrees(12, "a footprint 150 px long", &field, &settings());
    // Along an axis of the image, and a little off.
    for turn in [0.0, 0.004, 0.6] {
        field.gaussians.quaternions[0] = [1.0, 0.0, 0.0, turn];
        agrees(12, &format!("a footprint 150 px long, turned by {turn}"), &field, &settings());
    }
    // In a view that sees all of it.
    field.gaussians.quaternions[0] = [0.92, 0.05, 0.1, 0.37];
    field.gaussians.log_scales[0] = [0.0, -9.0, -9.0];
    let camera = plain_camera(192, 160, 100.0);
    for antialiased in [false, true] {
        let what = format!("a footprint 150 px long in sight, antialiased: {antialiased}");
        agrees_from(12, &what, &field, &RenderSettings { antialiased, ..settings() }, (&camera, 0.5));
    }
}

#[test]
fn row_17_the_clamped_jacobian_agrees() {
    let mut field = one();
    field.gaussians.log_scales[0] = [0.1, 0.3, -0.2];
    for (x, y) in [(1.7, 0.1), (-0.2, -1.6), (1.6, 1.7)] {
        field.gaussians.means[0] = [x, y, 2.0];
        agrees(17, &format!("centre at ({x}, {y})"), &field, &settings());
    }
}

#[test]
fn row_40_odd_sizes_agree() {
    let field = generate(&SyntheticConfig { gaussians: 8, ..SyntheticConfig::default() });
    for (width, height) in [(1, 1), (17, 33), (33, 1), (5, 40)] {
        let camera = PinholeCamera { width, height, ..field.camera };
        let what = format!("{width} x {height}");
        agrees_from(40, &what, &field.field, &settings(), (&camera, field.time));
    }
}

#[test]
fn row_41_nothing_agrees_with_nothing() {
    let mut scene = generate(&SyntheticConfig::default());
    scene.field.gaussians.means.iter_mut().for_each(|mean| *mean = [0.0, 0.0, -50.0]);
    agrees(41, "everything behind the camera", &scene.field, &settings());
}

#[test]
fn row_44_separated_depths_agree() {
    let scene = Case::clear(SyntheticConfig { seed: 40, ..Default::default() }, settings(), |_| {});
    agrees_there(44, "eight Gaussians", &scene.synthetic, &settings());
}

#[test]
fn row_6_thousands_of_faint_splats_add_up() {
    // Weights just above the gate: S falls to 1e-4 after some 2 300 layers, more than that never add up.
    let layers = 2600;
    let mut field =
        generate(&SyntheticConfig { gaussians: layers, instances: 1, ..Default::default() }).field;
    for i in 0..layers {
        field.gaussians.means[i] = [0.0, 0.0, 2.0 + 1e-3 * i as f32];
        field.gaussians.log_scales[i] = [6.0; 3];
        field.gaussians.opacity_logits[i] = logit(0.0042);
        field.gaussians.occupancy_logits[i] = logit(0.0042);
    }
    let (double, _) = run::<f64>(&field, &settings());
    let relative = |a: f64, e: f64| ((a - e) / e).abs();
    let m = |value: f64| (-value).exp();
    for seen in everywhere(&plain(&field), &settings(), &Cotangents::random(5, 16, 16)) {
        if let Some((loss, ..)) = seen.loss {
            let error = relative(m(loss), m(double.loss.mean));
            worst(6, Column::of(seen.path), Way::Forward, "M_y", error, 1e-5);
        }
    }
    agrees(6, "2600 layers", &field, &settings());
}

#[test]
fn row_7_the_last_contributor_keeps_its_responsibility() {
    // One Gaussian, one label: r = 1 at every pixel, and nothing behind it may take anything from it:
    // dL/dh = -(1 - pi), to the last bits.
    let mut field = one();
    field.gaussians.log_scales[0] = [5.0; 3];
    for occupancy in [0.02_f32, 0.3, 0.9] {
        field.gaussians.occupancy_logits[0] = logit(occupancy);
        let weight = Cotangents::random(5, 16, 16).instance_weight;
        let expected = -(1.0 - f64::from(sigmoid(field.gaussians.occupancy_logits[0]))) * weight;
        let relative = |v: f64| (v / expected - 1.0).abs();
        let (_, double) = run::<f64>(&field, &settings());
        worst(
            7,
            Column::F64,
            Way::Backward,
            "one Gaussian",
            relative(double.parameters.gaussians[0].occupancy_logit),
            1e-6,
        );
        for seen in everywhere(&plain(&field), &settings(), &Cotangents::random(5, 16, 16)) {
            let v = seen.gradient(OCCUPANCY_LOGITS, 0);
            worst(7, Column::of(seen.path), Way::Backward, "one Gaussian", relative(v), 2e-6);
        }
    }
}

#[test]
fn row_33_coincident_splats_blend_in_index_order_everywhere() {
    let mut field = generate(&SyntheticConfig { gaussians: 4, instances: 2, ..Default::default() }).field;
    for i in 0..4 {
        field.gaussians.means[i] = [0.02, 0.01, 2.0];
        field.gaussians.log_scales[i] = [-1.0; 3];
    }
    let (double, _) = run::<f64>(&field, &settings());
    assert_eq!(double.order, [0, 1, 2, 3]);
    // Moving one changes the order: there are no differences to compare with.
    let camera = plain_camera(16, 16, 20.0);
    let what = "four coincident splats";
    all_agree(33, what, &errors(what, &field, &settings(), (&camera, 0.5), false));
    // The other order is another image, or this could not fail.
    let reversed = field.gather(&[3, 2, 1, 0]);
    let (other, _) = run::<f64>(&reversed, &settings());
    let apart = |a: &[f64; 3], b: &[f64; 3]| (a[0] - b[0]).abs();
    assert!(double.color.pixels.iter().zip(&other.color.pixels).any(|(a, b)| apart(a, b) > 1e-3));
}

#[test]
fn row_43_fog_does_not_change_whose_a_gaussian_is() {
    let synthetic = generate(&SyntheticConfig { gaussians: 12, instances: 3, ..Default::default() });
    let count = |field: &Field| {
        let n = field.gaussians.len();
        let (camera, labels, settings) = (&synthetic.camera, &synthetic.labels, RenderSettings::default());
        let mut counts = vec![IdentityCounts::zeros(n, 3)];
        let scene = Scene::<f64>::from_field(field);
        reference::count_identities(&scene, camera, 0.0, &settings, labels, &mut counts[0]);
        for simd in SimdLevel::available() {
            let mut of_level = IdentityCounts::zeros(n, 3);
            Renderer::new(simd).count_identities(field, camera, 0.0, &settings, labels, &mut of_level);
            counts.push(of_level);
        }
        counts
    };
    let clear = count(&synthetic.field);
    let mut foggy = synthetic.field.gather(&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 0]);
    foggy.gaussians.opacity_logits[12] = logit(1e-4);
    foggy.gaussians.log_scales[12] = [5.0; 3];
    for (clear, foggy) in clear.iter().zip(&count(&foggy)) {
        for row in 0..12 {
            assert_eq!(clear.row(row), foggy.row(row));
            assert_eq!(clear.total_mass(row).to_bits(), foggy.total_mass(row).to_bits());
        }
        assert_eq!(foggy.total_mass(12), 0.0);
    }
}

/// A splat of a given shape and place.
fn splat_of<R: Real>(factor: [R; 3], mean2d: [R; 2]) -> Splat2d<R> {
    let gaussian = &Scene::<R>::from_field(&one()).parameters.gaussians[0];
    let view = View::from_camera(&plain_camera(16, 16, 20.0));
    let splat = project(gaussian, &view, &settings()).expect("it is drawn");
    Splat2d { factor, mean2d, ..splat }
}

proptest! {
    /// Row 12: P never exceeds 1, so a weight never exceeds its strength; and it keeps its digits.
    #[test]
    fn row_12_footprints_never_exceed_one(
        angle in 0.0..std::f64::consts::PI,
        condition in 1.0_f64..1e6,
        along in -2.0_f64..2.0,
        across in -3.0_f64..3.0,
    ) {
        // A needle of up to 548 px (standard deviation), and a pixel that many standard deviations from its centre.
        let (s, c) = angle.sin_cos();
        let (long, short) = (0.3 * condition, 0.3_f64);
        let c11 = long * s * s + short * c * c;
        let l00 = (c11 / (long * short)).sqrt();
        let factor = [l00, -l00 * (long - short) * s * c / c11, c11.sqrt().recip()];
        let (along, across) = (along * long.sqrt(), across * short.sqrt());
        let mean = [3.5 + along * c - across * s, 9.5 + along * s + across * c].map(|v| v as f32);
        let double = splat_of::<f64>(factor, mean.map(f64::from));
        let single = splat_of::<f32>(factor.map(|v| v as f32), mean);
        let (double, single) = (footprint(&double, [3, 9]).peak, footprint(&single, [3, 9]).peak);
        prop_assert!(single <= 1.0);
        // Four roundings of u, which is at most 1.8 per pixel; P changes by 0.61 per standard deviation at most.
        let limit = 4.0 * f64::from(f32::EPSILON) * 1.8 * along.hypot(across) * 0.61 + 1e-6;
        prop_assert!((f64::from(single) - double).abs() < limit, "{single} {double} {limit:e}");
    }

    /// Poison in any parameter either renders cleanly or culls the Gaussian.
    #[test]
    fn poison_never_spreads(
        parameter in 0_usize..6,
        index in 0_usize..48,
        poison in prop::sample::select(vec![
            f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, 1e-40, 0.0, 1e20, -1e20, 100.0, -100.0,
        ]),
        antialiased in any::<bool>(),
    ) {
        let mut field = one();
        let gaussians = &mut field.gaussians;
        match parameter {
            0 => gaussians.means[0][index % 3] = poison,
            1 => gaussians.log_scales[0][index % 3] = poison,
            2 => gaussians.quaternions[0][index % 4] = poison,
            3 => gaussians.opacity_logits[0] = poison,
            4 => gaussians.occupancy_logits[0] = poison,
            _ => gaussians.sh_coefficients[0][index] = poison,
        }
        let settings = RenderSettings { antialiased, ..settings() };
        let double = run::<f64>(&field, &settings);
        let single = run::<f32>(&field, &settings);
        // A colour of 1e20 is drawn as asked; its gradient by the direction may overflow single precision.
        if parameter != 5 || poison.abs() < 1e19 {
            assert_finite("poison", &single);
            assert_finite("poison", &double);
        }
    }
}

/// Shape of a fuzzed Gaussian.
#[derive(Clone, Copy, Debug)]
enum Shape {
    Needle,
    Pancake,
    Pixel,
    Wide,
}

fn shapes() -> impl Strategy<Value = Shape> {
    prop::sample::select(vec![Shape::Needle, Shape::Pancake, Shape::Pixel, Shape::Wide])
}

/// Strengths at and next to every threshold, and at both ends.
fn strengths() -> impl Strategy<Value = f32> {
    prop::sample::select(vec![
        0.0,
        1e-30,
        0.003_92,
        1.0 / 255.0,
        0.003_93,
        0.02,
        0.5,
        0.989_9,
        0.99,
        0.990_1,
        0.999_999,
        1.0,
    ])
}

/// A fuzzed Gaussian: place, strengths, shape, scale of its quaternion.
type Fuzzed = ([f32; 3], f32, f32, Shape, f32);

fn fuzzed() -> impl Strategy<Value = Fuzzed> {
    // Depths that tie, at the near plane and behind the camera; centres on tile edges (16 px are 1.6 m at z = 2).
    let depth = prop::sample::select(vec![-2.0_f32, 0.0, 0.199_99, 0.2, 0.200_01, 1.0, 2.0, 2.0, 2.0, 50.0]);
    let place = prop::sample::select(vec![-3.0_f32, -0.8, -0.05, 0.0, 0.3, 0.8, 1.6]);
    let quaternion = prop::sample::select(vec![0.0_f32, 1e-7, 1e-3, 1.0, 1e3]);
    (
        (place.clone(), place, depth).prop_map(|(x, y, z)| [x, y, z]),
        strengths(),
        strengths(),
        shapes(),
        quaternion,
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    /// Whatever meets in a view, also of one pixel and with the longest table of instances: everything is finite in
    /// every renderer, and all draw the same.
    #[test]
    fn edges_of_every_kind_render_alike(
        gaussians in prop::collection::vec(fuzzed(), 0..6),
        size in prop::sample::select(vec![(1_u32, 1_u32), (16, 16), (17, 15), (33, 1), (5, 40)]),
        instances in prop::sample::select(vec![1_usize, 2, 65_535]),
        antialiased in any::<bool>(),
    ) {
        let config = SyntheticConfig { gaussians: gaussians.len(), instances, ..SyntheticConfig::default() };
        let mut field = generate(&config).field;
        for (row, (mean, opacity, occupancy, shape, norm)) in gaussians.iter().enumerate() {
            let g = &mut field.gaussians;
            g.means[row] = *mean;
            g.opacity_logits[row] = logit(f64::from(*opacity)).clamp(-100.0, 100.0) as f32;
            g.occupancy_logits[row] = logit(f64::from(*occupancy)).clamp(-100.0, 100.0) as f32;
            g.log_scales[row] = match shape {
                Shape::Needle => [-0.5, -7.0, -7.0],
                Shape::Pancake => [-1.0, -1.0, -9.0],
                Shape::Pixel => [-6.0; 3],
                Shape::Wide => [1.0, 0.5, 0.0],
            };
            g.quaternions[row] = g.quaternions[row].map(|c| c * norm);
        }
        let settings = RenderSettings { antialiased, ..settings() };
        assert_finite("f64", &run::<f64>(&field, &settings));
        let camera = plain_camera(size.0, size.1, 20.0);
        for (column, [forward, _]) in errors("fuzz", &field, &settings, (&camera, 0.5), false).of {
            prop_assert!(forward < 2e-4, "colours of {:?} differ by {}", column, forward);
        }
    }
}

#[test]
fn strengths_beside_the_least_weight_are_drawn_or_not() {
    let config = SyntheticConfig { gaussians: 1, instances: 1, ..SyntheticConfig::default() };
    let mut field = generate(&config).field;
    // On the centre of a pixel, where its weight is its strength.
    field.gaussians.means[0] = [-0.05, -0.05, 2.0];
    field.gaussians.occupancy_logits[0] = logit(0.001) as f32;
    let camera = plain_camera(16, 16, 20.0);
    for ulps in -3..=3 {
        let least = logit(1.0 / 255.0) as f32;
        field.gaussians.opacity_logits[0] = f32::from_bits(least.to_bits().wrapping_add_signed(ulps));
        for (column, [forward, _]) in errors("least", &field, &settings(), (&camera, 0.5), false).of {
            assert!(forward < 2e-4, "{ulps}: colours of {column:?} differ by {forward}");
        }
    }
}

#[test]
fn logits_of_the_cap_are_stable() {
    // Extreme logits saturate to 0 and 1 without NaN in either precision.
    for value in [-200.0_f32, 200.0, f32::NEG_INFINITY, f32::INFINITY] {
        assert!(sigmoid(value).is_finite() && sigmoid(f64::from(value)).is_finite());
    }
}
