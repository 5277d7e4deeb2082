//! Parts of objects that turn on a hinge or slide: a door, a lid, a drawer, an arm.
//!
//! An object is first made of Gaussians that do not move in its frame. Where that leaves residuals, joints are guessed
//! by the box around it, and the values of each are searched for at some times with the static Gaussians cut in two.
//! The best of these get Gaussians for base and part, and are moved together with values and axis against the
//! pictures. What wins must explain pixels that were left out better than the static Gaussians do.
//!
//! | file | answers |
//! |---|---|
//! | `guesses` | which joints are tried |
//! | `search` | which values a joint has over time |
//! | `body` | base, part and joint, moved together |

mod body;
mod guesses;
mod search;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::tracks::JointKind;
use glam::{DQuat, DVec3};
use rand::RngExt;
use rayon::prelude::*;

pub(super) use self::body::Hinge;
use self::body::{Body, between, range};
use self::guesses::{Guess, Sides, guesses};
use self::search::search;
use super::fit::hull;
use super::outline::meeting_point;
use super::shape::{Pose, Shape};
use super::start::Object;
use super::trials::split;
use super::view::Seen;
use crate::error::TrainError;

/// Reliable times below which parts cannot be told apart.
const FEWEST_TIMES: usize = 8;

/// Gaussians and steps of the static body that guesses are cut from.
const ROUGH: (usize, usize) = (300, 300);

/// Times that guesses are searched at, one view each.
const LOOKS: usize = 12;

/// Most views of a time that values are searched on.
const VIEWS: usize = 2;

/// Places that the box is looked for among, of these the fewest that tell it, and the share of views that may have
/// them beside the mask.
const CANDIDATES: usize = 8000;
const FEWEST_INSIDE: usize = 50;
const BESIDE: f64 = 0.03;

/// Distance, of the size, within which two axes of one direction are the same joint.
const ALIKE: f64 = 0.25;

/// Further turns of the box about the direction away from the support, degrees.
const TURNS: [f64; 2] = [30.0, 60.0];

/// Reach of an object that one camera sees, of the radius of its outline.
const ACROSS: f64 = 1.1;

/// Least and largest share of the Gaussians that a part may have.
const PART: [f64; 2] = [0.03, 0.7];

/// Guesses that are fitted, with Gaussians of base and part and steps between searches.
const FITTED: usize = 12;
const FIT: ([usize; 2], usize) = ([200, 150], 250);

/// Of these, those whose values are searched for again, and those that are fitted finely.
const AGAIN: usize = 8;
const FINE: usize = 3;
const FINELY: ([usize; 2], usize) = ([500, 250], 500);

/// Places of a hinge that are tried about that of a fit: steps to each side of it, and a step, of the size.
const PLACES: i32 = 3;
const PLACE: f64 = 0.13;

/// Error of a slide, of that of the best joint, up to which it is preferred.
const SIMPLE: f64 = 1.12;

/// Opacity, as a logit, that the base starts with where the part is.
const FAINT: f32 = -2.0;

/// Opacity, as a logit, below which a Gaussian is dropped.
const SEEN: f32 = -3.0;

/// Error on pixels left out, of that of the static body, up to which a joint is taken.
const GAIN: f64 = 0.75;

/// Error on pixels left out beyond which nothing is explained.
const MOST_ERROR: f64 = 0.1;

/// Loss of the best guess, and of the best fit, of that of the static body, from which nothing is looked for.
const PROMISE: f64 = 0.99;
const PROMISE_OF_FIT: f64 = 0.85;

/// An object that rests and a part of it that moves, in the world.
#[derive(Clone, Debug)]
pub(crate) struct Jointed {
    pub(crate) base: Gaussians,
    /// As at the value 0.
    pub(crate) part: Gaussians,
    pub(crate) hinge: Hinge,
    /// Radians or metres, by time.
    pub(crate) values: BTreeMap<usize, f64>,
    /// Errors on pixels left out: with the joint, and without.
    pub(crate) errors: [f64; 2],
}

