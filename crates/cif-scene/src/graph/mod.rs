//! The scene graph: nodes, their splats and motion, and cameras.

use std::collections::BTreeMap;

use cif_dataset::CaptureFrame;
use cif_field::Embedding;
use cif_geometry::spherical_harmonics::{BAND_0, coefficient_count};
use cif_geometry::{Bounds, PinholeCamera, RigidTransform};
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::joint::PartJoint;
use crate::motion::choose::{DENSE_BYTES, POSE_BYTES};
use crate::motion::placement;
use crate::report::MotionReport;
use crate::shape::body::Cloud;
use crate::shape::extent;
use crate::{SceneOptions, UpAxis};

/// A scene, ready to be written in any format.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneGraph {
    /// Declared up axis of the world.
    pub up_axis: UpAxis,
    /// Metres per world unit.
    pub meters_per_unit: f64,
    /// Where the coordinates of the graph lie in the world: that of the capture. *World* in a graph means its own
    /// frame; writers place it in the world, and readers take it from there. The identity for ordinary captures; see
    /// [`crate::world`].
    pub frame: CaptureFrame,
    /// When the samples are.
    pub time_codes: TimeCodes,
    /// One node per instance in the order of the field's instance table, then the background where there is one.
    pub nodes: Vec<Node>,
    /// Recorded cameras.
    pub cameras: Vec<CameraTrack>,
    /// Colour behind everything, display-referred RGB in [0, 1].
    pub background_color: [f32; 3],
    /// Order in which the splats were blended in training.
    pub sort_metric: cif_field::SortMetric,
    /// True when the splats are drawn antialiased: footprints widened, and their opacity lowered in turn; `None` where
    /// that is not known, which means not.
    pub antialiased: Option<bool>,
    /// Labels of instances that no visible Gaussian belongs to, so that they have no node.
    pub omitted: Vec<String>,
    /// Warnings for the user, one sentence each.
    pub warnings: Vec<String>,
    /// Where the graph came from: what an edited file is compared with when it comes home.
    pub origin: Origin,
}

/// Where a graph came from.
///
/// A file that cif wrote keeps both, so that [`Splats::rows`] read from it can be traced to the field and the
/// graph that was exported can be built again.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// Fingerprint of the field whose rows [`Splats::rows`] are; `None` for files that others wrote.
    pub field_fingerprint: Option<String>,
    /// Options that the graph was built with; `None` for files that others wrote.
    pub options: Option<SceneOptions>,
}

/// Captured frame numbers: frame `f` of the field's timeline is time code `f`.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeCodes {
    /// Sampled time codes, ascending, at least one.
    pub samples: Vec<f64>,
    /// Normalised time of every sample.
    pub times: Vec<f64>,
    /// Time codes per second.
    pub frames_per_second: f64,
}

impl TimeCodes {
    /// First time code.
    #[must_use]
    pub fn start(&self) -> f64 {
        self.samples.first().copied().unwrap_or(0.0)
    }

    /// Last time code.
    #[must_use]
    pub fn end(&self) -> f64 {
        self.samples.last().copied().unwrap_or(0.0)
    }

    /// The range of the time codes.
    #[must_use]
    pub fn range(&self) -> CodeRange {
        CodeRange { ends: Some((self.start(), self.end())), per_second: self.frames_per_second }
    }
}

/// Range of the time codes of a file, by which it is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CodeRange {
    /// First and last time code; `None` where the file does not say.
    pub ends: Option<(f64, f64)>,
    /// Time codes per second.
    pub per_second: f64,
}

/// Kind of a node: an instance, or everything else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NodeKind {
    /// An instance of the field's table; `id` is its mask value and `index` its dense index.
    Instance {
        /// Mask value, 1 to 65 535.
        id: u16,
        /// Position in the instance table.
        index: usize,
    },
    /// Everything that belongs to no instance.
    Background,
}

