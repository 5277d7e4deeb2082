//! Tracks at one time, put onto posed Gaussians.

use cif_geometry::quaternion;
use cif_geometry::spherical_harmonics::HarmonicsRotation;
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::{DenseTrack, NO_GROUP, Samples, TrackGroup, Tracks};
use crate::gaussians::{SH_FLOATS, saturated_logit};
use crate::{Gaussians, GaussiansMut};

/// Opacity and occupancy logit of a hidden Gaussian: nothing in single precision is nearer to 0 and not 0.
pub const HIDDEN_LOGIT: f32 = -104.0;

/// Gaussians handled by one task.
const CHUNK: usize = 512;

/// A turn whose matrix is nearer to the identity than this changes no pixel.
const NO_TURN: f64 = 1e-12;

/// A group at a time.
#[derive(Clone, Debug)]
pub struct GroupAtTime<'a> {
    /// See [`super::TrackGroup::deformed`].
    pub deformed: bool,
    /// True when it is drawn.
    pub visible: bool,
    /// True when the pose does anything.
    pub moved: bool,
    /// True when the pose turns.
    pub turned: bool,
    /// Turn around the pivot.
    pub rotation: DQuat,
    /// Point that the pose carries.
    pub pivot: DVec3,
    /// Where the pivot is.
    pub translation: DVec3,
    /// Dense samples around the time.
    pub dense: Option<DenseAtTime<'a>>,
    /// Opacities around the time, in [0, 1].
    pub opacities: Option<SamplesAtTime<'a, f32>>,
    /// Spherical harmonics around the time, before the pose turns them.
    pub colors: Option<SamplesAtTime<'a, [f32; SH_FLOATS]>>,
}

impl GroupAtTime<'_> {
    /// True when nothing happens to the group.
    fn is_still(&self) -> bool {
        self.deformed
            && self.visible
            && !self.moved
            && self.dense.is_none()
            && self.opacities.is_none()
            && self.colors.is_none()
    }
}

/// The samples before and after a time.
#[derive(Clone, Copy, Debug)]
pub struct SamplesAtTime<'a, V> {
    before: &'a [V],
    after: &'a [V],
    /// Share of the sample after.
    pub fraction: f64,
}

impl<'a, V: Copy> SamplesAtTime<'a, V> {
    fn new(samples: &'a Samples<V>, time: f64) -> Self {
        let members = samples.members();
        let around = Around::new(&samples.times, time);
        let sample = |index: usize| &samples.values[index * members..(index + 1) * members];
        Self { before: sample(around.before), after: sample(around.after), fraction: around.fraction }
    }

    /// Values of a member before and after.
    #[must_use]
    pub fn values(&self, member: usize) -> [V; 2] {
        [self.before[member], self.after[member]]
    }
}

/// Positions of the samples before and after a time, and the share of the one after; the nearest one twice outside
/// of the samples.
struct Around {
    before: usize,
    after: usize,
    fraction: f64,
}

impl Around {
    fn new(times: &[f64], time: f64) -> Self {
        let after = times.partition_point(|sample| *sample <= time);
        let last = times.len() - 1;
        if after == 0 || after > last {
            let at = if after == 0 { 0 } else { last };
            return Self { before: at, after: at, fraction: 0.0 };
        }
        let (low, high) = (times[after - 1], times[after]);
        Self { before: after - 1, after, fraction: (time - low) / (high - low) }
    }
}

/// The dense samples before and after a time.
#[derive(Clone, Copy, Debug)]
pub struct DenseAtTime<'a> {
    track: &'a DenseTrack,
    /// First entry of the sample before.
    before: usize,
    /// First entry of the sample after.
    after: usize,
    /// Share of the sample after.
    pub fraction: f64,
}

impl<'a> DenseAtTime<'a> {
    fn new(track: &'a DenseTrack, time: f64) -> Self {
        let stride = track.members();
        let Around { before, after, fraction } = Around::new(&track.times, time);
        Self { track, before: before * stride, after: after * stride, fraction }
    }

