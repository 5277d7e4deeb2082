//! Groups of Gaussians that move as a whole, on the device: where their poses put them, and gradients by the poses.
//!
//! | file | stage |
//! |---|---|
//! | `poses.wgsl` | groups and their Gaussians at the time of a view |
//! | `poses_backward.wgsl` | gradients of Gaussians in the frame of their group, summed in parts |
//! | `poses_sum.wgsl` | gradients of the poses around the time |
//! | `quaternions.wgsl` | products |
//!
//! Harmonics stay in the frame of the group: projection turns the direction of view instead, see
//! `shared/turned_directions.wgsl`. Results are the same on every run.

use bytemuck::Zeroable;
use cif_field::Tracks;
use cif_field::tracks::{HIDDEN_LOGIT, JointKind, NO_GROUP, TrackGroup};
use glam::DQuat;

use super::deform::GpuDeformation;
use super::faults::FAULTS;
use super::gaussians::GpuGaussians;
use super::kernel::Constant;
use super::rasterizer::{PosedInput, Rasterizer};
use super::stages::entries;
use super::view::{CONSTANTS, NUMBERS};
use super::{
    Commands, Gpu, GpuError, GpuVec, Kernel, Layout, MAX_WORKGROUPS, Module, Shared, Snippet, Uniform,
    constants, structures, workgroups,
};

crate::shared_struct! {
    /// Sizes of what the kernels work on.
    pub struct GroupSizes {
        /// Groups.
        pub groups: u32,
        /// Gaussians in groups.
        pub members: u32,
        /// Pads to 16 bytes.
        pub unused: [u32; 2],
    }
}

crate::shared_struct! {
    /// A group, and its keys around the time of a view.
    pub struct GroupView {
        /// Pivot, and the share of the later key.
        pub pivot: [f32; 4],
        /// Earlier and later key among the poses of all groups; `NO_POSE` without any.
        pub keys: [u32; 2],
        /// Its first Gaussian among those of all groups, and the one after its last.
        pub members: [u32; 2],
        /// Its first pose among those of all groups, and the one after its last.
        pub poses: [u32; 2],
        /// 1 when it is drawn.
        pub visible: u32,
        /// 1 when the turns of its poses train.
        pub turns: u32,
        /// Axis of its joint; one more float.
        pub axis: [f32; 4],
        /// Kind of its joint (0 none, 1 revolute, 2 prismatic) and the group that it moves on; two more numbers.
        pub joint: [u32; 4],
    }
}

crate::shared_struct! {
    /// A pose.
    pub struct Pose {
        /// Unit quaternion (w, x, y, z).
        pub rotation: [f32; 4],
        /// Place of the pivot relative to the pivot, metres; one more float.
        pub offset: [f32; 4],
    }
}

crate::shared_struct! {
    /// A group at the time of a view.
    pub struct GroupFrame {
        /// Rows of the rotation, each with its component of where the pivot is.
        pub rotation: [[f32; 4]; 3],
        /// The rotation as a unit quaternion (w, x, y, z).
        pub turn: [f32; 4],
    }
}

crate::shared_struct! {
    /// Gradient by a pose, as [`crate::PoseGradient`] has it.
    pub struct PoseSum {
        /// By the turn, and a count.
        pub turn: [f32; 4],
        /// By the translation; one more float.
        pub translation: [f32; 4],
    }
}

/// Key of a group without poses.
const NO_POSE: u32 = u32::MAX;

/// Workgroups that sum the gradients of a group.
const GROUP_PARTS: u32 = 16;

/// Structures and constants of groups.
pub const GROUPS: Snippet = Snippet {
    name: "groups",
    text: || {
        let named = constants(&[
            ("NO_POSE", Constant::Unsigned(NO_POSE)),
            ("GROUP_PARTS", Constant::Unsigned(GROUP_PARTS)),
            ("HIDDEN_LOGIT", Constant::Float(HIDDEN_LOGIT)),
        ]);
        named + &structures(&LAYOUTS.map(|layout| layout()))
    },
};

