//! Finite differences on the `f64` reference, away from its discontinuities.

use cif_field::parameters::{Parameter, TABLE};
use std::collections::BTreeMap;

use cif_geometry::{PinholeCamera, PixelGrid, Real, spherical_harmonics};
use cif_render::RenderSettings;
use cif_render::constants::{
    LOG_SCALE_RANGE, MAX_ALPHA, MIN_ALPHA, MIN_LABEL_PROBABILITY, MIN_TRANSMITTANCE,
};
use cif_render::reference::rasterize::{footprint, weight};
use cif_render::reference::{self, Forward, Parameters, Scene};
use cif_render::synthetic::{SyntheticConfig, SyntheticScene, generate};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Gradients of the pixel outputs, and the weight of the instance loss.
#[derive(Clone, Debug)]
pub(crate) struct Cotangents {
    pub(crate) color: PixelGrid<[f64; 3]>,
    pub(crate) depth: Option<PixelGrid<f64>>,
    pub(crate) alpha: Option<PixelGrid<f64>>,
    pub(crate) instance_weight: f64,
}

impl Cotangents {
    /// Uniform noise with about unit norm per image.
    pub(crate) fn random(seed: u64, width: u32, height: u32) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0x5eed);
        let size = 1.0 / f64::from(width * height).sqrt();
        let mut color = PixelGrid::filled(width, height, [0.0; 3]);
        let mut depth = PixelGrid::filled(width, height, 0.0);
        let mut alpha = PixelGrid::filled(width, height, 0.0);
        for value in color.pixels.iter_mut().flatten().chain(&mut depth.pixels).chain(&mut alpha.pixels) {
            // Exact in f32 too, so that both precisions differentiate the same loss.
            *value = f64::from(random.random_range(-size..size) as f32);
        }
        Self { color, depth: Some(depth), alpha: Some(alpha), instance_weight: 0.75 }
    }

    pub(crate) fn backward<R: Real>(
        &self,
        scene: &Scene<R>,
        forward: &Forward<R>,
    ) -> reference::SceneGradients<R> {
        let of = |grid: &PixelGrid<f64>| grid.map(|value| R::of(*value));
        reference::backward(
            scene,
            forward,
            &self.color.map(|color| color.map(R::of)),
            self.depth.as_ref().map(of).as_ref(),
            self.alpha.as_ref().map(of).as_ref(),
            R::of(self.instance_weight),
        )
    }

    /// The loss whose gradient [`Self::backward`] is.
    pub(crate) fn loss(&self, forward: &Forward<f64>) -> f64 {
        self.image_loss(forward) + self.instance_weight * forward.loss.mean
    }

    pub(crate) fn image_loss(&self, forward: &Forward<f64>) -> f64 {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let mut loss = dot(self.color.pixels.as_flattened(), forward.color.pixels.as_flattened());
        loss += self.depth.as_ref().map_or(0.0, |v| dot(&v.pixels, &forward.depth.pixels));
        loss + self.alpha.as_ref().map_or(0.0, |v| dot(&v.pixels, &forward.alpha.pixels))
    }
}

/// A scene with its view, its forward pass in double precision and random cotangents.
pub(crate) struct Case {
    pub(crate) synthetic: SyntheticScene,
    pub(crate) settings: RenderSettings,
    pub(crate) scene: Scene<f64>,
    pub(crate) forward: Forward<f64>,
    pub(crate) cotangents: Cotangents,
}

impl Case {
    pub(crate) fn of(synthetic: SyntheticScene, settings: RenderSettings) -> Self {
        let scene = Scene::from_field(&synthetic.field);
        let forward = render(&scene, &synthetic, &settings);
        let (width, height) = (synthetic.camera.width, synthetic.camera.height);
        let cotangents = Cotangents::random(7, width, height);
        Self { synthetic, settings, scene, forward, cotangents }
    }

