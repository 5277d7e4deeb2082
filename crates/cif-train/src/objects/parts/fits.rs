//! Guesses with Gaussians of their own: base, part, joint and values moved together, to the body that is kept.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::tracks::JointKind;
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::super::sequence::between;
use super::super::shape::{Pose, Shape};
use super::body::{Body, Hinge, Part, range};
use super::guesses::{Guess, JointValues};
use super::promise::LOOKS;
use super::scope::Search;
use super::search::search;

/// Gaussians and steps of a fit of base and part.
#[derive(Clone, Copy)]
pub(super) struct Budget {
    /// Gaussians of the base.
    pub(super) base: usize,
    /// Gaussians of the part.
    pub(super) part: usize,
    /// Steps of both together, with the joint.
    pub(super) steps: usize,
}

/// Budget of fine fits.
pub(super) const FINELY: Budget = Budget { base: 500, part: 250, steps: 500 };

/// Places of a hinge that are tried about that of a fit: steps to each side of it, and a step, of the size.
const PLACES: i32 = 3;
const PLACE: f64 = 0.13;

/// Opacity, as a logit, that the base starts with where the part is.
const FAINT: f32 = -2.0;

/// Opacity, as a logit, below which a Gaussian is dropped.
const SEEN: f32 = -3.0;

/// A guess under way, with the loss on the views that it is fitted to.
pub(super) struct Fit<'a> {
    pub(super) guess: Guess,
    pub(super) body: Body<'a>,
    pub(super) loss: f64,
}

/// Keeps the best of the fits, in their order, and the best slide among them.
pub(super) fn keep_kinds(fits: &mut Vec<Fit<'_>>, count: usize) {
    fits.sort_by(|a, b| a.loss.total_cmp(&b.loss));
    let slide = fits.iter().position(|fit| fit.guess.hinge.kind == JointKind::Prismatic);
    if let Some(place) = slide.filter(|place| *place >= count) {
        fits.swap(count - 1, place);
    }
    fits.truncate(count);
}

