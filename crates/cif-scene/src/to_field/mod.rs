//! From a scene graph back to a field.
//!
//! Every node becomes Gaussians at their place at the first sampled time, in world coordinates, and its motion
//! a group of [`Tracks`] relative to there. Rigid tracks keep their keys; parts are sampled at the keys of both
//! levels and at all sampled time codes; dense samples stay samples. Instances keep their ids, nodes without
//! one get the next that is free, and every Gaussian belongs to its node ([`cif_field::Owner`]). Identity rows
//! that the file has come back; without them Gaussians of instances are certain of theirs, and those of the
//! background add to no label. Opacities and colours that change become samples of the groups.

use std::collections::{BTreeMap, BTreeSet};

use cif_field::gaussians::{INITIAL_OCCUPANCY, SH_FLOATS, saturated_logit};
use cif_field::tracks::{
    DenseTrack, Joint, NO_GROUP, Samples, TrackGroup, TrackPose, Tracks, VisibilityStep,
};
use cif_field::{
    Declared, Drawing, Embeddings, Field, FrameCodes, Gaussians, Identities, Instance, Owner, Record,
    RecordedCamera, Timeline,
};
use cif_geometry::spherical_harmonics::{HarmonicsRotation, coefficient_count};
use cif_geometry::{Bounds, quaternion};
use glam::{DMat3, DQuat, DVec3};

use crate::graph::{
    AppearanceSample, DenseMotion, Motion, Node, NodeKind, PartsMotion, PoseSample, SceneGraph, pose_at,
};
use crate::motion::time_map::TimeMap;
use crate::shape::flat::log_scale;
use crate::{CameraTrack, SceneError};

/// Turns below this leave spherical harmonics as they are, radians.
const NO_TURN: f64 = 1e-9;

/// Poses that differ by less do not move: part of the size of coordinates, and radians.
const STILL: f64 = 1e-9;

/// Builds a field without learned motion that shows what the graph shows. `source` names the file in the
/// field's record.
///
/// Occupancies that the graph does not have are the opacities; splats outside the instances of a file that cif
/// did not write get the occupancy of Gaussians that no mask spoke for.
///
/// # Errors
/// When arrays of the graph do not fit together or hold values that are not finite; the object is named.
pub fn field_from_graph(graph: &SceneGraph, source: &str) -> Result<Field, SceneError> {
    let times = TimeMap::of_file(&graph.time_codes)?;
    let reference = graph.time_codes.start();
    let has_instances = graph.nodes.iter().any(|node| matches!(node.kind, NodeKind::Instance { .. }));
    let is_foreign = graph.origin.field_fingerprint.is_none();
    let mut instances = InstanceTable::default();
    let mut gaussians = Gaussians::default();
    let mut tracks = Tracks::default();
    let mut identities = Identities::empty();
    let owners = graph
        .nodes
        .iter()
        .map(|node| match node.kind {
            NodeKind::Instance { id, .. } => instances.add(node, id).map(Some),
            NodeKind::Background => Ok(None),
        })
        .collect::<Result<Vec<Option<u16>>, SceneError>>()?;
    // Identity rows name ids as the file has them; the first of several nodes with one id keeps it.
    let mut index_of: BTreeMap<u16, u16> = BTreeMap::new();
    for (node, owner) in graph.nodes.iter().zip(&owners) {
        if let (NodeKind::Instance { id, .. }, Some(index)) = (node.kind, owner) {
            index_of.entry(id).or_insert(*index);
        }
    }
    for (node, &owner) in graph.nodes.iter().zip(&owners) {
        let mut rows = NodeRows::of(node, &times, &graph.time_codes.samples, reference)?;
        if owner.is_none() && is_foreign && has_instances {
            rows.gaussians.occupancy_logits.fill(saturated_logit(INITIAL_OCCUPANCY));
        }
        push_identities(&mut identities, node, owner, &index_of);
        rows.append_to(&mut gaussians, &mut tracks);
    }
    let cameras = cameras(&graph.cameras, &times);
    let degrees = graph.nodes.iter().map(|node| node.splats.sh_degree);
    let imported = serde_json::json!({
        "file": source,
        "first_time_code": reference,
        "exported_from": graph.origin.field_fingerprint,
        "cif": env!("CARGO_PKG_VERSION"),
    });
    let imported = serde_json::Map::from_iter([("imported".to_owned(), imported)]);
    let field = Field {
        extent: extent(&cameras, &gaussians),
        gaussians,
        deformation: None,
        tracks: tracks.compact(),
        identities: has_instances.then_some(identities),
        instances: instances.entries.clone(),
        timeline: Timeline {
            times: times.times().to_vec(),
            frames_per_second: graph.time_codes.frames_per_second,
        },
        cameras,
        sh_degree: degrees.max().unwrap_or(0),
        background: graph.background_color.map(|channel| channel.clamp(0.0, 1.0)),
        sort_metric: graph.sort_metric,
        record: Record {
            drawing: Drawing { antialiased: graph.antialiased, ..Drawing::default() },
            frame: graph.frame,
            declared: Some(Declared { up_axis: graph.up_axis, meters_per_unit: graph.meters_per_unit }),
            frame_codes: FrameCodes::of(times.codes()),
            embeddings: embeddings(graph, &owners, &instances.entries),
            notes: imported,
            ..Record::default()
        },
    };
    field
        .validate()
        .map_err(|error| SceneError::Import { object: source.to_owned(), what: error.to_string() })?;
    Ok(field)
}