/// Products of quaternions.
pub const QUATERNIONS: Snippet =
    Snippet { name: "quaternions", text: || include_str!("quaternions.wgsl").to_owned() };

/// Groups at the time of a view.
pub const POSES: Module = Module {
    name: "poses",
    text: include_str!("poses.wgsl"),
    imports: &[CONSTANTS, NUMBERS, GROUPS, QUATERNIONS],
    entries: &["frames_of_groups", "carry"],
};

/// Gradients in the frame of a group.
pub const POSES_BACKWARD: Module = Module {
    name: "poses_backward",
    text: include_str!("poses_backward.wgsl"),
    imports: &[CONSTANTS, GROUPS, QUATERNIONS],
    entries: &["poses_backward"],
};

/// Gradients of poses.
pub const POSES_SUM: Module = Module {
    name: "poses_sum",
    text: include_str!("poses_sum.wgsl"),
    imports: &[CONSTANTS, NUMBERS, GROUPS, FAULTS],
    entries: &["poses_sum"],
};

/// Structures of this stage.
pub const LAYOUTS: [fn() -> Layout; 5] =
    [GroupSizes::layout, GroupView::layout, Pose::layout, GroupFrame::layout, PoseSum::layout];

/// Groups with their poses and gradients on a device.
#[derive(Debug)]
pub struct GpuPoses {
    /// As they were sent: what they are at a time follows from times that nothing changes.
    groups: Vec<TrackGroup>,
    /// Gaussians of every group among those of all, first and end.
    ranges: Vec<[u32; 2]>,
    /// Of all groups, one after the other.
    pub poses: GpuVec<Pose>,
    /// By the poses, summed over the views of a step; next to the turn the views that the pose was a key of.
    pub gradients: GpuVec<PoseSum>,
    /// The groups at the time of the view that was recorded last.
    pub views: GpuVec<GroupView>,
    /// Gaussian and group, by group.
    pub members: GpuVec<[u32; 2]>,
    sizes: Uniform<GroupSizes>,
    frames: GpuVec<GroupFrame>,
    turns: GpuVec<[f32; 4]>,
    parts: GpuVec<PoseSum>,
    frames_of_groups: Kernel,
    carry: Kernel,
    backward: Kernel,
    sum: Kernel,
}

impl GpuPoses {
    /// A copy of the groups of a field, which do nothing but move as a whole.
    ///
    /// # Errors
    /// When there are more than the device takes, with the arithmetic; when the driver rejects the kernels.
    ///
    /// # Panics
    /// When groups have samples of their Gaussians.
    pub fn new(gpu: &Gpu, tracks: &Tracks) -> Result<Self, GpuError> {
        assert!(tracks.is_rigid(), "groups move as a whole");
        let groups = tracks.groups.len();
        if groups > MAX_WORKGROUPS as usize {
            return Err(GpuError::TooLarge {
                what: "groups that move as a whole".to_owned(),
                count: groups as u64,
                item_bytes: 1,
                bytes: groups as u128,
                limit: u64::from(MAX_WORKGROUPS),
                advice: "fewer groups".to_owned(),
            });
        }
        let [frames_of_groups, carry] = entries(gpu, &POSES)?;
        let [backward] = entries(gpu, &POSES_BACKWARD)?;
        let [sum] = entries(gpu, &POSES_SUM)?;
        let mut poses = Self {
            groups: tracks.groups.clone(),
            ranges: Vec::new(),
            poses: GpuVec::from_slice(gpu, "poses", &rows(tracks))?,
            gradients: GpuVec::zeros(gpu, "gradients of the poses", tracks.poses())?,
            views: GpuVec::zeros(gpu, "groups of a view", groups)?,
            members: GpuVec::zeros(gpu, "Gaussians of the groups", 0)?,
            sizes: Uniform::new(gpu, "sizes of the groups", &GroupSizes::zeroed()),
            frames: GpuVec::zeros(gpu, "frames of the groups", groups)?,
            turns: GpuVec::zeros(gpu, "turns of the Gaussians", 0)?,
            parts: GpuVec::zeros(gpu, "parts of the gradients of groups", groups * GROUP_PARTS as usize)?,
            frames_of_groups,
            carry,
            backward,
            sum,
        };
        poses.set_members(gpu, tracks)?;
        Ok(poses)
    }

