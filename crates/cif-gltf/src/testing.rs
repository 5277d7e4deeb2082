//! Small scenes for tests.

use cif_field::RotationEvidence;
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_geometry::{Bounds, PinholeCamera, RigidTransform};
use cif_scene::{
    CameraSample, CameraTrack, CaptureFrame, DenseMotion, DenseSample, IdentityShare, Motion, MotionModel,
    MotionReport, Node, NodeKind, Origin, Part, PartsMotion, PoseSample, ResidualStatistics, SceneGraph,
    SceneOptions, Splats, TimeCodes, UpAxis, VisibilitySample, extent,
};
use glam::{DMat3, DQuat, DVec2, DVec3};
use proptest::prelude::*;

/// Numbers from a seed: splitmix64.
pub(crate) struct Numbers(u64);

impl Numbers {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Between `low` and `high`.
    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.next() >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub(crate) fn vector(&mut self) -> DVec3 {
        DVec3::new(self.between(-2.0, 2.0), self.between(-2.0, 2.0), self.between(-2.0, 2.0))
    }

    pub(crate) fn rotation(&mut self) -> DQuat {
        let q = DQuat::from_xyzw(
            self.between(-1.0, 1.0),
            self.between(-1.0, 1.0),
            self.between(-1.0, 1.0),
            self.between(0.1, 1.0),
        );
        q.normalize()
    }

    pub(crate) fn splats(&mut self, count: usize, sh_degree: u8, first_row: u32) -> Splats {
        let stride = 3 * coefficient_count(sh_degree);
        let mut splats = Splats { sh_degree, ..Splats::default() };
        for k in 0..count {
            splats.means.push(self.vector().to_array().map(|v| v as f32));
            let q = self.rotation();
            splats.orientations.push([q.w, q.x, q.y, q.z].map(|v| v as f32));
            splats.scales.push(std::array::from_fn(|_| self.between(-6.0, -1.0).exp() as f32));
            splats.opacities.push(self.between(0.0, 1.0) as f32);
            splats.sh_coefficients.extend((0..stride).map(|_| self.between(-1.0, 1.0) as f32));
            splats.occupancies.push(self.between(0.0, 1.0) as f32);
            splats.identity_probabilities.push(self.between(0.0, 1.0) as f32);
            splats.identities.push(std::array::from_fn(|place| match place as u32 <= first_row % 3 {
                true => {
                    IdentityShare { id: (k + 300 * place) as u16 + 1, share: self.between(0.0, 0.25) as f32 }
                }
                false => IdentityShare::default(),
            }));
            splats.rows.push(first_row + 70_000 * k as u32);
        }
        splats
    }

    /// Splats that move and, where `changes`, grow and shrink on their own; as they are at first.
    pub(crate) fn dense(&mut self, splats: &mut Splats, codes: &[f64], changes: bool) -> DenseMotion {
        let mut samples: Vec<DenseSample> = Vec::new();
        for &time_code in codes {
            let mut shape = self.splats(splats.len(), 0, 0);
            if let Some(before) = samples.last() {
                for (q, before) in shape.orientations.iter_mut().zip(&before.orientations) {
                    if q.iter().zip(before).map(|(a, b)| a * b).sum::<f32>() < 0.0 {
                        *q = q.map(|value| -value);
                    }
                }
            }
            // As glTF holds them: the same along all axes, from those of the splats on.
            let mut grown = |scale: &[f32; 3]| {
                let size = self.between(0.5, 2.0) as f32;
                scale.map(|scale| size * scale)
            };
            let scales = changes.then(|| splats.scales.iter().map(&mut grown).collect());
            let Splats { means, orientations, .. } = shape;
            samples.push(DenseSample { time_code, means, orientations, scales, extent: Bounds::EMPTY });
        }
        splats.means.clone_from(&samples[0].means);
        splats.orientations.clone_from(&samples[0].orientations);
        if let Some(scales) = &samples[0].scales {
            splats.scales.clone_from(scales);
        }
        DenseMotion { track: Vec::new(), samples }
    }