/// Appearance of the instances, by the model of the first that tells; one field has one model.
fn embeddings(graph: &SceneGraph, owners: &[Option<u16>], instances: &[Instance]) -> Option<Embeddings> {
    let known = || {
        let nodes = graph.nodes.iter().zip(owners);
        nodes.filter_map(|(node, owner)| {
            Some((instances[usize::from((*owner)?)].id, node.embedding.as_ref()?))
        })
    };
    let model = known().next()?.1.model.clone();
    let of = known().filter(|(_, embedding)| embedding.model == model && embedding.is_valid());
    let of = of.map(|(id, embedding)| (id, embedding.direction.clone())).collect();
    Some(Embeddings { model, of })
}

/// Normalised time that a time code of a graph has in the field of [`field_from_graph`].
///
/// # Errors
/// When the time codes of the graph do not ascend.
pub fn time_in_field(graph: &SceneGraph, time_code: f64) -> Result<f64, SceneError> {
    Ok(TimeMap::of_file(&graph.time_codes)?.time(time_code))
}

/// Adds the identity rows of a node.
fn push_identities(
    identities: &mut Identities,
    node: &Node,
    owner: Option<u16>,
    index_of: &BTreeMap<u16, u16>,
) {
    let own_id = match node.kind {
        NodeKind::Instance { id, .. } => id,
        NodeKind::Background => 0,
    };
    for splat in 0..node.splats.len() {
        let shares = node.splats.identities.get(splat).copied().unwrap_or_default();
        let mut entries: Vec<(u16, f32)> = shares
            .iter()
            .filter(|entry| entry.id != 0 && entry.share > 0.0)
            .filter_map(|entry| {
                let own = owner.filter(|_| entry.id == own_id);
                own.or_else(|| index_of.get(&entry.id).copied()).map(|index| (index, entry.share))
            })
            .collect();
        entries.sort_by_key(|(index, _)| *index);
        entries.dedup_by_key(|(index, _)| *index);
        match owner {
            _ if entries.is_empty() => identities.push_certain(owner),
            Some(index) => identities.push(Owner::Instance(index), &entries),
            None => identities.push(Owner::Background, &entries),
        }
    }
}

/// Instances while they are collected.
#[derive(Default)]
pub(crate) struct InstanceTable {
    pub(crate) entries: Vec<Instance>,
}

