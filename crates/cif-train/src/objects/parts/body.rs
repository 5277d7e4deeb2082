//! A body under way: a base, and a part that a joint moves, or two; Gaussians, joints and values together.

use std::collections::BTreeMap;

use cif_field::tracks::{JointKind, TrackGroup, TrackPose, Tracks};
use glam::{DQuat, DVec3};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use super::super::sequence::between;
use super::super::shape::{Adam, Pose, Shape};
use super::super::view::ObjectView;

/// Rates of values, radians or of the size, of the direction of the axis, and of its place, of the size.
const RATES: [f64; 3] = [0.02, 0.004, 0.004];

/// Cosine from which an axis counts as upright.
const UPRIGHT: f64 = 0.99;

/// Background that losses are compared on.
const GREY: [f32; 3] = [0.5; 3];

/// A joint in the frame of the object.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Hinge {
    pub(crate) kind: JointKind,
    /// Unit.
    pub(crate) axis: DVec3,
    /// A point of the axis.
    pub(crate) point: DVec3,
}

impl Hinge {
    /// Turn about the point, and where that goes, at a value.
    pub(super) fn pose(&self, value: f64) -> (DQuat, DVec3) {
        match self.kind {
            JointKind::Revolute => (DQuat::from_axis_angle(self.axis, value), self.point),
            JointKind::Prismatic => (DQuat::IDENTITY, self.point + value * self.axis),
        }
    }

    /// World from the part where the object is at a pose.
    pub(super) fn posed(&self, base: &Pose, value: f64) -> Pose {
        let (turn, place) = self.pose(value);
        let rotation = base.rotation * turn;
        Pose { rotation, translation: base.rotation * (place - turn * self.point) + base.translation }
    }

    /// True where another joint is about the same: of one direction, and within a distance.
    pub(super) fn is_like(&self, other: &Self, distance: f64) -> bool {
        let apart = other.point - self.point;
        let across = apart - self.axis * self.axis.dot(apart);
        let is_near = self.kind == JointKind::Prismatic || across.length() < distance;
        self.kind == other.kind && self.axis.dot(other.axis).abs() > 0.98 && is_near
    }

    /// Length that a step of the values is measured by: an angle, or the size of the object.
    pub(super) fn unit(&self, size: f64) -> f64 {
        if self.kind == JointKind::Revolute { 1.0 } else { size }
    }
}

/// Optimisers of a joint.
struct Moments {
    values: BTreeMap<usize, Adam>,
    axis: Adam,
    point: Adam,
}

/// An object whose poses are known.
#[derive(Clone, Copy)]
pub(super) struct PosedObject<'a> {
    /// In the order of times.
    pub(super) views: &'a [ObjectView],
    /// World from object, by time.
    pub(super) base: &'a BTreeMap<usize, Pose>,
    /// The larger of half height and radius, metres.
    pub(super) size: f64,
    /// Direction away from the support, in the frame of the object, where there is one: the axis keeps its angle to it,
    /// for furniture has upright and level hinges.
    pub(super) up: Option<DVec3>,
}

/// A joint on the base of a body.
pub(super) struct JointOfBody {
    /// In the frame of the object.
    pub(super) hinge: Hinge,
    /// Values by time, radians or metres.
    pub(super) values: BTreeMap<usize, f64>,
    /// Its value, of one that is searched for: -1 of the second of two.
    pub(super) share: f64,
    moments: Moments,
}

impl JointOfBody {
    pub(super) fn new(hinge: Hinge, values: BTreeMap<usize, f64>, share: f64) -> Self {
        let moments = Moments { values: BTreeMap::new(), axis: Adam::new(3), point: Adam::new(3) };
        Self { hinge, values, share, moments }
    }

    /// Its value at a time, between those that are known.
    pub(super) fn value_at(&self, time: usize) -> f64 {
        between(&self.values, time)
    }
}

/// A base and, behind its Gaussians, those of parts on joints; without joints all of them are the base.
pub(super) struct Body<'a> {
    object: PosedObject<'a>,
    pub(super) shape: Shape,
    pub(super) joints: Vec<JointOfBody>,
    rng: Pcg64,
}

impl<'a> Body<'a> {
    /// A body of the Gaussians of a shape, each of the base (0) or of the part of a joint, counted from 1.
    pub(super) fn new(
        object: PosedObject<'a>,
        shape: Shape,
        joints: Vec<JointOfBody>,
        group_of: Vec<usize>,
        rng: Pcg64,
    ) -> Self {
        let shape = if joints.is_empty() {
            shape
        } else {
            let still = |name, pivot| TrackGroup { deformed: false, ..TrackGroup::still(name, pivot) };
            let of_joint = |joint: &JointOfBody| {
                let point = joint.hinge.point;
                let pose = TrackPose { time: 0.0, translation: point, rotation: DQuat::IDENTITY };
                TrackGroup { poses: vec![pose], ..still("part", point) }
            };
            let base = still("base", joints[0].hinge.point);
            let groups = std::iter::once(base).chain(joints.iter().map(of_joint)).collect();
            let group_of = group_of.into_iter().map(|group| group as u32).collect();
            shape.in_parts(Tracks { group_of, groups })
        };
        Self { object, shape, joints, rng }
    }

