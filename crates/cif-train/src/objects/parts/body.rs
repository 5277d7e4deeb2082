//! A body of two parts under way: a base, and a part that a joint moves; Gaussians, joint and values together.

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

/// A part of a body.
pub(super) struct Part {
    /// Joint that it is on.
    pub(super) hinge: Hinge,
    /// By Gaussian of the body, true for those of the part.
    pub(super) members: Vec<bool>,
    /// Values of the joint by time, radians or metres.
    pub(super) values: BTreeMap<usize, f64>,
}

/// A base and, behind its Gaussians, those of a part on a joint; without a joint all of them are the base.
pub(super) struct Body<'a> {
    object: PosedObject<'a>,
    pub(super) shape: Shape,
    pub(super) hinge: Option<Hinge>,
    /// Of the joint, by time.
    pub(super) values: BTreeMap<usize, f64>,
    moments: Moments,
    rng: Pcg64,
}

impl<'a> Body<'a> {
    /// A body of the Gaussians of a shape.
    pub(super) fn new(object: PosedObject<'a>, shape: Shape, part: Option<Part>, rng: Pcg64) -> Self {
        let (mut hinge, mut values) = (None, BTreeMap::new());
        let shape = match part {
            None => shape,
            Some(Part { hinge: of, members, values: at }) => {
                let still = |name| TrackGroup { deformed: false, ..TrackGroup::still(name, of.point) };
                let pose = TrackPose { time: 0.0, translation: of.point, rotation: DQuat::IDENTITY };
                let groups = vec![still("base"), TrackGroup { poses: vec![pose], ..still("part") }];
                (hinge, values) = (Some(of), at);
                shape.in_parts(Tracks { group_of: members.into_iter().map(u32::from).collect(), groups })
            }
        };
        let moments = Moments { values: BTreeMap::new(), axis: Adam::new(3), point: Adam::new(3) };
        Self { object, shape, hinge, values, moments, rng }
    }

    /// True for Gaussians of the part.
    pub(super) fn part_rows(&self) -> Vec<bool> {
        let rows = 0..self.shape.gaussians().len();
        rows.map(|row| self.shape.part_of(row) == Some(1)).collect()
    }

    /// Difference of the largest and the least value of the joint.
    pub(super) fn reach(&self) -> f64 {
        let (low, high) = range(&self.values);
        high - low
    }

    /// Value of the joint at a time, between those that are known.
    pub(super) fn value_at(&self, time: usize) -> f64 {
        between(&self.values, time)
    }

    /// Loss of a view with the joint at a value, by a shape of one's own.
    pub(super) fn loss_with(&self, shape: &mut Shape, view: usize, level: usize, value: f64) -> f64 {
        let view = &self.object.views[view];
        let Some(pose) = self.object.base.get(&view.time_index) else { return 0.0 };
        if let Some(hinge) = self.hinge {
            let (turn, place) = hinge.pose(value);
            shape.set_part(1, hinge.point, turn, place);
        }
        shape.loss(&view.crops[level], pose, GREY, 1.0, false).value
    }

    /// Mean loss over views, by their visible shares.
    pub(super) fn mean_loss(&self, views: &[usize], level: usize) -> f64 {
        let mut shape = self.shape.copied();
        let (mut sum, mut weights) = (0.0, 0.0);
        for view in views {
            let of = &self.object.views[*view];
            sum += of.visible * self.loss_with(&mut shape, *view, level, self.value_at(of.time_index));
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
        let value = self.value_at(time);
        if let Some(hinge) = self.hinge {
            let (turn, place) = hinge.pose(value);
            self.shape.set_part(1, hinge.point, turn, place);
        }
        let background = std::array::from_fn(|_| self.rng.random::<f32>());
        self.shape.loss(&view.crops[level], pose, background, view.visible as f32, true);
        self.shape.step(rate);
        if let Some(hinge) = self.hinge
            && of_joint > 0.0
        {
            self.move_joint(hinge, time, value, of_joint);
        }
    }

    /// Moves value, direction and place of the joint against the gradient of the last loss.
    fn move_joint(&mut self, hinge: Hinge, time: usize, value: f64, rate: f64) {
        let gradient = self.shape.part_gradient(0);
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
        let unit = hinge.unit(self.object.size);
        let moments = self.moments.values.entry(time).or_insert_with(|| Adam::new(1));
        moments.step(std::iter::once(of_value), RATES[0] * unit * rate, |_, step| at -= step);
        let values = |v: DVec3| v.to_array().into_iter();
        self.moments.axis.step(values(of_axis), RATES[1] * rate, |k, step| axis[k] -= step);
        if hinge.kind == JointKind::Revolute {
            let rate = RATES[2] * self.object.size * rate;
            self.moments.point.step(values(of_point), rate, |k, step| point[k] -= step);
            // Along the axis it says nothing.
            point -= hinge.axis * hinge.axis.dot(point - hinge.point);
        }
        if let Some(up) = self.object.up {
            let along = hinge.axis.dot(up);
            axis += up * (along - axis.dot(up));
            if along.abs() > UPRIGHT {
                axis = hinge.axis;
            }
        }
        self.values.insert(time, at);
        self.hinge = Some(Hinge { axis: axis.normalize(), point, ..hinge });
    }
}

/// Least and largest value; infinities where there are none.
pub(super) fn range(values: &BTreeMap<usize, f64>) -> (f64, f64) {
    values.values().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
}