/// Shared facts of a search.
struct Search<'a> {
    object: Object<'a>,
    /// World from object, by time.
    base: &'a BTreeMap<usize, Pose>,
    train: Vec<usize>,
    left_out: Vec<usize>,
    size: f64,
    /// Direction away from the support, in the frame of the object, where there is one.
    up: Option<DVec3>,
    /// True with one camera per time.
    one_camera: bool,
}

/// Looks for a part on a joint of an object that rests otherwise.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn find(object: Object<'_>) -> Result<Option<Jointed>, TrainError> {
    let views = object.views;
    let rays = views.iter().map(|view| (view, view.visible.powi(2)));
    let Some(place) = meeting_point(rays) else { return Ok(None) };
    let rests = Pose { rotation: DQuat::IDENTITY, translation: place };
    let base: BTreeMap<usize, Pose> = views.iter().map(|view| (view.time_index, rests)).collect();
    Ok(find_on(object, &base)?.map(|found| found.moved(place)))
}

/// The part in the frame of an object whose poses (world from object, by time) are known.
fn find_on(object: Object<'_>, base: &BTreeMap<usize, Pose>) -> Result<Option<Jointed>, TrainError> {
    let views = object.views;
    let stop = object.surroundings.stop;
    let is_usable = |view: &usize| views[*view].is_reliable() && base.contains_key(&views[*view].time_index);
    let reliable: Vec<usize> = (0..views.len()).filter(is_usable).collect();
    let mut times: Vec<usize> = reliable.iter().map(|view| views[*view].time_index).collect();
    times.dedup();
    if times.len() < FEWEST_TIMES {
        return Ok(None);
    }
    let (train, left_out) = split(views, &reliable, &times);
    let rotation = base.values().next().map_or(DQuat::IDENTITY, |pose| pose.rotation);
    let up = object.surroundings.plane.map(|plane| rotation.inverse() * plane.normal);
    let search = Search {
        object,
        base,
        train,
        left_out,
        size: object.outline.size(),
        up,
        one_camera: reliable.len() == times.len(),
    };
    let Some(rough) = search.rigid(ROUGH.0, ROUGH.1, search.level()) else { return Ok(None) };
    stop.check()?;
    let tried = search.tried(&rough);
    if tried.is_empty() {
        return Ok(None);
    }
    stop.check()?;
    let level = search.level();
    let mut begun: Vec<Fit<'_>> = tried
        .into_par_iter()
        .take(FITTED)
        .filter_map(|(guess, values, _)| search.begun(guess, &values, FIT, level))
        .collect();
    keep_kinds(&mut begun, AGAIN);
    stop.check()?;
    let mut fitted: Vec<Fit<'_>> =
        begun.into_par_iter().map(|begun| search.finely_valued(begun, FIT.1, level)).collect();
    keep_kinds(&mut fitted, FINE);
    stop.check()?;
    let promises = |fit: &Fit<'_>| fit.loss < PROMISE_OF_FIT * rough.mean_loss(&search.train, level);
    if !fitted.first().is_some_and(promises) {
        return Ok(None);
    }
    let (rigid, mut fine) = rayon::join(
        || {
            let ([base, part], steps) = FINELY;
            search.rigid(base + part, 2 * steps, 0)
        },
        || {
            let finely = |Fit { guess, body, .. }: Fit<'_>| {
                let (hinge, values) = search.placed(&guess, body, level);
                let begun = search.begun(Guess { hinge, ..guess }, &values, FINELY, 0)?;
                Some(search.finely_valued(begun, FINELY.1, 0))
            };
            fitted.into_par_iter().filter_map(finely).collect::<Vec<_>>()
        },
    );
    stop.check()?;
    let Some(rigid) = rigid else { return Ok(None) };
    let judged = if search.left_out.is_empty() { &search.train } else { &search.left_out };
    let still = rigid.mean_loss(judged, 0);
    for fit in &mut fine {
        fit.loss = fit.body.mean_loss(judged, 0);
    }
    fine.sort_by(|a, b| a.loss.total_cmp(&b.loss));
    let Some(best) = fine.first().map(|fit| fit.loss) else { return Ok(None) };
    // A hinge far away does what a slide does; nothing slides out of what holds it.
    let is_simple = |fit: &Fit<'_>| {
        let slides = fit.body.hinge.is_some_and(|hinge| hinge.kind == JointKind::Prismatic);
        fit.loss <= SIMPLE * best && slides && fit.body.reach() <= search.size
    };
    let taken = fine.iter().position(is_simple).unwrap_or(0);
    let Fit { body, loss: error, .. } = fine.swap_remove(taken);
    if error > MOST_ERROR || error > GAIN * still {
        return Ok(None);
    }
    Ok(search.finished(body, [error, still]))
}

