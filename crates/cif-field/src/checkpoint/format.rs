//! Names and JSON of the file, shared by reader and writer.

use cif_geometry::Bounds;
use serde::{Deserialize, Serialize};

use glam::{DQuat, DVec3};

use crate::gaussians::SH_FLOATS;
use crate::tracks::{
    DenseTrack, Joint, RotationEvidence, Samples, TrackGroup, TrackPose, Tracks, VisibilityStep,
};
use crate::{DeformationConfig, Field, Instance, RecordedCamera, SortMetric, Timeline};

/// Newest version of the layout, which this crate writes where it is needed; it reads all up to it.
///
/// 1 is the first; 2 adds recorded motion ([`crate::Tracks`]); 3 adds Gaussians that stand still
/// ([`crate::Deformation::still`]); 4 adds recorded opacities and colours ([`crate::TrackGroup::opacities`]), and
/// identity rows without entries or with an owner ([`crate::Owner`]); 5 adds evidence for rotations
/// ([`crate::TrackGroup::rotation`]); 6 adds joints ([`crate::TrackGroup::joint`]); 7 adds heads
/// ([`super::Checkpoint::head`]); 8 adds taxonomies ([`Instance::taxonomies`]); 9 adds instances of track
/// groups ([`crate::TrackGroup::instance`]). A scene without these is written as 1 to 8, so that older software reads it.
pub const FORMAT: u32 = 9;

/// The layout before instances of track groups.
const FORMAT_WITH_TAXONOMIES: u32 = 8;

/// The layout before taxonomies.
const FORMAT_WITH_HEADS: u32 = 7;

/// The layout before heads.
const FORMAT_WITH_JOINTS: u32 = 6;

/// The layout before joints.
const FORMAT_WITH_EVIDENCE: u32 = 5;

/// The layout before evidence for rotations.
const FORMAT_WITH_APPEARANCE: u32 = 4;

/// The layout before recorded opacities, colours and owners.
const FORMAT_WITH_STILL: u32 = 3;

/// The layout before Gaussians could stand still.
const FORMAT_WITH_TRACKS: u32 = 2;

/// The layout before there were tracks.
const FORMAT_WITHOUT_TRACKS: u32 = 1;

/// Oldest layout that holds a field, and what a head learnt where `has_head`.
pub(super) fn format_of(field: &Field, has_head: bool) -> u32 {
    if groups(field).any(|group| group.instance.is_some()) {
        FORMAT
    } else if field.instances.iter().any(|instance| !instance.taxonomies.is_empty()) {
        FORMAT_WITH_TAXONOMIES
    } else if has_head {
        FORMAT_WITH_HEADS
    } else if groups(field).any(|group| group.joint.is_some()) {
        FORMAT_WITH_JOINTS
    } else if has_evidence(field) {
        FORMAT_WITH_EVIDENCE
    } else if has_appearance(field) || has_owners(field) {
        FORMAT_WITH_APPEARANCE
    } else if stands_still(field) {
        FORMAT_WITH_STILL
    } else if field.tracks.is_some() {
        FORMAT_WITH_TRACKS
    } else {
        FORMAT_WITHOUT_TRACKS
    }
}

fn groups(field: &Field) -> impl Iterator<Item = &TrackGroup> {
    field.tracks.iter().flat_map(|tracks| &tracks.groups)
}

/// True where the evidence for rotations is known.
fn has_evidence(field: &Field) -> bool {
    groups(field).any(|group| group.rotation.is_some())
}

/// True where opacities or colours are recorded.
fn has_appearance(field: &Field) -> bool {
    groups(field).any(|group| group.opacities.is_some() || group.colors.is_some())
}

/// True where identity rows have owners, or no entries.
fn has_owners(field: &Field) -> bool {
    field.identities.as_ref().is_some_and(|rows| {
        !rows.owners.is_empty() || rows.row_offsets.windows(2).any(|pair| pair[0] == pair[1])
    })
}

/// True when any Gaussian of a deformed field stands still.
fn stands_still(field: &Field) -> bool {
    field.deformation.as_ref().is_some_and(|deformation| deformation.still.contains(&true))
}

