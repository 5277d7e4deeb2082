//! Numerically hard cases of rendering, in both precisions; numbers are rows of methods reference 7.

mod common;

use cif_field::Field;
use cif_geometry::scalar::{logit, sigmoid};
use cif_geometry::{PixelGrid, Real};
use cif_render::reference::project::{project, project_backward};
use cif_render::reference::rasterize::{footprint, weight};
use cif_render::reference::{self, Forward, Scene, SceneGradients, SplatGradient, View};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, generate};
use cif_render::{InstanceSettings, RenderSettings};
use common::{Cotangents, plain_camera};
use proptest::prelude::*;

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
    for group in reference::ParameterGroup::ALL {
        for index in 0..gradients.parameters.len(group) {
            let v = gradients.parameters.get(group, index);
            assert!(v.is_finite(), "{name}: {group:?} {index} is {v}");
        }
    }
}

/// Renders in both precisions and asserts that everything is finite; returns the double one.
fn finite(name: &str, field: &Field, settings: &RenderSettings) -> (Forward<f64>, SceneGradients<f64>) {
    assert_finite(name, &run::<f32>(field, settings));
    let double = run::<f64>(field, settings);
    assert_finite(name, &double);
    double
}

#[test]
fn row_8_transmittance_is_never_divided() {
    // The replay forms the same products in the same order: ends of the lists prove it bit for bit.
    let synthetic = generate(&SyntheticConfig { gaussians: 20, ..SyntheticConfig::default() });
    let scene = Scene::<f32>::from_field(&synthetic.field);
    let forward = common::render(&scene, &synthetic, &settings());
    for (position, state) in forward.pixels.pixels.iter().enumerate() {
        let pixel = [position as u32 % 32, position as u32 / 32];
        let mut transmittance = 1.0_f32;
        for &index in &forward.order[..state.end] {
            let Some(splat) = &forward.splats[index as usize] else { continue };
            let Some(footprint) = footprint(splat, pixel) else { continue };
            let Some(alpha) = weight(splat.opacity, footprint.peak) else { continue };
            transmittance *= 1.0 - alpha.value;
        }
        assert_eq!(transmittance, state.transmittance);
    }
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
    assert!((transmittance - 0.011).abs() < 1e-6);
    assert!(v.opacity != 0.0 && v.color[0] > 0.98);
    let (transmittance, v) = at(0.991);
    assert!((transmittance - 0.01).abs() < 1e-7, "{transmittance}");
    assert_eq!((v.opacity, v.mean2d, v.conic), (0.0, [0.0; 2], [0.0; 3]));
    assert!((v.color[0] - 0.99).abs() < 1e-6, "colour still flows, with the capped weight");
}

