//! Priors of poses: where the pictures say little, an object moves evenly, stays on its support, and rolls as far as it
//! goes. Source: methods reference of motion, 2.4.

use std::collections::BTreeMap;

use cif_geometry::quaternion;
use cif_geometry::scalar::direct_sigmoid;
use cif_render::PoseGradient;
use glam::DVec3;

use super::fit::{Fit, log};
use super::outline::RAISED;
use super::shape::{Pose, Shape};
use super::view::{ObjectView, median};

/// Weight of accelerations and changes of turning, where an object is hardly seen.
const ACCELERATION: f64 = 0.02;

/// Acceleration that counts as large, of the size and in radians, per 60th of the sequence squared.
const LARGE_ACCELERATION: f64 = 0.05;

/// Visible share below which accelerations count.
const HARDLY_SEEN: f64 = 0.3;

/// Times between which nothing is said of accelerations.
const GAP: usize = 8;

/// Weight of the height of the lowest Gaussians above the plane.
const CONTACT: f64 = 2.0;

/// Weight of the distance along the ray from where the rays of neighbouring times cross.
const DEPTH: f64 = 2.0;

/// Weight of rolling without slip, and the slip that counts as large, radians.
const ROLL: (f64, f64) = (0.05, 0.1);

impl Fit<'_> {
    /// Holds a time at which the object is hardly seen to even motion between its neighbours.
    pub(super) fn accelerate(&self, time: usize, gradients: &mut BTreeMap<usize, PoseGradient>) {
        let seen = self.views.iter().filter(|view| view.time_index == time);
        if seen.map(|view| view.visible).fold(0.0, f64::max) >= HARDLY_SEEN {
            return;
        }
        let [Some(before), Some(after)] = self.neighbours(time) else { return };
        let (h0, h1) = (time - before, after - time);
        if h0 > GAP || h1 > GAP {
            return;
        }
        let (h0, h1) = (h0 as f64, h1 as f64);
        let per_step = 60.0 / self.times.max(1) as f64;
        let scale = 2.0 / (h0 + h1) / (LARGE_ACCELERATION * per_step * per_step);
        let [a, b, c] = [before, time, after].map(|time| self.poses[&time]);
        let shares = [1.0 / h0, -1.0 / h0 - 1.0 / h1, 1.0 / h1];
        let s = scale / self.size();
        let e = s * (shares[0] * a.translation + shares[1] * b.translation + shares[2] * c.translation);
        let v = ACCELERATION * e / (1.0 + e.length_squared()).sqrt() * s;
        for (time, share) in [before, time, after].into_iter().zip(shares) {
            gradients.entry(time).or_default().translation += share * v;
        }
        let (u0, u1) = (log(b.rotation * a.rotation.inverse()), log(c.rotation * b.rotation.inverse()));
        if u0.length().max(u1.length()) > 2.5 {
            return;
        }
        let e = scale * (u1 / h1 - u0 / h0);
        let v = ACCELERATION * e / (1.0 + e.length_squared()).sqrt() * scale;
        // The Jacobian of the logarithm is taken as 1.
        for (time, share) in [before, time, after].into_iter().zip(shares) {
            gradients.entry(time).or_default().turn += share * v;
        }
    }

    /// Gradient by the translation that holds it along the ray to where rays of neighbouring times cross: the size of
    /// a mask alone says little of the distance.
    pub(super) fn depth(&self, view: &ObjectView, pose: &Pose) -> DVec3 {
        let path = self.outline.path.get(&view.time_index);
        let Some(place) = path.filter(|_| self.one_camera && self.outline.is_surrounded) else {
            return DVec3::ZERO;
        };
        let ray = view.camera.ray(view.centroid).normalize();
        let size = self.size();
        2.0 * DEPTH * ray.dot(pose.translation - *place) / (size * size) * ray
    }

    /// A place moved to the height at which it stands where several cameras see it, at times at which it stands and they do
    /// not: along the ray of the camera that alone sees it, which leaves where it is in the image, else straight up or
    /// down.
    pub(super) fn stood(&self, view: &ObjectView, place: DVec3) -> DVec3 {
        let held = &self.outline.held;
        let Some(plane) = self.plane.filter(|_| !self.stays && held.contains(&view.time_index)) else {
            return place;
        };
        let met = self.poses.iter().filter(|(time, _)| !held.contains(time));
        let heights = met.map(|(_, pose)| plane.height(pose.translation));
        let stands = |height: &f64| (height / self.outline.height - 1.0).abs() < RAISED;
        let mut heights: Vec<f64> = heights.filter(stands).collect();
        if heights.is_empty() {
            return place;
        }
        let height = median(&mut heights);
        let origin = view.camera.centre();
        let is_alone = self.views.iter().filter(|other| other.time_index == view.time_index).count() == 1;
        match plane.meet(origin, place - origin, height).filter(|_| is_alone) {
            Some(share) => origin + share * (place - origin),
            None => place + (height - plane.height(place)) * plane.normal,
        }
    }

    /// True where it is held to its support, as nothing else shows its distance: neither several cameras nor rays of one
    /// that cross.
    pub(super) fn is_held(&self) -> bool {
        self.plane.is_some() && !self.stays && self.one_camera && !self.outline.is_surrounded
    }

    /// Gradients, by the pose and by the centres, that put the lowest Gaussians onto the plane, or no deeper at times off
    /// the plane; `None` where nothing needs to move, and where several cameras give the distance.
    pub(super) fn contact(
        &self,
        shape: &Shape,
        time: usize,
        pose: &Pose,
    ) -> Option<(PoseGradient, Vec<DVec3>)> {
        let plane = self.plane.filter(|_| self.is_held())?;
        let size = self.size();
        let g = shape.gaussians();
        let normal = pose.rotation.inverse() * plane.normal;
        let mut heights = Vec::with_capacity(g.len());
        for row in 0..g.len() {
            let mean = DVec3::from_array(g.means[row].map(f64::from));
            let raw = g.quaternions[row].map(f64::from);
            let unit = quaternion::try_normalize(raw).unwrap_or([1.0, 0.0, 0.0, 0.0]);
            let rows = quaternion::to_rotation(unit);
            let along: f64 = (0..3)
                .map(|axis| {
                    let part: f64 = (0..3).map(|k| normal[k] * rows[k][axis]).sum();
                    (part * f64::from(g.log_scales[row][axis]).exp()).powi(2)
                })
                .sum();
            heights.push(plane.height(pose.rotation * mean + pose.translation) - along.sqrt());
        }
        let lowest = heights.iter().copied().fold(f64::INFINITY, f64::min);
        let opacity = |row: usize| direct_sigmoid(f64::from(g.opacity_logits[row]));
        let mut weights: Vec<f64> = heights
            .iter()
            .enumerate()
            .map(|(row, height)| opacity(row) * (-(height - lowest) / (0.05 * size)).exp())
            .collect();
        let total: f64 = weights.iter().sum();
        if total <= 0.0 || total.is_nan() {
            return None;
        }
        weights.iter_mut().for_each(|weight| *weight /= total);
        let height: f64 = heights.iter().zip(&weights).map(|(height, weight)| height * weight).sum();
        if height > 0.0 && self.air.contains(&time) {
            return None;
        }
        let c = 2.0 * CONTACT * height / (size * size);
        let mut lever = DVec3::ZERO;
        let mut of_centres = Vec::with_capacity(g.len());
        for (row, weight) in weights.iter().enumerate() {
            let mean = DVec3::from_array(g.means[row].map(f64::from));
            lever += *weight * (pose.rotation * mean);
            of_centres.push(c * *weight * normal);
        }
        Some((
            PoseGradient { turn: c * lever.cross(plane.normal), translation: c * plane.normal },
            of_centres,
        ))
    }

    /// Holds a rolling object to turning as far as it goes.
    pub(super) fn roll(&self, time: usize, gradients: &mut BTreeMap<usize, PoseGradient>) {
        let (Some(plane), Some(radius)) = (self.plane, self.rolls) else { return };
        let [before, after] = self.neighbours(time);
        for (a, b) in [(before, Some(time)), (Some(time), after)] {
            let (Some(a), Some(b)) = (a, b) else { continue };
            let (first, second) = (self.poses[&a], self.poses[&b]);
            let turn = plane.normal.cross(second.translation - first.translation) / radius;
            if b - a > GAP || turn.length() > 2.5 {
                continue;
            }
            let e = log(second.rotation * first.rotation.inverse()) - turn;
            let v = ROLL.0 * e / (1.0 + e.length_squared() / (ROLL.1 * ROLL.1)).sqrt() / (ROLL.1 * ROLL.1);
            let shift = plane.normal.cross(v) / radius;
            let gradient = gradients.entry(b).or_default();
            gradient.turn += v;
            gradient.translation += shift;
            let gradient = gradients.entry(a).or_default();
            gradient.turn -= v;
            gradient.translation -= shift;
        }
    }
}