/// Per Gaussian, 1 where it stands still; nothing when none does.
pub(super) fn still_rows(field: &Field) -> Option<Vec<u8>> {
    let deformation = field.deformation.as_ref().filter(|_| stands_still(field))?;
    Some((0..field.len()).map(|row| u8::from(deformation.is_still(row))).collect())
}

/// [`crate::Owner::code`] of every row; nothing where all rows are estimated.
pub(super) fn owner_codes(field: &Field) -> Option<Vec<i32>> {
    let rows = field.identities.as_ref().filter(|rows| !rows.owners.is_empty())?;
    Some(rows.owners.iter().map(|owner| owner.code()).collect())
}

/// Longest header, bytes; the limit of the safetensors format.
pub(super) const MAX_HEADER: u64 = 100_000_000;

pub(super) const FORMAT_KEY: &str = "cif.format";
pub(super) const VERSION_KEY: &str = "cif.version";
pub(super) const FIELD_KEY: &str = "cif.field";
pub(super) const TRAINING_KEY: &str = "cif.training";
pub(super) const HEAD_KEY: &str = "cif.head";

pub(super) const STILL: &str = "deformation.still";
pub(super) const TRACK_GROUPS: &str = "tracks.group_of";
pub(super) const TRACK_POSES: &str = "tracks.poses";
pub(super) const TRACK_MEANS: &str = "tracks.means";
pub(super) const TRACK_QUATERNIONS: &str = "tracks.quaternions";
pub(super) const TRACK_LOG_SCALES: &str = "tracks.log_scales";
pub(super) const TRACK_OPACITIES: &str = "tracks.opacities";
pub(super) const TRACK_COLORS: &str = "tracks.sh_coefficients";
pub(super) const ROW_OFFSETS: &str = "identities.row_offsets";
pub(super) const LABELS: &str = "identities.labels";
pub(super) const LOG_ESTIMATES: &str = "identities.log_estimates";
pub(super) const OWNERS: &str = "identities.owners";
pub(super) const TRAINING_PREFIX: &str = "training.";
pub(super) const HEAD_PREFIX: &str = "head.";

/// The part of a field that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FieldJson {
    pub(super) deformation: Option<DeformationJson>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) tracks: Option<Vec<TrackGroupJson>>,
    pub(super) has_identities: bool,
    /// True where there is a tensor of owners.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(super) has_owners: bool,
    pub(super) instances: Vec<Instance>,
    pub(super) timeline: Timeline,
    pub(super) cameras: Vec<RecordedCamera>,
    pub(super) sh_degree: u8,
    pub(super) background: [f32; 3],
    pub(super) sort_metric: SortMetric,
    pub(super) extent: f32,
    pub(super) provenance: serde_json::Value,
}

/// The part of a deformation that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DeformationJson {
    pub(super) config: DeformationConfig,
    pub(super) bounds: Bounds,
    /// True when there is a tensor of Gaussians that stand still.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(super) has_still: bool,
}

/// The part of a [`TrackGroup`] that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TrackGroupJson {
    name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    instance: Option<u16>,
    deformed: bool,
    pivot: [f64; 3],
    /// Rows of the poses' tensor; those of the groups follow one another.
    pub(super) poses: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    rotation: Option<RotationEvidence>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    joint: Option<Joint>,
    /// Pairs of time and whether visible.
    visibility: Vec<(f64, bool)>,
    pub(super) dense: Option<DenseJson>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) opacities: Option<SamplesJson>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) colors: Option<SamplesJson>,
}

/// The part of [`Samples`] that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SamplesJson {
    times: Vec<f64>,
    /// Rows of the tensor.
    pub(super) rows: usize,
}

impl SamplesJson {
    fn of<V>(samples: &Samples<V>) -> Self {
        Self { times: samples.times.clone(), rows: samples.values.len() }
    }
}

/// The part of a [`DenseTrack`] that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DenseJson {
    times: Vec<f64>,
    /// Rows of the dense tensors.
    pub(super) rows: usize,
    /// True when log-scales are sampled too.
    pub(super) log_scales: bool,
}

/// Time, translation x y z, quaternion w x y z.
pub(super) const POSE_FLOATS: usize = 8;

