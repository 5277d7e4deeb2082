//! A tiny capture: three shaded balls, of which one may move, ray-cast with exact masks.
#![allow(dead_code)] // Each test binary uses its own part.
#![allow(clippy::unwrap_used)] // Only tests call these.

use std::path::Path;
use std::sync::Mutex;

use cif_dataset::{Dataset, Frame, InstanceLabel, Layout, PointCloud, PointSource, Split};
use cif_field::Field;
use cif_geometry::{LensDistortion, PinholeCamera, RigidTransform};
use cif_train::{Clock, Control, Outcome, Seconds, TrainConfig, TrainEvent, Trainer};
use glam::{DMat3, DVec2, DVec3};

/// Size of the images where the scene has them no larger.
pub(crate) const WIDTH: u32 = 48;
/// Size of the images where the scene has them no larger.
pub(crate) const HEIGHT: u32 = 36;

/// Parameters of the synthetic capture.
#[derive(Clone, Copy)]
pub(crate) struct Scene {
    /// Times; one for a static scene.
    pub(crate) times: usize,
    /// Training views per time.
    pub(crate) views: usize,
    /// Masks are written.
    pub(crate) masks: bool,
    /// Masks are written, but empty.
    pub(crate) empty_masks: bool,
    /// The third ball rolls along x on a floor, this many metres forth and then back.
    pub(crate) rolls: Option<f64>,
    /// A single camera that is somewhere else at each time; there must be as many views as times.
    pub(crate) one_camera: bool,
    /// The third ball is there only in the second half of the times.
    pub(crate) appears: bool,
    /// Cameras disagree in exposure and white balance, before black; the one held out sees what they see on
    /// average.
    pub(crate) disagree: bool,
    /// Balls have highlights.
    pub(crate) shiny: bool,
    /// The third ball stays where it is first.
    pub(crate) frozen: bool,
    /// Images are so many times as wide and high.
    pub(crate) larger: u32,
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            times: 5,
            views: 4,
            masks: true,
            empty_masks: false,
            rolls: None,
            one_camera: false,
            appears: false,
            disagree: false,
            shiny: false,
            frozen: false,
            larger: 1,
        }
    }
}

/// Points per ball.
const POINTS: usize = 150;

/// Where light comes from.
fn sun() -> DVec3 {
    DVec3::new(0.3, -0.8, -0.5).normalize()
}

/// Height of the floor; y points down.
const FLOOR: f64 = 0.5;

/// Centre, radius, colour of the balls at a time; mask ids are 4, 7, 9.
fn balls(time: f64, rolls: Option<f64>) -> [(DVec3, f64, [f64; 3], u8); 3] {
    let third = match rolls {
        Some(travel) => DVec3::new(travel * ((std::f64::consts::PI * time).sin() - 0.5), FLOOR - 0.25, -0.75),
        None => DVec3::new(0.1, -0.5 + 0.5 * time, -0.45),
    };
    [
        (DVec3::new(-0.55, 0.0, 0.0), 0.4, [0.85, 0.2, 0.15], 4),
        (DVec3::new(0.5, 0.1, 0.3), 0.35, [0.2, 0.65, 0.25], 7),
        (third, 0.25, [0.2, 0.3, 0.85], 9),
    ]
}

fn camera(angle: f64) -> PinholeCamera {
    let centre = DVec3::new(3.0 * angle.sin(), -0.6, -3.0 * angle.cos());
    let forward = (-centre).normalize();
    let right = DVec3::new(0.0, 1.0, 0.0).cross(forward).normalize();
    let down = forward.cross(right);
    let rotation = DMat3::from_cols(right, down, forward).transpose();
    PinholeCamera {
        width: WIDTH,
        height: HEIGHT,
        focal_px: DVec2::splat(52.0),
        principal_px: DVec2::new(24.0, 18.0),
        camera_from_world: RigidTransform { rotation, translation: -(rotation * centre) },
    }
}

/// Factors per channel of training cameras that disagree; the one held out sees their geometric mean.
const GAINS: [[f64; 3]; 4] = [[0.95, 0.95, 0.95], [0.6, 0.65, 0.75], [0.9, 0.75, 0.6], [0.7, 0.9, 0.9]];

/// Gains per channel of a camera that disagrees, relative to the geometric mean of all.
pub(crate) fn relative_gain(view: usize) -> [f64; 3] {
    std::array::from_fn(|channel| {
        let mean = GAINS.iter().map(|gain| gain[channel]).product::<f64>().powf(0.25);
        GAINS[view % GAINS.len()][channel] / mean
    })
}

