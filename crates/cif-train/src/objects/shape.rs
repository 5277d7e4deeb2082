//! The Gaussians of an object in its own frame, alone: rendered on crops, compared with colours and masks, moved.

use cif_field::tracks::TrackPose;
use cif_field::{Field, Gaussians, Record, SortMetric, Timeline, Tracks};
use cif_geometry::{PinholeCamera, PixelGrid, RigidTransform};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Gradients, GroupedGaussian, PoseGradient, RenderSettings};
use glam::{DMat3, DQuat, DVec3};

use super::view::Crop;
use crate::phases::Phases;

/// Rates of centres (of the size), log-scales, quaternions, opacities and colours.
const RATES: [f64; 5] = [0.01, 0.02, 0.01, 0.05, 0.02];

/// Standard deviation that 150 Gaussians start with, of the size.
const START: f64 = 0.15;

/// Range of standard deviations, of the size.
const SCALES: [f64; 2] = [0.02, 0.3];

/// Range of opacity logits.
const OPACITIES: [f32; 2] = [-4.0, 5.0];

/// Weight of the coverage, relative to that of colours.
const COVERAGE: f32 = 0.5;

/// Differences of colours and of coverage below which the loss is quadratic.
const SOFT: [f32; 2] = [0.01, 0.05];

/// Moments of Adam; decays 0.9 and 0.99.
#[derive(Clone, Debug)]
pub(super) struct Adam {
    first: Vec<f64>,
    second: Vec<f64>,
    steps: i32,
}

impl Adam {
    pub(super) fn new(len: usize) -> Self {
        Self { first: vec![0.0; len], second: vec![0.0; len], steps: 0 }
    }

    /// Counts a step, and gives what to subtract of every value.
    pub(super) fn step(
        &mut self,
        gradients: impl Iterator<Item = f64>,
        rate: f64,
        mut take: impl FnMut(usize, f64),
    ) {
        self.steps += 1;
        let (one, two) = (1.0 - 0.9_f64.powi(self.steps), 1.0 - 0.99_f64.powi(self.steps));
        for (k, g) in gradients.enumerate() {
            self.first[k] = 0.9 * self.first[k] + 0.1 * g;
            self.second[k] = 0.99 * self.second[k] + 0.01 * g * g;
            take(k, rate * (self.first[k] / one) / ((self.second[k] / two).sqrt() + 1e-15));
        }
    }
}

/// A pose: world from object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pose {
    pub(super) rotation: DQuat,
    pub(super) translation: DVec3,
}

impl Pose {
    /// Upright at a place.
    pub(super) fn at(place: DVec3) -> Self {
        Self { rotation: DQuat::IDENTITY, translation: place }
    }

    /// Carries Gaussians whose colours are the same from everywhere.
    pub(super) fn carry(&self, gaussians: &mut Gaussians) {
        for (mean, quaternion) in gaussians.means.iter_mut().zip(&mut gaussians.quaternions) {
            let moved = self.rotation * DVec3::from_array(mean.map(f64::from)) + self.translation;
            *mean = moved.as_vec3().to_array();
            let [w, x, y, z] = quaternion.map(f64::from);
            let turned = self.rotation * DQuat::from_xyzw(x, y, z, w);
            *quaternion = [turned.w, turned.x, turned.y, turned.z].map(|value| value as f32);
        }
    }
}

/// Gaussians of an object, with their optimiser and a renderer.
pub(super) struct Shape {
    field: Field,
    gradients: Gradients,
    moments: [Adam; 5],
    renderer: Renderer,
    settings: RenderSettings,
    size: f64,
    phases: Phases,
}

/// Gradients of a view, by the Gaussians (kept in the shape) and by the pose, in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Loss {
    pub(super) value: f64,
    pub(super) pose: PoseGradient,
}

impl Shape {
    /// Gaussians at places in the object's frame, with colours in [0, 1].
    pub(super) fn new(
        places: &[[f32; 3]],
        colors: &[[f32; 3]],
        size: f64,
        near: f32,
        phases: &Phases,
    ) -> Option<Self> {
        let mut gaussians = Gaussians::from_points(places, colors).ok()?;
        let n = gaussians.len();
        // As many as 150 overlap at this size; more are smaller.
        let spread = START * size * (150.0 / n as f64).sqrt();
        gaussians.log_scales.fill([spread.ln() as f32; 3]);
        gaussians.opacity_logits.fill(0.0);
        let field = Field {
            gaussians,
            deformation: None,
            tracks: None,
            identities: None,
            instances: Vec::new(),
            timeline: Timeline { times: vec![0.0], frames_per_second: 24.0 },
            cameras: Vec::new(),
            sh_degree: 0,
            background: [0.0; 3],
            sort_metric: SortMetric::Z,
            extent: size as f32,
            record: Record::default(),
        };
        Some(Self {
            gradients: Gradients::zeros(&field),
            field,
            moments: [3 * n, 3 * n, 4 * n, n, 3 * n].map(Adam::new),
            renderer: Renderer::new(SimdLevel::Auto),
            settings: RenderSettings { sh_degree: 0, near, deform: false, ..RenderSettings::default() },
            size,
            phases: phases.clone(),
        })
    }

