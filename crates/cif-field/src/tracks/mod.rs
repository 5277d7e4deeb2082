//! Recorded motion: groups of Gaussians that follow a sampled path.
//!
//! Training learns motion as a [`crate::Deformation`]; motion that comes from elsewhere (an animated file, an
//! object moved by hand) is recorded here. At a time t a Gaussian of a group is
//!
//! 1. its canonical parameters, with the learned deltas added unless the group is exempt
//!    ([`TrackGroup::deformed`]),
//! 2. replaced by the dense samples of the group, where it has some ([`DenseTrack`]), and given its sampled opacity
//!    and colour ([`TrackGroup::opacities`], [`TrackGroup::colors`]),
//! 3. carried by the rigid pose of the group, `x' = R(t) (x - pivot) + translation(t)`: the orientation turns
//!    with it, and so does the view-dependent colour,
//! 4. not drawn while the group is hidden.
//!
//! Between samples, translations, dense samples, opacities and colours are linear and rotations spherical; outside
//! the samples the nearest one holds. Times are normalised as in [`crate::Timeline`].

mod apply;
mod joint;
mod jointed;

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::gaussians::SH_FLOATS;
use crate::instance::Instance;

pub use apply::{DenseAtTime, GroupAtTime, HIDDEN_LOGIT, SamplesAtTime, TracksAtTime};
pub use joint::{Joint, JointKind};

/// Entry of [`Tracks::group_of`] for a Gaussian without a group.
pub const NO_GROUP: u32 = u32::MAX;

/// Recorded motion of a field.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tracks {
    /// Group of every Gaussian, `[N]`: an index into `groups`, or [`NO_GROUP`].
    pub group_of: Vec<u32>,
    /// The groups. One without Gaussians is allowed and does nothing.
    pub groups: Vec<TrackGroup>,
}

/// Gaussians that move together.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackGroup {
    /// Name of the object, for people.
    pub name: String,
    /// Id ([`crate::Instance::id`]) of the instance that the group is of; `None` for the background, and where it is not
    /// recorded (files before format 9). With an id
    ///
    /// - every Gaussian of the group is the instance's, whatever its identity row says; an [`crate::Owner`] that a row has
    ///   is the same instance,
    /// - where the learned deformation leaves the group alone, its groups are all of the instance: Gaussians elsewhere
    ///   whose rows estimate the instance do not move with it (shadows, and what else its masks show), and are background,
    /// - the group that a joint is on is of the same instance.
    ///
    /// The first and the last are rules of [`crate::Field::validate`].
    pub instance: Option<u16>,
    /// True when the learned deformation moves the group before its track does; off for what was added to a
    /// trained scene.
    pub deformed: bool,
    /// Point that the poses carry, world, metres.
    pub pivot: DVec3,
    /// Poses by strictly ascending time; empty where the group stays.
    pub poses: Vec<TrackPose>,
    /// Evidence for the rotations of the poses; `None` where it is not recorded, as of motion that is not from images.
    pub rotation: Option<RotationEvidence>,
    /// Ties the poses to those of another part of the same object; `None` where they are free.
    pub joint: Option<Joint>,
    /// Changes of visibility by strictly ascending time; the first holds before its time too. Empty where the
    /// group is always visible.
    pub visibility: Vec<VisibilityStep>,
    /// A path for every Gaussian of the group, before the pose; `None` where the pose says it all.
    pub dense: Option<DenseTrack>,
    /// Opacities over time, in [0, 1] (not logits); `None` where they stay as in the canonical Gaussians.
    pub opacities: Option<Samples<f32>>,
    /// Spherical harmonics over time, before the pose turns them; `None` where they stay.
    pub colors: Option<Samples<[f32; SH_FLOATS]>>,
}

/// Evidence for the rotations of an object over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RotationEvidence {
    /// The images show how the object turns.
    Observed,
    /// They do not, as of a plain ball; a likely rotation is assumed.
    Assumed,
}

