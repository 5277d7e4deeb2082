//! Parts of objects that turn on a hinge or slide: a door, a lid, a drawer, an arm.
//!
//! An object is first made of Gaussians that do not move in its frame: as it looks at all times, and as it looks at the
//! times in a row that are most alike, say while its lid is closed. Where the first leave residuals that the second do
//! not, joints are guessed by the box around the second, and the values of each are searched for at some times with
//! these Gaussians cut in two, those of scissors into parts that turn against each other. The best of the joints get Gaussians
//! for base and part, and are moved together with values and axis against the pictures. What wins must explain pixels that
//! were left out better than the static Gaussians do, and about as well as Gaussians that bend, or the object deforms.
//!
//! | file | answers |
//! |---|---|
//! | `scope` | what is searched |
//! | `guesses` | which joints there may be |
//! | `search` | which values a joint has over time |
//! | `promise` | which joints are tried further |
//! | `body` | base, part and joint, moved together |
//! | `fits` | which joint is kept, and what it moves |
//! | `bending` | where places of what deforms instead are over time |

mod bending;
mod body;
mod fits;
mod guesses;
mod promise;
mod scope;
mod search;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_field::tracks::JointKind;
use glam::DVec3;
use rayon::prelude::*;

pub(crate) use self::bending::Bending;
pub(super) use self::body::Hinge;
use self::body::JointOfBody;
pub(crate) use self::fits::Jointed;
#[cfg(test)]
pub(super) use self::fits::JointedPart;
use self::fits::{Budget, FINELY, Fit, keep_kinds};
use self::guesses::Guess;
use self::scope::Search;
use super::discs;
use super::object::Object;
use super::rotation::{Turning, turning};
use super::shape::Pose;
use super::split::{SplitViews, times_of};
use super::view::meeting_point;
use crate::error::TrainError;

/// Reliable times below which parts cannot be distinguished.
const FEWEST_TIMES: usize = 8;

/// Gaussians and steps of the static body that guesses are cut from.
const GAUSSIANS: usize = 300;
const STEPS: usize = 300;

/// Guesses that are fitted, and the budget of this, its steps between searches.
const FITTED: usize = 12;
const FIT: Budget = Budget { base: 200, part: 150, steps: 250 };

/// Of these, those whose values are searched for again, and those that are fitted finely.
const AGAIN: usize = 8;
const FINE: usize = 4;

/// Loss of static Gaussians at all times, of that of others at the times that are most alike, up to which nothing moves.
const ALIKE: f64 = 1.5;

/// Error of a slide, of that of the best joint, up to which it is preferred.
const SIMPLE: f64 = 1.12;

/// Error on pixels left out, of that of the static body, up to which a joint is taken.
const GAIN: f64 = 0.62;

/// Error of an object that bends, of that of the best joint, below which it deforms instead, between four jellies (0.65 to
/// 0.74) and all else that joints were found of (0.90 and 0.96 of lamps with a second joint, 1.0 and more of lids, drawers and
/// cloths). A fifth one, before a camera that jumps, is at 1.4.
const DEFORMS: f64 = 0.82;

/// Loss of the best fit, of that of the static body, from which nothing is looked for: at first, and where values were
/// searched for again.
const PROMISES: [f64; 2] = [0.92, 0.85];

/// Distance from the middle of a ball, in radii, within which Gaussians are its own.
const OF_BALL: f64 = 1.1;

/// Looks for a ball that turns in place on the rest of its object, as a globe on its stand.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn turning_ball(object: Object<'_>) -> Result<Option<Jointed>, TrainError> {
    let phases = object.surroundings.phases;
    let shown = || object.views.iter().filter(|view| !view.is_sliver());
    let Some(ball) = discs::ball(shown()) else { return Ok(None) };
    phases.check()?;
    let Some((Turning { axis, angles }, errors)) = turning(shown(), &ball) else { return Ok(None) };
    phases.check()?;
    let at_rest = Pose::at(ball.centre);
    let base: BTreeMap<usize, Pose> = object.views.iter().map(|view| (view.time_index, at_rest)).collect();
    let is_shown = |view: &usize| !object.views[*view].is_sliver();
    let views = (0..object.views.len()).filter(is_shown).collect();
    let search = Search::new(object, &base, SplitViews::whole(views));
    let hinge = Hinge { kind: JointKind::Revolute, axis, point: DVec3::ZERO };
    let joints = vec![JointOfBody::new(hinge, angles, 1.0)];
    let is_ball = |place: DVec3| place.length() < ball.radius;
    let is_stand = |place: DVec3| !is_ball(place) && search.is_within(place);
    let stand = search.hull(&base, Some(&is_stand), FINELY.base);
    let turned = search.hull(&search.posed(&joints[0]), Some(&is_ball), FINELY.part);
    let Some((stand, turned)) = stand.zip(turned) else { return Ok(None) };
    let mut body = search.together([stand, turned], joints);
    // Light, which stays where it is, would pull the joint back.
    body.steps(&search.views.train, 2 * FINELY.steps, 0, |share| (0.1_f64.powf(share), 0.0));
    phases.check()?;
    let Some(mut found) = search.jointed(&body, errors) else { return Ok(None) };
    // Of the stand what got into the ball showed its light.
    let keep = |rows: &mut Gaussians, is_kept: &dyn Fn(f64) -> bool| {
        let distances = rows.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from)).length());
        let kept: Vec<bool> = distances.map(|distance| is_kept(distance / ball.radius)).collect();
        rows.retain(&kept);
    };
    keep(&mut found.base, &|distance| distance > 1.0);
    keep(&mut found.part.gaussians, &|distance| distance < OF_BALL);
    Ok(Some(found.moved(ball.centre)))
}

