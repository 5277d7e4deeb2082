//! Guesses with Gaussians of their own: base, parts, joints and values moved together, to the body that is kept.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::tracks::JointKind;
use glam::DVec3;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

use super::super::shape::{Pose, Shape};
use super::body::{Body, Hinge, JointOfBody, range};
use super::guesses::{Cut, Guess, JointValues};
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

/// Places of a hinge that are tried about that of a fit: steps to each side of it, then of the best one, and a step, of the
/// size.
const PLACES: [f64; 2] = [2.0, 1.0];
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
        let joints = guess.joints(values);
        let shapes = if let (Some(other), [first, second]) = (guess.cut.other(), &joints[..]) {
            let each = (budget.base + budget.part) / 2;
            [self.part(first, guess.cut, each)?, self.part(second, other, each)?]
        } else {
            let mut base = self.hull(self.base, None, budget.base)?;
            base.fade(FAINT, |place| guess.cut.has(place, 0.0));
            [base, self.part(&joints[0], guess.cut, budget.part)?]
        };
        let mut body = self.together(shapes, joints);
        body.steps(
            &self.views.train,
            budget.steps,
            level,
            |share| if share < 0.2 { (1.0, 0.0) } else { (1.0, 1.0) },
        );
        let loss = body.mean_loss(&self.views.train, level);
        Some(Fit { guess, body, loss })
    }

    /// Gaussians of what a cut has, as the part of a joint.
    fn part(&self, joint: &JointOfBody, cut: Cut, count: usize) -> Option<Shape> {
        let margin = 0.1 * self.size;
        let inside = |place: DVec3| cut.has(place, margin);
        let mut part = self.hull(&self.posed(joint), Some(&inside), count)?;
        part.fade(FAINT, |place| !cut.has(place, 0.0));
        Some(part)
    }

    /// World from the part of a joint, by time.
    pub(super) fn posed(&self, joint: &JointOfBody) -> BTreeMap<usize, Pose> {
        let posed = |(time, pose): (&usize, &Pose)| (*time, joint.hinge.posed(pose, joint.value_at(*time)));
        self.base.iter().map(posed).collect()
    }

    /// A body of the Gaussians of a base and of the part of a joint, or of those of two joints.
    pub(super) fn together(&self, shapes: [Shape; 2], mut joints: Vec<JointOfBody>) -> Body<'a> {
        let first = joints.len() - 1;
        let of = |k: usize| vec![first + k; shapes[k].gaussians().len()];
        let groups = [of(0), of(1)].concat();
        let times = self.times(usize::MAX);
        for joint in &mut joints {
            joint.values = times.keys().map(|time| (*time, joint.value_at(*time))).collect();
        }
        let [shape, other] = shapes;
        self.body(shape.joined(&other), joints, groups)
    }

    /// The joint of a body and its values, a hinge where it explains most: it was guessed at a side of the hull, which
    /// is too wide where few directions see the object, and angles follow the place.
    pub(super) fn placed(
        &self,
        guess: &Guess,
        mut body: Body<'a>,
        level: usize,
    ) -> (Hinge, BTreeMap<usize, f64>) {
        let (hinge, own) = body
            .joints
            .first()
            .map_or_else(|| (guess.hinge, BTreeMap::new()), |joint| (joint.hinge, joint.values.clone()));
        if guess.values.is_round || hinge.kind == JointKind::Prismatic {
            return (hinge, own);
        }
        let times = self.times(LOOKS);
        let (first, second) = hinge.axis.any_orthonormal_pair();
        let mut best = (hinge, BTreeMap::new(), f64::INFINITY);
        for step in PLACES {
            let around = best.0.point;
            let steps = [-step, 0.0, step].map(|steps| PLACE * self.size * steps);
            for aside in steps.iter().flat_map(|i| steps.map(|j| *i * first + j * second)) {
                let moved = Hinge { point: around + aside, ..hinge };
                if best.2.is_finite() && moved == best.0 {
                    continue;
                }
                body.joints.iter_mut().for_each(|joint| joint.hinge = moved);
                let (values, loss) = search(&body, &times, &guess.values, level);
                if loss < best.2 {
                    best = (moved, values, loss);
                }
            }
        }
        let (placed, values, _) = best;
        if placed == hinge { (hinge, own) } else { (placed, values) }
    }

    /// A fit whose values were searched for again at all times, and moved on from there.
    pub(super) fn finely_valued(&self, fit: Fit<'a>, steps: usize, level: usize) -> Fit<'a> {
        let Fit { guess, mut body, .. } = fit;
        let all = self.times(usize::MAX);
        let of = body.joints.first().into_iter().flat_map(|joint| joint.values.values());
        let (low, high) = of.fold((0.0_f64, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
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
            let mut loss = |value: Option<f64>| {
                views.iter().map(|view| body.loss_with(&mut shape, *view, level, value)).sum::<f64>()
            };
            if loss(Some(value)) < loss(None) {
                for joint in &mut body.joints {
                    joint.values.insert(time, joint.share * value);
                }
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
        let groups = body.groups();
        let g = body.shape.gaussians();
        let kept = |group: usize| {
            let mut own = g.clone();
            let is_selected = |row: usize| groups[row] == group && g.opacity_logits[row] > SEEN;
            own.retain(&(0..g.len()).map(is_selected).collect::<Vec<_>>());
            own
        };
        let part = |(k, joint): (usize, &JointOfBody)| {
            let mut gaussians = kept(k + 1);
            let hinge = joint.hinge;
            let start = *joint.values.values().next()?;
            hinge.posed(&Pose::at(DVec3::ZERO), start).carry(&mut gaussians);
            // It opens towards positive values.
            let values = joint.values.values().map(|value| value - start);
            let most =
                values.fold(0.0, |most: f64, value| if value.abs() > most.abs() { value } else { most });
            let sign = if most < 0.0 { -1.0 } else { 1.0 };
            let of = |time: &usize| (*time, sign * (joint.value_at(*time) - start));
            let hinge = Hinge { axis: sign * hinge.axis, ..hinge };
            Some(JointedPart { gaussians, hinge, values: self.base.keys().map(of).collect() })
        };
        let mut parts = body.joints.iter().enumerate().map(part);
        Some(Jointed {
            base: kept(0),
            part: parts.next()??,
            second: parts.next().flatten().map(Box::new),
            errors,
        })
    }
}

/// An object at rest and a part of it that moves, or two, in the world.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Jointed {
    #[serde(skip)]
    pub(crate) base: Gaussians,
    #[serde(flatten)]
    pub(crate) part: JointedPart,
    #[serde(default)]
    pub(crate) second: Option<Box<JointedPart>>,
    /// Errors on pixels left out: with the joints, and without.
    pub(crate) errors: [f64; 2],
}

/// A part on a joint.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct JointedPart {
    /// As at the value 0.
    #[serde(skip)]
    pub(crate) gaussians: Gaussians,
    pub(crate) hinge: Hinge,
    /// Radians or metres, by time.
    #[serde(deserialize_with = "by_time")]
    pub(crate) values: BTreeMap<usize, f64>,
}

/// Values by time from JSON, whose keys are text; what is flattened has to say so.
fn by_time<'de, D: Deserializer<'de>>(values: D) -> Result<BTreeMap<usize, f64>, D::Error> {
    let parsed = |(time, value): (String, f64)| Ok((time.parse().map_err(D::Error::custom)?, value));
    BTreeMap::<String, f64>::deserialize(values)?.into_iter().map(parsed).collect()
}

impl Jointed {
    /// Its parts.
    pub(crate) fn parts(&self) -> impl Iterator<Item = &JointedPart> {
        std::iter::once(&self.part).chain(self.second.as_deref())
    }

    /// The same elsewhere.
    pub(super) fn moved(mut self, by: DVec3) -> Self {
        let shift = Pose::at(by);
        shift.carry(&mut self.base);
        for part in std::iter::once(&mut self.part).chain(self.second.as_deref_mut()) {
            shift.carry(&mut part.gaussians);
            part.hinge.point += by;
        }
        self
    }

    /// The joints in words, with the ranges of their values.
    pub(crate) fn told(&self) -> String {
        let of = |(k, part): (usize, &JointedPart)| {
            let (low, high) = range(&part.values);
            let name = if k == 0 { "a part" } else { "another part" };
            // No "-0": what rounds to zero has no sign.
            match part.hinge.kind {
                JointKind::Revolute => {
                    let [low, high] = [low, high].map(|angle| angle.to_degrees().round() + 0.0);
                    format!("{name} turns on a hinge, {low:.0} to {high:.0} deg")
                }
                JointKind::Prismatic => {
                    let [low, high] = [low, high].map(|shift| (shift * 1e3).round() / 1e3 + 0.0);
                    format!("{name} slides, {low:.3} to {high:.3}")
                }
            }
        };
        self.parts().enumerate().map(of).collect::<Vec<_>>().join(" and ")
    }
}
