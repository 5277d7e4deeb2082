//! The whole chain: field to pixels and back to gradients.

use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid, Real};

use super::constant;
use super::cross_entropy::{InstanceLoss, instance_loss};
use super::deform::{Deformed, deform, deform_backward};
use super::dense::{instance_image, rasterize_dense};
use super::identity::count_label_mass;
use super::identity_rows::IdentityProbabilities;
use super::pixel::{InstanceTarget, PixelState};
use super::project::{Splat2d, SplatGradient, View, project, project_backward};
use super::rasterize::{InstanceCotangent, PixelCotangents, RasterGradients, rasterize, rasterize_backward};
use super::scene::{Parameters, Scene};
use super::sort::sort;
use super::tracks::follow;
use crate::constants::MIN_COVERAGE;
use crate::cpu::IdentityCounts;
use crate::image::{Channels, RenderedImage};
use crate::settings::RenderSettings;

/// A view after the forward pass, with everything the backward pass and comparisons need.
#[derive(Clone, Debug)]
pub struct Forward<R> {
    /// The camera.
    pub view: View<R>,
    /// The settings.
    pub settings: RenderSettings,
    /// Gaussians at the time of the view.
    pub deformed: Vec<Deformed<R>>,
    /// Their splats; `None` where nothing is drawn.
    pub splats: Vec<Option<Splat2d<R>>>,
    /// Visible Gaussians front to back.
    pub order: Vec<u32>,
    /// Calibrated identities; `None` without instance pass.
    pub identities: Option<IdentityProbabilities<R>>,
    /// Labels of the instance pass.
    pub labels: Option<PixelGrid<u16>>,
    /// State of every pixel: M_y, S, T and where the lists ended.
    pub pixels: PixelGrid<PixelState<R>>,
    /// Colour on the background.
    pub color: PixelGrid<[R; 3]>,
    /// Colour coverage 1 - T.
    pub alpha: PixelGrid<R>,
    /// Blended depth D, metres, not divided by coverage.
    pub depth: PixelGrid<R>,
    /// Instance loss; zero without instance pass.
    pub loss: InstanceLoss<R>,
}

impl<R: Real> Forward<R> {
    fn target(&self) -> Option<InstanceTarget<'_, R>> {
        Some(InstanceTarget {
            labels: self.labels.as_ref()?,
            identities: self.identities.as_ref()?,
            normalisation: self.settings.instances?.normalisation,
        })
    }
}

/// Gradients of a view.
#[derive(Clone, Debug)]
pub struct SceneGradients<R> {
    /// By every parameter.
    pub parameters: Parameters<R>,
    /// By splats and identity entries: the result of the raster stage.
    pub raster: RasterGradients<R>,
    /// Gradient of the projected centre in normalised device coordinates: (W / 2 v_x, H / 2 v_y), `[N]`.
    pub screen: Vec<[R; 2]>,
    /// Screen radius, pixels; 0 where not visible, `[N]`.
    pub radii: Vec<R>,
    /// Gaussians whose camera-space position gradient was clipped.
    pub clipped: usize,
}

/// Renders a training view. `labels` (dense index + 1, 0 = unlabelled) are read when `settings.instances` is set
/// and the scene has identities.
///
/// # Panics
/// When the labels have another size than the camera.
#[must_use]
pub fn forward<R: Real>(
    scene: &Scene<R>,
    camera: &PinholeCamera,
    time: f64,
    settings: &RenderSettings,
    labels: Option<&PixelGrid<u16>>,
) -> Forward<R> {
    if let Some(labels) = labels {
        assert_eq!((labels.width, labels.height), (camera.width, camera.height), "size of the label map");
    }
    let view = View::from_camera(camera);
    let mut deformed: Vec<Deformed<R>> =
        (0..scene.parameters.gaussians.len()).map(|i| deform(scene, i, time, settings.deform)).collect();
    if let Some(tracks) = scene.tracks.as_ref().map(|tracks| tracks.at(time)) {
        for (row, deformed) in deformed.iter_mut().enumerate() {
            if let Some((group, member)) = tracks.group(row) {
                follow(group, member, &scene.parameters.gaussians[row], &mut deformed.gaussian);
            }
        }
    }
    let splats: Vec<Option<Splat2d<R>>> =
        deformed.iter().map(|deformed| project(&deformed.gaussian, &view, settings)).collect();
    let order = sort(&splats);
    let identities = settings
        .instances
        .and(scene.identities.as_ref())
        .map(|rows| rows.probabilities(&scene.parameters.log_calibrations));
    let mut forward = Forward {
        view,
        settings: *settings,
        deformed,
        splats,
        order,
        identities,
        labels: labels.filter(|_| settings.instances.is_some()).cloned(),
        pixels: PixelGrid::filled(0, 0, PixelState::empty()),
        color: PixelGrid::filled(0, 0, [R::zero(); 3]),
        alpha: PixelGrid::filled(0, 0, R::zero()),
        depth: PixelGrid::filled(0, 0, R::zero()),
        loss: InstanceLoss { mean: R::zero(), labelled_pixels: 0, unsupported_pixels: 0 },
    };
    let target = forward.target();
    let pixels = rasterize(&forward.splats, &forward.order, camera.width, camera.height, target.as_ref());
    if let Some(target) = &target {
        forward.loss = instance_loss(&pixels, target);
    }
    let background = settings.background.map(constant::<R>);
    forward.color = pixels.map(|state| {
        std::array::from_fn(|channel| state.color[channel] + state.transmittance * background[channel])
    });
    forward.alpha = pixels.map(|state| R::one() - state.transmittance);
    forward.depth = pixels.map(|state| state.depth);
    forward.pixels = pixels;
    forward
}