    /// Centres of a member before and after.
    #[must_use]
    pub fn means(&self, member: usize) -> [[f32; 3]; 2] {
        [self.track.means[self.before + member], self.track.means[self.after + member]]
    }

    /// Quaternions of a member before and after, in one hemisphere.
    #[must_use]
    pub fn quaternions(&self, member: usize) -> [[f32; 4]; 2] {
        [self.track.quaternions[self.before + member], self.track.quaternions[self.after + member]]
    }

    /// Log-scales of a member before and after; `None` where they do not change.
    #[must_use]
    pub fn log_scales(&self, member: usize) -> Option<[[f32; 3]; 2]> {
        let values = self.track.log_scales.as_ref()?;
        Some([values[self.before + member], values[self.after + member]])
    }
}

/// All groups of a [`Tracks`] at a time.
#[derive(Clone, Debug)]
pub struct TracksAtTime<'a> {
    group_of: &'a [u32],
    /// The groups, in the order of [`Tracks::groups`].
    pub groups: Vec<GroupAtTime<'a>>,
    /// [`Tracks::members`]; empty where no group has samples of its members.
    members: Vec<u32>,
}

impl Tracks {
    /// The groups at a normalised time.
    #[must_use]
    pub fn at(&self, time: f64) -> TracksAtTime<'_> {
        TracksAtTime::new(self, time)
    }
}

impl<'a> TracksAtTime<'a> {
    fn new(tracks: &'a Tracks, time: f64) -> Self {
        let groups: Vec<GroupAtTime<'a>> = tracks
            .groups
            .iter()
            .map(|group| {
                let (rotation, translation) = group.pose(time);
                let turned = rotation.xyz().length_squared() > NO_TURN * NO_TURN;
                GroupAtTime {
                    deformed: group.deformed,
                    visible: group.is_visible(time),
                    moved: turned || translation != group.pivot,
                    turned,
                    rotation,
                    pivot: group.pivot,
                    translation,
                    dense: group.dense.as_ref().map(|dense| DenseAtTime::new(dense, time)),
                    opacities: group.opacities.as_ref().map(|samples| SamplesAtTime::new(samples, time)),
                    colors: group.colors.as_ref().map(|samples| SamplesAtTime::new(samples, time)),
                }
            })
            .collect();
        let is_sampled = tracks.groups.iter().any(TrackGroup::has_samples);
        let members = if is_sampled { tracks.members() } else { Vec::new() };
        Self { group_of: &tracks.group_of, groups, members }
    }

    /// The same with every group visible: what a hidden object would look like.
    #[must_use]
    pub fn unhidden(mut self) -> Self {
        self.groups.iter_mut().for_each(|group| group.visible = true);
        self
    }

    /// Group of a row, with the row's place among the members of a group that has samples of them.
    #[must_use]
    pub fn group(&self, row: usize) -> Option<(&GroupAtTime<'a>, usize)> {
        let group = *self.group_of.get(row)?;
        let member = self.members.get(row).map_or(0, |member| *member as usize);
        (group != NO_GROUP).then(|| (&self.groups[group as usize], member))
    }

    /// True when any Gaussian is other than posed without tracks.
    #[must_use]
    pub fn changes_anything(&self) -> bool {
        self.groups.iter().any(|group| !group.is_still())
    }

    /// True where canonical colours of this degree of spherical harmonics turn, which those of degree 0 do not, or are
    /// sampled.
    #[must_use]
    pub fn changes_colors(&self, degree: u8) -> bool {
        self.groups.iter().any(|group| (group.turned && degree > 0) || group.colors.is_some())
    }