    /// The first scene from `config.seed` on that keeps clear of every discontinuity; `edit` adapts it.
    pub(crate) fn clear(
        config: SyntheticConfig,
        settings: RenderSettings,
        edit: impl Fn(&mut SyntheticScene),
    ) -> Self {
        let mut rejected = Vec::new();
        for seed in config.seed..config.seed + 400 {
            let mut synthetic = generate(&SyntheticConfig { seed, ..config });
            edit(&mut synthetic);
            let case = Self::of(synthetic, settings);
            match nearest_discontinuity(&case) {
                None => return case,
                Some(name) => rejected.push(name),
            }
        }
        panic!("no scene is clear of discontinuities; rejected for: {rejected:?}");
    }

    pub(crate) fn render(&self, scene: &Scene<f64>) -> Forward<f64> {
        render(scene, &self.synthetic, &self.settings)
    }
}

pub(crate) fn render<R: Real>(
    scene: &Scene<R>,
    synthetic: &SyntheticScene,
    settings: &RenderSettings,
) -> Forward<R> {
    let labels = settings.instances.map(|_| &synthetic.labels);
    reference::forward(scene, &synthetic.camera, synthetic.time, settings, labels)
}

/// The discontinuity, in value or slope, that a perturbation of about 1e-5 might cross; the only ones skipped.
fn nearest_discontinuity(case: &Case) -> Option<&'static str> {
    let forward = &case.forward;
    if order_is_close(forward) {
        return Some("blending order");
    }
    for deformed in &forward.deformed {
        let Some(tape) = &deformed.tape else { continue };
        let kinks = tape.trunk.iter().chain(tape.hidden.iter().flatten());
        if kinks.into_iter().any(|value| value.abs() < 1e-5) {
            return Some("ReLU at 0");
        }
        let near_node = |fraction: f64, clamped: bool| !clamped && !(1e-4..1.0 - 1e-4).contains(&fraction);
        if tape.taps.iter().flatten().any(|tap| {
            near_node(tap.column_fraction, tap.column_clamped) || near_node(tap.row_fraction, tap.row_clamped)
        }) {
            return Some("plane node");
        }
    }
    for (deformed, splat) in forward.deformed.iter().zip(&forward.splats) {
        if let Some(splat) = splat
            && let Some(name) = near_projection_discontinuity(case, &deformed.gaussian, splat)
        {
            return Some(name);
        }
    }
    near_pixel_discontinuity(forward)
}

fn order_is_close(forward: &Forward<f64>) -> bool {
    let keys: Vec<f64> =
        forward.order.iter().filter_map(|i| Some(forward.splats[*i as usize].as_ref()?.sort_key)).collect();
    keys.windows(2).any(|pair| pair[1] - pair[0] < 1e-3)
}

fn near_projection_discontinuity(
    case: &Case,
    gaussian: &reference::Gaussian<f64>,
    splat: &reference::Splat2d<f64>,
) -> Option<&'static str> {
    let (view, settings) = (&case.forward.view, &case.settings);
    let (low, high) = (f64::from(LOG_SCALE_RANGE.0), f64::from(LOG_SCALE_RANGE.1));
    if gaussian.log_scale.iter().any(|s| (s - low).abs() < 1e-3 || (s - high).abs() < 1e-3) {
        return Some("log-scale clamp");
    }
    let point = view.to_camera(gaussian.mean);
    for axis in 0..2 {
        let (low, high) = view.ratio_limits(axis);
        let ratio = point[axis] / point[2];
        if (ratio - low).abs() < 1e-3 || (ratio - high).abs() < 1e-3 {
            return Some("Jacobian clamp");
        }
    }
    let offset: [f64; 3] = std::array::from_fn(|k| gaussian.mean[k] - view.centre[k]);
    let distance = offset.iter().map(|v| v * v).sum::<f64>().sqrt();
    let basis = spherical_harmonics::basis(offset.map(|v| v / distance), settings.sh_degree);
    for channel in 0..3 {
        let color = 0.5 + (0..16).map(|m| basis[m] * gaussian.sh[m * 3 + channel]).sum::<f64>();
        if color.abs() < 1e-3 {
            return Some("colour clamp");
        }
    }
    let rho = splat.opacity / cif_geometry::scalar::sigmoid(gaussian.opacity_logit);
    (settings.antialiased && rho < 0.006).then_some("antialiasing floor")
}