#[test]
fn row_10_weights_below_one_step_are_not_drawn() {
    assert!(weight(1.0 / 255.0 - 1e-6, 1.0_f64).is_none());
    assert!(weight(1.0 / 255.0 + 1e-6, 1.0_f64).is_some());
    assert!(weight(f64::NAN, 1.0).is_none());
    // Row 36: far tails vanish by the same gate, whatever the processor does with denormals.
    assert!(weight(1.0_f32, (-90.0_f32).exp()).is_none());
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
        // det X = 1 / det C. Through X01^2 - X00 X11 it would cancel, so compare X itself.
        for k in 0..3 {
            let (a, b) = (f64::from(single.conic[k]), double.conic[k]);
            assert!((a - b).abs() < 1e-5 * b.abs(), "focal {focal}, entry {k}: {a} {b}");
        }
    }
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
        let single = common::render(&Scene::<f32>::from_field(&synthetic.field), &synthetic, &settings());
        let double = common::render(&Scene::<f64>::from_field(&synthetic.field), &synthetic, &settings());
        assert_eq!(single.order, double.order);
        let mut differences: Vec<f64> = (0..single.color.pixels.len())
            .map(|position| {
                (f64::from(single.color.pixels[position][1]) - double.color.pixels[position][1]).abs()
            })
            .collect();
        differences.sort_by(f64::total_cmp);
        // Not the maximum: single pixels may lie on a threshold.
        let high = differences[differences.len() * 99 / 100];
        assert!(high < 1e-4, "growth {growth}: {high}");
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
    let forward = common::render(&double, &scene, &settings());
    assert!(forward.deformed[0].gaussian.log_scale[0] > 10.0);
    let gradients = Cotangents::random(1, 32, 24).backward(&double, &forward);
    assert_finite("spike", &(forward, gradients.clone()));
    assert!(gradients.parameters.gaussians.iter().all(|v| v.log_scale[0] == 0.0));
    assert!(gradients.parameters.gaussians.iter().any(|v| v.log_scale[1] != 0.0));
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
    let forward = common::render(&double, &scene, &settings());
    let gradients = Cotangents::random(1, 32, 24).backward(&double, &forward);
    assert_finite("zero plane", &(forward, gradients.clone()));
    let planes = &gradients.parameters.planes;
    assert!(planes[range.clone()].iter().any(|v| *v != 0.0));
    let others = (0..layout[5].offset).filter(|node| !range.contains(node));
    assert!(others.into_iter().all(|node| planes[node] == 0.0), "the product of the others is 0");
}

#[test]
fn row_22_lookup_at_the_last_node() {
    let mut scene = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..SyntheticConfig::default() });
    let bounds = scene.field.deformation.as_ref().unwrap().bounds;
    scene.field.gaussians.means[0] = bounds.high.as_vec3().to_array();
    scene.field.gaussians.means[1] = (bounds.high + 1.0).as_vec3().to_array();
    scene.time = 1.0;
    let double = Scene::<f64>::from_field(&scene.field);
    let forward = common::render(&double, &scene, &settings());
    let (corner, outside) = (&forward.deformed[0], &forward.deformed[1]);
    let (corner, outside) = (corner.tape.as_ref().unwrap(), outside.tape.as_ref().unwrap());
    for (a, b) in corner.features.iter().zip(&outside.features) {
        assert!((a - b).abs() < 1e-5, "{a} {b}");
    }
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
}

proptest! {
    /// Row 12: P never exceeds 1, so a weight never exceeds its strength.
    #[test]
    fn row_12_footprints_never_exceed_one(
        angle in 0.0..std::f32::consts::PI,
        condition in 1.0_f32..1e6,
        x in -2000.0_f32..2000.0,
        y in -2000.0_f32..2000.0,
    ) {
        let (s, c) = angle.sin_cos();
        let (a, b) = (1.0 / 0.3_f32, 1.0 / (0.3 * condition));
        let conic = [a * c * c + b * s * s, (a - b) * s * c, a * s * s + b * c * c];
        let camera = plain_camera(16, 16, 20.0);
        let field = one();
        let gaussian = &Scene::<f32>::from_field(&field).parameters.gaussians[0];
        let mut splat = project(gaussian, &View::from_camera(&camera), &settings()).unwrap();
        splat.conic = conic;
        splat.mean2d = [x, y];
        if let Some(footprint) = footprint(&splat, [3, 9]) {
            prop_assert!(footprint.peak <= 1.0);
        }
    }

    /// Poison in any parameter either renders cleanly or culls the Gaussian.
    #[test]
    fn poison_never_spreads(
        group in 0_usize..6,
        index in 0_usize..48,
        poison in prop::sample::select(vec![
            f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, 1e-40, 0.0, 1e20, -1e20, 100.0, -100.0,
        ]),
        antialiased in any::<bool>(),
    ) {
        let mut field = one();
        let gaussians = &mut field.gaussians;
        match group {
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
        if group != 5 || poison.abs() < 1e19 {
            assert_finite("poison", &single);
            assert_finite("poison", &double);
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