    /// Puts the tracks onto `posed`, the canonical Gaussians with the learned deformation at this time.
    ///
    /// # Panics
    /// When the arrays have other lengths than the tracks; the spherical harmonics may be empty.
    pub fn apply(&self, canonical: &Gaussians, posed: GaussiansMut<'_>) {
        if !self.changes_anything() {
            return;
        }
        let n = self.group_of.len();
        assert!(canonical.len() == n && posed.means.len() == n, "one group per Gaussian");
        (
            posed.means.par_iter_mut(),
            posed.log_scales.par_iter_mut(),
            posed.quaternions.par_iter_mut(),
            posed.opacity_logits.par_iter_mut(),
            posed.occupancy_logits.par_iter_mut(),
        )
            .into_par_iter()
            .with_min_len(CHUNK)
            .enumerate()
            .for_each(|(row, (mean, log_scale, quaternion, opacity_logit, occupancy_logit))| {
                let Some((group, member)) = self.group(row) else { return };
                if !group.deformed {
                    *mean = canonical.means[row];
                    *log_scale = canonical.log_scales[row];
                    *quaternion = canonical.quaternions[row];
                    *opacity_logit = canonical.opacity_logits[row];
                }
                if let Some(dense) = &group.dense {
                    dense.place(member, mean, log_scale, quaternion);
                }
                if let Some(opacities) = &group.opacities {
                    let [before, after] = opacities.values(member).map(f64::from);
                    *opacity_logit = saturated_logit(before + opacities.fraction * (after - before));
                }
                if group.moved {
                    let offset = DVec3::from_array(mean.map(f64::from)) - group.pivot;
                    let moved = group.rotation * offset + group.translation;
                    *mean = moved.to_array().map(|value| value as f32);
                }
                if group.turned {
                    let DQuat { x, y, z, w } = group.rotation;
                    let turned = quaternion::multiply([w, x, y, z], quaternion.map(f64::from));
                    *quaternion = turned.map(|value| value as f32);
                }
                if !group.visible {
                    *opacity_logit = HIDDEN_LOGIT;
                    *occupancy_logit = HIDDEN_LOGIT;
                }
            });
        if !posed.sh_coefficients.is_empty() {
            self.turn_colors(canonical, posed.sh_coefficients);
        }
    }

    fn turn_colors(&self, canonical: &Gaussians, sh_coefficients: &mut [[f32; SH_FLOATS]]) {
        let turns: Vec<Option<HarmonicsRotation<f32>>> = self
            .groups
            .iter()
            .map(|group| group.turned.then(|| harmonics_rotation(group.rotation)))
            .collect();
        sh_coefficients.par_iter_mut().with_min_len(CHUNK).enumerate().for_each(|(row, sh)| {
            let Some((group, member)) = self.group(row) else { return };
            if !group.deformed {
                *sh = canonical.sh_coefficients[row];
            }
            if let Some(colors) = &group.colors {
                *sh = mix(colors.values(member), colors.fraction as f32);
            }
            if let Some(turn) = &turns[self.group_of[row] as usize] {
                turn.rotate(sh);
            }
        });
    }
}

/// Rotation of spherical-harmonics coefficients by the rotation of a pose.
fn harmonics_rotation(rotation: DQuat) -> HarmonicsRotation<f32> {
    let rows = DMat3::from_quat(rotation).transpose().to_cols_array_2d();
    HarmonicsRotation::new(rows.map(|row| row.map(|value| value as f32)))
}

impl DenseAtTime<'_> {
    /// Replaces a shape by the samples around the time.
    fn place(&self, member: usize, mean: &mut [f32; 3], log_scale: &mut [f32; 3], quaternion: &mut [f32; 4]) {
        let fraction = self.fraction as f32;
        *mean = mix(self.means(member), fraction);
        *quaternion = mix(self.quaternions(member), fraction);
        if let Some(log_scales) = self.log_scales(member) {
            *log_scale = mix(log_scales, fraction);
        }
    }
}

fn mix<const LENGTH: usize>([before, after]: [[f32; LENGTH]; 2], fraction: f32) -> [f32; LENGTH] {
    if fraction == 0.0 {
        return before;
    }
    std::array::from_fn(|k| (1.0 - fraction) * before[k] + fraction * after[k])
}