/// Values of track groups in the tensors of a file.
#[derive(Default)]
pub(super) struct TrackArrays {
    pub(super) poses: Vec<[f64; POSE_FLOATS]>,
    pub(super) means: Vec<[f32; 3]>,
    pub(super) quaternions: Vec<[f32; 4]>,
    pub(super) log_scales: Vec<[f32; 3]>,
    pub(super) opacities: Vec<f32>,
    pub(super) colors: Vec<[f32; SH_FLOATS]>,
}

impl TrackGroupJson {
    fn of(group: &TrackGroup) -> Self {
        Self {
            name: group.name.clone(),
            instance: group.instance,
            deformed: group.deformed,
            pivot: group.pivot.to_array(),
            poses: group.poses.len(),
            rotation: group.rotation,
            joint: group.joint,
            visibility: group.visibility.iter().map(|step| (step.time, step.visible)).collect(),
            dense: group.dense.as_ref().map(|dense| DenseJson {
                times: dense.times.clone(),
                rows: dense.means.len(),
                log_scales: dense.log_scales.is_some(),
            }),
            opacities: group.opacities.as_ref().map(SamplesJson::of),
            colors: group.colors.as_ref().map(SamplesJson::of),
        }
    }

    /// The group again; `arrays` hold its own rows only.
    pub(super) fn group(self, arrays: TrackArrays) -> TrackGroup {
        let pose = |[time, x, y, z, qw, qx, qy, qz]: [f64; POSE_FLOATS]| TrackPose {
            time,
            translation: DVec3::new(x, y, z),
            rotation: DQuat::from_xyzw(qx, qy, qz, qw),
        };
        TrackGroup {
            name: self.name,
            instance: self.instance,
            deformed: self.deformed,
            pivot: DVec3::from_array(self.pivot),
            poses: arrays.poses.into_iter().map(pose).collect(),
            rotation: self.rotation,
            joint: self.joint,
            visibility: self
                .visibility
                .into_iter()
                .map(|(time, visible)| VisibilityStep { time, visible })
                .collect(),
            dense: self.dense.map(|dense| DenseTrack {
                times: dense.times,
                means: arrays.means,
                quaternions: arrays.quaternions,
                log_scales: dense.log_scales.then_some(arrays.log_scales),
            }),
            opacities: self
                .opacities
                .map(|samples| Samples { times: samples.times, values: arrays.opacities }),
            colors: self.colors.map(|samples| Samples { times: samples.times, values: arrays.colors }),
        }
    }
}

impl TrackArrays {
    /// The tensors of all groups.
    pub(super) fn of(tracks: &Tracks) -> Self {
        let mut arrays = Self::default();
        for group in &tracks.groups {
            arrays.poses.extend(group.poses.iter().map(|pose| {
                let (t, q) = (pose.translation, pose.rotation);
                [pose.time, t.x, t.y, t.z, q.w, q.x, q.y, q.z]
            }));
            if let Some(dense) = &group.dense {
                arrays.means.extend_from_slice(&dense.means);
                arrays.quaternions.extend_from_slice(&dense.quaternions);
                arrays.log_scales.extend_from_slice(dense.log_scales.as_deref().unwrap_or_default());
            }
            arrays.opacities.extend(group.opacities.iter().flat_map(|samples| &samples.values));
            arrays.colors.extend(group.colors.iter().flat_map(|samples| &samples.values));
        }
        arrays
    }
}

impl FieldJson {
    pub(super) fn of(field: &Field) -> Self {
        Self {
            deformation: field.deformation.as_ref().map(|deformation| DeformationJson {
                config: deformation.config.clone(),
                bounds: deformation.bounds,
                has_still: stands_still(field),
            }),
            tracks: field
                .tracks
                .as_ref()
                .map(|tracks| tracks.groups.iter().map(TrackGroupJson::of).collect()),
            has_identities: field.identities.is_some(),
            has_owners: field.identities.as_ref().is_some_and(|rows| !rows.owners.is_empty()),
            instances: field.instances.clone(),
            timeline: field.timeline.clone(),
            cameras: field.cameras.clone(),
            sh_degree: field.sh_degree,
            background: field.background,
            sort_metric: field.sort_metric,
            extent: field.extent,
            provenance: field.record.to_json(),
        }
    }
}

// Tensors are copied between memory and file as they are.
const _: () = assert!(cfg!(target_endian = "little"), "safetensors files are little-endian");
