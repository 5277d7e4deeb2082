//! C values per Gaussian, blended and differentiated: the reference against central differences in double precision,
//! then the fast path and the GPU against the reference.
//!
//! Differences are taken where the loss is smooth, see `gradients.rs` for what is skipped. Pixels in the boundary
//! band, see `views.rs`, carry no gradient and are not compared.

use cif_field::parameters::{Parameter, TABLE};
use cif_geometry::PixelGrid;
use cif_render::cpu::{
    BlendWeightGradients, ContributorMass, ContributorRule, IdentityCounts, Renderer, SimdLevel,
};
use cif_render::reference::Parameters;
use cif_render::reference::blend::{blend, blend_backward};
use cif_render::reference::{Forward, Scene, splats_backward};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use cif_render::{
    BlendRequest, BlendedImage, Blending, GeometryPath, Gradients, InstanceSettings, OccupancySource,
    RenderSettings,
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::renderers::fast_gradient;
use crate::support::{Case, Mismatches, compare_with_differences, pixel_discontinuity, render};
use crate::views;

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
            compare_with_differences(&case.scene, &TABLE, &analytic, loss, &mut mismatches);
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

/// Relative width of the boundary band: above the rounding of a weight in single precision.
const BAND: f64 = 1e-3;

/// Results of the reference for a head, with gradients by pixels away from the boundary band.
struct Expected {
    scene: SyntheticScene,
    head: Head,
    band: Vec<bool>,
    image: BlendedImage<f64>,
    /// By the values, `[N, C]`, and by the parameters through the weights, for each path.
    v_values: Vec<f64>,
    parameters: Vec<(GeometryPath, Parameters<f64>)>,
}

fn expected(
    config: &SyntheticConfig,
    settings: RenderSettings,
    channels: usize,
    blending: Blending,
    paths: &[GeometryPath],
    edit: impl Fn(&mut SyntheticScene),
) -> Expected {
    let mut synthetic = generate(config);
    edit(&mut synthetic);
    let scene = Scene::<f64>::from_field(&synthetic.field);
    let forward = render(&scene, &synthetic, &settings);
    let mut head = Head::new(&synthetic, channels, blending, 1.0);
    let band: Vec<bool> = (0..forward.pixels.pixels.len())
        .map(|position| pixel_discontinuity(&forward, position, BAND).is_some())
        .collect();
    let near = band.iter().filter(|near| **near).count();
    assert!(2 * near < band.len(), "{near} of {} pixels lie in the boundary band", band.len());
    for (v_pixel, near) in head.v_blended.chunks_exact_mut(channels).zip(&band) {
        if *near {
            v_pixel.fill(0.0);
        }
    }
    let image = head.blend(&forward, &head.values);
    let backward = |weights| {
        let (request, width) = (head.request(&head.values), forward.view.width);
        blend_backward(&forward.splats, &forward.order, width, &request, &head.v_blended, weights)
    };
    let v_values = backward(None).values;
    let parameters = (paths.iter())
        .map(|path| (*path, splats_backward(&scene, &forward, &backward(Some(*path)).splats).0))
        .collect();
    Expected { scene: synthetic, head, band, image, v_values, parameters }
}

fn single(values: &[f64]) -> Vec<f32> {
    values.iter().map(|value| *value as f32).collect()
}

impl Expected {
    fn compare_image(&self, actual: &[f32], tolerance: f64, mismatches: &mut Mismatches) {
        assert_eq!(actual.len(), self.image.values.len());
        for (index, (e, a)) in self.image.values.iter().zip(actual).enumerate() {
            if !self.band[index / self.head.channels] {
                mismatches.compare("blended", index, *e, f64::from(*a), 0.0, tolerance);
            }
        }
    }

    fn compare_values(&self, actual: &[f32], relative: f64, mismatches: &mut Mismatches) {
        assert_eq!(actual.len(), self.v_values.len());
        compare_scalars("values", &self.v_values, |index| f64::from(actual[index]), relative, mismatches);
    }
}

fn compare_scalars(
    name: &str,
    expected: &[f64],
    actual: impl Fn(usize) -> f64,
    relative: f64,
    mismatches: &mut Mismatches,
) {
    // Sums of terms of both signs are as exact as their largest term, not as their result.
    let largest = expected.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    for (index, e) in expected.iter().enumerate() {
        mismatches.compare(name, index, *e, actual(index), relative, 0.01 * relative * largest + 1e-12);
    }
}

/// Scalars of a parameter.
fn scalars_of(parameters: &Parameters<f64>, parameter: Parameter) -> Vec<f64> {
    (0..parameters.len(parameter)).map(|index| parameters.get(parameter, index)).collect()
}

const PATHS: [GeometryPath; 3] = [GeometryPath::Full, GeometryPath::MeansOnly, GeometryPath::Off];

fn check_fast_path(
    name: &str,
    config: &SyntheticConfig,
    settings: RenderSettings,
    channels: usize,
    edit: &dyn Fn(&mut SyntheticScene),
) {
    for blending in BOTH {
        let expected = expected(config, settings, channels, blending, &PATHS, edit);
        let (head, field) = (&expected.head, &expected.scene.field);
        let (values, v_blended) = (single(&head.values), single(&head.v_blended));
        let request = head.request(&values);
        for simd in SimdLevel::available() {
            let mut mismatches = Mismatches::default();
            let mut renderer = Renderer::new(simd);
            renderer.prepare(field, &expected.scene.camera, expected.scene.time, &settings);
            let blended = renderer.blend(&request);
            expected.compare_image(&blended.values, 2e-5, &mut mismatches);
            let mut listed = vec![f32::NAN; values.len()];
            for row in renderer.listed_rows() {
                let of_row = row as usize * channels..(row as usize + 1) * channels;
                listed[of_row.clone()].copy_from_slice(&values[of_row]);
            }
            let of_listed = renderer.blend(&head.request(&listed));
            assert_eq!(of_listed.values, blended.values, "others are not drawn");
            let mut frozen = vec![0.0; values.len()];
            renderer.blend_backward(&request, &v_blended, &mut frozen, None);
            expected.compare_values(&frozen, 1e-4, &mut mismatches);
            for (geometry, parameters) in &expected.parameters {
                let (mut v_values, mut gradients) = (vec![0.0; values.len()], Gradients::zeros(field));
                let weights = BlendWeightGradients {
                    field,
                    blended: &blended,
                    geometry: *geometry,
                    gradients: &mut gradients,
                };
                renderer.blend_backward(&request, &v_blended, &mut v_values, Some(weights));
                assert_eq!(v_values, frozen, "the weights do not change what the values get");
                for parameter in TABLE {
                    let expected = scalars_of(parameters, parameter);
                    let actual = |index| fast_gradient(&gradients, parameter, index);
                    let name = format!("{} {geometry:?}", parameter.name);
                    compare_scalars(&name, &expected, actual, 1e-3, &mut mismatches);
                }
            }
            mismatches.finish(&format!("{name}, C = {channels}, {blending:?}, {simd:?}"));
        }
    }
}

/// Compares what a renderer blends, and its gradients, with the reference: name of the case, scene, settings, channels,
/// and changes to the scene.
type Compare = fn(&str, &SyntheticConfig, RenderSettings, usize, &dyn Fn(&mut SyntheticScene));

/// Tests that every renderer has.
mod suite {
    use cif_render::synthetic::SyntheticConfig;
    use cif_render::{InstanceSettings, OccupancySource, RenderSettings};

    use super::{Compare, settings, views};

    pub(super) fn values_of_few_and_many_channels(compare: Compare) {
        for channels in [1, 3, 4, 16, 100, 101] {
            compare("static", &views::config(), settings(), channels, &|_| {});
        }
    }

    pub(super) fn weights_that_saturate_and_pixels_that_stop(compare: Compare) {
        let config = SyntheticConfig { gaussians: 60, screen_size: (0.05, 0.4), ..views::config() };
        compare("saturated", &config, settings(), 3, &|scene| {
            for row in 0..60 {
                scene.field.gaussians.opacity_logits[row] = if row % 2 == 0 { 7.0 } else { 1.0 };
                scene.field.gaussians.occupancy_logits[row] = if row % 3 == 0 { 7.0 } else { 0.0 };
            }
        });
    }

    pub(super) fn opacity_instead_of_occupancy(compare: Compare) {
        let instances =
            InstanceSettings { occupancy: OccupancySource::Opacity, ..InstanceSettings::default() };
        for antialiased in [false, true] {
            let settings = RenderSettings { antialiased, instances: Some(instances), ..settings() };
            compare("opacity as occupancy", &views::config(), settings, 3, &|_| {});
        }
    }
}

/// All tests of [`suite`] for a renderer.
macro_rules! blend_suite {
    ($module:ident, $compare:path) => {
        mod $module {
            crate::support::tests_of!(
                $compare;
                values_of_few_and_many_channels,
                weights_that_saturate_and_pixels_that_stop,
                opacity_instead_of_occupancy,
            );
        }
    };
}

blend_suite!(on_processor, super::check_fast_path);
#[cfg(feature = "wgpu")]
blend_suite!(on_gpu, super::gpu::check);

#[test]
fn fast_path_of_a_deformed_scene() {
    let config = SyntheticConfig { heads: Some(ALL_HEADS), ..views::config() };
    check_fast_path("deformed", &config, settings(), 5, &|_| {});
}

/// Blended image and gradients of a head, with so many threads and so much memory for a band.
fn head_on(
    threads: usize,
    memory: u64,
    scene: &SyntheticScene,
    head: &Head,
) -> (BlendedImage, Vec<f32>, Gradients) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started");
    let (values, v_blended) = (single(&head.values), single(&head.v_blended));
    pool.install(|| {
        let mut renderer = Renderer::new(SimdLevel::Auto);
        renderer.set_band_memory(memory);
        renderer.prepare(&scene.field, &scene.camera, scene.time, &settings());
        let blended = renderer.blend(&head.request(&values));
        let (mut v_values, mut gradients) = (vec![0.0; values.len()], Gradients::zeros(&scene.field));
        // Twice: gradients are added.
        for _ in 0..2 {
            let (field, geometry) = (&scene.field, GeometryPath::Full);
            let weights =
                BlendWeightGradients { field, blended: &blended, geometry, gradients: &mut gradients };
            renderer.blend_backward(&head.request(&values), &v_blended, &mut v_values, Some(weights));
        }
        (blended, v_values, gradients)
    })
}