    pub(crate) fn track(&mut self, codes: &[f64]) -> Vec<PoseSample> {
        let mut track: Vec<PoseSample> = Vec::new();
        for &time_code in codes {
            let turn = self.rotation();
            let turned = track.last().is_some_and(|before| before.rotation.dot(turn) < 0.0);
            let rotation = if turned { -turn } else { turn };
            track.push(PoseSample { time_code, translation: self.vector(), rotation });
        }
        track
    }
}

/// Parameters of a random scene.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Recipe {
    pub(crate) seed: u64,
    pub(crate) nodes: usize,
    pub(crate) splats: usize,
    pub(crate) sh_degree: u8,
    pub(crate) frames: usize,
    pub(crate) first_frame: usize,
    pub(crate) up_axis: UpAxis,
    pub(crate) meters_per_unit: f64,
    pub(crate) frame: CaptureFrame,
}

pub(crate) fn recipes() -> impl Strategy<Value = Recipe> {
    let axes = prop_oneof![Just(UpAxis::Y), Just(UpAxis::Z)];
    let units = prop_oneof![Just(1.0), Just(0.01), 0.1..10.0_f64];
    let frames = prop_oneof![
        Just(CaptureFrame::default()),
        Just(CaptureFrame { offset: [3.1e6, -2.7e5, 41.25], scale: 1.0 }),
        Just(CaptureFrame { offset: [-4.4e7, 1.3e8, 0.1], scale: 1e-3 }),
    ];
    (any::<u64>(), 1..6_usize, 1..9_usize, 0..=3_u8, 1..12_usize, 0..40_usize, axes, units, frames).prop_map(
        |(seed, nodes, splats, sh_degree, frames, first_frame, up_axis, meters_per_unit, frame)| Recipe {
            seed,
            nodes,
            splats,
            sh_degree,
            frames,
            first_frame,
            up_axis,
            meters_per_unit,
            frame,
        },
    )
}

/// A scene with all motion models that glTF holds, visibility, two cameras and a background.
pub(crate) fn scene(recipe: Recipe) -> SceneGraph {
    let mut numbers = Numbers::new(recipe.seed);
    let codes: Vec<f64> = (0..recipe.frames).map(|k| (recipe.first_frame + 2 * k) as f64).collect();
    let last = (recipe.frames.max(2) - 1) as f64;
    let times = (0..recipe.frames).map(|k| k as f64 / last).collect();
    let mut nodes = Vec::new();
    for index in 0..recipe.nodes {
        let splats = numbers.splats(recipe.splats + 2, recipe.sh_degree, 1000 * index as u32);
        let motion = motion(&mut numbers, index, &splats, &codes);
        let kind = NodeKind::Instance { id: 3 * index as u16 + 1, index };
        nodes.push(node(&mut numbers, kind, &format!("thing_{index:03}"), splats, motion, &codes));
    }
    let splats = numbers.splats(recipe.splats, recipe.sh_degree, 500_000);
    nodes.push(node(&mut numbers, NodeKind::Background, "background", splats, Motion::Static, &codes));
    SceneGraph {
        up_axis: recipe.up_axis,
        meters_per_unit: recipe.meters_per_unit,
        frame: recipe.frame,
        time_codes: TimeCodes { samples: codes.clone(), times, frames_per_second: 30.0 },
        nodes,
        windows: Vec::new(),
        cameras: vec![
            camera(&mut numbers, "cam 1", &codes, true),
            camera(&mut numbers, "fixed", &codes, false),
        ],
        background_color: [1.0, 0.3, 0.1],
        sort_metric: cif_field::SortMetric::Z,
        antialiased: Some(true),
        near: None,
        omitted: vec!["lost thing".into()],
        warnings: vec!["a warning".into()],
        origin: Origin { field_fingerprint: Some("0123abcd".into()), options: Some(SceneOptions::default()) },
    }
}