impl InstanceTable {
    /// Adds an instance for a node and returns its index; an id of 0 or one that is taken is replaced by the
    /// lowest free one.
    pub(crate) fn add(&mut self, node: &Node, id: u16) -> Result<u16, SceneError> {
        let taken: BTreeSet<u16> = self.entries.iter().map(|instance| instance.id).collect();
        let id = if id != 0 && !taken.contains(&id) {
            id
        } else {
            (1..=u16::MAX).find(|id| !taken.contains(id)).ok_or_else(|| SceneError::Import {
                object: node.name.clone(),
                what: "a field holds at most 65535 instances, and all ids are taken".to_owned(),
            })?
        };
        let index = self.entries.len() as u16;
        let label = if node.label.is_empty() { node.name.clone() } else { node.label.clone() };
        let category = if node.category.is_empty() { label.clone() } else { node.category.clone() };
        let taxonomies = node.taxonomies.clone();
        self.entries.push(Instance { id, label, category, taxonomies });
        Ok(index)
    }
}

/// Gaussians of a node in world coordinates at the reference time, and how they move.
pub(crate) struct NodeRows {
    pub(crate) gaussians: Gaussians,
    /// Groups with the rows that they hold; they do not overlap.
    pub(crate) groups: Vec<(std::ops::Range<usize>, TrackGroup)>,
}

impl NodeRows {
    /// `samples` are the time codes at which composed motion is sampled.
    pub(crate) fn of(
        node: &Node,
        times: &TimeMap,
        samples: &[f64],
        reference: f64,
    ) -> Result<Self, SceneError> {
        check(node)?;
        let mut rows = Self { gaussians: canonical(node), groups: Vec::new() };
        let pivot = node.pivot;
        match &node.motion {
            Motion::Static => {
                rows.place(node, 0..node.splats.len(), &node.name, &Path::still(pivot), times);
            }
            Motion::Rigid(track) => {
                let path = Path::of(track.clone(), pivot, reference);
                rows.place(node, 0..node.splats.len(), &node.name, &path, times);
            }
            Motion::Parts(parts) => {
                for part in &parts.parts {
                    let path = part_path(&parts.track, pivot, part, samples, reference);
                    let name = format!("{}/{}", node.name, part.name);
                    rows.place(node, part.splats.clone(), &name, &path, times);
                }
                rows.join(parts, pivot, reference);
            }
            Motion::Dense(dense) => {
                let path = Path::of(dense.track.clone(), pivot, reference);
                let group = rows.place(node, 0..node.splats.len(), &node.name, &path, times);
                group.dense = Some(dense_track(node, dense, &path.reference, times));
            }
        }
        rows.drop_idle();
        Ok(rows)
    }

    /// Drops groups that do nothing and that no joint is on.
    fn drop_idle(&mut self) {
        let bases: BTreeSet<u32> =
            self.groups.iter().filter_map(|(_, group)| Some(group.joint?.base)).collect();
        let is_kept = |(index, (_, group)): (usize, &(std::ops::Range<usize>, TrackGroup))| {
            let is_idle = group.poses.is_empty() && group.visibility.is_empty() && group.dense.is_none();
            group.moves() || !is_idle || bases.contains(&(index as u32))
        };
        let kept: Vec<bool> = self.groups.iter().enumerate().map(is_kept).collect();
        let place = |old: u32| kept[..old as usize].iter().filter(|kept| **kept).count() as u32;
        for (_, group) in &mut self.groups {
            group.joint = group.joint.map(|joint| Joint { base: place(joint.base), ..joint });
        }
        let mut flags = kept.iter();
        self.groups.retain(|_| *flags.next().expect("one flag per group"));
    }