    /// The same Gaussians, with an optimiser and a renderer of their own.
    pub(super) fn copied(&self) -> Self {
        let n = self.len();
        Self {
            field: self.field.clone(),
            gradients: Gradients::zeros(&self.field),
            moments: [3 * n, 3 * n, 4 * n, n, 3 * n].map(Adam::new),
            renderer: Renderer::new(SimdLevel::Auto),
            settings: self.settings,
            size: self.size,
            phases: self.phases.clone(),
        }
    }

    pub(super) fn gaussians(&self) -> &Gaussians {
        &self.field.gaussians
    }

    /// Phases of the run that it is fitted in.
    pub(super) fn phases(&self) -> &Phases {
        &self.phases
    }

    /// The same Gaussians in groups, each with a pose in the object's frame or none.
    pub(super) fn in_parts(mut self, tracks: Tracks) -> Self {
        self.field.tracks = Some(tracks);
        self.gradients = Gradients::zeros(&self.field);
        self
    }

    /// Group of a Gaussian in [`Self::in_parts`].
    pub(super) fn part_of(&self, row: usize) -> Option<usize> {
        self.field.tracks.as_ref().and_then(|tracks| tracks.group(row))
    }

    /// These Gaussians, then others, not yet in parts.
    pub(super) fn joined(mut self, other: &Self) -> Self {
        self.field.gaussians.append(&other.field.gaussians);
        self.field.tracks = None;
        self.copied()
    }

    /// Lowers the opacity of Gaussians at some places to `logit`.
    pub(super) fn fade(&mut self, logit: f32, selected: impl Fn(DVec3) -> bool) {
        let g = &mut self.field.gaussians;
        for (mean, opacity) in g.means.iter().zip(&mut g.opacity_logits) {
            if selected(DVec3::from_array(mean.map(f64::from))) {
                *opacity = opacity.min(logit);
            }
        }
    }

    /// Puts a group of [`Self::in_parts`] into a pose: its turn, and where its pivot is.
    pub(super) fn set_part(&mut self, group: usize, pivot: DVec3, rotation: DQuat, translation: DVec3) {
        if let Some(group) = self.field.tracks.as_mut().and_then(|tracks| tracks.groups.get_mut(group)) {
            group.pivot = pivot;
            group.poses = vec![TrackPose { time: 0.0, translation, rotation }];
        }
    }

    /// Gradient of the last loss by the pose at a place among those of [`Self::in_parts`]: the turn in the frame of
    /// the part.
    pub(super) fn part_gradient(&self, place: usize) -> PoseGradient {
        self.gradients.poses.get(place).copied().unwrap_or_default()
    }

    fn len(&self) -> usize {
        self.field.gaussians.len()
    }

