//! Guesses that promise something: their values searched for at some times, with static Gaussians cut in two.

use std::collections::BTreeMap;

use glam::DVec3;
use rand::RngExt;
use rayon::prelude::*;

use super::super::view::Seen;
use super::body::Body;
use super::guesses::{Guess, JointValues, Sides, guesses};
use super::scope::Search;
use super::search::search;

/// Times that guesses are searched at, one view each.
pub(super) const LOOKS: usize = 12;

/// Places that the box is looked for among, of these the fewest that determine it, and the share of views that may have
/// them beside the mask.
const CANDIDATES: usize = 8000;
const FEWEST_INSIDE: usize = 50;
const BESIDE: f64 = 0.03;

/// Distance, of the size, within which two axes of one direction are the same joint.
const ALIKE: f64 = 0.25;

/// Further turns of the box about the direction away from the support, degrees.
const TURNS: [f64; 2] = [30.0, 60.0];

/// Least and largest share of the Gaussians that a part may have.
const PART: [f64; 2] = [0.03, 0.7];

/// Loss of the best guess, of that of the static body, from which nothing is looked for.
const PROMISE: f64 = 0.99;

/// A guess whose values were searched for.
pub(super) struct TriedGuess {
    /// The joint, and the values that were tried.
    pub(super) guess: Guess,
    /// Value by time, radians or metres.
    pub(super) values: BTreeMap<usize, f64>,
    /// Mean loss per view.
    loss: f64,
}

impl<'a> Search<'a> {
    /// Guesses about static Gaussians with their values, best first; none where none promises anything. The views are those
    /// that the Gaussians were made from.
    pub(super) fn tried(&self, closed: &Body<'a>, still: &[usize]) -> Vec<TriedGuess> {
        let carved = self.carved(still);
        let inside = if carved.len() < FEWEST_INSIDE { closed.shape.centres() } else { carved };
        let sides = Sides::around(&inside, self.up.unwrap_or(DVec3::Z));
        let stands = self.object.surroundings.plane;
        let mut tried = self.tried_of(closed, guesses(&sides, stands));
        let as_it_is = JointValues::open(vec![0.0]);
        let (_, uncut) = search(closed, &self.times(LOOKS), &as_it_is, self.coarse_level());
        let best = tried.iter().map(|tried| tried.loss).fold(f64::INFINITY, f64::min);
        if best > PROMISE * uncut {
            return Vec::new();
        }
        if self.one_camera {
            // The hull of few directions hardly shows how the box is turned.
            for degrees in TURNS {
                let turned = sides.turned(degrees.to_radians(), &inside);
                tried.extend(self.tried_of(closed, guesses(&turned, stands)));
            }
        }
        tried.sort_by(|a, b| a.loss.total_cmp(&b.loss));
        // Of joints about one axis the best.
        let mut distinct: Vec<TriedGuess> = Vec::new();
        for found in tried {
            let Guess { hinge, cut, .. } = found.guess;
            let is_like = |other: &TriedGuess| {
                hinge.is_like(&other.guess.hinge, ALIKE * self.size)
                    && cut.other().is_some() == other.guess.cut.other().is_some()
            };
            if !distinct.iter().any(is_like) {
                distinct.push(found);
            }
        }
        distinct
    }

    /// Guesses about a body with their values.
    fn tried_of(&self, body: &Body<'a>, guesses: Vec<Guess>) -> Vec<TriedGuess> {
        let (times, level) = (self.times(LOOKS), self.coarse_level());
        let try_one = |guess: Guess| {
            let body = self.cut(body, &guess)?;
            let (values, loss) = search(&body, &times, &guess.values, level);
            Some(TriedGuess { guess, values, loss })
        };
        guesses.into_par_iter().filter_map(try_one).collect()
    }

    /// A static body with what a guess cuts of it as a part at the value 0, or two; `None` where that is too little or too
    /// much.
    fn cut(&self, body: &Body<'a>, guess: &Guess) -> Option<Body<'a>> {
        let joints = guess.joints(&BTreeMap::new());
        let other = if joints.len() > 1 { 2 } else { 0 };
        let group = |place| if guess.cut.has(place, 0.0) { 1 } else { other };
        let groups: Vec<usize> = body.shape.centres().into_iter().map(group).collect();
        let share = groups.iter().filter(|group| **group == 1).count() as f64 / groups.len() as f64;
        (PART[0]..=PART[1]).contains(&share).then(|| self.body(body.shape.copied(), joints, groups))
    }

    /// Places that some views which show the object well have inside its mask, above what it stands on.
    fn carved(&self, views: &[usize]) -> Vec<DVec3> {
        let mut rng = self.object.rng();
        let reach = 1.6 * self.size;
        let mut inside = Vec::new();
        for _ in 0..CANDIDATES {
            let place = reach * DVec3::from(std::array::from_fn(|_| 2.0 * rng.random::<f64>() - 1.0));
            if !self.is_within(place) {
                continue;
            }
            let (mut own, mut beside) = (0_u32, 0_u32);
            for view in views {
                let view = &self.object.views[*view];
                let Some(pose) = self.base.get(&view.time_index) else { continue };
                match view.at(pose.rotation * place + pose.translation) {
                    Seen::Object(_) => own += 1,
                    Seen::Nothing => beside += 1,
                    Seen::Other | Seen::Outside => {}
                }
                if f64::from(beside) > BESIDE * views.len() as f64 {
                    break;
                }
            }
            if own > 0 && f64::from(beside) <= BESIDE * f64::from(own + beside) {
                inside.push(place);
            }
        }
        inside
    }
}
