//! An object that bends, held against one that does not: a smooth field over its frame, which changes with time, shifts
//! its Gaussians. What deforms is explained far better by it, what is merely seen badly is not.

use cif_field::Gaussians;
use glam::DVec3;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

use super::fit::{Fit, GREY};
use super::shape::{Adam, Shape};
use super::split::SplitViews;

/// Functions of the place: 1, its coordinates, and products of two of these.
const TERMS: usize = 10;

/// Share of the first rates that the last have, and first rate of the Gaussians.
const LAST: f64 = 0.05;
const SHAPE_RATE: f64 = 0.5;

/// Work that a fit of the field may take.
#[derive(Clone, Copy)]
struct Effort {
    /// Captured times from one knot of the field to the next.
    knot: usize,
    steps: usize,
    /// First rate of the coefficients, of the size.
    rate: f64,
}

/// Enough to see that a rigid body does not explain an object, and to explain what deforms as well as it can be.
const ROUGHLY: Effort = Effort { knot: 3, steps: 900, rate: 0.002 };
const WELL: Effort = Effort { knot: 2, steps: 1500, rate: 0.008 };

/// Shifts that are quadratic in the place and linear in time between knots.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Shifts {
    /// Time of the first knot, and captured times from one to the next.
    first: usize,
    knot: usize,
    /// Size of the object, metres.
    size: f64,
    /// Coefficients by knot, metres.
    knots: Vec<[DVec3; TERMS]>,
}

impl Shifts {
    fn terms(&self, place: DVec3) -> [f64; TERMS] {
        let DVec3 { x, y, z } = place / self.size;
        [1.0, x, y, z, x * x, y * y, z * z, x * y, y * z, z * x]
    }

    /// Knots around a time, with their weights; times before the first and after the last are as these.
    fn knots_around(&self, time: usize) -> [(usize, f64); 2] {
        let last = self.first + self.knot * (self.knots.len() - 1) - 1;
        let since = time.clamp(self.first, last) - self.first;
        let (before, share) = (since / self.knot, (since % self.knot) as f64 / self.knot as f64);
        [(before, 1.0 - share), (before + 1, share)]
    }

    /// Places of the object, in its frame, with their shifts at a time.
    pub(crate) fn shifted(&self, time: usize, places: &[DVec3]) -> Vec<DVec3> {
        let near = self.knots_around(time);
        let coefficients: [DVec3; TERMS] =
            std::array::from_fn(|k| near.iter().map(|(knot, weight)| *weight * self.knots[*knot][k]).sum());
        let shift = |place: &DVec3| -> DVec3 {
            self.terms(*place).iter().zip(coefficients).map(|(term, coefficient)| *term * coefficient).sum()
        };
        places.iter().map(|place| *place + shift(place)).collect()
    }

    /// True where numbers that were saved are shifts, of a capture with so many times.
    pub(crate) fn are_sound(&self, times: usize) -> bool {
        let are_finite = self.knots.iter().flatten().all(|coefficient| coefficient.is_finite());
        let has_knots = self.first < times && (1..=times).contains(&self.knot) && self.knots.len() > 1;
        has_knots && self.size > 0.0 && are_finite
    }
}

/// Shifts that are fitted.
struct Bend {
    shifts: Shifts,
    moments: Vec<Adam>,
    /// By knot, true where some view showed it.
    is_seen: Vec<bool>,
    /// First rate of the coefficients, metres.
    rate: f64,
}

impl Bend {
    /// No shifts, at the times of the poses of a fit.
    fn none(fit: &Fit<'_>, effort: Effort) -> Self {
        let first = fit.poses.first_key_value().map_or(0, |(time, _)| *time);
        let last = fit.poses.last_key_value().map_or(0, |(time, _)| *time);
        let (knot, size) = (effort.knot, fit.size());
        let count = (last - first) / knot + 2;
        let shifts = Shifts { first, knot, size, knots: vec![[DVec3::ZERO; TERMS]; count] };
        Self {
            shifts,
            moments: vec![Adam::new(3 * TERMS); count],
            is_seen: vec![false; count],
            rate: effort.rate * size,
        }
    }

    /// A step against the gradients by the shifted places of a time, at a share of the first rate.
    fn step(&mut self, time: usize, places: &[DVec3], gradients: &[DVec3], share: f64) {
        let rate = share * self.rate;
        let mut sums = [DVec3::ZERO; TERMS];
        for (place, gradient) in places.iter().zip(gradients) {
            for (sum, term) in sums.iter_mut().zip(self.shifts.terms(*place)) {
                *sum += term * *gradient;
            }
        }
        for (knot, weight) in self.shifts.knots_around(time) {
            self.is_seen[knot] |= weight > 0.0;
            let values = sums.iter().flat_map(|sum| (weight * *sum).to_array());
            let coefficients = &mut self.shifts.knots[knot];
            self.moments[knot].step(values, rate, |k, step| coefficients[k / 3][k % 3] -= step);
        }
    }

