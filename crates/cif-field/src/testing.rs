//! Random fields for the unit tests.

use cif_geometry::{Bounds, PinholeCamera, RigidTransform};
use glam::{DMat3, DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use crate::tracks::{DenseTrack, NO_GROUP, Samples, TrackGroup, TrackPose, Tracks, VisibilityStep};
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
    let mut identities = Identities::default();
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
            taxonomies: Default::default(),
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
        tracks: None,
        identities: Some(identities),
        instances,
        timeline: Timeline { times: vec![0.0, 1.0 / 3.0, 0.1 + 0.6, 1.0], frames_per_second: 29.97 },
        cameras: (0..4).map(record).collect(),
        sh_degree: 3,
        background: [1.0, 0.1, 0.0],
        sort_metric: SortMetric::Distance,
        extent: 2.345_678_9,
        record: crate::Record {
            notes: serde_json::Map::from_iter([(
                "odd".to_owned(),
                serde_json::json!({ "seed": u64::MAX, "loss": 0.1 + 0.2, "tiny": 5e-324, "z": [null, -0.0] }),
            )]),
            ..crate::Record::default()
        },
    }
}

/// [`field`] with recorded motion: group 0 turns and travels, group 1 appears late and is dense, group 2 is
/// exempt from the deformation; a quarter of the Gaussians have no group. Opacities of
/// group 0 and colours of group 2 change.
pub(crate) fn tracked_field(n: usize, seed: u64) -> Field {
    let mut field = field(n, seed);
    let group_of: Vec<u32> = (0..n as u32).map(|row| if row % 4 == 3 { NO_GROUP } else { row % 4 }).collect();
    let count = |of: u32| group_of.iter().filter(|group| **group == of).count();
    let (turning, members, added) = (count(0), count(1), count(2));
    let opacity = |k: usize| (k % 7) as f32 / 6.0;
    let color = |k: usize| std::array::from_fn(|c| (k as f32 - c as f32) / 16.0);
    let mut rng = Pcg64::seed_from_u64(seed ^ 77);
    let mut row = || std::array::from_fn(|_| rng.random_range(-1.0_f32..1.0));
    let pose = |time: f64, angle: f64| TrackPose {
        time,
        translation: DVec3::new(0.3 + time, -0.2, 0.1 * angle),
        rotation: DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, angle),
    };
    let dense = DenseTrack {
        times: vec![0.1, 0.5, 0.9],
        means: (0..3 * members).map(|_| row()).collect(),
        quaternions: (0..3 * members).map(|k| [1.0, 0.1, 0.01 * k as f32, -0.2]).collect(),
        log_scales: Some(vec![[-2.0, -3.0, -2.5]; 3 * members]),
    };
    let still = |name: &str| TrackGroup::still(name, DVec3::new(0.25, 0.5, -0.125));
    let groups = vec![
        TrackGroup {
            poses: vec![pose(0.0, 0.0), pose(0.25, 0.9), pose(0.75, -0.6)],
            opacities: Some(Samples {
                times: vec![0.25, 0.75],
                values: (0..2 * turning).map(opacity).collect(),
            }),
            ..still("turning")
        },
        TrackGroup {
            visibility: vec![
                VisibilityStep { time: 0.0, visible: false },
                VisibilityStep { time: 0.5, visible: true },
            ],
            dense: Some(dense),
            ..still("late")
        },
        TrackGroup {
            deformed: false,
            poses: vec![pose(0.5, 2.5)],
            colors: Some(Samples { times: vec![0.0, 1.0], values: (0..2 * added).map(color).collect() }),
            ..still("added")
        },
    ];
    field.tracks = Some(Tracks { group_of, groups });
    field
}
