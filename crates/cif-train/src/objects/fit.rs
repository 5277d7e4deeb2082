//! Poses and Gaussians of one object, moved together against its views and its priors.

use std::collections::BTreeMap;

use cif_render::PoseGradient;
use glam::{DQuat, DVec3};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;

use super::outline::Outline;
use super::plane::Plane;
use super::shape::{Adam, Pose, Shape};
use super::view::ObjectView;

/// Rates of turns, radians, and of translations, of the size.
const POSE_RATE: f64 = 0.02;

/// Rate of the distance from the camera of what leaves its support, relative to that of other shifts.
const DEPTH_RATE: f64 = 3.0;

/// Turn, radians, from which the shortest one need not be it, and the largest difference from where it leads.
const LONG: f64 = 2.0;
const LEADS: f64 = 1.2;

/// Background that losses are compared on.
pub(super) const GREY: [f32; 3] = [0.5; 3];

/// Turns that poses may take.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Turns {
    /// All.
    Free,
    /// About the normal of the plane.
    Upright,
    /// None but those they start with.
    Given,
}

/// An object under way.
pub(super) struct Fit<'a> {
    pub(super) views: &'a [ObjectView],
    pub(super) plane: Option<Plane>,
    pub(super) outline: &'a Outline,
    pub(super) poses: BTreeMap<usize, Pose>,
    pub(super) shape: Shape,
    pub(super) turns: Turns,
    /// Radius, metres, with which it is held to rolling without slip.
    pub(super) rolls: Option<f64>,
    /// Captured times of the sequence.
    pub(super) times: usize,
    /// Distance from the camera from which Gaussians are drawn.
    pub(super) near: f32,
    /// True with one camera per time, so that distances are not observed.
    pub(super) one_camera: bool,
    pub(super) rng: Pcg64,
    /// True where it is taken to stay in one place, whatever its path and its support say.
    pub(super) stays: bool,
    /// Times at which it may be off the plane.
    pub(super) air: Vec<usize>,
    pub(super) moments: BTreeMap<usize, PoseMoments>,
    /// Runs of times that share a pose.
    pub(super) runs: Vec<Vec<usize>>,
}

/// Moments of turns and translations.
pub(super) type PoseMoments = [Adam; 2];

/// Moments of a pose that has not moved yet.
fn fresh_moments() -> PoseMoments {
    [Adam::new(3), Adam::new(3)]
}

/// A pose that moves by itself, and is not among those of a fit yet.
pub(super) struct MovingPose {
    /// The pose as far as it has moved.
    pub(super) pose: Pose,
    /// Of its optimiser.
    moments: PoseMoments,
}

impl MovingPose {
    /// A pose before its first step.
    pub(super) fn from(pose: Pose) -> Self {
        Self { pose, moments: fresh_moments() }
    }
}

/// A pose at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct TimedPose {
    /// Index of the time.
    pub(super) time: usize,
    /// World from object.
    pub(super) pose: Pose,
}

/// Tangent vector of a rotation, at most pi long.
pub(super) fn log(rotation: DQuat) -> DVec3 {
    let rotation = if rotation.w < 0.0 { -rotation } else { rotation };
    rotation.to_scaled_axis()
}