#[test]
fn threads_and_memory_do_not_change_a_bit() {
    let scene = generate(&SyntheticConfig { gaussians: 3000, ..views::config() });
    for blending in BOTH {
        let head = Head::new(&scene, 7, blending, 1.0);
        let one = head_on(1, u64::MAX, &scene, &head);
        for (threads, memory) in [(2, u64::MAX), (3, 40_000), (8, 1)] {
            let other = head_on(threads, memory, &scene, &head);
            assert!(other == one, "{threads} threads and {memory} bytes differ, {blending:?}");
        }
        let mut other = scene.clone();
        other.field.gaussians.means[0][0] += 1e-3;
        assert!(head_on(1, u64::MAX, &other, &head) != one, "the comparison must be able to fail");
    }
}

/// After a training pass the same tile lists serve, and pictures have none for gradients.
#[test]
fn gradients_follow_a_forward_pass_and_not_a_picture() {
    let scene = generate(&views::config());
    let head = Head::new(&scene, 2, Blending::Own, 1.0);
    let (values, v_blended) = (single(&head.values), single(&head.v_blended));
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let [prepared, drawn] = [false, true].map(|draws| {
        if draws {
            renderer.forward(&scene.field, &scene.camera, scene.time, &settings(), Some(&scene.labels));
        } else {
            renderer.prepare(&scene.field, &scene.camera, scene.time, &settings());
        }
        let mut v_values = vec![0.0; values.len()];
        renderer.blend_backward(&head.request(&values), &v_blended, &mut v_values, None);
        v_values
    });
    assert!(prepared == drawn && prepared.iter().any(|v| *v != 0.0));
    renderer.render(&scene.field, &scene.camera, scene.time, &settings(), cif_render::Channels::default());
    let refused = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        renderer.blend_backward(&head.request(&values), &v_blended, &mut vec![0.0; values.len()], None);
    }));
    let message = *refused.unwrap_err().downcast::<&str>().unwrap();
    assert!(message.contains("prepared"), "{message}");
}