    /// Ties the groups of parts, which were placed one after the other, by the joints of the parts.
    fn join(&mut self, parts: &PartsMotion, pivot: DVec3, reference: f64) {
        let node = pose_at(&parts.track, pivot, reference);
        for (index, part) in parts.parts.iter().enumerate() {
            let Some(joint) = part.joint.filter(|joint| joint.base < index) else { continue };
            let own = pose_at(&part.track, part.pivot, reference);
            let rotation = (node.rotation * own.rotation).normalize();
            let group = &mut self.groups[index].1;
            // The pivot of a part is a point of its axis.
            let offset = rotation * joint.anchor;
            for pose in &mut group.poses {
                pose.translation += pose.rotation * offset;
            }
            group.pivot += offset;
            let axis = (rotation * joint.axis).normalize();
            group.joint = Some(Joint { base: joint.base as u32, kind: joint.kind, axis });
        }
    }

    /// Brings a range of rows to the world at the reference time, and adds its group.
    fn place(
        &mut self,
        node: &Node,
        range: std::ops::Range<usize>,
        name: &str,
        path: &Path,
        times: &TimeMap,
    ) -> &mut TrackGroup {
        let PoseSample { rotation, translation, .. } = path.reference;
        let turned = rotation.xyz().length() > NO_TURN;
        let turn = turned.then(|| HarmonicsRotation::new(rows_of(rotation)));
        let gaussians = &mut self.gaussians;
        for row in range.clone() {
            gaussians.means[row] = placed(&path.reference, gaussians.means[row]);
            if let Some(turn) = &turn {
                gaussians.quaternions[row] = turned_quaternion(rotation, gaussians.quaternions[row]);
                turn.rotate(&mut gaussians.sh_coefficients[row]);
            }
        }
        let steps = node.visibility.iter();
        let visibility = steps
            .map(|step| VisibilityStep { time: times.time(step.time_code), visible: step.visible })
            .collect::<Vec<_>>();
        let appearance = &node.appearance;
        let opacities = samples(&appearance.opacities, &range, 1, times, |values| values[0]);
        let stride = 3 * coefficient_count(node.splats.sh_degree);
        let colors = samples(&appearance.colors, &range, stride, times, |values| {
            let mut sh = [0.0; SH_FLOATS];
            sh[..stride].copy_from_slice(values);
            if let Some(turn) = &turn {
                turn.rotate(&mut sh);
            }
            sh
        });
        let always_visible = visibility.iter().all(|step| step.visible);
        let group = TrackGroup {
            poses: path.poses(times),
            rotation: node.report.rotation.filter(|_| matches!(node.motion, Motion::Rigid(_))),
            visibility: if always_visible { Vec::new() } else { visibility },
            opacities,
            colors,
            ..TrackGroup::still(name, translation)
        };
        self.groups.push((range, group));
        let (_, group) = self.groups.last_mut().expect("just pushed");
        group
    }

    /// Keeps the learned deformation of a field away from the rows.
    pub(crate) fn exempt(&mut self, name: &str) {
        let mut next = 0;
        let mut gaps = Vec::new();
        for (range, group) in &mut self.groups {
            group.deformed = false;
            if next < range.start {
                gaps.push(next..range.start);
            }
            next = range.end;
        }
        if next < self.gaussians.len() {
            gaps.push(next..self.gaussians.len());
        }
        let still = TrackGroup { deformed: false, ..TrackGroup::still(name, DVec3::ZERO) };
        self.groups.extend(gaps.into_iter().map(|gap| (gap, still.clone())));
    }

    /// Adds the rows at the end of a set with tracks.
    pub(crate) fn append_to(self, gaussians: &mut Gaussians, tracks: &mut Tracks) {
        let first = gaussians.len();
        gaussians.append(&self.gaussians);
        tracks.group_of.resize(gaussians.len(), NO_GROUP);
        let before = tracks.groups.len() as u32;
        for (range, mut group) in self.groups {
            group.joint = group.joint.map(|joint| Joint { base: before + joint.base, ..joint });
            tracks.group_of[first + range.start..first + range.end].fill(tracks.groups.len() as u32);
            tracks.groups.push(group);
        }
    }
}