/// A guess under way, with the loss on the views that it is fitted to.
struct Fit<'a> {
    guess: Guess,
    body: Body<'a>,
    loss: f64,
}

/// Keeps the best of the fits, in their order, and the best slide among them.
fn keep_kinds(fits: &mut Vec<Fit<'_>>, count: usize) {
    fits.sort_by(|a, b| a.loss.total_cmp(&b.loss));
    let slide = fits.iter().position(|fit| fit.guess.hinge.kind == JointKind::Prismatic);
    if let Some(place) = slide.filter(|place| *place >= count) {
        fits.swap(count - 1, place);
    }
    fits.truncate(count);
}

impl<'a> Search<'a> {
    /// Reduction at which guesses are compared.
    fn level(&self) -> usize {
        let mut areas: Vec<f64> = self.train.iter().map(|view| self.object.views[*view].area()).collect();
        usize::from(super::view::median(&mut areas) > 1500.0)
    }

    fn hull(
        &self,
        poses: &BTreeMap<usize, Pose>,
        bound: Option<&dyn Fn(DVec3) -> bool>,
        count: usize,
    ) -> Option<Shape> {
        let near = self.object.surroundings.near;
        let reach = 1.3 * self.size;
        // A part leaves the room of the base.
        let bounded = bound.is_none();
        let inside =
            |place: DVec3| (!bounded || self.is_within(place)) && bound.is_none_or(|bound| bound(place));
        let bound: Option<&dyn Fn(DVec3) -> bool> = Some(&inside);
        let mut shape = hull(self.object.views, poses, (reach, bound), count, near, &mut self.object.rng())?;
        shape.fade(0.0, |_| true);
        Some(shape)
    }