/// Products that are far from 1, but within the range of single precision, are no fault.
#[test]
fn large_and_small_values_stay_finite() {
    let scene = generate(&SyntheticConfig { gaussians: 60, screen_size: (0.05, 0.4), ..views::config() });
    for blending in BOTH {
        for (magnitude, v_magnitude) in [(1e-30, 1.0), (1e30, 1e-3), (1e10, 1e10)] {
            let mut head = Head::new(&scene, 3, blending, magnitude);
            head.v_blended = noise(2, head.v_blended.len(), v_magnitude);
            let (blended, v_values, gradients) = head_on(1, u64::MAX, &scene, &head);
            let through = [gradients.gaussians.means.as_flattened(), &gradients.gaussians.opacity_logits];
            let all = [&blended.values[..], &v_values, through[0], through[1]];
            assert!(all.iter().flat_map(|values| *values).all(|value| value.is_finite()), "{magnitude:e}");
            let largest = |values: &[f32]| values.iter().fold(0.0_f32, |most, value| most.max(value.abs()));
            assert!(largest(&blended.values) > 0.1 * magnitude as f32, "{magnitude:e}");
            assert!(largest(&v_values) > 0.1 * v_magnitude as f32, "{magnitude:e}");
        }
    }
}

#[test]
fn scenes_without_gaussians() {
    let scene = generate(&SyntheticConfig { gaussians: 0, instances: 0, ..views::config() });
    let head = Head::new(&scene, 4, Blending::Color, 1.0);
    let (blended, v_values, _) = head_on(1, u64::MAX, &scene, &head);
    assert!(v_values.is_empty() && blended.values == vec![0.0; 4 * 71 * 53]);
}