fn near_pixel_discontinuity(forward: &Forward<f64>) -> Option<&'static str> {
    (0..forward.pixels.pixels.len()).find_map(|position| pixel_discontinuity(forward, position, 5e-4))
}

/// The threshold that a weight or a transmittance of a pixel meets to within a relative `margin`, if any.
pub(crate) fn pixel_discontinuity(
    forward: &Forward<f64>,
    position: usize,
    margin: f64,
) -> Option<&'static str> {
    let near = |value: f64, threshold: f32| (value / f64::from(threshold)).ln().abs() < margin;
    let state = &forward.pixels.pixels[position];
    let pixel = [position as u32 % forward.pixels.width, position as u32 / forward.pixels.width];
    let label = forward.labels.as_ref().map_or(0, |labels| labels.pixels[position]);
    if label != 0 && near(state.label_probability, MIN_LABEL_PROBABILITY) {
        return Some("label probability floor");
    }
    for instance in [false, true] {
        let mut transmittance = 1.0;
        for &index in &forward.order {
            let Some(splat) = &forward.splats[index as usize] else { continue };
            let footprint = footprint(splat, pixel);
            let strength = if instance { splat.occupancy } else { splat.opacity };
            if near(strength * footprint.peak, MIN_ALPHA) {
                return Some("weight 1/255");
            }
            if near(strength * footprint.peak, MAX_ALPHA) {
                return Some("weight 0.99");
            }
            let Some(weight) = weight(strength, footprint.peak) else { continue };
            transmittance *= 1.0 - weight.value;
            if near(transmittance, MIN_TRANSMITTANCE) {
                return Some("transmittance 1e-4");
            }
            if transmittance < f64::from(MIN_TRANSMITTANCE) {
                break;
            }
        }
    }
    None
}

/// Half the distance of the two evaluations, in units of the parameter (all are of order one here).
pub(crate) const STEP: f64 = 1e-6;

/// `|analytic - numerical| <= RELATIVE * max(|analytic|, |numerical|) + ABSOLUTE`. The absolute part is the
/// rounding of the loss (order 1) over twice the step, times the few dozen roundings that add up in it.
pub(crate) const RELATIVE: f64 = 1e-6;
/// See [`RELATIVE`].
pub(crate) const ABSOLUTE: f64 = 5e-9;

/// Worst differences by quantity, printed at the end of a test.
#[derive(Default)]
pub(crate) struct Worst(BTreeMap<String, f64>);

impl Worst {
    pub(crate) fn see(&mut self, what: &str, difference: f64) {
        match self.0.get_mut(what) {
            Some(worst) => *worst = worst.max(difference),
            None => drop(self.0.insert(what.to_owned(), difference)),
        }
    }

    pub(crate) fn report(&self, name: &str) {
        for (what, worst) in &self.0 {
            println!("{name}: worst {what} {worst:.1e}");
        }
    }
}

/// Rows that disagree, as a table.
#[derive(Default)]
pub(crate) struct Mismatches {
    rows: Vec<String>,
    compared: usize,
    nonzero: usize,
}

impl Mismatches {
    pub(crate) fn compare(
        &mut self,
        what: &str,
        index: usize,
        expected: f64,
        actual: f64,
        relative: f64,
        absolute: f64,
    ) {
        self.compared += 1;
        self.nonzero += usize::from(expected != 0.0);
        let tolerance = relative * expected.abs().max(actual.abs()) + absolute;
        let difference = (expected - actual).abs();
        // A NaN must not pass.
        if difference.is_nan() || difference > tolerance {
            self.rows.push(format!(
                "{what:>20} {index:>6} {expected:>20.12e} {actual:>20.12e} {tolerance:>10.1e}"
            ));
        }
    }

    /// # Panics
    /// With the table, unless everything agreed; and when hardly anything but zeros was compared.
    pub(crate) fn finish(self, name: &str) {
        println!("{name}: {} of {} compared values are not zero", self.nonzero, self.compared);
        assert!(20 * self.nonzero > self.compared, "{name}: {} of {} not zero", self.nonzero, self.compared);
        let shown: Vec<&str> = self.rows.iter().take(40).map(String::as_str).collect();
        assert!(
            self.rows.is_empty(),
            "{name}: {} of {} disagree\n{:>20} {:>6} {:>20} {:>20} {:>10}\n{}",
            self.rows.len(),
            self.compared,
            "parameter",
            "index",
            "expected",
            "actual",
            "tolerance",
            shown.join("\n")
        );
    }
}