/// One object of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    /// Instance or background.
    pub kind: NodeKind,
    /// Unique name, `[A-Za-z0-9_]`, e.g. `red_mug_001`.
    pub name: String,
    /// Human name, e.g. `red mug`.
    pub label: String,
    /// Class, e.g. `mug`.
    pub category: String,
    /// Names of its class in vocabularies of others, by taxonomy.
    pub taxonomies: BTreeMap<String, String>,
    /// Its appearance, for questions in words.
    pub embedding: Option<Embedding>,
    /// Origin of the local frame at the reference time, world.
    pub pivot: DVec3,
    /// Motion of the node.
    pub motion: Motion,
    /// Splats in the local frame.
    pub splats: Splats,
    /// Changes of opacities and colours of the splats over time.
    pub appearance: Appearance,
    /// Light stand-in for the splats; `None` when proxies were not asked for.
    pub proxy: Option<PointProxy>,
    /// Convex hulls of the opaque splats, for simulators; empty when not asked for, which for the background
    /// is the default.
    pub colliders: Vec<ConvexHull>,
    /// Changes of visibility, ascending time codes; empty where the node is always visible.
    pub visibility: Vec<VisibilitySample>,
    /// Box of the 3-sigma ellipsoids of `splats`, local frame.
    pub extent: Bounds,
    /// Captured frames over which the node exists, first and last.
    pub source_frames: (usize, usize),
    /// Opacity-weighted mean occupancy of its Gaussians.
    pub mean_occupancy: f32,
    /// Which motion model was chosen, and what it misses.
    pub report: MotionReport,
}

/// Motion models, cheapest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionModel {
    /// Stands still.
    Static,
    /// Turns and moves as one body.
    Rigid,
    /// A few rigid bodies.
    Parts,
    /// Every Gaussian has its own path.
    Dense,
}

impl std::fmt::Display for MotionModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Static => "static",
            Self::Rigid => "rigid",
            Self::Parts => "parts",
            Self::Dense => "dense",
        })
    }
}

/// Motion of a node: its model, with samples.
#[derive(Clone, Debug, PartialEq)]
pub enum Motion {
    /// The local frame stays at the pivot.
    Static,
    /// The local frame moves; the splats are constant in it.
    Rigid(Vec<PoseSample>),
    /// The local frame moves, and a few rigid parts move in it.
    Parts(PartsMotion),
    /// The local frame moves and the splats deform in it.
    Dense(DenseMotion),
}

impl Motion {
    /// The motion model.
    #[must_use]
    pub fn model(&self) -> MotionModel {
        match self {
            Self::Static => MotionModel::Static,
            Self::Rigid(_) => MotionModel::Rigid,
            Self::Parts(_) => MotionModel::Parts,
            Self::Dense(_) => MotionModel::Dense,
        }
    }

    /// Number of samples: poses over all parts, or times of a dense motion.
    #[must_use]
    pub fn sample_count(&self) -> usize {
        match self {
            Self::Static => 0,
            Self::Rigid(track) => track.len(),
            Self::Parts(motion) => {
                motion.track.len() + motion.parts.iter().map(|part| part.track.len()).sum::<usize>()
            }
            Self::Dense(dense) => dense.samples.len(),
        }
    }

    /// Size of the sampled values, bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let Self::Dense(dense) = self else { return self.sample_count() * POSE_BYTES };
        let per_splat = |sample: &DenseSample| DENSE_BYTES + if sample.scales.is_some() { 12 } else { 0 };
        let shapes = dense.samples.iter().map(|sample| sample.means.len() * per_splat(sample));
        shapes.sum::<usize>() + dense.track.len() * POSE_BYTES
    }

    /// Number of parts; 0 for other motion.
    #[must_use]
    pub fn part_count(&self) -> usize {
        if let Self::Parts(motion) = self { motion.parts.len() } else { 0 }
    }
}

/// Pose of a node's local frame in the world at a time code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample {
    /// Time code.
    pub time_code: f64,
    /// Origin of the local frame, world.
    pub translation: DVec3,
    /// Unit; successive samples lie in one hemisphere.
    pub rotation: DQuat,
}

impl PoseSample {
    /// A transform at a time code.
    #[must_use]
    pub fn new(time_code: f64, transform: &RigidTransform) -> Self {
        let rotation = DQuat::from_mat3(&transform.rotation).normalize();
        Self { time_code, translation: transform.translation, rotation }
    }

    /// The pose as `world_from_local`.
    #[must_use]
    pub fn transform(&self) -> RigidTransform {
        RigidTransform { rotation: DMat3::from_quat(self.rotation), translation: self.translation }
    }
}

/// A few rigid parts under one node.
#[derive(Clone, Debug, PartialEq)]
pub struct PartsMotion {
    /// Path of the node's local frame, which follows its largest part; empty where it stays at the pivot.
    pub track: Vec<PoseSample>,
    /// The parts, at least two. Their [`Part::splats`] partition [`Node::splats`] in order.
    pub parts: Vec<Part>,
}