#[cfg(feature = "wgpu")]
mod gpu {
    use cif_field::parameters::{LOG_SCALES, MEANS, OCCUPANCY_LOGITS, OPACITY_LOGITS, QUATERNIONS};
    use cif_render::wgpu::{
        BlendWeightGradients, Commands, DeviceIdentities, Gpu, GpuError, GpuGaussians, GpuVec, Rasterizer,
        ViewInput,
    };

    use super::*;
    use crate::on_gpu::device;

    /// Everything that comes back of a head.
    #[derive(Debug, PartialEq)]
    struct Outcome {
        blended: Vec<f32>,
        v_values: Vec<f32>,
        /// Of the geometry of the Gaussians, through the weights.
        posed: Vec<[f32; 12]>,
    }

    /// Blends and differentiates a head on the device, as often as there are `paths`; gradients by the values add up.
    fn run(
        device: &mut (Gpu, Rasterizer),
        expected: &Expected,
        settings: &RenderSettings,
        paths: &[Option<GeometryPath>],
    ) -> Result<Outcome, GpuError> {
        let (gpu, rasterizer) = (&device.0, &mut device.1);
        let (scene, head) = (&expected.scene, &expected.head);
        let gaussians = GpuGaussians::upload(gpu, &scene.field.gaussians)?;
        let identities = scene.field.identities.as_ref().filter(|_| settings.instances.is_some());
        let identities = identities
            .map(|rows| DeviceIdentities::from_identities(gpu, rows, scene.field.instances.len()))
            .transpose()?;
        let input = ViewInput { camera: &scene.camera, settings, labels: None };
        let values = GpuVec::from_slice(gpu, "values", &single(&head.values))?;
        let v_blended = GpuVec::from_slice(gpu, "gradients of pixels", &single(&head.v_blended))?;
        let mut blended = GpuVec::zeros(gpu, "blended values", 0)?;
        let v_values = GpuVec::zeros(gpu, "gradients of values", values.len())?;
        let request = BlendRequest { values: &values, channels: head.channels, blending: head.blending };

        let mut commands = Commands::new(gpu, None);
        rasterizer.project(gpu, &mut commands, (&gaussians).into(), identities.as_ref(), &input)?;
        rasterizer.measure(gpu, commands)?;
        let mut commands = Commands::new(gpu, None);
        rasterizer.list_tiles(gpu, &mut commands, identities.as_ref())?;
        rasterizer.blend(gpu, &mut commands, &request, &mut blended)?;
        for path in paths {
            let weights = path.map(|geometry| BlendWeightGradients {
                gaussians: (&gaussians).into(),
                blended: &blended,
                geometry,
            });
            rasterizer.blend_backward(gpu, &mut commands, &request, &v_blended, &v_values, weights)?;
        }
        commands.submit();
        let through = paths.iter().any(Option::is_some);
        let posed = if through { rasterizer.gradients().gaussians.geometry.read(gpu)? } else { Vec::new() };
        Ok(Outcome { blended: blended.read(gpu)?, v_values: v_values.read(gpu)?, posed })
    }

