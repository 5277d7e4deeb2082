//! A training view through every renderer against the reference in double precision: colour, loss and gradients.
//!
//! The tests are declared once, in [`suite`]; a renderer has all of them by one line at the end of this file.
//!
//! Pixels where some weight or transmittance meets a threshold (1/255, 0.99, 1e-4) to within a relative 1e-3
//! form the boundary band: the two precisions may decide differently there. They take part in the comparison of
//! images with the tolerance that one decision can cost, and not in gradients (no cotangent, no label).

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use cif_field::parameters::TABLE;
use cif_render::reference::rasterize::{footprint, weight};
use cif_render::reference::{Forward, Scene, SceneGradients};
use cif_render::synthetic::{SyntheticConfig, SyntheticScene, generate};
use cif_render::{Channels, InstanceSettings, RenderSettings};

use crate::renderers::{Path, RenderView, Seen};
use crate::support::{Cotangents, Mismatches, Worst, pixel_discontinuity, render};

/// Relative width of the boundary band: above the rounding of a weight in single precision.
pub(crate) const BAND: f64 = 1e-3;

/// Largest change of a pixel by one decision at a threshold: 1/255 of the largest colour here (about 3).
pub(crate) const ONE_DECISION: f64 = 0.013;

pub(crate) const CHANNELS: Channels = Channels { depth: true, instances: true };

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
    /// As [`Self::of`], computed for the first of the renderers that are compared with it.
    fn once(
        name: &str,
        config: &SyntheticConfig,
        settings: &RenderSettings,
        edit: impl Fn(&mut SyntheticScene),
    ) -> Arc<Self> {
        type Known = BTreeMap<String, Arc<OnceLock<Arc<Expected>>>>;
        static KNOWN: Mutex<Known> = Mutex::new(Known::new());
        let key = format!("{name} {config:?} {settings:?}");
        let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
        let one = known.entry(key).or_default().clone();
        drop(known);
        one.get_or_init(|| Arc::new(Self::of(name, config, settings, edit))).clone()
    }

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
    renderer: RenderView,
    name: &str,
    config: &SyntheticConfig,
    settings: &RenderSettings,
    edit: impl Fn(&mut SyntheticScene),
) {
    check_within(renderer, Tolerances::of, name, config, settings, edit);
}

/// Colour, loss and gradients of a training view through a renderer.
fn check_within(
    renderer: RenderView,
    tolerances: impl Fn(Path) -> Tolerances,
    name: &str,
    config: &SyntheticConfig,
    settings: &RenderSettings,
    edit: impl Fn(&mut SyntheticScene),
) {
    let expected = Expected::once(name, config, settings, edit);
    for actual in renderer(&expected.synthetic, settings, &expected.cotangents) {
        let name = format!("{name}, {:?}", actual.path);
        let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
        expected.compare(&actual, tolerances(actual.path), &mut mismatches, &mut worst);
        worst.report(&name);
        mismatches.finish(&name);
    }
}

/// Tests of a training view.
mod suite {
    use cif_field::{Heads, SortMetric};
    use cif_render::synthetic::{ALL_HEADS, SyntheticConfig};
    use cif_render::{
        GeometryPath, InstanceNormalisation, InstanceSettings, OccupancySource, RenderSettings,
    };

    use super::{Tolerances, check, check_within, config, settings};
    use crate::renderers::RenderView;

    pub(super) fn static_scene(renderer: RenderView) {
        check(renderer, "static", &config(), &settings(), |_| {});
    }

    pub(super) fn deformed_scene(renderer: RenderView) {
        let config = SyntheticConfig { heads: Some(ALL_HEADS), ..config() };
        check(renderer, "deformed", &config, &settings(), |_| {});
        check(renderer, "not deformed", &config, &RenderSettings { deform: false, ..settings() }, |_| {});
        let heads = Heads { opacity: false, sh: false, ..ALL_HEADS };
        check(
            renderer,
            "three heads",
            &SyntheticConfig { heads: Some(heads), ..config },
            &settings(),
            |_| {},
        );
    }

    pub(super) fn colour_only(renderer: RenderView) {
        let settings = RenderSettings { instances: None, ..settings() };
        check(renderer, "colour only", &SyntheticConfig { instances: 0, ..config() }, &settings, |_| {});
        check(renderer, "colour only, identities unused", &config(), &settings, |_| {});
    }

    pub(super) fn every_image_setting(renderer: RenderView) {
        check(
            renderer,
            "antialiased",
            &config(),
            &RenderSettings { antialiased: true, ..settings() },
            |_| {},
        );
        check(
            renderer,
            "another low pass",
            &config(),
            &RenderSettings { low_pass: 0.05, ..settings() },
            |_| {},
        );
        let by_distance = RenderSettings { sort_metric: SortMetric::Distance, ..settings() };
        check(renderer, "distance", &config(), &by_distance, |_| {});
        for sh_degree in 0..3 {
            check(renderer, "degree", &config(), &RenderSettings { sh_degree, ..settings() }, |_| {});
        }
    }

    pub(super) fn every_instance_setting(renderer: RenderView) {
        for normalisation in [InstanceNormalisation::None, InstanceNormalisation::Coverage] {
            for geometry in [GeometryPath::Full, GeometryPath::MeansOnly, GeometryPath::Off] {
                for occupancy in [OccupancySource::Own, OccupancySource::Opacity] {
                    let instances = InstanceSettings { occupancy, geometry, normalisation };
                    let settings = RenderSettings { instances: Some(instances), ..settings() };
                    check(renderer, &format!("{instances:?}"), &config(), &settings, |_| {});
                }
            }
        }
    }