impl<'a> Search<'a> {
    /// A guess with Gaussians of its own, moved with the joint.
    pub(super) fn begun(
        &self,
        guess: Guess,
        values: &BTreeMap<usize, f64>,
        budget: Budget,
        level: usize,
    ) -> Option<Fit<'a>> {
        let hinge = guess.hinge;
        let mut base = self.hull(self.base, None, budget.base)?;
        base.fade(FAINT, |place| guess.has(place, 0.0));
        let margin = 0.1 * self.size;
        let inside = |place: DVec3| guess.has(place, margin);
        let mut part = self.hull(&self.posed(hinge, values), Some(&inside), budget.part)?;
        part.fade(FAINT, |place| !guess.has(place, 0.0));
        let mut body = self.together(base, &part, hinge, values);
        body.steps(
            &self.views.train,
            budget.steps,
            level,
            |share| if share < 0.2 { (1.0, 0.0) } else { (1.0, 1.0) },
        );
        let loss = body.mean_loss(&self.views.train, level);
        Some(Fit { guess, body, loss })
    }

    /// World from a part by time, with values of its joint.
    pub(super) fn posed(&self, hinge: Hinge, values: &BTreeMap<usize, f64>) -> BTreeMap<usize, Pose> {
        let posed = |(time, pose): (&usize, &Pose)| (*time, hinge.posed(pose, between(values, *time)));
        self.base.iter().map(posed).collect()
    }

    /// A base and a part on a joint.
    pub(super) fn together(
        &self,
        base: Shape,
        part: &Shape,
        hinge: Hinge,
        values: &BTreeMap<usize, f64>,
    ) -> Body<'a> {
        let of_base = base.gaussians().len();
        let members = (0..of_base + part.gaussians().len()).map(|row| row >= of_base).collect();
        let times = self.times(usize::MAX);
        let values = times.keys().map(|time| (*time, between(values, *time))).collect();
        self.body(base.joined(part), Some(Part { hinge, members, values }))
    }

    /// The joint of a body and its values, a hinge where it explains most: it was guessed at a side of the hull, which
    /// is too wide where few directions see the object, and angles follow the place.
    pub(super) fn placed(
        &self,
        guess: &Guess,
        mut body: Body<'a>,
        level: usize,
    ) -> (Hinge, BTreeMap<usize, f64>) {
        let hinge = body.hinge.unwrap_or(guess.hinge);
        if guess.values.is_round || hinge.kind == JointKind::Prismatic {
            return (hinge, body.values);
        }
        let times = self.times(LOOKS);
        let (first, second) = hinge.axis.any_orthonormal_pair();
        let mut best = (hinge, BTreeMap::new(), f64::INFINITY);
        for (i, j) in (-PLACES..=PLACES).flat_map(|i| (-PLACES..=PLACES).map(move |j| (i, j))) {
            let aside = PLACE * self.size * (f64::from(i) * first + f64::from(j) * second);
            let moved = Hinge { point: hinge.point + aside, ..hinge };
            body.hinge = Some(moved);
            let (values, loss) = search(&body, &times, &guess.values, level);
            if loss < best.2 {
                best = (moved, values, loss);
            }
        }
        let (placed, values, _) = best;
        if placed == hinge { (hinge, body.values) } else { (placed, values) }
    }

    /// A fit whose values were searched for again at all times, and moved on from there.
    pub(super) fn finely_valued(&self, fit: Fit<'a>, steps: usize, level: usize) -> Fit<'a> {
        let Fit { guess, mut body, .. } = fit;
        let all = self.times(usize::MAX);
        let (low, high) = body.values.values().fold((0.0_f64, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
        let widened = 0.25 * (high - low) + 0.05 * guess.hinge.unit(self.size);
        let count = 25;
        let finer: Vec<f64> = (0..count)
            .map(|k| low - widened + (high - low + 2.0 * widened) * f64::from(k) / f64::from(count - 1))
            .collect();
        let finer = JointValues::open(finer);
        let again = if guess.values.is_round { &guess.values } else { &finer };
        let (found, _) = search(&body, &all, again, level);
        // The search is coarse: what is as good stays.
        let mut shape = body.shape.copied();
        for (time, value) in found {
            let views = &all[&time];
            let mut loss = |value: f64| {
                views.iter().map(|view| body.loss_with(&mut shape, *view, level, value)).sum::<f64>()
            };
            if loss(value) < loss(body.value_at(time)) {
                body.values.insert(time, value);
            }
        }
        body.steps(&self.views.train, steps, level, |share| {
            let rate = if share < 0.5 { 1.0 } else { 0.3 };
            (rate, rate)
        });
        let loss = body.mean_loss(&self.views.train, level);
        Fit { guess, body, loss }
    }

    /// The body that is kept, fitted to all views that show it well: at the value 0 as it is seen first.
    pub(super) fn finished(&self, mut body: Body<'a>, errors: [f64; 2]) -> Option<Jointed> {
        let all: Vec<usize> = self.views.train.iter().chain(&self.views.left_out).copied().collect();
        body.steps(&all, FINELY.steps, 0, |share| (0.6 * 0.1_f64.powf(share), 0.5 * 0.1_f64.powf(share)));
        self.jointed(&body, errors)
    }

    /// What a body shows: at the value 0 as it is seen first.
    pub(super) fn jointed(&self, body: &Body<'a>, errors: [f64; 2]) -> Option<Jointed> {
        let hinge = body.hinge?;
        let start = *body.values.values().next()?;
        let members = body.part_rows();
        let g = body.shape.gaussians();
        let kept = |of_part: bool| {
            let mut own = g.clone();
            let is_selected = |row: usize| members[row] == of_part && g.opacity_logits[row] > SEEN;
            own.retain(&(0..g.len()).map(is_selected).collect::<Vec<_>>());
            own
        };
        let mut part = kept(true);
        let (turn, place) = hinge.pose(start);
        for (mean, quaternion) in part.means.iter_mut().zip(&mut part.quaternions) {
            let moved = turn * (DVec3::from_array(mean.map(f64::from)) - hinge.point) + place;
            *mean = moved.as_vec3().to_array();
            let [w, x, y, z] = quaternion.map(f64::from);
            let turned = turn * DQuat::from_xyzw(x, y, z, w);
            *quaternion = [turned.w, turned.x, turned.y, turned.z].map(|value| value as f32);
        }
        // It opens towards positive values.
        let most = body
            .values
            .values()
            .map(|value| value - start)
            .fold(0.0, |most: f64, value| if value.abs() > most.abs() { value } else { most });
        let sign = if most < 0.0 { -1.0 } else { 1.0 };
        let values = self.base.keys().map(|time| (*time, sign * (body.value_at(*time) - start))).collect();
        let hinge = Hinge { axis: sign * hinge.axis, ..hinge };
        Some(Jointed { base: kept(false), part, hinge, values, errors })
    }
}

/// An object at rest and a part of it that moves, in the world.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Jointed {
    #[serde(skip)]
    pub(crate) base: Gaussians,
    /// As at the value 0.
    #[serde(skip)]
    pub(crate) part: Gaussians,
    pub(crate) hinge: Hinge,
    /// Radians or metres, by time.
    pub(crate) values: BTreeMap<usize, f64>,
    /// Errors on pixels left out: with the joint, and without.
    pub(crate) errors: [f64; 2],
}

impl Jointed {
    /// The same elsewhere.
    pub(super) fn moved(mut self, by: DVec3) -> Self {
        for mean in self.base.means.iter_mut().chain(&mut self.part.means) {
            *mean = (DVec3::from_array(mean.map(f64::from)) + by).as_vec3().to_array();
        }
        self.hinge.point += by;
        self
    }

    /// The joint in words, with the range of its values.
    pub(crate) fn told(&self) -> String {
        let (low, high) = range(&self.values);
        match self.hinge.kind {
            JointKind::Revolute => {
                format!("a part turns on a hinge, {:.0} to {:.0} deg", low.to_degrees(), high.to_degrees())
            }
            JointKind::Prismatic => format!("a part slides, {low:.3} to {high:.3}"),
        }
    }
}