fn write_frame(
    camera: &PinholeCamera,
    scene: Scene,
    time: f64,
    gain: [f64; 3],
    image: &Path,
    mask: Option<&Path>,
) {
    let empty = if scene.disagree { 0 } else { 255 };
    let mut rgb = image::RgbImage::from_pixel(camera.width, camera.height, image::Rgb([empty; 3]));
    let mut ids = image::GrayImage::new(camera.width, camera.height);
    let world_from_camera = camera.camera_from_world.inverse();
    for y in 0..camera.height {
        for x in 0..camera.width {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let ray = ((pixel - camera.principal_px) / camera.focal_px).extend(1.0);
            let direction = (world_from_camera.rotation * ray).normalize();
            let origin = world_from_camera.translation;
            let mut nearest = f64::INFINITY;
            let floor = origin + direction * ((FLOOR - origin.y) / direction.y);
            if scene.rolls.is_some() && direction.y > 0.0 && floor.length() < 2.5 {
                nearest = (floor - origin).length();
                let light = 0.6 + 0.15 * (5.0 * floor.x).sin() + 0.15 * (4.0 * floor.z).cos();
                rgb.put_pixel(x, y, image::Rgb([light * 200.0, light * 230.0, 160.0].map(|c| c as u8)));
            }
            let there = if scene.appears && time < 0.5 { 2 } else { 3 };
            let when = if scene.frozen { 0.0 } else { time };
            for (centre, radius, color, id) in balls(when, scene.rolls).into_iter().take(there) {
                let to = centre - origin;
                let along = to.dot(direction);
                let squared = radius * radius - (to.length_squared() - along * along);
                if squared > 0.0 && along - squared.sqrt() < nearest {
                    nearest = along - squared.sqrt();
                    let normal = (origin + direction * nearest - centre) / radius;
                    let light = 0.6 + 0.4 * normal.dot(sun()).max(0.0);
                    let mirrored = direction - 2.0 * direction.dot(normal) * normal;
                    let highlight =
                        if scene.shiny { 0.6 * mirrored.dot(sun()).max(0.0).powi(6) } else { 0.0 };
                    let seen = color.map(|c| ((c * light + highlight).min(1.0) * 255.0) as u8);
                    rgb.put_pixel(x, y, image::Rgb(seen));
                    ids.put_pixel(x, y, image::Luma([id]));
                }
            }
        }
    }
    for pixel in rgb.pixels_mut() {
        pixel.0 = std::array::from_fn(|channel| (f64::from(pixel.0[channel]) * gain[channel]).round() as u8);
    }
    rgb.save(image).unwrap();
    if let Some(mask) = mask {
        ids.save(mask).unwrap();
    }
}

/// Writes a capture into `folder`.
pub(crate) fn capture(folder: &Path, scene: Scene) -> Dataset {
    let times: Vec<f64> = (0..scene.times).map(|k| k as f64 / (scene.times.max(2) - 1) as f64).collect();
    let mut frames = Vec::new();
    for view in 0..=scene.views {
        for (time_index, time) in times.iter().enumerate() {
            if scene.one_camera && view != time_index && view != scene.views {
                continue;
            }
            // The last view is held out, between the others.
            let held_out = view == scene.views;
            let turn = if held_out { 0.5 } else { view as f64 };
            let camera = camera((turn / scene.views as f64 - 0.4) * 2.4)
                .resized(WIDTH * scene.larger, HEIGHT * scene.larger);
            let name = format!("{view}_{time_index}");
            let image = folder.join(format!("{name}.png"));
            let mask = scene.masks.then(|| folder.join(format!("{name}_mask.png")));
            let gain = match (scene.disagree, held_out) {
                (false, _) => [1.0; 3],
                // Dimmed, so that the brightest camera is not saturated.
                (true, true) => [0.8; 3],
                (true, false) => relative_gain(view).map(|gain| 0.8 * gain),
            };
            write_frame(&camera, scene, *time, gain, &image, mask.as_deref());
            if let Some(mask) = mask.as_ref().filter(|_| scene.empty_masks) {
                image::GrayImage::new(camera.width, camera.height).save(mask).unwrap();
            }
            frames.push(Frame {
                name,
                camera_name: format!("cam{view}"),
                camera,
                lens: LensDistortion::default(),
                time: *time,
                time_index,
                split: if held_out { Split::Val } else { Split::Train },
                group: None,
                image,
                turn: cif_dataset::Turn::NONE,
                source: None,
                mask,
                confidence: None,
            });
        }
    }
    let label = |id| InstanceLabel {
        id,
        label: format!("ball {id}"),
        category: "ball".into(),
        taxonomies: Default::default(),
    };
    let (mut positions, mut colors) = (Vec::new(), Vec::new());
    for (centre, radius, color, _) in balls(0.0, scene.rolls) {
        for k in 0..POINTS {
            let z = 1.0 - (2.0 * k as f64 + 1.0) / POINTS as f64;
            let (s, c) = (k as f64 * 2.399_963).sin_cos();
            let r = (1.0 - z * z).sqrt();
            positions.push((centre + radius * DVec3::new(r * c, r * s, z)).as_vec3().to_array());
            colors.push(color.map(|c| (c * 200.0) as u8));
        }
    }
    for k in 0..if scene.rolls.is_some() { 625 } else { 0 } {
        positions.push([(k % 25) as f32 * 0.15 - 1.8, FLOOR as f32, (k / 25) as f32 * 0.15 - 1.8]);
        colors.push([120, 140, 160]);
    }
    Dataset {
        root: folder.to_owned(),
        layout: Layout::HyperNerf,
        frames,
        times,
        window: None,
        frames_per_second: Some(10.0),
        mask_objects: Default::default(),
        instances: if scene.masks { [4, 7, 9].map(label).to_vec() } else { Vec::new() },
        points: PointCloud { positions, colors, source: PointSource::Random },
        has_alpha: false,
        warnings: Vec::new(),
        notes: Vec::new(),
        unknown: None,
        frame: Default::default(),
    }
}

