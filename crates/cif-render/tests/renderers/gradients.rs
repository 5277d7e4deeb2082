//! Analytic gradients of the reference against central differences in double precision, through the full chain
//! from every parameter to pixels and losses; and the single-precision instantiation against the double one.
//!
//! Differences are taken where the loss is smooth. Skipped, because a scene near them is replaced by the next
//! seed: the blending order, ReLU at 0, plane nodes, the clamps of log-scales, Jacobian and colour, the floor of
//! the antialiasing factor, the weights 1/255 and 0.99, the stop at transmittance 1e-4, and the floor of the
//! label probability. Both sides of them are tested in `hard_cases.rs`.

use crate::support::{Case, Mismatches, check_gradients, compare_with_differences};
use cif_field::parameters::{
    LOG_CALIBRATIONS, LOG_SCALES, MEANS, OCCUPANCY_LOGITS, OPACITY_LOGITS, Parameter, QUATERNIONS,
    SH_COEFFICIENTS,
};
use cif_field::{Heads, SortMetric};
use cif_render::reference::cross_entropy::instance_loss;
use cif_render::reference::rasterize::rasterize;
use cif_render::reference::{InstanceTarget, Scene};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig};
use cif_render::{GeometryPath, InstanceNormalisation, InstanceSettings, OccupancySource, RenderSettings};

const NO_HEADS: Heads = Heads { position: false, scale: false, rotation: false, opacity: false, sh: false };

fn settings() -> RenderSettings {
    RenderSettings {
        background: [0.2, 0.5, 0.9],
        instances: Some(InstanceSettings::default()),
        ..RenderSettings::default()
    }
}

fn with_instances(instances: InstanceSettings) -> RenderSettings {
    RenderSettings { instances: Some(instances), ..settings() }
}

#[test]
fn one_gaussian() {
    let config = SyntheticConfig { gaussians: 1, width: 16, height: 16, ..SyntheticConfig::default() };
    check_gradients("one Gaussian", &Case::clear(config, settings(), |_| {}));
}

#[test]
fn static_scene() {
    check_gradients("static", &Case::clear(SyntheticConfig::default(), settings(), |_| {}));
}

#[test]
fn many_overlapping_gaussians() {
    let config = SyntheticConfig {
        gaussians: 20,
        width: 48,
        height: 32,
        screen_size: (0.1, 0.3),
        ..SyntheticConfig::default()
    };
    check_gradients("many", &Case::clear(config, settings(), |_| {}));
}

#[test]
fn odd_size() {
    let config = SyntheticConfig { width: 17, height: 33, instances: 5, ..SyntheticConfig::default() };
    check_gradients("17 x 33", &Case::clear(config, settings(), |_| {}));
}

#[test]
fn colour_only() {
    let settings = RenderSettings { instances: None, ..settings() };
    let case = Case::clear(SyntheticConfig { instances: 0, ..SyntheticConfig::default() }, settings, |_| {});
    check_gradients("colour only", &case);
    assert_eq!(case.forward.loss.mean, 0.0);
}

#[test]
fn antialiased() {
    let settings = RenderSettings { antialiased: true, ..settings() };
    // Small footprints, so that the factor is far from 1.
    let config = SyntheticConfig { screen_size: (0.02, 0.08), ..SyntheticConfig::default() };
    let case = Case::clear(config, settings, |_| {});
    check_gradients("antialiased", &case);
}

#[test]
fn another_low_pass() {
    let settings = RenderSettings { low_pass: 0.1, ..settings() };
    let case = Case::clear(SyntheticConfig::default(), settings, |_| {});
    check_gradients("another low pass", &case);
}

#[test]
fn lower_harmonics_degrees() {
    for sh_degree in 0..3 {
        let settings = RenderSettings { sh_degree, ..settings() };
        let config = SyntheticConfig { gaussians: 4, width: 16, height: 16, ..SyntheticConfig::default() };
        check_gradients(&format!("degree {sh_degree}"), &Case::clear(config, settings, |_| {}));
    }
}

#[test]
fn sorted_by_distance() {
    let settings = RenderSettings { sort_metric: SortMetric::Distance, ..settings() };
    check_gradients("distance", &Case::clear(SyntheticConfig::default(), settings, |_| {}));
}