    pub(super) fn check(
        name: &str,
        config: &SyntheticConfig,
        settings: RenderSettings,
        channels: usize,
        edit: &dyn Fn(&mut SyntheticScene),
    ) {
        let Some(mut device) = device() else { return };
        for blending in BOTH {
            let expected = expected(config, settings, channels, blending, &PATHS, edit);
            let mut mismatches = Mismatches::default();
            let frozen = run(&mut device, &expected, &settings, &[None]).expect("the view is drawn");
            expected.compare_image(&frozen.blended, 3e-5, &mut mismatches);
            expected.compare_values(&frozen.v_values, 1e-3, &mut mismatches);
            for (geometry, parameters) in &expected.parameters {
                let path = [Some(*geometry)];
                let actual = run(&mut device, &expected, &settings, &path).expect("the view is drawn");
                expected.compare_values(&actual.v_values, 1e-3, &mut mismatches);
                let places: [(Parameter, usize); 5] = [
                    (MEANS, 0),
                    (OPACITY_LOGITS, 3),
                    (LOG_SCALES, 4),
                    (OCCUPANCY_LOGITS, 7),
                    (QUATERNIONS, 8),
                ];
                for (parameter, first) in places {
                    let at = |index: usize| {
                        f64::from(actual.posed[index / parameter.width()][first + index % parameter.width()])
                    };
                    let name = format!("{} {geometry:?}", parameter.name);
                    compare_scalars(&name, &scalars_of(parameters, parameter), at, 2e-3, &mut mismatches);
                }
            }
            mismatches.finish(&format!("{name}, C = {channels}, {blending:?}"));
        }
    }

    #[test]
    fn gradients_add_up_and_two_runs_give_the_same_bits() {
        let Some(mut device) = device() else { return };
        let config = SyntheticConfig { gaussians: 3000, screen_size: (0.01, 0.03), ..views::config() };
        let expected = expected(&config, settings(), 6, Blending::Color, &[], |_| {});
        let both = [None, Some(GeometryPath::Full)];
        let twice = run(&mut device, &expected, &settings(), &both).unwrap();
        assert!(run(&mut device, &expected, &settings(), &both).unwrap() == twice);
        let once = run(&mut device, &expected, &settings(), &both[..1]).unwrap();
        let largest = once.v_values.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
        for (twice, once) in twice.v_values.iter().zip(&once.v_values) {
            assert!((twice - 2.0 * once).abs() <= 1e-6 * largest, "{twice} is not twice {once}");
        }
        assert!(largest > 0.0);
    }

    #[test]
    fn views_without_gaussians() {
        let Some(mut device) = device() else { return };
        let config = SyntheticConfig { gaussians: 0, instances: 0, ..views::config() };
        let expected = expected(&config, settings(), 5, Blending::Color, &[], |_| {});
        let settings = RenderSettings { instances: None, ..settings() };
        let outcome = run(&mut device, &expected, &settings, &[Some(GeometryPath::Full)]).unwrap();
        assert!(outcome.v_values.is_empty() && outcome.blended == vec![0.0; 5 * 71 * 53]);
    }
}