/// Samples of a range of splats; none where nothing changes.
fn samples<V: Copy>(
    of: &[AppearanceSample],
    range: &std::ops::Range<usize>,
    stride: usize,
    times: &TimeMap,
    value: impl Fn(&[f32]) -> V,
) -> Option<Samples<V>> {
    if of.is_empty() {
        return None;
    }
    let own = range.start * stride..range.end * stride;
    Some(Samples {
        times: of.iter().map(|sample| times.time(sample.time_code)).collect(),
        values: of
            .iter()
            .flat_map(|sample| sample.values[own.clone()].chunks_exact(stride).map(&value))
            .collect(),
    })
}

/// A path whose keys are joined by lines and arcs, with its pose at the reference time.
struct Path {
    keys: Vec<PoseSample>,
    reference: PoseSample,
}

impl Path {
    fn still(at: DVec3) -> Self {
        Self::of(Vec::new(), at, 0.0)
    }

    fn of(keys: Vec<PoseSample>, rest: DVec3, reference: f64) -> Self {
        let mut reference = pose_at(&keys, rest, reference);
        reference.rotation = reference.rotation.normalize();
        Self { keys, reference }
    }

    /// The keys relative to the reference pose; none where they are all as it is.
    fn poses(&self, times: &TimeMap) -> Vec<TrackPose> {
        let back = self.reference.rotation.conjugate();
        let poses: Vec<TrackPose> = self
            .keys
            .iter()
            .map(|key| TrackPose {
                time: times.time(key.time_code),
                translation: key.translation,
                rotation: (key.rotation * back).normalize(),
            })
            .collect();
        let at = self.reference.translation;
        let is_still = |pose: &TrackPose| {
            (pose.translation - at).length() <= STILL * (1.0 + at.length())
                && pose.rotation.xyz().length() <= STILL
        };
        if poses.iter().all(is_still) { Vec::new() } else { poses }
    }
}

/// Poses of a part in the world, at the keys of both levels and at the sampled time codes between them.
fn part_path(
    node_track: &[PoseSample],
    pivot: DVec3,
    part: &crate::Part,
    samples: &[f64],
    reference: f64,
) -> Path {
    let mut codes: Vec<f64> = node_track.iter().chain(&part.track).map(|key| key.time_code).collect();
    if !node_track.is_empty() && !part.track.is_empty() {
        codes.extend_from_slice(samples);
    }
    codes.sort_by(f64::total_cmp);
    codes.dedup();
    let world = |code: f64| {
        let (node, part) = (pose_at(node_track, pivot, code), pose_at(&part.track, part.pivot, code));
        PoseSample {
            time_code: code,
            translation: node.rotation * part.translation + node.translation,
            rotation: (node.rotation * part.rotation).normalize(),
        }
    };
    let mut keys: Vec<PoseSample> = Vec::with_capacity(codes.len());
    for code in codes {
        let mut key = world(code);
        if keys.last().is_some_and(|last| last.rotation.dot(key.rotation) < 0.0) {
            key.rotation = -key.rotation;
        }
        keys.push(key);
    }
    Path { keys, reference: world(reference) }
}

/// Dense samples before the pose: in the world as the reference pose has them.
fn dense_track(node: &Node, dense: &DenseMotion, reference: &PoseSample, times: &TimeMap) -> DenseTrack {
    let turned = reference.rotation.xyz().length() > NO_TURN;
    let scaled = dense.samples.iter().any(|sample| sample.scales.is_some());
    let mut track = DenseTrack {
        times: Vec::with_capacity(dense.samples.len()),
        means: Vec::new(),
        quaternions: Vec::new(),
        log_scales: scaled.then(Vec::new),
    };
    for sample in &dense.samples {
        track.times.push(times.time(sample.time_code));
        track.means.extend(sample.means.iter().map(|mean| placed(reference, *mean)));
        track.quaternions.extend(sample.orientations.iter().map(|orientation| {
            if turned { turned_quaternion(reference.rotation, *orientation) } else { *orientation }
        }));
        if let Some(log_scales) = &mut track.log_scales {
            let scales = sample.scales.as_ref().unwrap_or(&node.splats.scales);
            log_scales.extend(scales.iter().map(|scale| scale.map(log_scale)));
        }
    }
    track
}