#[test]
fn clamped_jacobian() {
    // Wide Gaussians far outside the field of view, whose tails reach into the image.
    let case = Case::clear(SyntheticConfig::default(), settings(), |scene| {
        let world_from_camera = scene.camera.camera_from_world.inverse();
        for (index, (x, y)) in [(2.0, 0.1), (-0.2, -1.9), (1.8, 2.1)].into_iter().enumerate() {
            let limit = 0.5 * glam::DVec2::new(32.0, 24.0) / scene.camera.focal_px;
            let z = 2.5 + 0.3 * index as f64;
            let point = glam::DVec3::new(x * limit.x * z, y * limit.y * z, z);
            scene.field.gaussians.means[index] = world_from_camera.apply(point).as_vec3().to_array();
            scene.field.gaussians.log_scales[index] = [-0.3, -0.1, -0.6];
            scene.field.gaussians.opacity_logits[index] = 1.0;
        }
    });
    let clamped = case.forward.deformed[..3].iter().zip(&case.forward.splats).filter(|(deformed, splat)| {
        let view = &case.forward.view;
        let point = view.to_camera(deformed.gaussian.mean);
        let outside = |axis: usize| {
            let (low, high) = view.ratio_limits(axis);
            !(low..=high).contains(&(point[axis] / point[2]))
        };
        splat.is_some() && (outside(0) || outside(1))
    });
    assert_eq!(clamped.count(), 3, "the case must exercise the clamp");
    check_gradients("clamped Jacobian", &case);
}

#[test]
fn clamped_colour() {
    let case = Case::clear(SyntheticConfig::default(), settings(), |scene| {
        for (index, sh) in scene.field.gaussians.sh_coefficients.iter_mut().enumerate() {
            sh[index % 3] = -2.5;
        }
    });
    let clamped = case.forward.splats.iter().flatten().flat_map(|splat| splat.color_clamped);
    assert!(clamped.filter(|clamped| *clamped).count() >= 4, "the case must exercise the clamp");
    check_gradients("clamped colour", &case);
}

#[test]
fn saturated_weights_and_stopped_pixels() {
    let config = SyntheticConfig { gaussians: 12, screen_size: (0.15, 0.4), ..SyntheticConfig::default() };
    let case = Case::clear(config, settings(), |scene| {
        for index in 0..12 {
            scene.field.gaussians.opacity_logits[index] = 5.5;
            scene.field.gaussians.occupancy_logits[index] = 6.0;
        }
    });
    let stopped = case.forward.pixels.pixels.iter().filter(|state| state.transmittance < 2e-4).count();
    assert!(stopped > 0, "the case must exercise the stop");
    check_gradients("saturated", &case);
}

#[test]
fn coverage_normalisation() {
    let instances =
        InstanceSettings { normalisation: InstanceNormalisation::Coverage, ..InstanceSettings::default() };
    let case = Case::clear(SyntheticConfig::default(), with_instances(instances), |_| {});
    check_gradients("coverage", &case);
}

#[test]
fn opacity_as_occupancy() {
    for antialiased in [false, true] {
        let instances =
            InstanceSettings { occupancy: OccupancySource::Opacity, ..InstanceSettings::default() };
        let settings = RenderSettings { antialiased, ..with_instances(instances) };
        let config = SyntheticConfig { screen_size: (0.04, 0.15), ..SyntheticConfig::default() };
        let case = Case::clear(config, settings, |_| {});
        check_gradients("opacity as occupancy", &case);
        let gradients = case.cotangents.backward(&case.scene, &case.forward);
        assert!(gradients.parameters.gaussians.iter().all(|v| v.occupancy_logit == 0.0));
    }
}

/// Geometry that the instance loss may or may not reach.
const GEOMETRY: [Parameter; 3] = [MEANS, LOG_SCALES, QUATERNIONS];

/// Groups that the geometry switch leaves alone.
const OTHERS: [Parameter; 4] = [OPACITY_LOGITS, OCCUPANCY_LOGITS, SH_COEFFICIENTS, LOG_CALIBRATIONS];

#[test]
fn instance_loss_without_geometry() {
    let instances = InstanceSettings { geometry: GeometryPath::Off, ..InstanceSettings::default() };
    let case = Case::clear(SyntheticConfig::default(), with_instances(instances), |_| {});
    let analytic = case.cotangents.backward(&case.scene, &case.forward).parameters;
    let mut mismatches = Mismatches::default();
    let image = |scene: &Scene<f64>| case.cotangents.image_loss(&case.render(scene));
    compare_with_differences(&case.scene, &GEOMETRY, &analytic, image, &mut mismatches);
    let whole = |scene: &Scene<f64>| case.cotangents.loss(&case.render(scene));
    compare_with_differences(&case.scene, &OTHERS, &analytic, whole, &mut mismatches);
    mismatches.finish("no geometry");
}