/// Points of the balls as a reconstruction gives them, with the light that falls on them.
pub(crate) fn with_known_points(mut dataset: Dataset) -> Dataset {
    dataset.points.source = PointSource::File(dataset.root.join("points.ply"));
    let points = &mut dataset.points;
    for (of_ball, colors) in points.positions.chunks(POINTS).zip(points.colors.chunks_mut(POINTS)).take(3) {
        let places: Vec<DVec3> = of_ball.iter().map(|p| DVec3::from(p.map(f64::from))).collect();
        let centre = places.iter().sum::<DVec3>() / POINTS as f64;
        for (place, color) in places.iter().zip(colors) {
            let light = 0.6 + 0.4 * (*place - centre).normalize().dot(sun()).max(0.0);
            *color = color.map(|c| (f64::from(c) * 255.0 / 200.0 * light) as u8);
        }
    }
    dataset
}

/// Settings that train the capture in seconds.
pub(crate) fn small_config() -> TrainConfig {
    let mut config = TrainConfig { seed: 3, ..TrainConfig::default() };
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (100, 250, 120);
    config.model.spatial_resolution = [8; 3];
    config.model.multipliers = vec![1, 2];
    config.model.channels = 4;
    config.model.width = 16;
    config.model.sh_interval = 100;
    config.densify.from = 40;
    config.densify.until = 200;
    config.densify.every = 40;
    config.densify.prune_every = 60;
    config.densify.max_gaussians = 800;
    config.resample.from = 20;
    config.resample.every = 20;
    config.resample.until = 100;
    config.resample.rate = 0.05;
    // Fits of objects take longer than such a run: tests that are about them turn them on.
    (config.motion.rigid, config.motion.parts, config.motion.rehearsal) = (false, false, 30);
    // Its window is as large as a ball of these images.
    config.loss.lambda_dssim = 0.0;
    config.loss.time_smoothness = 1e-3;
    config
}

/// Runs to the end without looking.
pub(crate) fn train(dataset: Dataset, config: TrainConfig) -> Trainer {
    let mut trainer = Trainer::new(dataset, config).unwrap();
    assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    trainer
}

/// The state of a run that is interrupted after so many steps of all stages.
pub(crate) fn stopped_after(dataset: &Dataset, config: &TrainConfig, steps: u64) -> Trainer {
    let mut config = config.clone();
    config.report.step_every = 1;
    let mut trainer = Trainer::new(dataset.clone(), config).unwrap();
    let mut done = 0;
    let outcome = trainer.run(&mut |event, _| {
        done += u64::from(matches!(event, TrainEvent::Step { .. }));
        if done >= steps { Control::Stop } else { Control::Continue }
    });
    assert_eq!((outcome.unwrap(), trainer.steps_done()), (Outcome::Interrupted, steps));
    trainer
}

/// A clock that stands still until time passes on it; two processors are busy.
#[derive(Default)]
pub(crate) struct Manual(Mutex<f64>);

impl Manual {
    /// So many seconds pass.
    pub(crate) fn pass(&self, seconds: f64) {
        *self.0.lock().unwrap() += seconds;
    }
}

impl Clock for Manual {
    fn now(&self) -> Seconds {
        let wall_s = *self.0.lock().unwrap();
        Seconds { wall_s, cpu_s: 2.0 * wall_s }
    }
}

/// A field without its record, which holds wall times.
pub(crate) fn without_record(field: &Field) -> Field {
    Field { record: Default::default(), ..field.clone() }
}