fn placed(pose: &PoseSample, mean: [f32; 3]) -> [f32; 3] {
    let at = pose.rotation * DVec3::from_array(mean.map(f64::from)) + pose.translation;
    at.to_array().map(|value| value as f32)
}

fn turned_quaternion(rotation: DQuat, orientation: [f32; 4]) -> [f32; 4] {
    let DQuat { x, y, z, w } = rotation;
    quaternion::multiply([w, x, y, z], orientation.map(f64::from)).map(|value| value as f32)
}

/// Rows of a rotation matrix.
pub(crate) fn rows_of(rotation: DQuat) -> [[f32; 3]; 3] {
    DMat3::from_quat(rotation).transpose().to_cols_array_2d().map(|row| row.map(|value| value as f32))
}

/// Raw logit of a probability in single precision.
pub(crate) fn logit(probability: f32) -> f32 {
    saturated_logit(f64::from(probability))
}

/// Raw Gaussians of a node in its local frame.
fn canonical(node: &Node) -> Gaussians {
    let splats = &node.splats;
    let stride = 3 * coefficient_count(splats.sh_degree);
    let opacity_logits: Vec<f32> = splats.opacities.iter().map(|opacity| logit(*opacity)).collect();
    Gaussians {
        means: splats.means.clone(),
        log_scales: splats.scales.iter().map(|scale| scale.map(log_scale)).collect(),
        quaternions: splats.orientations.clone(),
        occupancy_logits: if splats.occupancies.len() == splats.len() {
            splats.occupancies.iter().map(|occupancy| logit(*occupancy)).collect()
        } else {
            opacity_logits.clone()
        },
        opacity_logits,
        sh_coefficients: splats
            .sh_coefficients
            .chunks_exact(stride)
            .map(|coefficients| {
                let mut all = [0.0; SH_FLOATS];
                all[..stride].copy_from_slice(coefficients);
                all
            })
            .collect(),
    }
}