impl std::fmt::Display for RotationEvidence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Observed => "observed",
            Self::Assumed => "assumed",
        })
    }
}

/// Values of a group of M Gaussians over time, linear in between and held outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Samples<V> {
    /// T normalised times, strictly ascending, at least one.
    pub times: Vec<f64>,
    /// Values `[T, M]`; members are the rows of the group in [`Tracks::group_of`] in ascending order.
    pub values: Vec<V>,
}

impl<V: Copy> Samples<V> {
    /// Gaussians per sample, M.
    #[must_use]
    pub fn members(&self) -> usize {
        self.values.len() / self.times.len().max(1)
    }

    /// The samples of members `members[0], members[1], ...`, which may repeat.
    fn gather(&self, members: &[usize]) -> Self {
        let stride = self.members();
        let picked =
            (0..self.times.len()).flat_map(|sample| members.iter().map(move |member| (sample, *member)));
        let values = picked.map(|(sample, member)| self.values[sample * stride + member]).collect();
        Self { times: self.times.clone(), values }
    }
}

/// A pose at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackPose {
    /// Normalised time.
    pub time: f64,
    /// Where the pivot is, world, metres.
    pub translation: DVec3,
    /// Unit turn around the pivot; successive poses lie in one hemisphere.
    pub rotation: DQuat,
}

/// A change of visibility; it holds until the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilityStep {
    /// Normalised time.
    pub time: f64,
    /// True when the group can be seen from here on.
    pub visible: bool,
}

/// Sampled shapes of a group of M Gaussians, which are its rows of [`Tracks::group_of`] in ascending order.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseTrack {
    /// T normalised times, strictly ascending, at least one.
    pub times: Vec<f64>,
    /// Centres `[T, M]`, world before the pose, metres.
    pub means: Vec<[f32; 3]>,
    /// Quaternions `[T, M]` (w, x, y, z); every one in the hemisphere of its predecessor.
    pub quaternions: Vec<[f32; 4]>,
    /// Log-scales `[T, M]`; `None` where they stay as in the canonical Gaussians.
    pub log_scales: Option<Vec<[f32; 3]>>,
}

impl DenseTrack {
    /// Gaussians per sample, M.
    #[must_use]
    pub fn members(&self) -> usize {
        self.means.len() / self.times.len().max(1)
    }

    /// The samples of members `members[0], members[1], ...`, which may repeat.
    fn gather(&self, members: &[usize]) -> Self {
        let stride = self.members();
        let pick = |sample: usize| members.iter().map(move |member| sample * stride + member);
        let samples = 0..self.times.len();
        Self {
            times: self.times.clone(),
            means: samples.clone().flat_map(pick).map(|at| self.means[at]).collect(),
            quaternions: samples.clone().flat_map(pick).map(|at| self.quaternions[at]).collect(),
            log_scales: self
                .log_scales
                .as_ref()
                .map(|values| samples.clone().flat_map(pick).map(|at| values[at]).collect()),
        }
    }
}

impl TrackGroup {
    /// True where pictures may turn the poses: an assumed rotation is one that they do not show.
    #[must_use]
    pub fn turns_are_trained(&self) -> bool {
        self.rotation != Some(RotationEvidence::Assumed)
    }

    /// A group that does nothing yet, around a pivot.
    #[must_use]
    pub fn still(name: impl Into<String>, pivot: DVec3) -> Self {
        Self {
            name: name.into(),
            instance: None,
            deformed: true,
            pivot,
            poses: Vec::new(),
            rotation: None,
            joint: None,
            visibility: Vec::new(),
            dense: None,
            opacities: None,
            colors: None,
        }
    }

    /// A group of an instance, still so far, that the learned deformation leaves alone.
    #[must_use]
    pub fn of_instance(instance: &Instance, pivot: DVec3) -> Self {
        Self { instance: Some(instance.id), deformed: false, ..Self::still(&instance.label, pivot) }
    }