impl Fit<'_> {
    pub(super) fn size(&self) -> f64 {
        self.outline.size()
    }

    /// Reductions that steps take, coarse to fine, as places in the crops of a view.
    pub(super) fn levels(&self) -> &'static [usize] {
        let mut areas: Vec<f64> = self.views.iter().map(ObjectView::detail).collect();
        match super::view::median(&mut areas) {
            area if area > 600.0 => &[2, 1, 0],
            area if area > 120.0 => &[1, 0],
            _ => &[0],
        }
    }

    /// Reduction at which trials are compared: the last but one, where there are several.
    pub(super) fn trial_level(&self) -> usize {
        let levels = self.levels();
        levels[levels.len().saturating_sub(2)]
    }

    /// Times that share the pose of one; none where it has its own.
    pub(super) fn run(&self, time: usize) -> &[usize] {
        self.runs.iter().find(|run| run.contains(&time)).map_or(&[], Vec::as_slice)
    }

    /// Times before and after one that have poses.
    pub(super) fn neighbours(&self, time: usize) -> [Option<usize>; 2] {
        [
            self.poses.range(..time).next_back().map(|(time, _)| *time),
            self.poses.range(time + 1..).next().map(|(time, _)| *time),
        ]
    }

    /// Loss of a view in its present pose.
    pub(super) fn loss(&mut self, view: usize, level: usize) -> f64 {
        let view = &self.views[view];
        let Some(pose) = self.poses.get(&view.time_index) else { return 0.0 };
        self.shape.loss(&view.crops[level], pose, GREY, 1.0, false).value
    }

    /// Loss of a view in a pose, by a shape of one's own.
    pub(super) fn loss_with(&self, shape: &mut Shape, view: usize, level: usize, pose: &Pose) -> f64 {
        shape.loss(&self.views[view].crops[level], pose, GREY, 1.0, false).value
    }

    /// A step of a pose that is not among those of the fit yet; the shape stays.
    pub(super) fn pose_step(
        &self,
        shape: &mut Shape,
        view: usize,
        level: usize,
        moving: &mut MovingPose,
        rate: f64,
    ) {
        let view = &self.views[view];
        let MovingPose { pose, moments } = moving;
        let mut gradient = shape.loss(&view.crops[level], pose, GREY, view.visible as f32, true).pose;
        if view.is_sliver() {
            gradient.turn = DVec3::ZERO;
        }
        gradient.translation += self.depth(view, pose);
        if let Some((of_pose, _)) = self.contact(shape, view.time_index, pose) {
            gradient.turn += of_pose.turn;
            gradient.translation += of_pose.translation;
        }
        *pose = self.moved(view, pose, &gradient, moments, rate);
    }

    /// A pose moved onto views in so many steps, the shape as it is.
    pub(super) fn settled(
        &self,
        shape: &mut Shape,
        views: &[usize],
        level: usize,
        pose: Pose,
        steps: usize,
    ) -> Pose {
        let mut moving = MovingPose::from(pose);
        for step in 0..steps {
            let rate = if step < steps / 2 { 1.0 } else { 0.3 };
            self.pose_step(shape, views[step % views.len()], level, &mut moving, rate);
        }
        moving.pose
    }

    /// Mean loss over views, by their visible shares.
    pub(super) fn mean_loss(&mut self, views: &[usize], level: usize) -> f64 {
        let weights: f64 = views.iter().map(|view| self.views[*view].visible).sum();
        let sum: f64 = views.iter().map(|view| self.views[*view].visible * self.loss(*view, level)).sum();
        sum / weights.max(1e-12)
    }

    /// A step on a view: its Gaussians at `rate`, unless they stay, its pose and those next to it at `pose_rate`.
    pub(super) fn step(&mut self, view: usize, level: usize, rate: Option<f64>, pose_rate: f64) {
        let view = &self.views[view];
        let time = view.time_index;
        let Some(pose) = self.poses.get(&time).copied() else { return };
        let background = std::array::from_fn(|_| self.rng.random::<f32>());
        let weight = view.visible as f32;
        let mut loss = self.shape.loss(&view.crops[level], &pose, background, weight, true);
        if view.is_sliver() {
            loss.pose.turn = DVec3::ZERO;
        }
        let mut gradients = BTreeMap::from([(time, loss.pose)]);
        gradients.entry(time).or_default().translation += self.depth(view, &pose);
        self.accelerate(time, &mut gradients);
        if let Some((of_pose, of_centres)) = self.contact(&self.shape, time, &pose) {
            let gradient = gradients.entry(time).or_default();
            gradient.turn += of_pose.turn;
            gradient.translation += of_pose.translation;
            self.shape.add_to_centres(&of_centres);
        }
        self.roll(time, &mut gradients);
        if let Some(rate) = rate {
            self.shape.step(rate);
        }
        for (time, gradient) in gradients {
            let Some(pose) = self.poses.get(&time) else { continue };
            let mut moments = self.moments.remove(&time).unwrap_or_else(fresh_moments);
            let view = self.views.iter().find(|view| view.time_index == time).unwrap_or(view);
            let moved = self.moved(view, pose, &gradient, &mut moments, pose_rate);
            self.moments.insert(time, moments);
            self.poses.insert(time, moved);
        }
        let pose = self.poses[&time];
        for other in self.run(time).to_vec() {
            self.poses.insert(other, pose);
        }
    }

    /// A pose after a step against its gradient, at the time of a view.
    fn moved(
        &self,
        view: &ObjectView,
        pose: &Pose,
        gradient: &PoseGradient,
        moments: &mut PoseMoments,
        rate: f64,
    ) -> Pose {
        let (mut turn, mut shift) = (DVec3::ZERO, DVec3::ZERO);
        let [of_turns, of_shifts] = moments;
        let values = |v: DVec3| v.to_array().into_iter();
        of_turns.step(values(gradient.turn), POSE_RATE * rate, |k, step| turn[k] = -step);
        let rate = POSE_RATE * rate * self.size();
        if self.one_camera && !self.air.is_empty() {
            // Along the axes of the camera: off its support, nothing but its size shows how far away it is, which is
            // weak compared with what shows its place in the image.
            let axes = view.camera.camera_from_world.rotation;
            of_shifts.step(values(axes * gradient.translation), rate, |k, step| shift[k] = -step);
            shift.z *= DEPTH_RATE;
            shift = axes.transpose() * shift;
        } else {
            of_shifts.step(values(gradient.translation), rate, |k, step| shift[k] = -step);
        }
        turn = match (self.turns, &self.plane) {
            (Turns::Given, _) => DVec3::ZERO,
            (Turns::Upright, Some(plane)) => plane.normal * plane.normal.dot(turn),
            _ => turn,
        };
        Pose {
            rotation: (DQuat::from_scaled_axis(turn) * pose.rotation).normalize(),
            translation: self.stood(view, pose.translation + shift),
        }
    }

    /// Steps over views in a shuffled order, again and again; `rates` gives those of Gaussians and poses, and the
    /// level, by the share of the steps done.
    pub(super) fn steps(&mut self, views: &[usize], count: usize, rates: impl Fn(f64) -> (f64, f64, usize)) {
        let mut order = views.to_vec();
        for step in 0..if order.is_empty() { 0 } else { count } {
            if self.shape.phases().is_over() {
                break;
            }
            let place = step % order.len();
            if place == 0 {
                order.shuffle(&mut self.rng);
            }
            let (rate, pose_rate, level) = rates(step as f64 / count as f64);
            self.step(order[place], level, Some(rate), pose_rate);
        }
    }

    /// Pose at a time between or beyond those that have one.
    pub(super) fn pose_at(&self, time: usize) -> Option<Pose> {
        if let Some(pose) = self.poses.get(&time) {
            return Some(*pose);
        }
        let [before, after] = self.neighbours(time);
        Some(match (before, after) {
            (Some(a), Some(b)) => {
                let share = (time - a) as f64 / (b - a) as f64;
                let mut pose = between(&self.poses[&a], &self.poses[&b], share);
                if let Some([turn, rest]) = self.long_turn(a, b) {
                    let part = |turn: DVec3| DQuat::from_scaled_axis(share * turn);
                    pose.rotation = (part(rest) * part(turn) * self.poses[&a].rotation).normalize();
                }
                let path = |time: usize| self.outline.path.get(&time).copied();
                if self.outline.is_surrounded
                    && !self.stays
                    && let (Some(from), Some(to), Some(place)) = (path(a), path(b), path(time))
                {
                    // Offset from the path as its neighbours are.
                    pose.translation += place - from.lerp(to, share);
                }
                pose
            }
            (Some(a), None) => self.beyond(a, self.neighbours(a)[0], time),
            (None, Some(a)) => self.beyond(a, self.neighbours(a)[1], time),
            (None, None) => return None,
        })
    }

    /// Turn from one time to the next that has a pose, which may be a whole one and more, as its rolling or its speed on
    /// either side leads, and what is left from there; `None` where that is short, so that the shortest turn is it, or
    /// leads elsewhere.
    fn long_turn(&self, a: usize, b: usize) -> Option<[DVec3; 2]> {
        let (first, last) = (self.poses[&a], self.poses[&b]);
        let steps = (b - a) as f64;
        let speed = |from: usize, to: usize| {
            log(self.poses[&to].rotation * self.poses[&from].rotation.inverse()) / (to - from) as f64
        };
        let turn = match (self.rolls, &self.plane) {
            (Some(radius), Some(plane)) => plane.normal.cross(last.translation - first.translation) / radius,
            _ => {
                let before = self.neighbours(a)[0].map(|before| speed(before, a));
                let after = self.neighbours(b)[1].map(|after| speed(b, after));
                0.5 * steps * (before? + after?)
            }
        };
        let rest = log(last.rotation * (DQuat::from_scaled_axis(turn) * first.rotation).inverse());
        (turn.length() > LONG && rest.length() < LEADS).then_some([turn, rest])
    }

    /// Fills the gaps across which it turns far. Across others the poses that are trained on either side show what lies
    /// between.
    pub(super) fn fill_long_turns(&mut self) {
        let times: Vec<usize> = self.poses.keys().copied().collect();
        let far = times.windows(2).filter(|pair| self.long_turn(pair[0], pair[1]).is_some());
        let gaps = far.flat_map(|pair| pair[0] + 1..pair[1]);
        let filled: Vec<(usize, Pose)> = gaps.filter_map(|time| Some((time, self.pose_at(time)?))).collect();
        self.poses.extend(filled);
    }

    /// Pose at a time beyond the outermost one, from its neighbour.
    fn beyond(&self, near: usize, far: Option<usize>, time: usize) -> Pose {
        let at = |time: usize| TimedPose { time, pose: self.poses[&time] };
        far.map_or(self.poses[&near], |far| onward(at(near), at(far), time))
    }
}

/// Pose at a time where the speed between a far and a near one leads, for a few steps at most.
pub(super) fn onward(near: TimedPose, far: TimedPose, time: usize) -> Pose {
    let steps = (time as f64 - near.time as f64) / (near.time as f64 - far.time as f64);
    let steps = steps.clamp(-6.0, 6.0);
    let (last, before) = (near.pose, far.pose);
    let turn = log(last.rotation * before.rotation.inverse());
    Pose {
        rotation: (DQuat::from_scaled_axis(steps * turn) * last.rotation).normalize(),
        translation: last.translation + steps * (last.translation - before.translation),
    }
}

/// Pose between two.
pub(super) fn between(a: &Pose, b: &Pose, share: f64) -> Pose {
    Pose {
        rotation: a.rotation.slerp(b.rotation, share),
        translation: a.translation.lerp(b.translation, share),
    }
}