/// Checks that the arrays of a node belong together, so that nothing later indexes past one.
pub(crate) fn check(node: &Node) -> Result<(), SceneError> {
    let wrong = |what: String| Err(SceneError::Import { object: node.name.clone(), what });
    let splats = &node.splats;
    let n = splats.len();
    if splats.sh_degree > 3 {
        return wrong(format!(
            "its spherical harmonics have degree {}; at most 3 can be drawn",
            splats.sh_degree
        ));
    }
    let floats = 3 * coefficient_count(splats.sh_degree);
    let lengths = [
        ("orientations", splats.orientations.len(), n),
        ("scales", splats.scales.len(), n),
        ("opacities", splats.opacities.len(), n),
        ("colour coefficients", splats.sh_coefficients.len(), n * floats),
    ];
    for (what, found, expected) in lengths {
        if found != expected {
            return wrong(format!("it has {n} centres, but {found} {what} instead of {expected}"));
        }
    }
    let in_range = |values: &[f32]| values.iter().all(|value| (0.0..=1.0).contains(value));
    if !in_range(&splats.opacities) || !in_range(&splats.occupancies) {
        return wrong("an opacity or occupancy is outside 0 to 1".to_owned());
    }
    if splats.scales.as_flattened().iter().any(|scale| !(scale.is_finite() && *scale >= 0.0)) {
        return wrong("a scale is below 0 or not finite".to_owned());
    }
    let ascend = |track: &[PoseSample]| {
        track.windows(2).all(|pair| pair[0].time_code < pair[1].time_code)
            && track.iter().all(|key| key.translation.is_finite() && key.rotation.is_finite())
    };
    if !ascend(node.track()) {
        return wrong("its motion does not ascend in time, or is not finite".to_owned());
    }
    for (what, samples, expected) in [
        ("opacities", &node.appearance.opacities, n),
        ("colour coefficients", &node.appearance.colors, n * floats),
    ] {
        if let Some(sample) = samples.iter().find(|sample| sample.values.len() != expected) {
            return wrong(format!(
                "it has {n} centres, but {} {what} at time code {} instead of {expected}",
                sample.values.len(),
                sample.time_code
            ));
        }
        if samples.windows(2).any(|pair| pair[0].time_code >= pair[1].time_code) {
            return wrong(format!("its {what} do not ascend in time"));
        }
    }
    if !node.appearance.opacities.iter().all(|sample| in_range(&sample.values)) {
        return wrong("a sampled opacity is outside 0 to 1".to_owned());
    }
    match &node.motion {
        Motion::Parts(parts) => {
            let mut next = 0;
            for part in &parts.parts {
                if part.splats.start != next || part.splats.end < next || part.splats.end > n {
                    return wrong(format!("its part {} does not follow the part before it", part.name));
                }
                next = part.splats.end;
                if !ascend(&part.track) {
                    return wrong(format!("the motion of its part {} does not ascend in time", part.name));
                }
            }
            if next != n {
                return wrong(format!("its parts hold {next} of {n} splats"));
            }
        }
        Motion::Dense(dense) => {
            if dense.samples.is_empty() {
                return wrong("it deforms, but has no samples".to_owned());
            }
            for sample in &dense.samples {
                let scales = sample.scales.as_ref().map_or(n, Vec::len);
                if [sample.means.len(), sample.orientations.len(), scales] != [n; 3] {
                    return wrong(format!(
                        "its sample at time code {} does not have {n} splats",
                        sample.time_code
                    ));
                }
                let scales = sample.scales.as_deref().unwrap_or_default().as_flattened();
                if scales.iter().any(|scale| !(scale.is_finite() && *scale >= 0.0)) {
                    return wrong("a sampled scale is below 0 or not finite".to_owned());
                }
            }
            if dense.samples.windows(2).any(|pair| pair[0].time_code >= pair[1].time_code) {
                return wrong("its deformation does not ascend in time".to_owned());
            }
        }
        Motion::Static | Motion::Rigid(_) => {}
    }
    Ok(())
}

fn cameras(tracks: &[CameraTrack], times: &TimeMap) -> Vec<RecordedCamera> {
    let mut cameras: Vec<RecordedCamera> = Vec::new();
    for track in tracks {
        let name = if track.label.is_empty() { &track.name } else { &track.label };
        let mut previous = None;
        for sample in &track.samples {
            let time_index = times.nearest_frame(sample.time_code);
            if previous.replace(time_index) != Some(time_index) {
                let camera = sample.camera;
                cameras.push(RecordedCamera { name: name.clone(), time_index, trained: true, camera });
            }
        }
    }
    cameras
}

/// Scene extent: from the cameras as in training, else half the box of the centres.
fn extent(cameras: &[RecordedCamera], gaussians: &Gaussians) -> f32 {
    let from_points = || {
        let bounds =
            Bounds::around(gaussians.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from))));
        if gaussians.is_empty() { 0.0 } else { bounds.size().length() / 2.0 }
    };
    let centres: Vec<DVec3> = cameras.iter().map(|camera| camera.camera.centre()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let spread = centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max) * 1.1;
    let extent = if spread > 0.0 { spread } else { from_points() };
    if extent.is_finite() { extent as f32 } else { 0.0 }
}

#[cfg(test)]
mod tests;
