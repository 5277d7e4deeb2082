//! Small random scenes from a seed, for tests and benchmarks: a field, a camera that sees it, and labels.

use cif_field::deformation::{Deformation, DeformationConfig, Heads, TimeEncoding};
use cif_field::gaussians::SH_FLOATS;
use cif_field::{Field, Gaussians, Identities, Instance, SortMetric, Timeline};
use cif_geometry::{Bounds, PinholeCamera, PixelGrid, RigidTransform};
use glam::{DMat3, DVec2, DVec3};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Parameters of a synthetic scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SyntheticConfig {
    /// Equal configurations give equal scenes.
    pub seed: u64,
    /// Gaussians N.
    pub gaussians: usize,
    /// Instances K; 0 for a field without identities.
    pub instances: usize,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Heads of the deformation; `None` for a static field.
    pub heads: Option<Heads>,
    /// Range of the standard deviations on screen, as shares of the image height.
    pub screen_size: (f64, f64),
}

impl Default for SyntheticConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            gaussians: 8,
            instances: 3,
            width: 32,
            height: 24,
            heads: None,
            screen_size: (0.06, 0.2),
        }
    }
}

/// Every head.
pub const ALL_HEADS: Heads = Heads { position: true, scale: true, rotation: true, opacity: true, sh: true };

/// A generated scene.
#[derive(Clone, Debug)]
pub struct SyntheticScene {
    /// The field.
    pub field: Field,
    /// A camera that sees most of it, with an off-centre principal point.
    pub camera: PinholeCamera,
    /// Dense index + 1 per pixel in blocks of 4 x 4, about a fifth of them unlabelled; all unlabelled when K = 0.
    pub labels: PixelGrid<u16>,
    /// Time of the view.
    pub time: f64,
}

/// Nearest and farthest camera depth, metres.
const DEPTHS: (f64, f64) = (2.0, 4.5);

/// Generates a scene.
#[must_use]
pub fn generate(config: &SyntheticConfig) -> SyntheticScene {
    let mut random = Pcg64Mcg::seed_from_u64(config.seed);
    let camera = camera(config);
    let gaussians = gaussians(config, &camera, &mut random);
    let identities = (config.instances > 0).then(|| identities(config, &mut random));
    let deformation = config.heads.map(|heads| deformation(heads, &gaussians, &mut random));
    let labels = labels(config, &mut random);
    let field = Field {
        gaussians,
        deformation,
        tracks: None,
        identities,
        instances: (0..config.instances)
            .map(|k| Instance {
                id: k as u16 + 1,
                label: format!("object {k}"),
                category: "object".to_owned(),
                taxonomies: Default::default(),
            })
            .collect(),
        timeline: Timeline { times: vec![0.0, 0.5, 1.0], frames_per_second: 24.0 },
        cameras: Vec::new(),
        sh_degree: 3,
        background: [0.2, 0.5, 0.9],
        sort_metric: SortMetric::Z,
        extent: 4.0,
        record: Default::default(),
    };
    SyntheticScene { field, camera, labels, time: 0.37 }
}

fn camera(config: &SyntheticConfig) -> PinholeCamera {
    let size = DVec2::new(f64::from(config.width), f64::from(config.height));
    PinholeCamera {
        width: config.width,
        height: config.height,
        focal_px: DVec2::new(1.1, 1.05) * size.y,
        principal_px: size * DVec2::new(0.48, 0.53),
        camera_from_world: RigidTransform {
            rotation: DMat3::from_rotation_x(0.3)
                * DMat3::from_rotation_y(-0.4)
                * DMat3::from_rotation_z(0.2),
            translation: DVec3::new(0.2, -0.1, 0.3),
        },
    }
}

fn gaussians(config: &SyntheticConfig, camera: &PinholeCamera, random: &mut Pcg64Mcg) -> Gaussians {
    let world_from_camera = camera.camera_from_world.inverse();
    // One depth slot each, so that no two Gaussians are nearer than a fraction of a slot.
    let mut slots: Vec<usize> = (0..config.gaussians).collect();
    slots.shuffle(random);
    let slot = (DEPTHS.1 - DEPTHS.0) / config.gaussians.max(1) as f64;
    let mut result = Gaussians::default();
    for index in slots {
        let z = DEPTHS.0 + (index as f64 + random.random_range(0.2..0.8)) * slot;
        let pixel = DVec2::new(
            f64::from(config.width) * random.random_range(-0.05..1.05),
            f64::from(config.height) * random.random_range(-0.05..1.05),
        );
        let xy = (pixel - camera.principal_px) / camera.focal_px * z;
        let mean = world_from_camera.apply(DVec3::new(xy.x, xy.y, z));
        let (small, large) = (config.screen_size.0.ln(), config.screen_size.1.ln());
        let metres = z * f64::from(config.height) / camera.focal_px.y;
        result.means.push(mean.as_vec3().to_array());
        result.log_scales.push([0; 3].map(|_: i32| (random.random_range(small..large) + metres.ln()) as f32));
        // Any norm but a vanishing one is a valid raw quaternion.
        let quaternion = DVec3::from_array([0; 3].map(|_: i32| random.random_range(-1.0..1.0)));
        let factor = random.random_range(0.6..1.5);
        let quaternion = [1.0, quaternion.x, quaternion.y, quaternion.z].map(|c| (c * factor) as f32);
        result.quaternions.push(quaternion);
        result.opacity_logits.push(random.random_range(-1.5..2.0));
        result.occupancy_logits.push(random.random_range(-1.5..2.0));
        let mut sh = [0.0; SH_FLOATS];
        for (k, coefficient) in sh.iter_mut().enumerate() {
            let size = if k < 3 { 1.2 } else { 0.12 };
            *coefficient = random.random_range(-size..size);
        }
        result.sh_coefficients.push(sh);
    }
    result
}