/// One rigid part of a node.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Unique within the node, `[A-Za-z0-9_]`, e.g. `part_00`.
    pub name: String,
    /// Range of [`Node::splats`]; these splats are in the part's own frame.
    pub splats: std::ops::Range<usize>,
    /// Origin of the part's frame at the reference time, in the node's local frame.
    pub pivot: DVec3,
    /// Poses `node_from_part`, ascending time codes; empty where the part stays at its pivot.
    pub track: Vec<PoseSample>,
    /// Box of the 3-sigma ellipsoids, part frame.
    pub extent: Bounds,
    /// Ties it to another part; `None` where its poses are free.
    pub joint: Option<PartJoint>,
}

/// A closed convex mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConvexHull {
    /// Corners, at most 64; in the node's local frame, or in the part's where there is one.
    pub points: Vec<[f32; 3]>,
    /// Triangles, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Part that the hull moves with.
    pub part: Option<usize>,
}

/// A change of visibility; it holds until the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilitySample {
    /// Time code.
    pub time_code: f64,
    /// True when the node can be seen from here on.
    pub visible: bool,
}

/// Per-sample splats.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseMotion {
    /// Best rigid fit, which carries the bulk of the motion; empty for the background, which stays put.
    pub track: Vec<PoseSample>,
    /// Splats in the local frame of their time, ascending time codes; where samples were left out, interpolation
    /// is inside the tolerance. First and last are those of the graph.
    pub samples: Vec<DenseSample>,
}

/// Splats of a node at one time code; between samples centres and scales are interpolated linearly; arrays parallel
/// to [`Node::splats`].
#[derive(Clone, Debug, PartialEq)]
pub struct DenseSample {
    /// Time code.
    pub time_code: f64,
    /// Centres, local frame of this time.
    pub means: Vec<[f32; 3]>,
    /// Unit quaternions (w, x, y, z), each in the hemisphere of the previous sample.
    pub orientations: Vec<[f32; 4]>,
    /// Standard deviations; `None` while they stay as in [`Node::splats`] over all samples.
    pub scales: Option<Vec<[f32; 3]>>,
    /// Box of the 3-sigma ellipsoids, local frame.
    pub extent: Bounds,
}

/// Opacities and colours over time; see [`crate::appearance`]. Where there are samples they stand for the values of
/// [`Splats`] at all times, linear in between and held outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Appearance {
    /// Opacities, one per splat; ascending time codes, empty where they stay as in [`Splats::opacities`].
    pub opacities: Vec<AppearanceSample>,
    /// Coefficients as in [`Splats::sh_coefficients`]; ascending time codes, empty where they stay.
    pub colors: Vec<AppearanceSample>,
}

/// Values of all splats of a node at one time code.
#[derive(Clone, Debug, PartialEq)]
pub struct AppearanceSample {
    /// Time code.
    pub time_code: f64,
    /// Values, splat-major.
    pub values: Vec<f32>,
}

/// Splats in post-activation form; every array has one entry per splat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// Centres, local frame.
    pub means: Vec<[f32; 3]>,
    /// Unit quaternions (w, x, y, z).
    pub orientations: Vec<[f32; 4]>,
    /// Standard deviations along the axes, world units; 0 along an axis in which a splat is flat.
    pub scales: Vec<[f32; 3]>,
    /// Opacities in [0, 1].
    pub opacities: Vec<f32>,
    /// Spherical-harmonics degree, 0 to 3.
    pub sh_degree: u8,
    /// Coefficients `[N, (degree + 1)^2, 3]`, splat-major, DC first, RGB inner; raw (colour = 0.5 + 0.28209 c0).
    pub sh_coefficients: Vec<f32>,
    /// Occupancies in [0, 1].
    pub occupancies: Vec<f32>,
    /// Probability of the most probable instance; 0 without identities.
    pub identity_probabilities: Vec<f32>,
    /// The instances that every splat may belong to, most probable first; empty without identities.
    pub identities: Vec<IdentityShares>,
    /// Row of every splat in the field; [`Splats::NO_ROW`] for a splat that comes from elsewhere.
    pub rows: Vec<u32>,
}

/// Most instances that are kept of the identity row of a splat.
pub const SHARES_PER_SPLAT: usize = 4;

/// The most probable instances of a splat, with unused places at the end.
pub type IdentityShares = [IdentityShare; SHARES_PER_SPLAT];