    fn body(&self, shape: Shape, part: Option<(Hinge, Vec<bool>, BTreeMap<usize, f64>)>) -> Body<'a> {
        Body::new((self.object.views, self.base), shape, part, (self.size, self.up), self.object.rng())
    }

    /// The object without parts.
    fn rigid(&self, gaussians: usize, steps: usize, level: usize) -> Option<Body<'a>> {
        let mut body = self.body(self.hull(self.base, None, gaussians)?, None);
        body.steps(&self.train, steps, level, |share| (if share < 0.5 { 1.0 } else { 0.5 }, 0.0));
        Some(body)
    }

    /// Views of some times, one each, or of all times, a few each.
    fn times(&self, count: usize) -> BTreeMap<usize, Vec<usize>> {
        let mut of: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for view in &self.train {
            of.entry(self.object.views[*view].time_index).or_default().push(*view);
        }
        let all = of.len();
        let wanted = count.min(all).max(2);
        let kept: Vec<usize> = (0..wanted).map(|k| k * (all - 1) / (wanted - 1)).collect();
        let mut times: BTreeMap<usize, Vec<usize>> = of
            .into_iter()
            .enumerate()
            .filter(|(k, _)| kept.contains(k))
            .map(|(_, of_time)| of_time)
            .collect();
        for (k, views) in times.values_mut().enumerate() {
            let wanted = if count < all { 1 } else { VIEWS.min(views.len()) };
            *views = (0..wanted).map(|view| views[(k + view * views.len() / wanted) % views.len()]).collect();
        }
        times
    }

    /// Guesses with their values, best first; none where none promises anything.
    fn tried(&self, rough: &Body<'a>) -> Vec<(Guess, BTreeMap<usize, f64>, f64)> {
        let means = &rough.shape.gaussians().means;
        let places: Vec<DVec3> = means.iter().map(|mean| DVec3::from_array(mean.map(f64::from))).collect();
        let carved = self.carved();
        let inside = if carved.len() < FEWEST_INSIDE { &places } else { &carved };
        let plane = self.object.surroundings.plane;
        let up = self.up.unwrap_or(DVec3::Z);
        let sides = Sides::around(inside, up);
        let (times, level) = (self.times(LOOKS), self.level());
        let try_one = |guess: Guess| {
            let members: Vec<bool> = places.iter().map(|place| guess.has(*place, 0.0)).collect();
            let share = members.iter().filter(|member| **member).count() as f64 / members.len() as f64;
            if !(PART[0]..=PART[1]).contains(&share) {
                return None;
            }
            let body = self.body(rough.shape.copied(), Some((guess.hinge, members, BTreeMap::new())));
            let (values, loss) = search(&body, &times, (&guess.values, guess.is_round), level);
            Some((guess, values, loss))
        };
        let try_all =
            |sides: &Sides| -> Vec<_> { guesses(sides, plane).into_par_iter().filter_map(try_one).collect() };
        let mut tried = try_all(&sides);
        let (_, still) = search(rough, &times, (&[0.0], false), level);
        let best = tried.iter().map(|(.., loss)| *loss).fold(f64::INFINITY, f64::min);
        if best > PROMISE * still {
            return Vec::new();
        }
        if self.one_camera {
            // The hull of few directions hardly tells how the box is turned.
            for degrees in TURNS {
                tried.extend(try_all(&sides.turned(degrees.to_radians(), inside)));
            }
        }
        tried.sort_by(|a, b| a.2.total_cmp(&b.2));
        // Of joints about one axis the best.
        let mut distinct: Vec<(Guess, BTreeMap<usize, f64>, f64)> = Vec::new();
        for (guess, values, loss) in tried {
            if !distinct.iter().any(|(other, ..)| guess.hinge.is_like(&other.hinge, ALIKE * self.size)) {
                distinct.push((guess, values, loss));
            }
        }
        distinct
    }

    /// Places that all views which show the object well have inside its mask, above what it stands on.
    fn carved(&self) -> Vec<DVec3> {
        let mut rng = self.object.rng();
        let reach = 1.6 * self.size;
        let mut inside = Vec::new();
        for _ in 0..CANDIDATES {
            let place = reach * DVec3::from(std::array::from_fn(|_| 2.0 * rng.random::<f64>() - 1.0));
            if !self.is_within(place) {
                continue;
            }
            let (mut own, mut beside) = (0_u32, 0_u32);
            for view in &self.train {
                let view = &self.object.views[*view];
                let Some(pose) = self.base.get(&view.time_index) else { continue };
                match view.at(pose.rotation * place + pose.translation) {
                    Seen::Object(_) => own += 1,
                    Seen::Nothing => beside += 1,
                    Seen::Other | Seen::Outside => {}
                }
                if f64::from(beside) > BESIDE * self.train.len() as f64 {
                    break;
                }
            }
            if own > 0 && f64::from(beside) <= BESIDE * f64::from(own + beside) {
                inside.push(place);
            }
        }
        inside
    }

    /// True for places that what the object stands on leaves room for and that, where one camera sees it at a time and
    /// does not tell how deep it is, are not farther away from its middle than it is wide.
    fn is_within(&self, place: DVec3) -> bool {
        let Some((plane, up)) = self.object.surroundings.plane.zip(self.up) else { return true };
        let Some(pose) = self.base.values().next() else { return true };
        let across = (place - up * up.dot(place)).length();
        let is_near = !self.one_camera || across < ACROSS * self.object.outline.radius;
        is_near && plane.height(pose.rotation * place + pose.translation) > -0.05 * self.size
    }

    /// A guess with Gaussians of its own, moved with the joint.
    fn begun(
        &self,
        guess: Guess,
        values: &BTreeMap<usize, f64>,
        ([of_base, of_part], steps): ([usize; 2], usize),
        level: usize,
    ) -> Option<Fit<'a>> {
        let hinge = guess.hinge;
        let posed = self.base.iter().map(|(time, pose)| (*time, hinge.posed(pose, between(values, *time))));
        let posed: BTreeMap<usize, Pose> = posed.collect();
        let mut base = self.hull(self.base, None, of_base)?;
        base.fade(FAINT, |place| guess.has(place, 0.0));
        let margin = 0.1 * self.size;
        let inside = |place: DVec3| guess.has(place, margin);
        let mut part = self.hull(&posed, Some(&inside), of_part)?;
        part.fade(FAINT, |place| !guess.has(place, 0.0));
        let members: Vec<bool> = (0..base.gaussians().len() + part.gaussians().len())
            .map(|row| row >= base.gaussians().len())
            .collect();
        let times = self.times(usize::MAX);
        let values = times.keys().map(|time| (*time, between(values, *time))).collect();
        let mut body = self.body(base.joined(&part), Some((hinge, members, values)));
        body.steps(&self.train, steps, level, |share| if share < 0.2 { (1.0, 0.0) } else { (1.0, 1.0) });
        let loss = body.mean_loss(&self.train, level);
        Some(Fit { guess, body, loss })
    }

    /// The joint of a body and its values, a hinge where it explains most: it was guessed at a side of the hull, which
    /// is too wide where few directions see the object, and angles follow the place.
    fn placed(&self, guess: &Guess, mut body: Body<'a>, level: usize) -> (Hinge, BTreeMap<usize, f64>) {
        let hinge = body.hinge.unwrap_or(guess.hinge);
        if guess.is_round || hinge.kind == JointKind::Prismatic {
            return (hinge, body.values);
        }
        let times = self.times(LOOKS);
        let (first, second) = hinge.axis.any_orthonormal_pair();
        let mut best = (hinge, BTreeMap::new(), f64::INFINITY);
        for (i, j) in (-PLACES..=PLACES).flat_map(|i| (-PLACES..=PLACES).map(move |j| (i, j))) {
            let aside = PLACE * self.size * (f64::from(i) * first + f64::from(j) * second);
            let moved = Hinge { point: hinge.point + aside, ..hinge };
            body.hinge = Some(moved);
            let (values, loss) = search(&body, &times, (&guess.values, false), level);
            if loss < best.2 {
                best = (moved, values, loss);
            }
        }
        let (placed, values, _) = best;
        if placed == hinge { (hinge, body.values) } else { (placed, values) }
    }

    /// A fit whose values were searched for again at all times, and moved on from there.
    fn finely_valued(&self, fit: Fit<'a>, steps: usize, level: usize) -> Fit<'a> {
        let Fit { guess, mut body, .. } = fit;
        let all = self.times(usize::MAX);
        let (low, high) = body.values.values().fold((0.0_f64, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
        let widened = 0.25 * (high - low) + 0.05 * guess.hinge.unit(self.size);
        let count = 25;
        let finer: Vec<f64> = (0..count)
            .map(|k| low - widened + (high - low + 2.0 * widened) * f64::from(k) / f64::from(count - 1))
            .collect();
        let again = if guess.is_round { (&guess.values[..], true) } else { (&finer[..], false) };
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
        body.steps(&self.train, steps, level, |share| {
            let rate = if share < 0.5 { 1.0 } else { 0.3 };
            (rate, rate)
        });
        let loss = body.mean_loss(&self.train, level);
        Fit { guess, body, loss }
    }

    /// The body that is kept, fitted to all views that show it well: at the value 0 as it is seen first.
    fn finished(&self, mut body: Body<'a>, errors: [f64; 2]) -> Option<Jointed> {
        let all: Vec<usize> = self.train.iter().chain(&self.left_out).copied().collect();
        body.steps(&all, FINELY.1, 0, |share| (0.6 * 0.1_f64.powf(share), 0.5 * 0.1_f64.powf(share)));
        let hinge = body.hinge?;
        let start = *body.values.values().next()?;
        let members = body.part_rows();
        let g = body.shape.gaussians();
        let kept = |wanted: bool| {
            let mut own = g.clone();
            let is_wanted = |row: usize| members[row] == wanted && g.opacity_logits[row] > SEEN;
            own.retain(&(0..g.len()).map(is_wanted).collect::<Vec<_>>());
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

impl Jointed {
    /// The same elsewhere.
    fn moved(mut self, by: DVec3) -> Self {
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
