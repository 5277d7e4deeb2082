//! Scenes with recorded motion, for the tests of imports.

use cif_field::tracks::{DenseTrack, NO_GROUP, TrackGroup, TrackPose, Tracks, VisibilityStep};
use cif_field::{Field, Gaussians, Identities, Instance, RecordedCamera, SortMetric, Timeline};
use cif_geometry::{PinholeCamera, RigidTransform};
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::{
    Appearance, CaptureFrame, Motion, MotionReport, Node, NodeKind, Origin, SceneGraph, Splats, TimeCodes,
    UpAxis, extent,
};

/// Gaussians per object, and of the background.
pub(crate) const MEMBERS: usize = 40;

/// Times of the scenes.
pub(crate) const TIMES: [f64; 6] = [0.0, 0.15, 0.4, 0.55, 0.8, 1.0];

/// Numbers in [-1, 1) that depend on the seed alone.
pub(crate) struct Numbers(u64);

impl Numbers {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub(crate) fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    pub(crate) fn vector(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }
}

/// `objects` instances one metre apart and a background. By turns an object stands still, turns and travels,
/// deforms, or appears at frame 2. Object k has id 3 k + 2. Occupancies are anything: owners are given.
pub(crate) fn recorded_field(objects: usize, seed: u64) -> Field {
    let mut numbers = Numbers::new(seed);
    let mut gaussians = Gaussians::default();
    let mut identities = Identities::empty();
    let mut tracks = Tracks::default();
    for object in 0..=objects {
        let owner = (object < objects).then_some(object as u16);
        let centre = DVec3::new(object as f64, 0.3 * numbers.next(), 0.5);
        let first = gaussians.len();
        for _ in 0..MEMBERS {
            gaussians.means.push((centre + 0.2 * numbers.vector()).as_vec3().to_array());
            gaussians.log_scales.push((0.7 * numbers.vector() - 4.0).as_vec3().to_array());
            let turn = numbers.vector();
            let turn = DQuat::from_xyzw(turn.x, turn.y, turn.z, 1.2).normalize();
            gaussians.quaternions.push([turn.w, turn.x, turn.y, turn.z].map(|v| v as f32));
            gaussians.opacity_logits.push(1.5 + numbers.next() as f32);
            gaussians.occupancy_logits.push(4.0 * numbers.next() as f32);
            gaussians
                .sh_coefficients
                .push(std::array::from_fn(|k| numbers.next() as f32 * if k < 3 { 1.0 } else { 0.2 }));
            identities.push_certain(owner);
        }
        if owner.is_none() {
            tracks.group_of.extend([NO_GROUP; MEMBERS]);
            continue;
        }
        tracks.group_of.extend([tracks.groups.len() as u32; MEMBERS]);
        let instance = Some(3 * object as u16 + 2);
        tracks.groups.push(TrackGroup { instance, ..group(object, centre, &gaussians, first, &mut numbers) });
    }
    Field {
        gaussians,
        deformation: None,
        tracks: tracks.compact(),
        identities: Some(identities),
        instances: (0..objects as u16)
            .map(|k| Instance {
                id: 3 * k + 2,
                label: format!("thing {k}"),
                category: "thing".into(),
                taxonomies: Default::default(),
            })
            .collect(),
        timeline: Timeline { times: TIMES.to_vec(), frames_per_second: 30.0 },
        cameras: cameras(),
        sh_degree: 3,
        background: [0.25, 0.5, 1.0],
        sort_metric: SortMetric::Distance,
        extent: 1.0,
        record: Default::default(),
    }
}

fn group(
    object: usize,
    centre: DVec3,
    gaussians: &Gaussians,
    first: usize,
    numbers: &mut Numbers,
) -> TrackGroup {
    let mut group = TrackGroup::still(format!("object {object}"), centre);
    match object % 4 {
        1 => {
            let axis = (numbers.vector() + DVec3::Z * 1.5).normalize();
            let pose = |time: f64| TrackPose {
                time,
                translation: centre + DVec3::new(0.3 * time, -0.2 * time, time * time),
                rotation: DQuat::from_axis_angle(axis, 1.7 * time),
            };
            group.poses = TIMES.map(pose).to_vec();
        }
        2 => {
            let rows = first..first + MEMBERS;
            let mut dense = DenseTrack {
                times: TIMES.to_vec(),
                means: Vec::new(),
                quaternions: Vec::new(),
                log_scales: Some(Vec::new()),
            };
            for time in TIMES {
                for row in rows.clone() {
                    let sway = (0.3 * time * numbers.vector()).as_vec3().to_array();
                    let mean = gaussians.means[row];
                    dense.means.push(std::array::from_fn(|k| mean[k] + sway[k]));
                    dense.quaternions.push(gaussians.quaternions[row]);
                    let grown = gaussians.log_scales[row].map(|scale| scale + 0.3 * time as f32);
                    dense.log_scales.as_mut().unwrap().push(grown);
                }
            }
            group.dense = Some(dense);
        }
        3 => {
            group.visibility = vec![
                VisibilityStep { time: TIMES[0], visible: false },
                VisibilityStep { time: TIMES[2], visible: true },
            ];
        }
        _ => {}
    }
    group
}

