//! Random small scenes.

use cif_field::{Embedding, RotationEvidence};
use cif_geometry::{Bounds, PinholeCamera, RigidTransform, spherical_harmonics};
use cif_scene::{
    Appearance, AppearanceSample, CameraSample, CameraTrack, CaptureFrame, ConvexHull, DenseMotion,
    DenseSample, IdentityShare, IdentityShares, Motion, MotionModel, MotionReport, Node, NodeKind, Origin,
    Part, PartsMotion, PointProxy, PoseSample, ResidualStatistics, SceneGraph, SceneOptions, Splats,
    TimeCodes, UpAxis, VisibilitySample, extent,
};
use glam::{DMat3, DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

pub(super) struct Maker {
    chance: Pcg64Mcg,
    codes: Vec<f64>,
}

fn bounds(means: &[[f32; 3]], orientations: &[[f32; 4]], scales: &[[f32; 3]]) -> Bounds {
    extent::ellipsoid_bounds(&RigidTransform::IDENTITY, means, orientations, scales)
}

pub(super) fn splat_bounds(splats: &Splats) -> Bounds {
    bounds(&splats.means, &splats.orientations, &splats.scales)
}

impl Maker {
    pub(super) fn new(seed: u64) -> Self {
        let mut chance = Pcg64Mcg::seed_from_u64(seed);
        let count = chance.random_range(1..6);
        let codes = (0..count).map(|index| f64::from(index * 3)).collect();
        Self { chance, codes }
    }

    /// As [`Maker::new`], sampled at these time codes.
    pub(super) fn at(seed: u64, codes: Vec<f64>) -> Self {
        Self { codes, ..Self::new(seed) }
    }

    fn float(&mut self, low: f32, high: f32) -> f32 {
        self.chance.random_range(low..high)
    }

    fn vector(&mut self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| self.chance.random_range(-2.0..2.0)))
    }

    /// Unit to single precision, as USD keeps it.
    fn rotation(&mut self) -> DQuat {
        let q: [f64; 4] = std::array::from_fn(|_| self.chance.random_range(-1.0..1.0));
        let q = DQuat::from_array(q).normalize();
        DQuat::from_array(q.to_array().map(|component| f64::from(component as f32)))
    }

    fn orientation(&mut self) -> [f32; 4] {
        let q = self.rotation();
        [q.w, q.x, q.y, q.z].map(|component| component as f32)
    }

    pub(super) fn splats(&mut self, count: usize, degree: u8) -> Splats {
        let floats = 3 * spherical_harmonics::coefficient_count(degree);
        Splats {
            means: (0..count).map(|_| std::array::from_fn(|_| self.float(-1.0, 1.0))).collect(),
            orientations: (0..count).map(|_| self.orientation()).collect(),
            scales: (0..count).map(|_| std::array::from_fn(|_| self.float(0.001, 0.1))).collect(),
            opacities: (0..count).map(|_| self.float(0.0, 1.0)).collect(),
            sh_degree: degree,
            sh_coefficients: (0..count * floats).map(|_| self.float(-3.0, 3.0)).collect(),
            occupancies: (0..count)
                .map(|index| if index % 2 == 0 { 0.25 } else { self.float(0.0, 1.0) })
                .collect(),
            identity_probabilities: (0..count).map(|_| self.float(0.0, 1.0)).collect(),
            rows: (0..count as u32).map(|index| index * 7 + 3).collect(),
            identities: (0..count).map(|_| self.identity()).collect(),
        }
    }

    /// No instance to as many as are kept.
    fn identity(&mut self) -> IdentityShares {
        let mut shares = IdentityShares::default();
        let used = self.chance.random_range(0..=shares.len());
        for (place, entry) in shares[..used].iter_mut().enumerate() {
            *entry =
                IdentityShare { id: 1 + 1000 * place as u16, share: self.chance.random_range(0.0..0.25) };
        }
        shares
    }

    /// Half of the nodes fade, and half of them change their colours.
    fn appearance(&mut self, splats: &mut Splats) -> Appearance {
        let mut samples = |count: usize, low: f32, high: f32| -> Vec<AppearanceSample> {
            if self.chance.random_bool(0.5) {
                return Vec::new();
            }
            let codes = self.codes.clone().into_iter();
            codes
                .map(|time_code| {
                    let values = (0..count).map(|_| self.chance.random_range(low..high)).collect();
                    AppearanceSample { time_code, values }
                })
                .collect()
        };
        let opacities = samples(splats.len(), 0.0, 1.0);
        let colors = samples(splats.sh_coefficients.len(), -3.0, 3.0);
        if let Some(first) = colors.first() {
            splats.sh_coefficients.clone_from(&first.values);
        }
        Appearance { opacities, colors }
    }

    pub(super) fn track(&mut self) -> Vec<PoseSample> {
        let mut track: Vec<PoseSample> = Vec::new();
        for time_code in self.codes.clone() {
            let (translation, mut rotation) = (self.vector(), self.rotation());
            if track.last().is_some_and(|before| before.rotation.dot(rotation) < 0.0) {
                rotation = -rotation;
            }
            track.push(PoseSample { time_code, translation, rotation });
        }
        track
    }

    fn motion(&mut self, model: MotionModel, splats: &mut Splats) -> Motion {
        match model {
            MotionModel::Static => Motion::Static,
            MotionModel::Rigid => Motion::Rigid(self.track()),
            MotionModel::Parts => {
                let cuts = [0, 3, splats.len()];
                let parts = (0..2).map(|index| {
                    let range = cuts[index]..cuts[index + 1];
                    let track = if index == 0 { Vec::new() } else { self.track() };
                    Part {
                        name: format!("part_{index:02}"),
                        pivot: self.vector(),
                        track,
                        extent: bounds(
                            &splats.means[range.clone()],
                            &splats.orientations[range.clone()],
                            &splats.scales[range.clone()],
                        ),
                        splats: range,
                        joint: None,
                    }
                });
                let parts = parts.collect();
                Motion::Parts(PartsMotion { track: self.track(), parts })
            }
            MotionModel::Dense => {
                let scaled = self.chance.random_bool(0.5);
                let mut samples: Vec<DenseSample> = Vec::new();
                for time_code in self.codes.clone() {
                    let other = self.splats(splats.len(), 0);
                    let mut orientations = other.orientations;
                    if let Some(before) = samples.last() {
                        for (q, before) in orientations.iter_mut().zip(&before.orientations) {
                            if q.iter().zip(before).map(|(a, b)| a * b).sum::<f32>() < 0.0 {
                                *q = q.map(|component| -component);
                            }
                        }
                    }
                    let extent = bounds(
                        &other.means,
                        &orientations,
                        if scaled { &other.scales } else { &splats.scales },
                    );
                    samples.push(DenseSample {
                        time_code,
                        means: other.means,
                        orientations,
                        scales: scaled.then_some(other.scales),
                        extent,
                    });
                }
                splats.means.clone_from(&samples[0].means);
                splats.orientations.clone_from(&samples[0].orientations);
                if let Some(scales) = &samples[0].scales {
                    splats.scales.clone_from(scales);
                }
                let track = if self.chance.random_bool(0.5) { self.track() } else { Vec::new() };
                Motion::Dense(DenseMotion { track, samples })
            }
        }
    }

    fn hull(&mut self, part: Option<usize>) -> ConvexHull {
        let size = self.float(0.2, 1.0);
        ConvexHull {
            points: vec![[0.0; 3], [size, 0.0, 0.0], [0.0, size, 0.0], [0.0, 0.0, size]],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            part,
        }
    }

    fn residual(&mut self) -> ResidualStatistics {
        let mut value = || self.chance.random_range(0.0..0.1);
        ResidualStatistics {
            rms: value(),
            decisive: value(),
            percentile_95: value(),
            max: value(),
            outlier_share: value(),
            orientation_rms_degrees: value(),
        }
    }

    pub(super) fn node(&mut self, kind: NodeKind, model: MotionModel) -> Node {
        let degree = self.chance.random_range(0..=3);
        let count = self.chance.random_range(5..12);
        let mut splats = self.splats(count, degree);
        let motion = self.motion(model, &mut splats);
        let appearance = self.appearance(&mut splats);
        let pivot = self.vector();
        let (name, label, category) = match kind {
            NodeKind::Instance { id, .. } => {
                (format!("red_mug_{id:03}"), "red \"mug\" Ü".to_owned(), "mug".to_owned())
            }
            NodeKind::Background => {
                splats.identity_probabilities.fill(0.0);
                ("background".into(), "background".into(), "background".into())
            }
        };
        let proxy = self.chance.random_bool(0.5).then(|| PointProxy {
            indices: (0..count as u32).step_by(2).collect(),
            widths: (0..count.div_ceil(2)).map(|_| self.float(0.01, 0.1)).collect(),
            colors: (0..count.div_ceil(2)).map(|_| [self.float(0.0, 1.0), 0.5, 0.25]).collect(),
        });
        let colliders = match (kind, &motion) {
            (NodeKind::Background, _) => Vec::new(),
            (_, Motion::Parts(_)) => vec![self.hull(Some(1)), self.hull(Some(0))],
            _ => vec![self.hull(None), self.hull(None)],
        };
        let visibility = match self.chance.random_range(0..3) {
            0 => vec![
                VisibilitySample { time_code: 0.0, visible: false },
                VisibilitySample { time_code: 2.0, visible: true },
            ],
            _ => Vec::new(),
        };
        let report = MotionReport {
            model,
            rotation: match self.chance.random_range(0..3) {
                _ if model != MotionModel::Rigid => None,
                0 => None,
                1 => Some(RotationEvidence::Observed),
                _ => Some(RotationEvidence::Assumed),
            },
            gaussians: count,
            size: self.chance.random(),
            tolerance: self.chance.random(),
            residual: self.residual(),
            static_residual: self.residual(),
            rigid_residual: self.chance.random_bool(0.5).then(|| self.residual()),
            parts_residual: self.chance.random_bool(0.5).then(|| self.residual()),
            parts: if model == MotionModel::Parts { 2 } else { 0 },
            samples: self.codes.len(),
            motion_bytes: 123,
            seconds: 0.5,
        };
        let mut node = Node {
            kind,
            name,
            label,
            category,
            taxonomies: match kind {
                NodeKind::Instance { .. } => [("wikidata_qcode".to_owned(), "Q81727".to_owned())].into(),
                NodeKind::Background => Default::default(),
            },
            embedding: match kind {
                NodeKind::Instance { id, .. } => {
                    let angle = f32::from(id);
                    Some(Embedding { model: "clip".to_owned(), direction: vec![angle.sin(), angle.cos()] })
                }
                NodeKind::Background => None,
            },
            pivot,
            motion,
            extent: splat_bounds(&splats),
            splats,
            proxy,
            colliders,
            visibility,
            source_frames: (0, 3 * (self.codes.len() - 1)),
            mean_occupancy: self.float(0.0, 1.0),
            report,
            appearance,
        };
        if let Motion::Parts(motion) = &node.motion {
            let boxes = motion.parts.iter().map(|part| {
                let rest = part.track.first().map_or(
                    RigidTransform { rotation: DMat3::IDENTITY, translation: part.pivot },
                    PoseSample::transform,
                );
                let (s, range) = (&node.splats, part.splats.clone());
                let (means, orientations) = (&s.means[range.clone()], &s.orientations[range.clone()]);
                extent::ellipsoid_bounds(&rest, means, orientations, &s.scales[range])
            });
            node.extent = boxes.fold(Bounds::EMPTY, |all, bounds| all.union(bounds));
        }
        node
    }

    fn camera(&mut self, name: &str, moves: bool) -> CameraTrack {
        let first = self.vector();
        let samples = self.codes.clone().into_iter().map(|time_code| CameraSample {
            time_code,
            // One adapts while it films, the other does not.
            exposure: if moves { 0.25 - time_code / 64.0 } else { 0.0 },
            camera: PinholeCamera {
                width: 64,
                height: 48,
                focal_px: DVec2::new(60.0, 58.0),
                principal_px: DVec2::new(30.0, 25.0),
                camera_from_world: RigidTransform {
                    rotation: DMat3::from_quat(DQuat::from_rotation_y(0.3)),
                    translation: if moves { self.vector() } else { first },
                },
            },
        });
        let samples = samples.collect();
        CameraTrack { name: name.to_owned(), label: format!("{name} 1"), samples }
    }

    /// A scene with a node of every motion model and a background.
    pub(super) fn scene(&mut self) -> SceneGraph {
        let models = [MotionModel::Static, MotionModel::Rigid, MotionModel::Parts, MotionModel::Dense];
        let mut nodes: Vec<Node> = models
            .iter()
            .enumerate()
            .map(|(index, &model)| self.node(NodeKind::Instance { id: 1 + 5 * index as u16, index }, model))
            .collect();
        let model = if self.chance.random_bool(0.5) { MotionModel::Static } else { MotionModel::Dense };
        nodes.push(self.node(NodeKind::Background, model));
        if let Motion::Dense(dense) = &mut nodes[4].motion {
            dense.track.clear();
        }
        let codes = self.codes.clone();
        let last = codes[codes.len() - 1].max(1.0);
        SceneGraph {
            up_axis: if self.chance.random_bool(0.5) { UpAxis::Y } else { UpAxis::Z },
            meters_per_unit: if self.chance.random_bool(0.5) { 1.0 } else { 0.1 },
            frame: CaptureFrame::default(),
            time_codes: TimeCodes {
                times: codes.iter().map(|code| code / last).collect(),
                samples: codes,
                frames_per_second: 12.5,
            },
            nodes,
            windows: Vec::new(),
            cameras: vec![self.camera("hand_held", true), self.camera("tripod", false)],
            background_color: [0.1, 0.2, 0.3],
            sort_metric: cif_field::SortMetric::Distance,
            antialiased: Some(true),
            near: None,
            omitted: vec!["ghost".to_owned()],
            warnings: vec!["colours change".to_owned()],
            origin: Origin {
                field_fingerprint: Some("0123abcd".to_owned()),
                options: Some(SceneOptions { frame_step: 3, min_opacity: 0.1, ..SceneOptions::default() }),
            },
        }
    }
}