fn motion(numbers: &mut Numbers, index: usize, splats: &Splats, codes: &[f64]) -> Motion {
    match index % 4 {
        0 => Motion::Rigid(numbers.track(codes)),
        1 => Motion::Static,
        2 => {
            let half = splats.len() / 2;
            let mut part = |name: &str, splats: std::ops::Range<usize>, moves: bool| Part {
                name: name.into(),
                splats,
                pivot: numbers.vector(),
                track: if moves { numbers.track(codes) } else { Vec::new() },
                extent: Bounds::EMPTY,
                joint: None,
            };
            let parts = vec![part("part_00", 0..half, true), part("part_01", half..splats.len(), false)];
            let track = if codes.len() > 1 { numbers.track(codes) } else { Vec::new() };
            let mut motion = PartsMotion { track, parts };
            if codes.len() < 2 {
                motion.parts[0].track.clear();
            }
            for part in &mut motion.parts {
                let r = part.splats.clone();
                part.extent = extent::ellipsoid_bounds(
                    &RigidTransform::IDENTITY,
                    &splats.means[r.clone()],
                    &splats.orientations[r.clone()],
                    &splats.scales[r],
                );
            }
            Motion::Parts(motion)
        }
        // Only some of the times.
        _ => Motion::Rigid(numbers.track(&codes[..codes.len().div_ceil(2)])),
    }
}

fn node(
    numbers: &mut Numbers,
    kind: NodeKind,
    name: &str,
    splats: Splats,
    motion: Motion,
    codes: &[f64],
) -> Node {
    let visibility = match (kind, codes.len()) {
        (NodeKind::Instance { index, .. }, 2..) if index % 2 == 0 => vec![
            VisibilitySample { time_code: codes[0], visible: index % 4 == 0 },
            VisibilitySample { time_code: codes[1], visible: index % 4 != 0 },
        ],
        _ => Vec::new(),
    };
    let model = match &motion {
        Motion::Static => MotionModel::Static,
        Motion::Rigid(_) => MotionModel::Rigid,
        Motion::Parts(_) => MotionModel::Parts,
        Motion::Dense(_) => MotionModel::Dense,
    };
    let identity = RigidTransform::IDENTITY;
    Node {
        kind,
        name: name.into(),
        label: format!("{name} \u{676f}"),
        category: "thing".into(),
        taxonomies: [("coco".to_owned(), "cup".to_owned())].into(),
        embedding: Some(cif_field::Embedding { model: "clip".into(), direction: vec![0.6, -0.8] }),
        pivot: if kind == NodeKind::Background { DVec3::ZERO } else { numbers.vector() },
        extent: extent::ellipsoid_bounds(&identity, &splats.means, &splats.orientations, &splats.scales),
        motion,
        proxy: None,
        colliders: Vec::new(),
        appearance: cif_scene::Appearance::default(),
        visibility,
        source_frames: (2, 9),
        mean_occupancy: numbers.between(0.0, 1.0) as f32,
        report: MotionReport {
            model,
            rotation: (model == MotionModel::Rigid).then_some(RotationEvidence::Assumed),
            gaussians: splats.len(),
            size: numbers.between(0.1, 2.0),
            tolerance: 0.01,
            residual: ResidualStatistics { rms: numbers.between(0.0, 0.01), ..ResidualStatistics::default() },
            static_residual: ResidualStatistics::default(),
            rigid_residual: None,
            samples: codes.len(),
            motion_bytes: 123,
            parts_residual: None,
            parts: 0,
            seconds: 0.0,
        },
        splats,
    }
}

fn camera(numbers: &mut Numbers, label: &str, codes: &[f64], moves: bool) -> CameraTrack {
    let mut pose =
        RigidTransform { rotation: DMat3::from_quat(numbers.rotation()), translation: numbers.vector() };
    let samples = codes.iter().map(|&time_code| {
        if moves {
            pose = RigidTransform {
                rotation: DMat3::from_quat(numbers.rotation()),
                translation: numbers.vector(),
            };
        }
        CameraSample {
            time_code,
            exposure: 0.0,
            camera: PinholeCamera {
                width: 640,
                height: 480,
                focal_px: DVec2::new(500.0, 480.0),
                principal_px: DVec2::new(318.0, 243.0),
                camera_from_world: pose,
            },
        }
    });
    CameraTrack { name: label.replace(' ', "_"), label: label.into(), samples: samples.collect() }
}