    /// Takes other Gaussians for the same groups.
    ///
    /// # Errors
    /// When they exceed what the device binds.
    pub fn set_members(&mut self, gpu: &Gpu, tracks: &Tracks) -> Result<(), GpuError> {
        let mut members: Vec<[u32; 2]> =
            (0_u32..).zip(&tracks.group_of).map(|(row, group)| [row, *group]).collect();
        members.retain(|[_, group]| *group != NO_GROUP);
        members.sort_by_key(|[_, group]| *group);
        let first = |group: usize| members.partition_point(|[_, of]| (*of as usize) < group) as u32;
        self.ranges = (0..self.groups.len()).map(|group| [first(group), first(group + 1)]).collect();
        self.members.replace(gpu, &members)?;
        self.turns.replace(gpu, &vec![[1.0, 0.0, 0.0, 0.0]; tracks.group_of.len()])?;
        let sizes =
            GroupSizes { groups: self.groups.len() as u32, members: members.len() as u32, unused: [0; 2] };
        self.sizes.write(gpu, &sizes);
        Ok(())
    }

    /// Number of groups.
    #[must_use]
    pub fn groups(&self) -> usize {
        self.groups.len()
    }

    /// Reads the poses into the groups that they were made from, waiting for the device.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<TrackGroup>, GpuError> {
        let mut groups = self.groups.clone();
        let poses = self.poses.read(gpu)?;
        let of_groups = groups.iter_mut().flat_map(|group| {
            let pivot = group.pivot;
            group.poses.iter_mut().map(move |pose| (pivot, pose))
        });
        for ((pivot, pose), row) in of_groups.zip(poses) {
            let [w, x, y, z] = row.rotation.map(f64::from);
            pose.rotation = DQuat::from_xyzw(x, y, z, w);
            pose.translation = pivot + glam::DVec3::from_slice(&row.offset.map(f64::from));
        }
        Ok(groups)
    }

    /// Records where the groups put their Gaussians at a time in 0..=1, into `posed`: `moved` is what the deformation
    /// makes of the `canonical` ones, `posed` itself or these. One time per submission: it is written at once.
    fn carry<'a>(
        &'a self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        time: f64,
        canonical: &GpuGaussians,
        moved: PosedInput<'a>,
        posed: &'a GpuGaussians,
    ) -> PosedInput<'a> {
        if !std::ptr::eq(moved.geometry, &posed.geometry) {
            commands.copy(moved.geometry, &posed.geometry);
        }
        self.views.write(gpu, 0, &self.views_at(time));
        let bindings = [
            self.sizes.binding(),
            self.views.binding(),
            self.poses.binding(),
            self.members.binding(),
            canonical.geometry.binding(),
            self.frames.binding(),
            posed.geometry.binding(),
            self.turns.binding(),
        ];
        let frames = self.frames_of_groups.bind(gpu, &bindings);
        let carry = self.carry.bind(gpu, &bindings);
        commands.stage("deform", |stage| {
            stage.dispatch(&self.frames_of_groups, &frames, workgroups(self.groups.len(), 64));
            stage.dispatch(&self.carry, &carry, workgroups(self.members.len(), 64));
        });
        PosedInput { geometry: &posed.geometry, turns: Some(&self.turns), ..moved }
    }

    /// Kind and base of a joint that the device holds poses to: one whose base is at rest, or has poses at the same times.
    fn joint(&self, group: &TrackGroup) -> [u32; 4] {
        let Some(joint) = group.joint else { return [0; 4] };
        let base = &self.groups[joint.base as usize];
        let times = |group: &TrackGroup| group.poses.iter().map(|pose| pose.time).collect::<Vec<_>>();
        if !base.poses.is_empty() && times(base) != times(group) {
            return [0; 4];
        }
        let kind = match joint.kind {
            JointKind::Revolute => 1,
            JointKind::Prismatic => 2,
        };
        [kind, joint.base, 0, 0]
    }

    fn views_at(&self, time: f64) -> Vec<GroupView> {
        let mut first = 0;
        let of_group = |(group, members): (&TrackGroup, &[u32; 2])| {
            let end = first + group.poses.len() as u32;
            let [(before, _), (after, share)] = group.keys(time).unwrap_or_default();
            let keys = match group.poses.is_empty() {
                true => [NO_POSE; 2],
                false => [first + before as u32, first + after as u32],
            };
            let [x, y, z] = group.pivot.as_vec3().to_array();
            let view = GroupView {
                pivot: [x, y, z, share as f32],
                keys,
                members: *members,
                poses: [first, end],
                visible: u32::from(group.is_visible(time)),
                turns: u32::from(group.turns_are_trained()),
                axis: group.joint.map_or([0.0; 4], |joint| joint.axis.as_vec3().extend(0.0).to_array()),
                joint: self.joint(group),
            };
            first = end;
            view
        };
        self.groups.iter().zip(&self.ranges).map(of_group).collect()
    }

    /// Records what the gradients of the view in `rasterizer` are in the frames of the groups, and adds those by the
    /// poses to [`Self::gradients`]; the view was recorded after [`pose`]. What no optimiser may take is a bit
    /// of the first word of `faults`.
    pub fn backward(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        canonical: &GpuGaussians,
        rasterizer: &Rasterizer,
        faults: &GpuVec<u32>,
    ) {
        let v_posed = &rasterizer.gradients().gaussians.geometry;
        let backward = self.backward.bind(
            gpu,
            &[
                self.views.binding(),
                self.members.binding(),
                canonical.geometry.binding(),
                self.frames.binding(),
                rasterizer.splat_gradients().binding(),
                v_posed.binding(),
                self.parts.binding(),
            ],
        );
        let sum = self.sum.bind(
            gpu,
            &[
                self.sizes.binding(),
                self.views.binding(),
                self.frames.binding(),
                self.parts.binding(),
                self.gradients.binding(),
                faults.binding(),
            ],
        );
        commands.stage("project backward", |stage| {
            stage.dispatch(&self.backward, &backward, [self.groups.len() as u32, GROUP_PARTS, 1]);
            stage.dispatch(&self.sum, &sum, workgroups(self.groups.len(), 64));
        });
    }
}