    /// Group of each Gaussian: 0 of the base.
    pub(super) fn groups(&self) -> Vec<usize> {
        (0..self.shape.gaussians().len()).map(|row| self.shape.part_of(row).unwrap_or(0)).collect()
    }

    /// Difference of the largest and the least value of the first joint.
    pub(super) fn reach(&self) -> f64 {
        self.joints.first().map_or(0.0, |joint| {
            let (low, high) = range(&joint.values);
            high - low
        })
    }

    /// Loss of a view by a shape of one's own, with a value that is searched for, or those that the joints have.
    pub(super) fn loss_with(&self, shape: &mut Shape, view: usize, level: usize, value: Option<f64>) -> f64 {
        let view = &self.object.views[view];
        let Some(pose) = self.object.base.get(&view.time_index) else { return 0.0 };
        let of =
            |joint: &JointOfBody| value.map_or(joint.value_at(view.time_index), |value| joint.share * value);
        put(shape, &self.joints, of);
        shape.loss(&view.crops[level], pose, GREY, 1.0, false).value
    }

    /// Mean loss over views, by their visible shares.
    pub(super) fn mean_loss(&self, views: &[usize], level: usize) -> f64 {
        let mut shape = self.shape.copied();
        let (mut sum, mut weights) = (0.0, 0.0);
        for view in views {
            let of = &self.object.views[*view];
            sum += of.visible * self.loss_with(&mut shape, *view, level, None);
            weights += of.visible;
        }
        sum / f64::max(weights, 1e-12)
    }

    /// Steps over views in a shuffled order, with rates of Gaussians and of the joint by the share of the steps done.
    pub(super) fn steps(
        &mut self,
        views: &[usize],
        count: usize,
        level: usize,
        rates: impl Fn(f64) -> (f64, f64),
    ) {
        let mut order = views.to_vec();
        for step in 0..if order.is_empty() { 0 } else { count } {
            if self.shape.phases().is_over() {
                break;
            }
            let place = step % order.len();
            if place == 0 {
                order.shuffle(&mut self.rng);
            }
            let (rate, of_joint) = rates(step as f64 / count as f64);
            self.step(order[place], level, rate, of_joint);
        }
    }

    fn step(&mut self, view: usize, level: usize, rate: f64, of_joint: f64) {
        let view = &self.object.views[view];
        let time = view.time_index;
        let Some(pose) = self.object.base.get(&time) else { return };
        put(&mut self.shape, &self.joints, |joint| joint.value_at(time));
        let background = std::array::from_fn(|_| self.rng.random::<f32>());
        self.shape.loss(&view.crops[level], pose, background, view.visible as f32, true);
        self.shape.step(rate);
        if of_joint > 0.0 {
            (0..self.joints.len()).for_each(|joint| self.move_joint(joint, time, of_joint));
        }
    }

    /// Moves value, direction and place of a joint against the gradient of the last loss.
    fn move_joint(&mut self, joint: usize, time: usize, rate: f64) {
        let PosedObject { size, up, .. } = self.object;
        let gradient = self.shape.part_gradient(joint);
        let joint = &mut self.joints[joint];
        let (hinge, value) = (joint.hinge, joint.value_at(time));
        let (turn, _) = hinge.pose(value);
        let v_turn = turn * gradient.turn;
        let (of_value, of_axis, of_point) = match hinge.kind {
            JointKind::Revolute => {
                let (sine, cosine) = value.sin_cos();
                (
                    hinge.axis.dot(v_turn),
                    sine * v_turn + (1.0 - cosine) * v_turn.cross(hinge.axis),
                    gradient.translation - turn.inverse() * gradient.translation,
                )
            }
            JointKind::Prismatic => {
                (hinge.axis.dot(gradient.translation), value * gradient.translation, DVec3::ZERO)
            }
        };
        let (mut axis, mut point, mut at) = (hinge.axis, hinge.point, value);
        let moments = joint.moments.values.entry(time).or_insert_with(|| Adam::new(1));
        let rate_of_value = RATES[0] * hinge.unit(size) * rate;
        moments.step(std::iter::once(of_value), rate_of_value, |_, step| at -= step);
        let values = |v: DVec3| v.to_array().into_iter();
        joint.moments.axis.step(values(of_axis), RATES[1] * rate, |k, step| axis[k] -= step);
        if hinge.kind == JointKind::Revolute {
            let rate = RATES[2] * size * rate;
            joint.moments.point.step(values(of_point), rate, |k, step| point[k] -= step);
            // Along the axis it says nothing.
            point -= hinge.axis * hinge.axis.dot(point - hinge.point);
        }
        if let Some(up) = up {
            let along = hinge.axis.dot(up);
            axis += up * (along - axis.dot(up));
            if along.abs() > UPRIGHT {
                axis = hinge.axis;
            }
        }
        joint.values.insert(time, at);
        joint.hinge = Hinge { axis: axis.normalize(), point, ..hinge };
    }
}

/// Puts the parts of a shape where their joints have values.
fn put(shape: &mut Shape, joints: &[JointOfBody], value: impl Fn(&JointOfBody) -> f64) {
    for (k, joint) in joints.iter().enumerate() {
        let (turn, place) = joint.hinge.pose(value(joint));
        shape.set_part(k + 1, joint.hinge.point, turn, place);
    }
}

/// Least and largest value; infinities where there are none.
pub(super) fn range(values: &BTreeMap<usize, f64>) -> (f64, f64) {
    values.values().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
}
