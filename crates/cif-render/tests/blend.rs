//! C values per Gaussian, blended and differentiated: the reference against central differences in double precision,
//! then the fast path and the GPU against the reference.
//!
//! Differences are taken where the loss is smooth, see `gradients.rs` for what is skipped. Pixels in the boundary band,
//! see `agreement.rs`, carry no gradient and are not compared.

mod common;

use cif_render::reference::blend::{blend, blend_backward};
use cif_render::reference::{Forward, ParameterGroup, Scene, splats_backward};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene};
use cif_render::{
    BlendRequest, BlendedImage, Blending, GeometryPath, InstanceSettings, OccupancySource, RenderSettings,
};
use common::{Case, Mismatches, compare_with_differences};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const BOTH: [Blending; 2] = [Blending::Color, Blending::Own];

fn settings() -> RenderSettings {
    RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() }
}

/// Uniform noise below a magnitude, exact in single precision too.
fn noise(seed: u64, count: usize, magnitude: f64) -> Vec<f64> {
    let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0xb1e4d);
    (0..count).map(|_| f64::from((magnitude * random.random_range(-1.0..1.0)) as f32)).collect()
}

/// Values of every Gaussian and a gradient by every blended one, so that the loss is of order 1.
struct Head {
    channels: usize,
    blending: Blending,
    /// `[N, C]`.
    values: Vec<f64>,
    /// `[height, width, C]`.
    v_blended: Vec<f64>,
}

impl Head {
    /// With values below a magnitude.
    fn new(scene: &SyntheticScene, channels: usize, blending: Blending, magnitude: f64) -> Self {
        let pixels = (scene.camera.width * scene.camera.height) as usize;
        let share = 1.0 / ((pixels * channels) as f64).sqrt() / magnitude;
        Self {
            channels,
            blending,
            values: noise(1, scene.field.len() * channels, magnitude),
            v_blended: noise(2, pixels * channels, share),
        }
    }

    fn request<'a, R>(&self, values: &'a [R]) -> BlendRequest<'a, [R]> {
        BlendRequest { values, channels: self.channels, blending: self.blending }
    }

    fn blend(&self, forward: &Forward<f64>, values: &[f64]) -> BlendedImage<f64> {
        let view = &forward.view;
        blend(&forward.splats, &forward.order, view.width, view.height, &self.request(values))
    }

    fn loss(&self, forward: &Forward<f64>, values: &[f64]) -> f64 {
        self.blend(forward, values).values.iter().zip(&self.v_blended).map(|(b, v)| b * v).sum()
    }
}

/// As [`check_paths`], through the weights to all geometry.
fn check(name: &str, case: &Case, channels: usize, magnitude: f64) {
    check_paths(name, case, channels, magnitude, &[GeometryPath::Full]);
}

/// Gradients by the values and, through the weights, by every parameter, against differences.
fn check_paths(name: &str, case: &Case, channels: usize, magnitude: f64, paths: &[GeometryPath]) {
    for blending in BOTH {
        let head = Head::new(&case.synthetic, channels, blending, magnitude);
        let (forward, view) = (&case.forward, &case.forward.view);
        let backward = |weights| {
            let request = head.request(&head.values);
            blend_backward(&forward.splats, &forward.order, view.width, &request, &head.v_blended, weights)
        };
        let frozen = backward(None);
        assert!(frozen.splats.is_empty(), "nothing goes through the weights unless it is asked for");
        let mut mismatches = Mismatches::default();
        let mut values = head.values.clone();
        for (index, analytic) in frozen.values.iter().enumerate() {
            // The loss is linear in the values.
            let mut at = |offset: f64| {
                values[index] = head.values[index] + offset;
                head.loss(forward, &values)
            };
            let numerical = (at(magnitude) - at(-magnitude)) / (2.0 * magnitude);
            values[index] = head.values[index];
            let (numerical, analytic) = (numerical * magnitude, analytic * magnitude);
            mismatches.compare("values", index, numerical, analytic, 1e-9, 1e-13);
        }
        for &geometry in paths {
            let gradients = backward(Some(geometry));
            assert_eq!(gradients.values, frozen.values);
            let (analytic, _) = splats_backward(&case.scene, forward, &gradients.splats);
            let loss = |scene: &Scene<f64>| {
                let mut forward = case.render(scene);
                for (splat, fixed) in forward.splats.iter_mut().zip(&case.forward.splats) {
                    let (Some(splat), Some(fixed)) = (splat, fixed) else { continue };
                    if geometry != GeometryPath::Full {
                        splat.factor = fixed.factor;
                    }
                    if geometry == GeometryPath::Off {
                        splat.mean2d = fixed.mean2d;
                    }
                }
                head.loss(&forward, &head.values)
            };
            compare_with_differences(&case.scene, &ParameterGroup::ALL, &analytic, loss, &mut mismatches);
        }
        mismatches.finish(&format!("{name}, C = {channels}, {blending:?}"));
    }
}