/// One-hot labels of a picture, and what a gradient of `share` by the channel of each pixel's label adds up to per
/// Gaussian: its blending weights on the label.
fn weights_on_labels(
    renderer: &mut Renderer,
    scene: &SyntheticScene,
    labels: &PixelGrid<u16>,
    share: impl Fn(usize) -> f32,
) -> Vec<f32> {
    let channels = scene.field.instances.len();
    let values = vec![0.0; scene.field.len() * channels];
    let mut v_blended = vec![0.0; labels.pixels.len() * channels];
    for (pixel, label) in labels.pixels.iter().enumerate().filter(|(_, label)| **label != 0) {
        v_blended[pixel * channels + usize::from(*label) - 1] = share(pixel);
    }
    let mut sums = vec![0.0; values.len()];
    let request = BlendRequest { values: &values[..], channels, blending: Blending::Color };
    renderer.prepare(&scene.field, &scene.camera, 0.3, &RenderSettings::default());
    renderer.blend_backward(&request, &v_blended, &mut sums, None);
    sums
}

#[test]
fn contributors_of_pixels_have_the_weights_that_blending_gives_them() {
    let scene = generate(&SyntheticConfig { gaussians: 200, ..SyntheticConfig::default() });
    let (n, k) = (scene.field.len(), scene.field.instances.len());
    let settings = RenderSettings::default();
    let labels = PixelGrid::from_pixels(
        scene.camera.width,
        scene.camera.height,
        (0..scene.camera.width * scene.camera.height)
            .map(|pixel| (pixel / 5 % (k as u32 + 1)) as u16)
            .collect(),
    );
    for level in SimdLevel::available() {
        let mut renderer = Renderer::new(level);
        let count = |renderer: &mut Renderer, rule: ContributorRule| {
            let mut counts = IdentityCounts::zeros(n, k);
            renderer.prepare(&scene.field, &scene.camera, 0.3, &settings);
            renderer.count_contributors(&labels, &rule, &mut counts);
            counts
        };
        let agree = |counts: &IdentityCounts, sums: &[f32]| {
            for row in 0..n {
                for label in 0..k {
                    let (a, b) = (counts.label_mass(row, label as u16), f64::from(sums[row * k + label]));
                    assert!((a - b).abs() < 1e-4 * b.max(1.0), "{level:?} {row} {label}: {a} and {b}");
                }
            }
        };
        // With all contributors: the counts of identities before they are divided by the coverage.
        let all = count(&mut renderer, ContributorRule::ALL);
        agree(&all, &weights_on_labels(&mut renderer, &scene, &labels, |_| 1.0));
        let rendered =
            renderer.render(&scene.field, &scene.camera, 0.3, &settings, cif_render::Channels::default());
        let mut identities = IdentityCounts::zeros(n, k);
        renderer.count_identities(&scene.field, &scene.camera, 0.3, &settings, &labels, &mut identities);
        let share = |pixel: usize| match rendered.alpha.pixels[pixel] {
            alpha if alpha >= cif_render::constants::MIN_COVERAGE => 1.0 / alpha,
            _ => 0.0,
        };
        agree(&identities, &weights_on_labels(&mut renderer, &scene, &labels, share));

        let total = |counts: &IdentityCounts| (0..n).map(|row| counts.total_mass(row)).sum::<f64>();
        let first = ContributorRule { first: 1, ..ContributorRule::ALL };
        let strongest = ContributorRule { strongest: 1, ..ContributorRule::ALL };
        let (nearest, best) = (count(&mut renderer, first), count(&mut renderer, strongest));
        assert!(total(&nearest) < total(&best) && total(&best) < total(&all));
        // One contributor of every covered pixel.
        let ones = ContributorRule { mass: ContributorMass::One, ..strongest };
        let labelled = labels.pixels.iter().filter(|label| **label != 0).count() as f64;
        let found = total(&count(&mut renderer, ones));
        assert!(found <= labelled && found > 0.5 * labelled, "{found} of {labelled}");
    }
}