    /// The same motion for members `members[0], members[1], ...` of the group, which may repeat.
    fn gather(&self, members: &[usize]) -> Self {
        Self {
            name: self.name.clone(),
            instance: self.instance,
            deformed: self.deformed,
            pivot: self.pivot,
            poses: self.poses.clone(),
            rotation: self.rotation,
            joint: self.joint,
            visibility: self.visibility.clone(),
            dense: self.dense.as_ref().map(|dense| dense.gather(members)),
            opacities: self.opacities.as_ref().map(|opacities| opacities.gather(members)),
            colors: self.colors.as_ref().map(|colors| colors.gather(members)),
        }
    }

    /// True where members have samples of their own, so that their place in the group counts.
    fn has_samples(&self) -> bool {
        self.dense.is_some() || self.opacities.is_some() || self.colors.is_some()
    }

    /// Turn and place of the pivot at a time.
    #[must_use]
    pub fn pose(&self, time: f64) -> (DQuat, DVec3) {
        let Some([(before, _), (after, share)]) = self.keys(time) else {
            return (DQuat::IDENTITY, self.pivot);
        };
        let (a, b) = (&self.poses[before], &self.poses[after]);
        if before == after {
            return (a.rotation, a.translation);
        }
        (a.rotation.slerp(b.rotation, share), a.translation.lerp(b.translation, share))
    }

    /// Keys that decide the pose at a time, with their shares, which sum to 1; the same one twice at a key. `None`
    /// without poses.
    #[must_use]
    pub fn keys(&self, time: f64) -> Option<[(usize, f64); 2]> {
        let last = self.poses.len().checked_sub(1)?;
        let after = self.poses.partition_point(|pose| pose.time <= time);
        if after == 0 || after > last {
            let key = if after == 0 { 0 } else { last };
            return Some([(key, 1.0), (key, 0.0)]);
        }
        let (a, b) = (self.poses[after - 1].time, self.poses[after].time);
        let fraction = (time - a) / (b - a);
        Some([(after - 1, 1.0 - fraction), (after, fraction)])
    }

    /// True when the group can be seen at a time.
    #[must_use]
    pub fn is_visible(&self, time: f64) -> bool {
        let after = self.visibility.partition_point(|step| step.time <= time);
        self.visibility.get(after.max(1) - 1).is_none_or(|step| step.visible)
    }

    /// True when anything of the group changes over time, apart from its visibility.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.poses.len() > 1
            || self.dense.as_ref().is_some_and(|dense| dense.times.len() > 1)
            || self.opacities.as_ref().is_some_and(|opacities| opacities.times.len() > 1)
            || self.colors.as_ref().is_some_and(|colors| colors.times.len() > 1)
    }
}