#[test]
fn one_gaussian() {
    let config = SyntheticConfig { gaussians: 1, width: 16, height: 16, ..SyntheticConfig::default() };
    check("one Gaussian", &Case::clear(config, settings(), |_| {}), 3, 1.0);
}

#[test]
fn few_and_many_channels() {
    let config = SyntheticConfig { gaussians: 5, width: 19, height: 17, ..SyntheticConfig::default() };
    let case = Case::clear(config, settings(), |_| {});
    for channels in [1, 3, 16, 100] {
        check("channels", &case, channels, 1.0);
    }
}

#[test]
fn every_path_through_the_weights() {
    let case = Case::clear(SyntheticConfig::default(), settings(), |_| {});
    let paths = [GeometryPath::Full, GeometryPath::MeansOnly, GeometryPath::Off];
    check_paths("paths", &case, 3, 1.0, &paths);
}

#[test]
fn pixels_that_nothing_covers() {
    let config = SyntheticConfig { gaussians: 4, screen_size: (0.03, 0.06), ..SyntheticConfig::default() };
    let case = Case::clear(config, settings(), |_| {});
    let empty = case.forward.pixels.pixels.iter().filter(|state| state.end == 0).count();
    assert!(empty > 100, "the case must have pixels that nothing covers");
    let head = Head::new(&case.synthetic, 3, Blending::Color, 1.0);
    let image = head.blend(&case.forward, &head.values);
    for (state, blended) in case.forward.pixels.pixels.iter().zip(image.pixels()) {
        assert_eq!(state.end == 0, blended == [0.0; 3]);
    }
    check("small", &case, 3, 1.0);
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
    check("saturated", &case, 3, 1.0);
}

#[test]
fn values_of_any_size() {
    let config = SyntheticConfig { gaussians: 6, width: 24, height: 20, ..SyntheticConfig::default() };
    let case = Case::clear(config, settings(), |_| {});
    for magnitude in [1e-20, 1e20] {
        check("values of any size", &case, 3, magnitude);
    }
}

#[test]
fn opacity_as_occupancy() {
    let instances = InstanceSettings { occupancy: OccupancySource::Opacity, ..InstanceSettings::default() };
    let settings = RenderSettings { instances: Some(instances), ..settings() };
    check("opacity as occupancy", &Case::clear(SyntheticConfig::default(), settings, |_| {}), 3, 1.0);
}

#[test]
fn deformed() {
    let config = SyntheticConfig {
        gaussians: 4,
        width: 16,
        height: 16,
        heads: Some(ALL_HEADS),
        ..SyntheticConfig::default()
    };
    check("deformed", &Case::clear(config, settings(), |_| {}), 3, 1.0);
}

/// The blended 1 is coverage, and blended colour is colour.
#[test]
fn known_values() {
    let case = Case::clear(SyntheticConfig::default(), settings(), |_| {});
    let colors: Vec<f64> = (case.forward.splats.iter())
        .flat_map(|splat| splat.as_ref().map_or([0.0; 4], |s| [s.color[0], s.color[1], s.color[2], 1.0]))
        .collect();
    let head = Head::new(&case.synthetic, 4, Blending::Color, 1.0);
    let image = head.blend(&case.forward, &colors);
    let mut mismatches = Mismatches::default();
    for (position, (state, blended)) in case.forward.pixels.pixels.iter().zip(image.pixels()).enumerate() {
        for channel in 0..3 {
            mismatches.compare("colour", position, state.color[channel], blended[channel], 1e-14, 1e-15);
        }
        mismatches.compare("coverage", position, 1.0 - state.transmittance, blended[3], 1e-14, 1e-15);
    }
    mismatches.finish("known values");
}