/// Gradients of `v_color . colour + v_depth . D + v_alpha . alpha + instance_weight * instance loss` by every
/// parameter; `forward` is the forward pass of the same scene.
///
/// # Panics
/// When the scene has recorded motion, which is not differentiated.
#[must_use]
pub fn backward<R: Real>(
    scene: &Scene<R>,
    forward: &Forward<R>,
    v_color: &PixelGrid<[R; 3]>,
    v_depth: Option<&PixelGrid<R>>,
    v_alpha: Option<&PixelGrid<R>>,
    instance_weight: R,
) -> SceneGradients<R> {
    assert!(scene.tracks.is_none(), "recorded motion has no gradients");
    let settings = &forward.settings;
    let instances =
        forward.target().filter(|_| forward.loss.labelled_pixels > 0).map(|target| InstanceCotangent {
            target,
            pixel_weight: instance_weight / R::of(forward.loss.labelled_pixels as f64),
            geometry: settings.instances.map(|instances| instances.geometry).unwrap_or_default(),
        });
    let raster = rasterize_backward(
        &forward.splats,
        &forward.order,
        settings.background.map(constant::<R>),
        &forward.pixels,
        &PixelCotangents { color: v_color, depth: v_depth, alpha: v_alpha },
        instances.as_ref(),
    );
    let (mut parameters, clipped) = splats_backward(scene, forward, &raster.splats);
    if let Some(instances) = &instances {
        parameters.log_calibrations = instances.target.identities.calibration_backward(&raster.label_mass);
    }
    let half = [forward.view.width, forward.view.height].map(|size| R::of(f64::from(size) / 2.0));
    SceneGradients {
        parameters,
        screen: raster.splats.iter().map(|v| [half[0] * v.mean2d[0], half[1] * v.mean2d[1]]).collect(),
        radii: forward
            .splats
            .iter()
            .map(|splat| splat.as_ref().map_or(R::zero(), |splat| splat.radius))
            .collect(),
        raster,
        clipped,
    }
}

/// Carries gradients of splats, `[N]`, to every parameter but the calibrations, which come out 0; and how many
/// camera-space position gradients were clipped.
#[must_use]
pub fn splats_backward<R: Real>(
    scene: &Scene<R>,
    forward: &Forward<R>,
    v_splats: &[SplatGradient<R>],
) -> (Parameters<R>, usize) {
    let mut parameters = scene.parameters.zeros_like();
    let mut clipped = 0;
    for &index in &forward.order {
        let index = index as usize;
        let (deformed, Some(splat)) = (&forward.deformed[index], &forward.splats[index]) else { continue };
        let v =
            project_backward(&deformed.gaussian, &forward.view, &forward.settings, splat, &v_splats[index]);
        clipped += usize::from(v.clipped);
        deform_backward(scene, index, deformed, &v.gaussian, &mut parameters);
    }
    (parameters, clipped)
}

/// Renders a view for looking at or measuring.
#[must_use]
pub fn render<R: Real>(
    field: &Field,
    camera: &PinholeCamera,
    time: f64,
    settings: &RenderSettings,
    channels: Channels,
) -> RenderedImage {
    let scene = Scene::<R>::from_field(field);
    let forward = forward(&scene, camera, time, settings, None);
    let single = |value: R| value.to_double() as f32;
    let depth = forward.pixels.map(|state| {
        let coverage = R::one() - state.transmittance;
        if coverage < constant(MIN_COVERAGE) { 0.0 } else { single(state.depth / coverage) }
    });
    let instances = forward.identities.as_ref().filter(|_| channels.instances).map(|identities| {
        let (splats, order) = (&forward.splats, &forward.order);
        instance_image(&rasterize_dense(
            splats,
            order,
            camera.width,
            camera.height,
            identities,
            scene.instances,
        ))
    });
    RenderedImage {
        color: forward.color.map(|color| color.map(single)),
        alpha: forward.alpha.map(|alpha| single(*alpha)),
        depth: channels.depth.then_some(depth),
        instances,
    }
}

/// Adds a view's colour-weighted label mass to `counts`.
pub fn count_identities<R: Real>(
    scene: &Scene<R>,
    camera: &PinholeCamera,
    time: f64,
    settings: &RenderSettings,
    labels: &PixelGrid<u16>,
    counts: &mut IdentityCounts,
) {
    let forward = forward(scene, camera, time, settings, None);
    count_label_mass(&forward.splats, &forward.order, &forward.pixels, labels, counts);
}