impl Tracks {
    /// True when anything moves, apart from visibility.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.groups.iter().any(TrackGroup::moves)
    }

    /// Leaves open which instances the groups are of.
    pub fn forget_instances(&mut self) {
        self.groups.iter_mut().for_each(|group| group.instance = None);
    }

    /// Poses of all groups.
    #[must_use]
    pub fn poses(&self) -> usize {
        self.groups.iter().map(|group| group.poses.len()).sum()
    }

    /// True when groups do nothing but move as a whole, apart from the learned deformation: then poses have
    /// gradients.
    #[must_use]
    pub fn is_rigid(&self) -> bool {
        self.groups.iter().all(|group| !group.deformed && !group.has_samples())
    }

    /// Group of a row.
    #[must_use]
    pub fn group(&self, row: usize) -> Option<usize> {
        self.group_of.get(row).filter(|group| **group != NO_GROUP).map(|group| *group as usize)
    }

    /// Place of every row among the rows of its group, `[N]`; 0 without a group.
    #[must_use]
    pub fn members(&self) -> Vec<u32> {
        let mut sizes = vec![0; self.groups.len()];
        self.group_of
            .iter()
            .map(|&group| {
                if group == NO_GROUP {
                    return 0;
                }
                let size = &mut sizes[group as usize];
                *size += 1;
                *size - 1
            })
            .collect()
    }

    /// Rows `sources[0], sources[1], ...` as a new set; rows may repeat. All groups stay.
    ///
    /// # Panics
    /// When a source is out of range.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        let members = self.members();
        let mut kept: Vec<Vec<usize>> = vec![Vec::new(); self.groups.len()];
        let group_of: Vec<u32> = sources.iter().map(|&row| self.group_of[row as usize]).collect();
        for (&row, &group) in sources.iter().zip(&group_of) {
            if group != NO_GROUP {
                kept[group as usize].push(members[row as usize] as usize);
            }
        }
        let groups = self.groups.iter().zip(&kept).map(|(group, kept)| group.gather(kept)).collect();
        Self { group_of, groups }
    }

    /// Gives rows a motion of their own, free of joints: `change` makes the new group from the old one (a still one called
    /// `name` around `pivot` where there was none), once per old group. Samples go with their rows.
    ///
    /// # Panics
    /// When a row is out of range or given twice.
    pub fn regroup(
        &mut self,
        rows: &[u32],
        name: &str,
        pivot: DVec3,
        mut change: impl FnMut(TrackGroup) -> TrackGroup,
    ) {
        let members = self.members();
        let mut sizes = vec![0_usize; self.groups.len()];
        for &group in self.group_of.iter().filter(|group| **group != NO_GROUP) {
            sizes[group as usize] += 1;
        }
        let mut by_group: std::collections::BTreeMap<u32, Vec<u32>> = Default::default();
        for &row in rows {
            by_group.entry(self.group_of[row as usize]).or_default().push(row);
        }
        for (old, mut rows) in by_group {
            rows.sort_unstable();
            assert!(rows.windows(2).all(|pair| pair[0] < pair[1]), "every row once");
            let group = if old == NO_GROUP {
                TrackGroup::still(name, pivot)
            } else {
                let group = &mut self.groups[old as usize];
                let taken: Vec<usize> = rows.iter().map(|&row| members[row as usize] as usize).collect();
                let moving = group.gather(&taken);
                let mut is_taken = vec![false; sizes[old as usize]];
                taken.iter().for_each(|&member| is_taken[member] = true);
                let rest: Vec<usize> = (0..is_taken.len()).filter(|&member| !is_taken[member]).collect();
                *group = group.gather(&rest);
                moving
            };
            let new = self.groups.len() as u32;
            self.groups.push(TrackGroup { joint: None, ..change(group) });
            rows.iter().for_each(|&row| self.group_of[row as usize] = new);
        }
    }

    /// The same motion without groups that have no Gaussians; `None` when none is left. A joint goes with its base.
    #[must_use]
    pub fn compact(mut self) -> Option<Self> {
        let mut used = vec![false; self.groups.len()];
        for &group in self.group_of.iter().filter(|group| **group != NO_GROUP) {
            used[group as usize] = true;
        }
        let mut next = 0;
        let renumbered: Vec<u32> = used
            .iter()
            .map(|used| {
                next += u32::from(*used);
                if *used { next - 1 } else { NO_GROUP }
            })
            .collect();
        for group in self.group_of.iter_mut().filter(|group| **group != NO_GROUP) {
            *group = renumbered[*group as usize];
        }
        let mut flags = used.iter();
        self.groups.retain(|_| *flags.next().expect("one flag per group"));
        for group in &mut self.groups {
            let base = group.joint.map_or(NO_GROUP, |joint| renumbered[joint.base as usize]);
            group.joint = group.joint.filter(|_| base != NO_GROUP).map(|joint| Joint { base, ..joint });
        }
        (!self.groups.is_empty()).then_some(self)
    }
}

#[cfg(test)]
mod tests;