fn cameras() -> Vec<RecordedCamera> {
    let record = |(name, time_index): (&str, usize)| RecordedCamera {
        name: name.to_owned(),
        time_index,
        trained: true,
        camera: PinholeCamera {
            width: 40,
            height: 30,
            focal_px: DVec2::new(30.0, 31.0),
            principal_px: DVec2::new(20.5, 14.0),
            camera_from_world: RigidTransform {
                rotation: DMat3::from_rotation_x(0.1 * time_index as f64),
                translation: DVec3::new(-1.0, 0.0, 4.0 + 0.1 * time_index as f64),
            },
        },
    };
    [("left", 0), ("left", 3), ("right", 5)].map(record).to_vec()
}

/// The objects of [`recorded_field`] without recorded motion, with a deformation as training makes them, and
/// identities as they are estimated: some rows name two instances, and every tenth Gaussian is too faint to see.
pub(crate) fn learned_field(objects: usize, seed: u64) -> Field {
    let mut field = Field { tracks: None, ..recorded_field(objects, seed) };
    let heads = cif_field::Heads { position: true, scale: true, rotation: true, opacity: false, sh: false };
    let config = cif_render::synthetic::SyntheticConfig { heads: Some(heads), seed, ..Default::default() };
    let mut deformation = cif_render::synthetic::generate(&config).field.deformation.unwrap();
    deformation.bounds =
        cif_geometry::Bounds { low: DVec3::splat(-1.0), high: DVec3::new(objects as f64 + 1.0, 1.0, 1.5) };
    field.deformation = Some(deformation);
    let mut identities = Identities::empty();
    for row in 0..field.len() {
        let object = (row / MEMBERS) as u16;
        let is_background = usize::from(object) == objects;
        field.gaussians.occupancy_logits[row] = if is_background { -4.0 } else { 2.0 };
        if row % 10 == 3 {
            field.gaussians.opacity_logits[row] = -7.0;
        }
        let label = if is_background { 0 } else { object };
        let other = (label + 1) % objects as u16;
        let mut entries = vec![(label, 0.8_f32)];
        if row % 3 == 0 && other != label {
            entries.push((other, 0.15));
        }
        entries.sort_by_key(|(label, _)| *label);
        for (label, share) in entries {
            // The background was hardly seen inside masks.
            let share = if is_background { 0.05 * share } else { share };
            identities.labels.push(label);
            identities.log_estimates.push(share.ln());
            identities.log_calibrations.push(0.1);
        }
        identities.row_offsets.push(identities.labels.len() as u32);
    }
    field.identities = Some(identities);
    field
}

/// An instance at rest whose splats lie at these places, all of one size.
pub(crate) fn node_of(places: &[DVec3], scales: [f32; 3]) -> Node {
    let count = places.len();
    let splats = Splats {
        means: places.iter().map(|place| place.to_array().map(|v| v as f32)).collect(),
        orientations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        scales: vec![scales; count],
        opacities: vec![0.9; count],
        sh_coefficients: vec![0.5; 3 * count],
        occupancies: vec![0.9; count],
        identity_probabilities: vec![1.0; count],
        rows: (0..count as u32).collect(),
        ..Splats::default()
    };
    Node {
        kind: NodeKind::Instance { id: 1, index: 0 },
        name: "thing_001".to_owned(),
        label: "thing".to_owned(),
        category: "thing".to_owned(),
        taxonomies: Default::default(),
        embedding: None,
        pivot: DVec3::ZERO,
        motion: Motion::Static,
        report: MotionReport::unfitted(&splats, &Motion::Static),
        extent: extent::splat_bounds(&RigidTransform::IDENTITY, &splats, 0..count),
        splats,
        appearance: Appearance::default(),
        proxy: None,
        colliders: Vec::new(),
        visibility: Vec::new(),
        source_frames: (0, 0),
        mean_occupancy: 0.9,
    }
}

/// A scene of one moment.
pub(crate) fn graph_of(nodes: Vec<Node>) -> SceneGraph {
    SceneGraph {
        antialiased: None,
        near: None,
        up_axis: UpAxis::Z,
        meters_per_unit: 1.0,
        frame: CaptureFrame::default(),
        time_codes: TimeCodes { samples: vec![0.0], times: vec![0.0], frames_per_second: 24.0 },
        nodes,
        windows: Vec::new(),
        cameras: Vec::new(),
        background_color: [1.0; 3],
        sort_metric: SortMetric::Z,
        omitted: Vec::new(),
        warnings: Vec::new(),
        origin: Origin::default(),
    }
}
