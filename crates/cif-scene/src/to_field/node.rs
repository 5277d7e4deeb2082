//! Gaussians of a node, and the track groups that move them.

use cif_field::Gaussians;
use cif_field::gaussians::{SH_FLOATS, saturated_logit};
use cif_field::tracks::{DenseTrack, Joint, NO_GROUP, Samples, TrackGroup, Tracks, VisibilityStep};
use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::{HarmonicsRotation, coefficient_count};
use glam::{DQuat, DVec3};

use super::check::check;
use super::path::{Path, part_path};
use crate::SceneError;
use crate::graph::{AppearanceSample, DenseMotion, Motion, Node, PartsMotion, PoseSample, pose_at};
use crate::motion::time_map::TimeMap;
use crate::shape::flat::log_scale;
use crate::vectors::rows_of;

/// Turns below this leave spherical harmonics as they are, radians.
const NO_TURN: f64 = 1e-9;

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

    /// Drops the groups of a node that does nothing.
    fn drop_idle(&mut self) {
        let is_idle = |(_, group): &(std::ops::Range<usize>, TrackGroup)| {
            !group.moves() && group.poses.is_empty() && group.visibility.is_empty() && group.dense.is_none()
        };
        if self.groups.iter().all(is_idle) {
            self.groups.clear();
        }
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

    /// Adds the rows at the end of a set with tracks, in groups of an instance (an id).
    pub(crate) fn append_to(self, gaussians: &mut Gaussians, tracks: &mut Tracks, instance: Option<u16>) {
        let first = gaussians.len();
        gaussians.append(&self.gaussians);
        tracks.group_of.resize(gaussians.len(), NO_GROUP);
        let before = tracks.groups.len() as u32;
        for (range, mut group) in self.groups {
            group.joint = group.joint.map(|joint| Joint { base: before + joint.base, ..joint });
            group.instance = instance;
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

/// Raw logit of a probability in single precision.
pub(crate) fn logit(probability: f32) -> f32 {
    saturated_logit(f64::from(probability))
}