/// Motion of an object that stays where it is.
pub(crate) enum InPlace {
    /// A part on a joint.
    Jointed(Jointed),
    /// All of it deforms.
    Bends(Bending),
}

/// Looks for a part on a joint of an object that is otherwise at rest, or how it deforms.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn find(object: Object<'_>) -> Result<Option<InPlace>, TrainError> {
    let views = object.views;
    let rays = views.iter().map(|view| (view, view.visible.powi(2)));
    let Some(place) = meeting_point(rays) else { return Ok(None) };
    let at_rest = Pose::at(place);
    let base: BTreeMap<usize, Pose> = views.iter().map(|view| (view.time_index, at_rest)).collect();
    Ok(find_on(object, &base)?.map(|found| match found {
        InPlace::Jointed(found) => InPlace::Jointed(found.moved(place)),
        InPlace::Bends(found) => InPlace::Bends(Bending { place: found.place + place, ..found }),
    }))
}

/// The part in the frame of an object whose poses (world from object, by time) are known.
fn find_on(object: Object<'_>, base: &BTreeMap<usize, Pose>) -> Result<Option<InPlace>, TrainError> {
    let views = object.views;
    let phases = object.surroundings.phases;
    let is_usable = |view: &usize| views[*view].is_reliable() && base.contains_key(&views[*view].time_index);
    let reliable: Vec<usize> = (0..views.len()).filter(is_usable).collect();
    if times_of(views, &reliable).len() < FEWEST_TIMES {
        return Ok(None);
    }
    let search = Search::new(object, base, SplitViews::of(views, &reliable));
    let (train, level) = (&search.views.train, search.level());
    let Some(rough) = search.rigid(train, GAUSSIANS, STEPS, level) else { return Ok(None) };
    let uncut = rough.mean_loss(train, level);
    phases.check()?;
    let Some((closed, alike)) = search.closed(GAUSSIANS, STEPS, level) else { return Ok(None) };
    if uncut <= ALIKE * closed.mean_loss(&alike, level) {
        return Ok(None);
    }
    let tried = search.tried(&closed, &alike);
    if tried.is_empty() {
        return Ok(None);
    }
    phases.check()?;
    let mut begun: Vec<Fit<'_>> = tried
        .into_par_iter()
        .take(FITTED)
        .filter_map(|tried| search.begun(tried.guess, &tried.values, FIT, level))
        .collect();
    keep_kinds(&mut begun, AGAIN);
    phases.check()?;
    let promises = |fits: &[Fit<'_>], most: f64| fits.first().is_some_and(|best| best.loss < most * uncut);
    if !promises(&begun, PROMISES[0]) {
        return Ok(None);
    }
    let mut fitted: Vec<Fit<'_>> =
        begun.into_par_iter().map(|begun| search.finely_valued(begun, FIT.steps, level)).collect();
    keep_kinds(&mut fitted, FINE);
    phases.check()?;
    if !promises(&fitted, PROMISES[1]) {
        return Ok(None);
    }
    let (rigid, mut fine) = rayon::join(
        || search.rigid(train, FINELY.base + FINELY.part, 2 * FINELY.steps, 0),
        || {
            let finely = |Fit { guess, body, .. }: Fit<'_>| {
                let (hinge, values) = search.placed(&guess, body, level);
                let begun = search.begun(Guess { hinge, ..guess }, &values, FINELY, 0)?;
                Some(search.finely_valued(begun, FINELY.steps, 0))
            };
            fitted.into_par_iter().filter_map(finely).collect::<Vec<_>>()
        },
    );
    phases.check()?;
    let Some(rigid) = rigid else { return Ok(None) };
    let judged = search.views.judged();
    let still = rigid.mean_loss(judged, 0);
    for fit in &mut fine {
        fit.loss = fit.body.mean_loss(judged, 0);
    }
    fine.sort_by(|a, b| a.loss.total_cmp(&b.loss));
    let Some(best) = fine.first().map(|fit| fit.loss) else { return Ok(None) };
    // A hinge far away does what a slide does; nothing slides out of what holds it.
    let is_simple = |fit: &Fit<'_>| {
        let slides = fit.guess.hinge.kind == JointKind::Prismatic;
        fit.loss <= SIMPLE * best && slides && fit.body.reach() <= search.size
    };
    let taken = fine.iter().position(is_simple).unwrap_or(0);
    let Fit { body, loss: error, .. } = fine.swap_remove(taken);
    if error > GAIN * still {
        return Ok(None);
    }
    let bending = search.bending().filter(|bending| bending.error < DEFORMS * error);
    let jointed = || search.finished(body, [error, still]).map(InPlace::Jointed);
    Ok(bending.map(InPlace::Bends).or_else(jointed))
}