#[test]
fn instance_loss_to_means_only() {
    // The loss moves projected centres; footprints are constants of the instance pass.
    let instances = InstanceSettings { geometry: GeometryPath::MeansOnly, ..InstanceSettings::default() };
    let case = Case::clear(SyntheticConfig::default(), with_instances(instances), |_| {});
    let analytic = case.cotangents.backward(&case.scene, &case.forward).parameters;
    let loss = |scene: &Scene<f64>| {
        let forward = case.render(scene);
        let mut splats = forward.splats.clone();
        for (splat, frozen) in splats.iter_mut().zip(&case.forward.splats) {
            if let (Some(splat), Some(frozen)) = (splat, frozen) {
                splat.factor = frozen.factor;
            }
        }
        let target = InstanceTarget {
            labels: &case.synthetic.labels,
            identities: forward.identities.as_ref().unwrap(),
            normalisation: InstanceNormalisation::None,
        };
        let view = &forward.view;
        let pixels = rasterize(&splats, &forward.order, view.width, view.height, Some(&target));
        let instances = instance_loss(&pixels, &target).mean;
        case.cotangents.image_loss(&forward) + case.cotangents.instance_weight * instances
    };
    let mut mismatches = Mismatches::default();
    compare_with_differences(&case.scene, &GEOMETRY, &analytic, loss, &mut mismatches);
    compare_with_differences(&case.scene, &OTHERS, &analytic, loss, &mut mismatches);
    mismatches.finish("means only");
}

#[test]
fn deformed_with_all_heads() {
    let config = SyntheticConfig {
        gaussians: 6,
        width: 24,
        height: 20,
        heads: Some(ALL_HEADS),
        ..SyntheticConfig::default()
    };
    let case = Case::clear(config, settings(), |_| {});
    let clamped = case
        .forward
        .deformed
        .iter()
        .filter_map(|d| d.tape.as_ref())
        .any(|tape| tape.taps[0].iter().any(|tap| tap.column_clamped));
    assert!(clamped, "some lookup must be clamped to the box");
    check_gradients("all heads", &case);
}

#[test]
fn deformed_with_each_head() {
    let heads = [
        Heads { position: true, ..NO_HEADS },
        Heads { scale: true, ..NO_HEADS },
        Heads { rotation: true, ..NO_HEADS },
        Heads { opacity: true, ..NO_HEADS },
        Heads { sh: true, ..NO_HEADS },
    ];
    for heads in heads {
        let config = SyntheticConfig {
            gaussians: 3,
            width: 16,
            height: 16,
            heads: Some(heads),
            ..SyntheticConfig::default()
        };
        let case = Case::clear(config, settings(), |_| {});
        check_gradients(&format!("{heads:?}"), &case);
    }
}

#[test]
fn deformation_switched_off() {
    let settings = RenderSettings { deform: false, ..settings() };
    let config = SyntheticConfig { gaussians: 4, heads: Some(ALL_HEADS), ..SyntheticConfig::default() };
    let case = Case::clear(config, settings, |_| {});
    check_gradients("deformation off", &case);
    let gradients = case.cotangents.backward(&case.scene, &case.forward).parameters;
    assert!(gradients.planes.iter().chain(&gradients.mlp).all(|v| *v == 0.0));
}

#[test]
#[should_panic(expected = "disagree")]
fn the_harness_notices_a_wrong_gradient() {
    let case =
        Case::clear(SyntheticConfig { gaussians: 2, ..SyntheticConfig::default() }, settings(), |_| {});
    let mut analytic = case.cotangents.backward(&case.scene, &case.forward).parameters;
    let visible = case.forward.order[0] as usize;
    analytic.gaussians[visible].log_scale[1] *= 1.0 + 1e-5;
    let loss = |scene: &Scene<f64>| case.cotangents.loss(&case.render(scene));
    let mut mismatches = Mismatches::default();
    compare_with_differences(&case.scene, &[LOG_SCALES], &analytic, loss, &mut mismatches);
    mismatches.finish("perturbed on purpose");
}
