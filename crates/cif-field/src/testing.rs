//! Random fields for the unit tests.

use cif_geometry::{Bounds, PinholeCamera, RigidTransform};
use glam::{DMat3, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use crate::{
    Deformation, DeformationConfig, Field, Gaussians, Heads, Identities, Instance, RecordedCamera,
    SortMetric, TimeEncoding, Timeline,
};

/// A valid field with `n` Gaussians in a box of 2 m, four instances, motion, and odd values everywhere.
pub(crate) fn field(n: usize, seed: u64) -> Field {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut uniform = |low: f32, high: f32| rng.random_range(low..high);
    let positions: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| uniform(-1.0, 1.0))).collect();
    let colors: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| uniform(0.0, 1.0))).collect();
    let mut gaussians = Gaussians::from_points(&positions, &colors).unwrap();
    for row in 0..n {
        gaussians.log_scales[row] = std::array::from_fn(|_| uniform(-4.0, -1.0));
        gaussians.quaternions[row] = std::array::from_fn(|_| uniform(-1.0, 1.0));
        gaussians.occupancy_logits[row] = uniform(-4.0, 3.0);
    }
    let config = DeformationConfig {
        spatial_resolution: [4, 3, 5],
        time_resolution: 7,
        multipliers: vec![1, 2],
        channels: 2,
        width: 8,
        heads: Heads { position: true, scale: true, rotation: true, opacity: false, sh: false },
        time_encoding: TimeEncoding::Compact,
    };
    let bounds = Bounds { low: DVec3::splat(-1.0), high: DVec3::new(1.0, 1.0, 1.0 / 3.0 + 1.0) };
    let deformation = Deformation::new(config, bounds, 2.0, seed, false).unwrap();
    let mut identities = Identities {
        row_offsets: vec![0],
        labels: Vec::new(),
        log_estimates: Vec::new(),
        log_calibrations: Vec::new(),
    };
    for row in 0..n {
        for label in 0..4_u16 {
            if usize::from(label) == row % 4 || uniform(0.0, 1.0) < 0.3 {
                identities.labels.push(label);
                identities.log_estimates.push(uniform(-5.0, 0.0));
                identities.log_calibrations.push(uniform(-1.0, 1.0));
            }
        }
        identities.row_offsets.push(identities.labels.len() as u32);
    }
    let instances = (0..4_u16)
        .map(|index| Instance {
            id: 7 * index + 300,
            label: format!("thing \"{index}\" ü\n"),
            category: "thing".to_owned(),
        })
        .collect();
    let camera = PinholeCamera {
        width: 64,
        height: 48,
        focal_px: DVec2::new(50.1, 1.0 / 3.0),
        principal_px: DVec2::new(32.0, 0.1 + 0.2),
        camera_from_world: RigidTransform {
            rotation: DMat3::from_rotation_y(0.3),
            translation: DVec3::new(0.1, -0.0, 2.0e-17),
        },
    };
    let record = |time_index: usize| RecordedCamera {
        name: "left".to_owned(),
        time_index,
        trained: time_index.is_multiple_of(2),
        camera,
    };
    Field {
        gaussians,
        deformation: Some(deformation),
        identities: Some(identities),
        instances,
        timeline: Timeline { times: vec![0.0, 1.0 / 3.0, 0.1 + 0.6, 1.0], frames_per_second: 29.97 },
        cameras: (0..4).map(record).collect(),
        sh_degree: 3,
        background: [1.0, 0.1, 0.0],
        sort_metric: SortMetric::Distance,
        extent: 2.345_678_9,
        provenance: serde_json::json!({ "seed": u64::MAX, "loss": 0.1 + 0.2, "tiny": 5e-324, "z": [null, -0.0] }),
    }
}