/// An instance that a splat may belong to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct IdentityShare {
    /// Mask value of the instance; 0 for an unused place.
    pub id: u16,
    /// Probability of the instance times the share of the splat's image that was labelled at all: what is missing to
    /// 1 over all instances was seen outside of every mask.
    pub share: f32,
}

impl Splats {
    /// Entry of [`Splats::rows`] for a splat that is no row of a field.
    pub const NO_ROW: u32 = u32::MAX;

    /// Number of splats.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Adds splats; the higher degree of the two is kept, the other is filled up with zeros, and so are identities
    /// that only one of them has.
    pub fn append(&mut self, mut more: Self) {
        if self.is_empty() {
            *self = more;
            return;
        }
        let degree = self.sh_degree.max(more.sh_degree);
        self.raise_degree(degree);
        more.raise_degree(degree);
        if !(self.identities.is_empty() && more.identities.is_empty()) {
            self.identities.resize(self.len(), IdentityShares::default());
            more.identities.resize(more.len(), IdentityShares::default());
            self.identities.append(&mut more.identities);
        }
        self.means.append(&mut more.means);
        self.orientations.append(&mut more.orientations);
        self.scales.append(&mut more.scales);
        self.opacities.append(&mut more.opacities);
        self.sh_coefficients.append(&mut more.sh_coefficients);
        self.occupancies.append(&mut more.occupancies);
        self.identity_probabilities.append(&mut more.identity_probabilities);
        self.rows.append(&mut more.rows);
    }

    fn raise_degree(&mut self, degree: u8) {
        if self.sh_degree == degree {
            return;
        }
        let (from, to) = (3 * coefficient_count(self.sh_degree), 3 * coefficient_count(degree));
        let mut raised = Vec::with_capacity(self.len() * to);
        for row in self.sh_coefficients.chunks_exact(from) {
            raised.extend_from_slice(row);
            raised.resize(raised.len() + to - from, 0.0);
        }
        self.sh_coefficients = raised;
        self.sh_degree = degree;
    }

    /// Opacity-weighted mean of the occupancies; 0 where all splats are clear.
    #[must_use]
    pub fn mean_occupancy(&self) -> f32 {
        let pairs = self.occupancies.iter().zip(&self.opacities);
        let (sum, total) = pairs.fold((0.0, 0.0), |(sum, total), (occupancy, opacity)| {
            (sum + f64::from(occupancy * opacity), total + f64::from(*opacity))
        });
        if total > 0.0 { (sum / total) as f32 } else { 0.0 }
    }

    /// View-independent colours `clamp(0.5 + 0.28209 c0)`, display-referred.
    #[must_use]
    pub fn base_colors(&self) -> Vec<[f32; 3]> {
        let stride = 3 * coefficient_count(self.sh_degree);
        let band_0 = BAND_0 as f32;
        self.sh_coefficients
            .chunks_exact(stride)
            .map(|sh| std::array::from_fn(|c| (0.5 + band_0 * sh[c]).clamp(0.0, 1.0)))
            .collect()
    }
}

/// A light point cloud standing in for the splats.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointProxy {
    /// Splats that the points sit on, ascending.
    pub indices: Vec<u32>,
    /// Diameters, world units.
    pub widths: Vec<f32>,
    /// Colours, display-referred.
    pub colors: Vec<[f32; 3]>,
}

/// A camera over time.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraTrack {
    /// Unique name, `[A-Za-z0-9_]`.
    pub name: String,
    /// Name in the capture.
    pub label: String,
    /// Views, ascending time codes, at least one.
    pub samples: Vec<CameraSample>,
}

/// A camera at a time code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraSample {
    /// Time code.
    pub time_code: f64,
    /// The view.
    pub camera: PinholeCamera,
}

/// True when changes of visibility leave something visible at a time code; before the first one it counts.
#[must_use]
pub fn is_visible_at(changes: &[VisibilitySample], time_code: f64) -> bool {
    let after = changes.partition_point(|sample| sample.time_code <= time_code);
    changes.get(after.max(1) - 1).is_none_or(|sample| sample.visible)
}