/// Compares `analytic` with central differences of `loss` for every scalar of `parameters`.
pub(crate) fn compare_with_differences(
    scene: &Scene<f64>,
    parameters: &[Parameter],
    analytic: &Parameters<f64>,
    loss: impl Fn(&Scene<f64>) -> f64,
    mismatches: &mut Mismatches,
) {
    let mut perturbed = scene.clone();
    for &parameter in parameters {
        for index in 0..scene.parameters.len(parameter) {
            let value = scene.parameters.get(parameter, index);
            let mut at = |offset: f64| {
                *perturbed.parameters.get_mut(parameter, index) = value + offset;
                loss(&perturbed)
            };
            // The step that is really taken, after rounding.
            let numerical = (at(STEP) - at(-STEP)) / ((value + STEP) - (value - STEP));
            *perturbed.parameters.get_mut(parameter, index) = value;
            let analytic = analytic.get(parameter, index);
            mismatches.compare(parameter.name, index, numerical, analytic, RELATIVE, ABSOLUTE);
        }
    }
}

/// The radial component of a raw quaternion's gradient must vanish: only the direction matters.
pub(crate) fn compare_radial(scene: &Scene<f64>, analytic: &Parameters<f64>, mismatches: &mut Mismatches) {
    for (index, (gaussian, v)) in scene.parameters.gaussians.iter().zip(&analytic.gaussians).enumerate() {
        if scene.deformation.is_none() {
            let radial: f64 = (0..4).map(|k| gaussian.quaternion[k] * v.quaternion[k]).sum();
            mismatches.compare("radial quaternion", index, 0.0, radial, 0.0, 1e-12);
        }
    }
}

/// Compares the `f32` instantiation with `f64` on the same field.
pub(crate) fn compare_precisions(case: &Case, expected: &Parameters<f64>, mismatches: &mut Mismatches) {
    let scene = Scene::<f32>::from_field(&case.synthetic.field);
    let forward = render(&scene, &case.synthetic, &case.settings);
    let single = case.cotangents.backward(&scene, &forward).parameters;
    for parameter in TABLE {
        for index in 0..expected.len(parameter) {
            let (expected, actual) =
                (expected.get(parameter, index), f64::from(single.get(parameter, index)));
            mismatches.compare(&format!("{} f32", parameter.name), index, expected, actual, 1e-3, 2e-6);
        }
    }
}

/// Every parameter against differences of the whole loss, then the other precision.
pub(crate) fn check_gradients(name: &str, case: &Case) {
    let analytic = case.cotangents.backward(&case.scene, &case.forward).parameters;
    let mut mismatches = Mismatches::default();
    compare_radial(&case.scene, &analytic, &mut mismatches);
    let loss = |scene: &Scene<f64>| case.cotangents.loss(&case.render(scene));
    compare_with_differences(&case.scene, &TABLE, &analytic, loss, &mut mismatches);
    compare_precisions(case, &analytic, &mut mismatches);
    mismatches.finish(name);
}

/// A camera without rotation at the origin, looking along +z.
pub(crate) fn plain_camera(width: u32, height: u32, focal_px: f64) -> PinholeCamera {
    PinholeCamera {
        width,
        height,
        focal_px: glam::DVec2::splat(focal_px),
        principal_px: glam::DVec2::new(f64::from(width), f64::from(height)) / 2.0,
        camera_from_world: cif_geometry::RigidTransform::IDENTITY,
    }
}

/// Makes tests of the functions of the module `suite` next to this one, which take a renderer.
macro_rules! tests_of {
    ($renderer:path; $($test:ident),+ $(,)?) => {
        $(
            #[test]
            fn $test() {
                super::suite::$test($renderer);
            }
        )+
    };
}
pub(crate) use tests_of;