    /// The shifts, those of knots that no view showed between those of the nearest ones that some did.
    fn filled(self) -> Shifts {
        let Self { mut shifts, is_seen, .. } = self;
        let seen = |knots: std::ops::Range<usize>| knots.filter(|knot| is_seen[*knot]);
        for knot in (0..is_seen.len()).filter(|knot| !is_seen[*knot]) {
            let (before, after) = (seen(0..knot).next_back(), seen(knot..is_seen.len()).next());
            let Some((before, after)) = before.or(after).zip(after.or(before)) else { continue };
            let share = (knot - before.min(knot)) as f64 / after.abs_diff(before).max(1) as f64;
            let [a, b] = [before, after].map(|knot| shifts.knots[knot]);
            shifts.knots[knot] = std::array::from_fn(|k| a[k].lerp(b[k], share));
        }
        shifts
    }
}

/// Loss of a view with the Gaussians shifted; their gradients stay in the shape, unless only the value is asked for.
fn loss(
    fit: &Fit<'_>,
    shape: &mut Shape,
    shifts: Option<&Shifts>,
    view: usize,
    level: usize,
    differentiates: bool,
) -> f64 {
    let view = &fit.views[view];
    let Some(pose) = fit.poses.get(&view.time_index) else { return 0.0 };
    let places = shape.centres();
    if let Some(shifts) = shifts {
        shape.set_centres(&shifts.shifted(view.time_index, &places));
    }
    let value = shape.loss(&view.crops[level], pose, GREY, 1.0, differentiates).value;
    shape.set_centres(&places);
    value
}

/// Gaussians and shifts after so many steps in the poses that there are, with the mean loss over the views that judge.
fn refitted(
    fit: &Fit<'_>,
    mut bend: Option<Bend>,
    steps: usize,
    views: &SplitViews,
    level: usize,
) -> (Shape, Option<Shifts>, f64) {
    let (mut shape, mut rng, mut order) = (fit.shape.copied(), fit.rng.clone(), views.train.clone());
    for step in 0..if order.is_empty() { 0 } else { steps } {
        let place = step % order.len();
        if place == 0 {
            order.shuffle(&mut rng);
        }
        let (view, rate) = (order[place], LAST.powf(step as f64 / steps as f64));
        let places = shape.centres();
        loss(fit, &mut shape, bend.as_ref().map(|bend| &bend.shifts), view, level, true);
        if let Some(bend) = &mut bend {
            bend.step(fit.views[view].time_index, &places, &shape.centre_gradients(), rate);
        }
        shape.step(SHAPE_RATE * rate);
    }
    let shifts = bend.map(Bend::filled);
    let weight = |view: &usize| fit.views[*view].visible;
    let mut judge = |view: &usize| weight(view) * loss(fit, &mut shape, shifts.as_ref(), *view, level, false);
    let judged = views.judged();
    let sum: f64 = judged.iter().map(&mut judge).sum();
    let error = sum / judged.iter().map(weight).sum::<f64>().max(1e-12);
    (shape, shifts, error)
}

/// Error of an object that may bend, on views that were left out.
pub(super) fn bent(fit: &Fit<'_>, views: &SplitViews, level: usize) -> f64 {
    refitted(fit, Some(Bend::none(fit, ROUGHLY)), ROUGHLY.steps, views, level).2
}

/// The same, of that of one that may not.
pub(super) fn gain(fit: &Fit<'_>, views: &SplitViews, level: usize) -> f64 {
    let rigid = || refitted(fit, None, ROUGHLY.steps, views, level).2;
    let (rigid, bent) = rayon::join(rigid, || bent(fit, views, level));
    bent / rigid.max(1e-12)
}

/// An object that bends in one place, explained as well as it can be: its Gaussians and shifts, in its frame, with the
/// error on views that were left out.
pub(super) fn bending(fit: &Fit<'_>, views: &SplitViews) -> Option<(Gaussians, Shifts, f64)> {
    let (shape, shifts, error) = refitted(fit, Some(Bend::none(fit, WELL)), WELL.steps, views, 0);
    Some((shape.gaussians().clone(), shifts?, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shifts_at_times_that_nothing_shows_lie_between_those_around_them() {
        let at = |x: f64| [DVec3::X * x; TERMS];
        let bend = |is_seen: &[bool]| Bend {
            shifts: Shifts {
                first: 0,
                knot: 2,
                size: 1.0,
                knots: vec![at(1.0), at(0.0), at(0.0), at(4.0), at(0.0)],
            },
            moments: Vec::new(),
            is_seen: is_seen.to_vec(),
            rate: 0.0,
        };
        let filled = |is_seen: &[bool]| -> Vec<f64> {
            bend(is_seen).filled().knots.iter().map(|terms| terms[3].x).collect()
        };
        assert_eq!(filled(&[true, false, false, true, false]), [1.0, 2.0, 3.0, 4.0, 4.0]);
        assert_eq!(filled(&[true; 5]), [1.0, 0.0, 0.0, 4.0, 0.0], "what was seen stays");
        assert_eq!(filled(&[false, true, false, false, false]), [0.0; 5]);
        assert_eq!(filled(&[false; 5]), [1.0, 0.0, 0.0, 4.0, 0.0], "nothing to lie between");
    }
}