/// Pose on a track at a time code: linear in translation, spherical in rotation between samples, held outside
/// them; without samples unturned at `rest`.
#[must_use]
pub fn pose_at(track: &[PoseSample], rest: DVec3, time_code: f64) -> PoseSample {
    let Some((first, last)) = track.first().zip(track.last()) else {
        return PoseSample { time_code, translation: rest, rotation: DQuat::IDENTITY };
    };
    let after = track.partition_point(|sample| sample.time_code <= time_code);
    if after == 0 {
        return PoseSample { time_code, ..*first };
    }
    if after == track.len() {
        return PoseSample { time_code, ..*last };
    }
    let (a, b) = (&track[after - 1], &track[after]);
    let fraction = (time_code - a.time_code) / (b.time_code - a.time_code);
    PoseSample {
        time_code,
        translation: a.translation.lerp(b.translation, fraction),
        rotation: a.rotation.slerp(b.rotation, fraction),
    }
}

impl Node {
    /// Path of the local frame: samples by ascending time code, or none where it stays at the pivot. Not every
    /// sampled time code needs one; see [`pose_at`].
    #[must_use]
    pub fn track(&self) -> &[PoseSample] {
        match &self.motion {
            Motion::Static => &[],
            Motion::Rigid(track) => track,
            Motion::Parts(parts) => &parts.track,
            Motion::Dense(dense) => &dense.track,
        }
    }

    /// Chosen motion model.
    #[must_use]
    pub fn model(&self) -> MotionModel {
        self.motion.model()
    }

    /// `world_from_local` at a time code: linear in translation, spherical in rotation between samples, held
    /// outside them.
    #[must_use]
    pub fn world_transform(&self, time_code: f64) -> RigidTransform {
        pose_at(self.track(), self.pivot, time_code).transform()
    }

    /// True when the node can be seen at a time code.
    #[must_use]
    pub fn is_visible(&self, time_code: f64) -> bool {
        is_visible_at(&self.visibility, time_code)
    }

    /// Boxes of what can be seen of the node at any time.
    #[must_use]
    pub fn boxes(&self) -> NodeBoxes<'_> {
        let importance = self.splats.importance();
        let of = |range| Cloud::of(&self.splats, &importance, range).body_box();
        let at_rest = match (&self.kind, &self.motion) {
            (NodeKind::Background, _) | (_, Motion::Dense(_)) => Vec::new(),
            (_, Motion::Parts(motion)) => motion.parts.iter().map(|part| of(part.splats.clone())).collect(),
            _ => vec![of(0..self.splats.len())],
        };
        NodeBoxes { node: self, importance, at_rest }
    }
}

/// Boxes of a node over time. Those of instances hold their body (see [`crate::shape::body`]), without the strays that
/// training leaves about; a background has no body, and its boxes hold the 3-sigma ellipsoids.
#[derive(Clone, Debug)]
pub struct NodeBoxes<'a> {
    node: &'a Node,
    importance: Vec<f64>,
    /// Of the parts, each in its frame, or of the whole; empty where boxes are made anew for each time.
    at_rest: Vec<Bounds>,
}

impl NodeBoxes<'_> {
    /// In the local frame of the node at a time code.
    #[must_use]
    pub fn local(&self, time_code: f64) -> Bounds {
        let node = self.node;
        match &node.motion {
            Motion::Dense(dense) => {
                let placed = placement::local_splats_at(dense, &node.splats.scales, time_code);
                let means: Vec<[f32; 3]> =
                    placed.means.iter().map(|mean| mean.as_vec3().to_array()).collect();
                let orientations: Vec<[f32; 4]> =
                    placed.orientations.iter().map(|q| q.map(|component| component as f32)).collect();
                if node.kind == NodeKind::Background {
                    let local = RigidTransform::IDENTITY;
                    return extent::ellipsoid_bounds(&local, &means, &orientations, &placed.scales);
                }
                let cloud = Cloud {
                    means: &means,
                    orientations: &orientations,
                    scales: &placed.scales,
                    opacities: &node.splats.opacities,
                    importance: &self.importance,
                };
                cloud.body_box()
            }
            _ if node.kind == NodeKind::Background => node.extent,
            Motion::Parts(motion) => {
                let of_part = |(part, bounds): (&Part, &Bounds)| {
                    bounds.transformed(&pose_at(&part.track, part.pivot, time_code).transform())
                };
                motion.parts.iter().zip(&self.at_rest).map(of_part).fold(Bounds::EMPTY, Bounds::union)
            }
            Motion::Static | Motion::Rigid(_) => self.at_rest.first().copied().unwrap_or(Bounds::EMPTY),
        }
    }

    /// In the world at a time code.
    #[must_use]
    pub fn world(&self, time_code: f64) -> Bounds {
        self.local(time_code).transformed(&self.node.world_transform(time_code))
    }
}