    /// Loss of a crop in a pose, on a background; with gradients unless only the value is asked for. This is where fits
    /// spend their time: once the run is to end, nothing is rendered any more and the loss is 0, so that every fit comes
    /// to its end at once, where [`Phases::check`] refuses what came out.
    pub(super) fn loss(
        &mut self,
        crop: &Crop,
        pose: &Pose,
        background: [f32; 3],
        weight: f32,
        differentiates: bool,
    ) -> Loss {
        let is_over = if differentiates { self.phases.tick() } else { self.phases.is_over() };
        if is_over {
            return Loss { value: 0.0, pose: PoseGradient::default() };
        }
        let rotation = DMat3::from_quat(pose.rotation);
        let world = crop.camera.camera_from_world;
        let camera = PinholeCamera {
            camera_from_world: RigidTransform {
                rotation: world.rotation * rotation,
                translation: world.rotation * pose.translation + world.translation,
            },
            ..crop.camera
        };
        let settings = RenderSettings { background, low_pass: crop.low_pass, ..self.settings };
        let color = self.renderer.forward(&self.field, &camera, 0.0, &settings, None).color;
        let alpha = self.renderer.alpha();
        let mut value = 0.0_f64;
        let mut v_color = PixelGrid::filled(camera.width, camera.height, [0.0_f32; 3]);
        let mut v_alpha = PixelGrid::filled(camera.width, camera.height, 0.0_f32);
        let scale = weight / crop.pixels;
        for (pixel, found) in color.pixels.iter().enumerate() {
            let of_color = crop.color_weight(pixel) * scale / 3.0;
            if of_color > 0.0 {
                for channel in 0..3 {
                    let d = found[channel] - crop.colors[pixel][channel];
                    let h = (d * d + SOFT[0] * SOFT[0]).sqrt();
                    value += f64::from(of_color * (h - SOFT[0]));
                    v_color.pixels[pixel][channel] = of_color * d / h;
                }
            }
            let of_mask = COVERAGE * crop.known[pixel] * scale;
            if of_mask > 0.0 {
                let d = alpha.pixels[pixel] - crop.mask[pixel];
                let h = (d * d + SOFT[1] * SOFT[1]).sqrt();
                value += f64::from(of_mask * (h - SOFT[1]));
                v_alpha.pixels[pixel] = of_mask * d / h;
            }
        }
        let mut sum = PoseGradient::default();
        if differentiates {
            self.gradients.reset();
            self.renderer.backward_with_alpha(&self.field, &v_color, &v_alpha, &mut self.gradients);
            let (g, v) = (&self.field.gaussians, &self.gradients.gaussians);
            for row in 0..self.len() {
                let (offset, quaternion, sh) = (g.means[row], g.quaternions[row], &g.sh_coefficients[row]);
                let gaussian = GroupedGaussian { offset, quaternion, sh };
                sum.add(&gaussian, v.means[row], v.quaternions[row], None);
            }
            sum = PoseGradient { turn: rotation * sum.turn, translation: rotation * sum.translation };
        }
        Loss { value, pose: sum }
    }

    /// Centres, in the object's frame.
    pub(super) fn centres(&self) -> Vec<DVec3> {
        self.field.gaussians.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from))).collect()
    }

    pub(super) fn set_centres(&mut self, centres: &[DVec3]) {
        for (mean, centre) in self.field.gaussians.means.iter_mut().zip(centres) {
            *mean = centre.to_array().map(|value| value as f32);
        }
    }

    /// Gradients of the last loss by the centres.
    pub(super) fn centre_gradients(&self) -> Vec<DVec3> {
        self.gradients.gaussians.means.iter().map(|v| DVec3::from_array(v.map(f64::from))).collect()
    }

    /// Adds a gradient by the centres, in the object's frame.
    pub(super) fn add_to_centres(&mut self, v: &[DVec3]) {
        for (sum, v) in self.gradients.gaussians.means.iter_mut().zip(v) {
            (0..3).for_each(|axis| sum[axis] += v[axis] as f32);
        }
    }

    /// Moves the Gaussians by the gradients of the last loss.
    pub(super) fn step(&mut self, rate: f64) {
        let size = self.size;
        let (g, v) = (&mut self.field.gaussians, &self.gradients.gaussians);
        let [means, scales, quaternions, opacities, colors] = &mut self.moments;
        let single = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
        let take = |moments: &mut Adam, values: &mut [f32], gradients: &[f32], rate: f64| {
            moments.step(single(gradients).into_iter(), rate, |k, step| values[k] -= step as f32);
        };
        let [of_means, of_scales, of_quaternions, of_opacities, of_colors] = RATES.map(|r| r * rate);
        take(means, g.means.as_flattened_mut(), v.means.as_flattened(), of_means * size);
        take(scales, g.log_scales.as_flattened_mut(), v.log_scales.as_flattened(), of_scales);
        take(quaternions, g.quaternions.as_flattened_mut(), v.quaternions.as_flattened(), of_quaternions);
        take(opacities, &mut g.opacity_logits, &v.opacity_logits, of_opacities);
        let of_dc = v.sh_coefficients.iter().flat_map(|sh| [0, 1, 2].map(|c| f64::from(sh[c])));
        colors.step(of_dc, of_colors, |k, step| g.sh_coefficients[k / 3][k % 3] -= step as f32);
        let [low, high] = SCALES.map(|share| (share * size).ln() as f32);
        g.log_scales.as_flattened_mut().iter_mut().for_each(|scale| *scale = scale.clamp(low, high));
        let [low, high] = OPACITIES;
        g.opacity_logits.iter_mut().for_each(|logit| *logit = logit.clamp(low, high));
    }
}