fn identities(config: &SyntheticConfig, random: &mut Pcg64Mcg) -> Identities {
    let mut identities = Identities::default();
    let mut all: Vec<u16> = (0..config.instances as u16).collect();
    for _ in 0..config.gaussians {
        let support = random.random_range(1..=config.instances.min(4));
        all.shuffle(random);
        let mut row = all[..support].to_vec();
        row.sort_unstable();
        let weights: Vec<f32> = row.iter().map(|_| random.random_range(0.05_f32..1.0)).collect();
        let sum: f32 = weights.iter().sum();
        for (label, weight) in row.into_iter().zip(weights) {
            identities.labels.push(label);
            identities.log_estimates.push((weight / sum).ln());
            identities.log_calibrations.push(random.random_range(-0.5..0.5));
        }
        identities.row_offsets.push(identities.labels.len() as u32);
    }
    identities
}

fn deformation(heads: Heads, gaussians: &Gaussians, random: &mut Pcg64Mcg) -> Deformation {
    let config = DeformationConfig {
        spatial_resolution: [5, 4, 6],
        time_resolution: 9,
        multipliers: vec![1, 2],
        channels: 4,
        width: 12,
        heads,
        time_encoding: TimeEncoding::Compact,
    };
    // A little tighter than the cloud, so that some lookups are clamped.
    let cloud = Bounds::around(gaussians.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from))));
    let inset = cloud.size() * 0.03;
    let widening = DVec3::splat(1e-3);
    let bounds = Bounds { low: cloud.low + inset - widening, high: cloud.high - inset + widening };
    let (planes, mlp) = (config.plane_layout().1, config.mlp_layout());
    let mut deformation = Deformation {
        planes: (0..planes).map(|_| random.random_range(0.5..1.3)).collect(),
        mlp: vec![0.0; mlp.len],
        bounds,
        config,
        still: Vec::new(),
    };
    let mut fill = |range: std::ops::Range<usize>, size: f32| {
        for value in &mut deformation.mlp[range] {
            *value = random.random_range(-size..size);
        }
    };
    fill(mlp.trunk.weights, 0.6);
    fill(mlp.trunk.biases, 0.3);
    for head in mlp.heads {
        fill(head.hidden.weights, 0.5);
        fill(head.hidden.biases, 0.3);
        fill(head.output.weights, 0.15);
        fill(head.output.biases, 0.05);
    }
    deformation
}

fn labels(config: &SyntheticConfig, random: &mut Pcg64Mcg) -> PixelGrid<u16> {
    const BLOCK: u32 = 4;
    let columns = config.width.div_ceil(BLOCK);
    let blocks: Vec<u16> = (0..columns * config.height.div_ceil(BLOCK))
        .map(|_| {
            let unlabelled = config.instances == 0 || random.random_bool(0.2);
            if unlabelled { 0 } else { random.random_range(1..=config.instances as u16) }
        })
        .collect();
    let mut labels = PixelGrid::filled(config.width, config.height, 0);
    for (position, label) in labels.pixels.iter_mut().enumerate() {
        let (x, y) = (position as u32 % config.width, position as u32 / config.width);
        *label = blocks[(y / BLOCK * columns + x / BLOCK) as usize];
    }
    labels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_seeds_give_equal_scenes() {
        let config = SyntheticConfig { heads: Some(ALL_HEADS), ..SyntheticConfig::default() };
        let (a, b) = (generate(&config), generate(&config));
        assert_eq!(a.field, b.field);
        assert_eq!(a.labels, b.labels);
        assert_ne!(a.field, generate(&SyntheticConfig { seed: 1, ..config }).field);
    }

    #[test]
    fn shapes_are_consistent() {
        let config =
            SyntheticConfig { gaussians: 20, instances: 40, width: 17, height: 33, ..Default::default() };
        let scene = generate(&config);
        let identities = scene.field.identities.unwrap();
        assert_eq!(identities.len(), 20);
        assert!(identities.labels.iter().all(|label| usize::from(*label) < 40));
        assert_eq!(scene.labels.pixels.len(), 17 * 33);
        assert!(scene.labels.pixels.iter().all(|label| *label <= 40));
        assert_eq!(generate(&SyntheticConfig { gaussians: 0, ..config }).field.gaussians.len(), 0);
    }
}