/// Records where Gaussians are at a time in 0..=1, into `posed`, which has as many rows as `canonical` where anything
/// moves them: the deformation, then groups; what is to be drawn then. One time per submission: it is written at once.
pub fn pose<'a>(
    gpu: &Gpu,
    commands: &mut Commands<'_>,
    time: f64,
    deformation: Option<&GpuDeformation>,
    groups: Option<&'a GpuPoses>,
    canonical: &'a GpuGaussians,
    posed: &'a GpuGaussians,
) -> PosedInput<'a> {
    let moved = match deformation {
        Some(deformation) => deformation.pose(gpu, commands, time, canonical, posed),
        None => canonical.into(),
    };
    match groups {
        Some(groups) => groups.carry(gpu, commands, time, canonical, moved, posed),
        None => moved,
    }
}

/// Poses of all groups in the layout of the device.
fn rows(tracks: &Tracks) -> Vec<Pose> {
    let of_group = |group: &TrackGroup| {
        let pivot = group.pivot;
        let row = move |pose: &cif_field::tracks::TrackPose| {
            let DQuat { x, y, z, w } = pose.rotation;
            let [dx, dy, dz] = (pose.translation - pivot).as_vec3().to_array();
            Pose { rotation: [w, x, y, z].map(|value| value as f32), offset: [dx, dy, dz, 0.0] }
        };
        group.poses.iter().map(row).collect::<Vec<_>>()
    };
    tracks.groups.iter().flat_map(of_group).collect()
}