    pub(super) fn few_and_many_instances(renderer: RenderView) {
        for instances in [1, 2, 9, 40, 300] {
            let config = SyntheticConfig { instances, ..config() };
            check(renderer, &format!("K = {instances}"), &config, &settings(), |scene| {
                // Labels that change at every pixel: far more than 8 in a tile.
                for (position, label) in scene.labels.pixels.iter_mut().enumerate() {
                    *label = (position * 7 % (instances + 1)) as u16;
                }
            });
        }
    }

    pub(super) fn large_saturated_gaussians_and_stops(renderer: RenderView) {
        let config = SyntheticConfig { gaussians: 60, screen_size: (0.1, 0.5), ..config() };
        check(renderer, "saturated", &config, &settings(), |scene| {
            scene.field.gaussians.opacity_logits.fill(5.5);
            scene.field.gaussians.occupancy_logits.fill(6.0);
        });
    }

    pub(super) fn faint_but_occupied_gaussians_are_not_cut(renderer: RenderView) {
        // The extent must follow max(o, pi).
        check(renderer, "faint colour", &config(), &settings(), |scene| {
            scene.field.gaussians.opacity_logits.iter_mut().step_by(2).for_each(|logit| *logit = -7.0);
        });
        check(renderer, "faint occupancy", &config(), &settings(), |scene| {
            scene.field.gaussians.occupancy_logits.iter_mut().step_by(2).for_each(|logit| *logit = -7.0);
        });
    }

    pub(super) fn needles(renderer: RenderView) {
        // 40 times as long as wide on screen: the gradient of the covariance, X V X, loses the square of that ratio
        // in single precision. Worst seen 0.8 %, and 0.6 % in the single-precision reference.
        let tolerances = |path| Tolerances { gradient: 2e-2, ..Tolerances::of(path) };
        check_within(renderer, tolerances, "needles", &config(), &settings(), |scene| {
            for log_scale in scene.field.gaussians.log_scales.iter_mut().step_by(5) {
                *log_scale = [log_scale[0] + 1.5, -9.0, -9.0];
            }
        });
    }

    pub(super) fn clamps_of_projection(renderer: RenderView) {
        check(renderer, "clamps", &config(), &settings(), |scene| {
            let gaussians = &mut scene.field.gaussians;
            // Colour below 0 on one channel, and centres outside the field of view whose tails reach in.
            gaussians.sh_coefficients.iter_mut().step_by(3).for_each(|sh| sh[1] = -2.5);
            let world_from_camera = scene.camera.camera_from_world.inverse();
            for index in 0..20 {
                let angle = f64::from(index) * 0.314 + 0.1;
                let point = glam::DVec3::new(1.9 * angle.cos(), 1.6 * angle.sin(), 1.0)
                    * (2.5 + 0.05 * f64::from(index));
                gaussians.means[index as usize] = world_from_camera.apply(point).as_vec3().to_array();
                gaussians.log_scales[index as usize] = [0.2, 0.0, -0.4];
            }
        });
    }

    /// Rows of identities longer than the eight entries that the GPU sums side by side.
    pub(super) fn long_identity_rows(renderer: RenderView) {
        let config = SyntheticConfig { instances: 21, ..config() };
        check(renderer, "long rows", &config, &settings(), |scene| {
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
    pub(super) fn antialiased_opacity_as_occupancy(renderer: RenderView) {
        let instances =
            InstanceSettings { occupancy: OccupancySource::Opacity, ..InstanceSettings::default() };
        let settings = RenderSettings { antialiased: true, instances: Some(instances), ..settings() };
        check(renderer, "antialiased, opacity as occupancy", &config(), &settings, |_| {});
    }

    pub(super) fn gaussians_that_stand_still(renderer: RenderView) {
        let config = SyntheticConfig { heads: Some(ALL_HEADS), ..config() };
        for every in [1, 2, 7] {
            check(renderer, &format!("every {every}th stands still"), &config, &settings(), |scene| {
                let n = scene.field.len();
                let deformation = scene.field.deformation.as_mut().unwrap();
                deformation.still = (0..n).map(|row| row % every == 0).collect();
            });
        }
    }

    pub(super) fn odd_images(renderer: RenderView) {
        for (width, height) in [(17, 33), (15, 2), (130, 3), (16, 16)] {
            let config =
                SyntheticConfig { width, height, gaussians: 20, screen_size: (0.1, 0.5), ..config() };
            check(renderer, &format!("{width} x {height}"), &config, &settings(), |_| {});
        }
    }
}

/// All tests of [`suite`] for a renderer.
macro_rules! view_suite {
    ($module:ident, $renderer:path) => {
        mod $module {
            crate::support::tests_of!(
                $renderer;
                static_scene,
                deformed_scene,
                colour_only,
                every_image_setting,
                every_instance_setting,
                few_and_many_instances,
                large_saturated_gaussians_and_stops,
                faint_but_occupied_gaussians_are_not_cut,
                needles,
                clamps_of_projection,
                long_identity_rows,
                antialiased_opacity_as_occupancy,
                gaussians_that_stand_still,
                odd_images,
            );
        }
    };
}

view_suite!(reference, crate::renderers::on_reference);
view_suite!(processor, crate::renderers::on_processor);
#[cfg(feature = "wgpu")]
view_suite!(gpu, crate::renderers::on_gpu);
