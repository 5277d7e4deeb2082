//! Start of an object: ways of turning along its path are tried, the one that explains pixels it was not fitted to
//! is kept, times that hardly show the object are added, and everything is trained together.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::fit::{Fit, Turns, between, hull, hull_within};
use super::follow::follow;
use super::outline::{self, Outline};
use super::path::smooth;
use super::plane::Plane;
use super::shape::Pose;
use super::view::ObjectView;
use super::ways::{Paths, Way, is_round, rolled};
use crate::error::TrainError;
use crate::random::{Purpose, stream};
use crate::stop::Stop;

/// Reliable times below which ways of turning cannot be told apart.
const FEWEST_TIMES: usize = 8;

/// Times at which an object must be seen to be followed.
const FEWEST_SEEN: usize = 5;

/// Gaussians of an object that is followed.
const FOLLOWED: usize = 300;

/// Error of resting, relative to that of the best way of moving, up to which an object is taken to rest.
const REST_GAIN: f64 = 1.2;

/// Error of an object that was followed, relative to that of paths, below which following is preferred: of most
/// objects, and of round ones.
const FOLLOW_GAIN: [f64; 2] = [0.98, 0.94];

/// Gaussians of a trial.
const GAUSSIANS: usize = 150;

/// Steps of a trial until hopeless ones are given up, and all of them.
const STEPS: [usize; 2] = [300, 900];

/// Loss beyond the best at which a trial is hopeless.
const HOPELESS: f64 = 1.2;

/// Largest error of rolling, relative to that of sliding, at which rolling is preferred.
const ROLL_GAIN: f64 = 0.97;

/// Error by which rivals must be told apart, relative: of most objects, and of round ones, whose shading prefers no
/// turn; and the turn from which they are rivals, degrees.
const RIVAL: ([f64; 2], i32) = ([1.02, 1.06], 60);

/// Most rivals that are tried again with all pixels, of paths and of rolls, their errors relative to the best, of
/// rolls the second, and Gaussians and steps.
const RIVALS: usize = 4;
const CLOSE: f64 = 1.12;
const FAR: f64 = 1.3;
const FINE: (usize, usize) = (800, 1500);

/// Steps of the joint fit.
const JOINT: usize = 2500;

/// Pose-only steps of a time that is added.
const ADDED: usize = 30;

/// Evidence for the turns of an object: seen in pictures, or assumed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rotation {
    /// The pictures tell.
    Observed,
    /// They do not; something plausible is assumed.
    Assumed,
}

/// An object with its motion.
#[derive(Clone, Debug)]
pub(crate) struct Fitted {
    /// World from object, by time.
    pub(crate) poses: BTreeMap<usize, (DQuat, DVec3)>,
    /// In the frame of the object.
    pub(crate) gaussians: Gaussians,
    /// Pose at the time that shows most of it.
    pub(crate) reference: (DQuat, DVec3),
    pub(crate) rotation: Rotation,
    /// Error on pixels that were left out.
    pub(crate) error: f64,
    /// Way of turning that was kept, in words.
    pub(crate) turns: String,
}

struct Trial<'a> {
    way: Way,
    fit: Fit<'a>,
    /// Loss on the views it is fitted to, and on those left out.
    losses: [f64; 2],
}

/// Facts about the capture that fits need.
#[derive(Clone, Copy)]
pub(crate) struct Surroundings<'a> {
    pub(crate) times: usize,
    pub(crate) near: f32,
    pub(crate) seed: u64,
    /// Gaussians that an object leaves with.
    pub(crate) gaussians: usize,
    pub(crate) stop: &'a Stop,
}

/// Fits an object; `None` where its masks do not tell enough.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(crate) fn fit_object(
    label: u16,
    views: &[ObjectView],
    plane: Option<&Plane>,
    outline: &Outline,
    surroundings: Surroundings<'_>,
) -> Result<Option<Fitted>, TrainError> {
    let Surroundings { times, near, seed, gaussians, stop } = surroundings;
    let path = smooth(&outline.path, views, times);
    let reliable: Vec<usize> = (0..views.len())
        .filter(|view| {
            let time = &views[*view].time_index;
            views[*view].is_reliable() && path.contains_key(time)
        })
        .collect();
    let mut good: Vec<usize> = reliable.iter().map(|view| views[*view].time_index).collect();
    good.dedup();
    // Best seen: the largest mask, whole if there is one.
    let seen = |time: usize| -> f64 {
        let of = views.iter().filter(|view| view.time_index == time);
        of.map(|view| view.area() * (1.0 - 0.7 * view.touched) * if view.cut { 0.2 } else { 1.0 }).sum()
    };
    let best_seen = |times: &[usize]| times.iter().copied().max_by(|a, b| seen(*a).total_cmp(&seen(*b)));
    let rng = || stream(seed, Purpose::Objects, u64::from(label));
    let support = (plane.copied(), outline);
    let all_of = |fit: &Fit<'_>| -> Vec<usize> {
        (0..views.len()).filter(|view| fit.poses.contains_key(&views[*view].time_index)).collect()
    };
    // One view does not tell how deep an object is: the ellipsoid or cylinder of its outline does.
    let within = |place: DVec3| {
        let up = plane.map_or(0.0, |plane| plane.normal.dot(place));
        let across = (place.length_squared() - up * up).max(0.0).sqrt();
        up.abs() < 1.1 * outline.height && across < 1.1 * outline.radius
    };
    let bound: Option<&dyn Fn(DVec3) -> bool> = if plane.is_some() { Some(&within) } else { None };
    let (mut fit, way, rotation, error, reference) = if good.len() < FEWEST_TIMES {
        let known: Vec<usize> = path.keys().copied().collect();
        let Some(reference) = best_seen(&known).filter(|_| known.len() >= FEWEST_SEEN) else { return Ok(None) };
        let all: Vec<usize> =
            (0..views.len()).filter(|view| path.contains_key(&views[*view].time_index)).collect();
        let pose = Pose { rotation: DQuat::IDENTITY, translation: path[&reference] };
        let start = BTreeMap::from([(reference, pose)]);
        let Some(shape) = hull_within(views, &start, (outline.size(), bound), FOLLOWED, near, &mut rng()) else {
            return Ok(None);
        };
        let mut fit = Fit::new(views, support, (times, near), start, shape, rng());
        follow(&mut fit, reference, &path, &all);
        stop.check()?;
        let error = fit.mean_loss(&all, 0);
        (fit, Way::Followed, Rotation::Observed, error, reference)
    } else {
        let raw: BTreeMap<usize, DVec3> = good.iter().map(|time| (*time, outline.path[time])).collect();
        let start = smooth(&raw, views, times);
        let reference = best_seen(&good).unwrap_or(good[0]);
        let (train, left_out) = split(views, &reliable, &good);
        let left_out_times: Vec<usize> = left_out.iter().map(|view| views[*view].time_index).collect();
        let interpolates =
            left_out_times.iter().all(|time| !train.iter().any(|v| views[*v].time_index == *time));
        let mut paths = Paths {
            place: resting_place(views, &reliable),
            along: start,
            outline,
            normal: plane.map(|plane| plane.normal),
            reference,
            followed: None,
        };
        if reliable.len() > good.len() {
            let pose = Pose { rotation: DQuat::IDENTITY, translation: paths.along[&reference] };
            let first = BTreeMap::from([(reference, pose)]);
            if let Some(shape) =
                hull_within(views, &first, (outline.size(), bound), FOLLOWED, near, &mut rng())
            {
                let mut fit = Fit::new(views, support, (times, near), first, shape, rng());
                follow(&mut fit, reference, &paths.along, &train);
                paths.followed = Some(fit.poses);
            }
        }
        stop.check()?;
        let begin = |way: Way, gaussians: usize| -> Option<Trial<'_>> {
            let mut rng = rng();
            let mut poses = paths.poses(way);
            let shape = hull(views, &poses, outline.size(), gaussians, near, &mut rng)?;
            if interpolates {
                left_out_times.iter().for_each(|time| {
                    poses.remove(time);
                });
            }
            let mut fit = Fit::new(views, support, (times, near), poses, shape, rng);
            (fit.turns, fit.rolls) = match way {
                Way::Rest => (Turns::Given, None),
                Way::Slide(_) | Way::Spin(_) => (Turns::Upright, None),
                Way::Roll(factor) => (Turns::Free, Some(outline.height / factor)),
                Way::Followed => (Turns::Free, None),
            };
            fit.touches = !matches!(way, Way::Rest | Way::Spin(_));
            Some(Trial { way, fit, losses: [0.0; 2] })
        };
        let begin_all = |ways: &[Way], gaussians: usize| -> Vec<Trial<'_>> {
            ways.par_iter().filter_map(|way| begin(*way, gaussians)).collect()
        };
        let advance = |trials: &mut Vec<Trial<'_>>, (from, to, all): (usize, usize, usize), is_fine: bool| {
            trials.par_iter_mut().for_each(|trial| {
                let level = if is_fine { 0 } else { trial.fit.trial_level() };
                let moves = if trial.way == Way::Rest { 0.0 } else { 1.0 };
                trial.fit.steps(&train, to - from, |share| {
                    let done = from as f64 + share * (to - from) as f64;
                    let rate = if done < 0.5 * all as f64 { 1.0 } else { 0.5 };
                    (rate, moves * rate, level)
                });
                trial.losses[0] = trial.fit.mean_loss(&train, level);
            });
        };
        let judge = |trials: &mut Vec<Trial<'_>>, is_fine: bool| {
            trials.par_iter_mut().for_each(|trial| {
                if interpolates {
                    for time in &left_out_times {
                        if let Some(pose) = trial.fit.pose_at(*time) {
                            trial.fit.poses.insert(*time, pose);
                        }
                    }
                }
                let level = if is_fine { 0 } else { trial.fit.trial_level() };
                let judged = if left_out.is_empty() { &train } else { &left_out };
                trial.losses[1] = trial.fit.mean_loss(judged, level);
            });
        };
        // Most objects that do not travel rest, which two trials tell.
        let mut simple = begin_all(&[Way::Rest, Way::Slide(0)], GAUSSIANS);
        advance(&mut simple, (0, STEPS[1], STEPS[1]), false);
        judge(&mut simple, false);
        stop.check()?;
        let error = |way: Way| simple.iter().find(|trial| trial.way == way).map(|trial| trial.losses[1]);
        let rests = error(Way::Rest).zip(error(Way::Slide(0))).is_some_and(|(rest, moves)| rest <= REST_GAIN * moves);
        let mut trials = simple;
        if rests {
            if !paths.may_turn_unseen(views) {
                return Ok(None);
            }
            trials = begin_all(&paths.spins(), FINE.0);
            advance(&mut trials, (0, FINE.1, FINE.1), true);
            judge(&mut trials, true);
        } else {
            let mut more = begin_all(&paths.ways(), GAUSSIANS);
            advance(&mut more, (0, STEPS[0], STEPS[1]), false);
            stop.check()?;
            let best = more.iter().map(|trial| trial.losses[0]).fold(f64::INFINITY, f64::min);
            more.retain(|trial| {
                trial.losses[0] <= HOPELESS * best || matches!(trial.way, Way::Followed | Way::Roll(_))
            });
            advance(&mut more, (STEPS[0], STEPS[1], STEPS[1]), false);
            stop.check()?;
            judge(&mut more, false);
            trials.extend(more);
            if !is_round(outline) {
                // Again with all pixels and smaller Gaussians, where fine texture may tell.
                let rivals = rivals(&trials);
                if rivals.len() > 1 {
                    trials = begin_all(&rivals, FINE.0);
                    advance(&mut trials, (0, FINE.1, FINE.1), true);
                    judge(&mut trials, true);
                }
            }
        }
        stop.check()?;
        let in_contact = outline.air.is_empty();
        let Some((way, rotation)) = decide(&trials, is_round(outline), in_contact) else { return Ok(None) };
        // The path of a ball whose turn does not show is best where none is looked for; its rolling is put on
        // afterwards.
        let rolls_unseen = rotation == Rotation::Assumed && matches!(way, Way::Roll(_));
        let fitted = if rolls_unseen { Way::Slide(0) } else { way };
        let place = trials.iter().position(|trial| trial.way == fitted).unwrap_or(0);
        let Trial { mut fit, losses, .. } = trials.swap_remove(place);
        drop(trials);
        (fit.turns, fit.rolls) = match (rotation, &way) {
            (Rotation::Assumed, Way::Roll(_)) => (Turns::Free, None),
            (Rotation::Assumed, _) => (Turns::Given, None),
            (_, Way::Roll(factor)) => (Turns::Free, Some(outline.height / factor)),
            _ => (Turns::Free, None),
        };
        grow(&mut fit, &path);
        (fit, way, rotation, losses[1], reference)
    };
    stop.check()?;
    let all = all_of(&fit);
    let levels = fit.levels();
    fit.steps(&all, JOINT, |share| {
        let decay = 0.05_f64.powf(share);
        let level = if share < 0.2 && levels.len() > 1 { 1 } else { 0 };
        (0.6 * decay, 1.5 * decay, level)
    });
    stop.check()?;
    if let (Rotation::Assumed, Way::Roll(_), Some(plane)) = (rotation, way, plane) {
        roll_along(&mut fit, plane, outline.height);
        if let Some(shape) = hull(views, &fit.poses, outline.size(), GAUSSIANS, near, &mut rng()) {
            fit.shape = shape;
            fit.turns = Turns::Given;
            fit.steps(&all, STEPS[1], |share| (0.6 * 0.2_f64.powf(share), 0.1, 0));
        }
    }
    // More Gaussians, in poses that hardly move any more.
    if let Some(shape) = hull(views, &fit.poses, outline.size(), gaussians, near, &mut rng()) {
        fit.shape = shape;
        fit.steps(&all, STEPS[1], |share| (0.6 * 0.05_f64.powf(share), 0.1, 0));
    }
    stop.check()?;
    Ok(Some(Fitted {
        poses: fit.poses.iter().map(|(time, pose)| (*time, (pose.rotation, pose.translation))).collect(),
        gaussians: fit.shape.gaussians().clone(),
        reference: fit
            .poses
            .get(&reference)
            .map_or((DQuat::IDENTITY, DVec3::ZERO), |p| (p.rotation, p.translation)),
        rotation,
        error,
        turns: way.told(),
    }))
}

/// The point nearest to the rays through the middles of masks: where the object is, had it stayed in place.
fn resting_place(views: &[ObjectView], of: &[usize]) -> DVec3 {
    let rays = of.iter().map(|view| (&views[*view], views[*view].visible.powi(2)));
    outline::meeting_point(rays).unwrap_or(DVec3::ZERO)
}

/// Views to fit to, and views left out: a camera in the middle where there are several at a time, else every fourth
/// time.
fn split(views: &[ObjectView], reliable: &[usize], good: &[usize]) -> (Vec<usize>, Vec<usize>) {
    if reliable.len() > good.len() {
        let mut cameras: Vec<[i64; 3]> = reliable.iter().map(|view| views[*view].camera_key).collect();
        cameras.sort_unstable();
        cameras.dedup();
        let middle = cameras[cameras.len() / 2];
        return reliable.iter().partition(|view| views[**view].camera_key != middle);
    }
    let is_left_out = |time: usize| {
        let place = good.iter().position(|other| *other == time).unwrap_or(0);
        good.len() > 8 && place >= 2 && place + 1 < good.len() && (place - 2).is_multiple_of(4)
    };
    reliable.iter().partition(|view| !is_left_out(views[**view].time_index))
}

/// Ways that are near the best: paths, rolls, and what following found.
fn rivals(trials: &[Trial<'_>]) -> Vec<Way> {
    let mut best: Vec<(f64, Way)> = trials.iter().map(|trial| (trial.losses[1], trial.way)).collect();
    best.sort_by(|a, b| a.0.total_cmp(&b.0));
    let is_near = |factor: f64, error: f64| error < factor * best[0].0;
    let (mut paths, mut rolls, mut rivals) = (0, 0, Vec::new());
    for (error, way) in &best {
        // What turns about a long axis shows it by its texture alone.
        let (count, most, factor) = match way {
            Way::Roll(_) => (&mut rolls, RIVALS, FAR),
            Way::Rest | Way::Followed => (&mut 0, 1, FAR),
            _ => (&mut paths, RIVALS, CLOSE),
        };
        if *count < most && is_near(factor, *error) {
            *count += 1;
            rivals.push(*way);
        }
    }
    rivals
}

/// The way of moving that is kept, and whether the pictures tell its turns; `None` where the object rests.
fn decide(trials: &[Trial<'_>], is_round: bool, in_contact: bool) -> Option<(Way, Rotation)> {
    let (way, rotation) = decide_moving(trials, is_round, in_contact)?;
    let error = |way: Way| trials.iter().find(|trial| trial.way == way).map(|trial| trial.losses[1]);
    let rests = error(Way::Rest).zip(error(way)).is_some_and(|(rest, moves)| rest <= REST_GAIN * moves);
    (!rests).then_some((way, rotation))
}

/// The best way of moving, and whether the pictures tell its turns.
fn decide_moving(trials: &[Trial<'_>], is_round: bool, in_contact: bool) -> Option<(Way, Rotation)> {
    let best = |wanted: &dyn Fn(&Way) -> bool| {
        let of = trials.iter().filter(|trial| wanted(&trial.way));
        of.min_by(|a, b| a.losses[1].total_cmp(&b.losses[1])).map(|trial| (trial.way, trial.losses[1]))
    };
    let (moving, moving_error) = best(&|way| *way != Way::Rest)?;
    let roll = best(&|way| matches!(way, Way::Roll(_)));
    let Some((turning, turning_error)) = best(&|way| way.degrees().is_some()) else {
        return Some((moving, Rotation::Observed));
    };
    let others = roll.map_or(turning_error, |(_, error)| error.min(turning_error));
    if moving == Way::Followed && moving_error < FOLLOW_GAIN[usize::from(is_round)] * others {
        return Some((moving, Rotation::Observed));
    }
    if let Some((way, error)) = roll
        && error <= ROLL_GAIN * turning_error
    {
        return Some((way, Rotation::Observed));
    }
    let apart = |other: i32| {
        let difference = (other - turning.degrees().unwrap_or(0)).rem_euclid(360);
        difference.min(360 - difference) >= RIVAL.1
    };
    let rival = best(&|way| way.degrees().is_some_and(apart));
    if rival.is_some_and(|(_, error)| error < RIVAL.0[usize::from(is_round)] * turning_error) {
        let has = |wanted: &Way| trials.iter().any(|trial| trial.way == *wanted);
        if is_round && in_contact && has(&Way::Roll(1.0)) {
            return Some((Way::Roll(1.0), Rotation::Assumed));
        }
        if has(&Way::Slide(0)) {
            return Some((Way::Slide(0), Rotation::Assumed));
        }
        return Some((turning, Rotation::Assumed));
    }
    Some((turning, Rotation::Observed))
}

/// Turns an object as it rolls without slip along its path, about its middle.
fn roll_along(fit: &mut Fit<'_>, plane: &Plane, radius: f64) {
    let g = fit.shape.gaussians();
    let weight = |row: usize| 1.0 / (1.0 + f64::from(-g.opacity_logits[row]).exp());
    let total: f64 = (0..g.len()).map(weight).sum();
    let sum: DVec3 =
        (0..g.len()).map(|row| weight(row) * DVec3::from_array(g.means[row].map(f64::from))).sum();
    let middle = sum / total.max(1e-9);
    let places: Vec<DVec3> =
        fit.poses.values().map(|pose| pose.rotation * middle + pose.translation).collect();
    let rotations = rolled(&places, plane.normal, radius);
    for ((pose, rotation), translation) in fit.poses.values_mut().zip(rotations).zip(places) {
        *pose = Pose { rotation, translation };
    }
}

/// Adds the times that are seen, but not reliable or off the plane, nearest first.
fn grow(fit: &mut Fit<'_>, path: &BTreeMap<usize, DVec3>) {
    let known: Vec<usize> = fit.poses.keys().copied().collect();
    let mut rest: Vec<usize> = path.keys().copied().filter(|time| !fit.poses.contains_key(time)).collect();
    rest.sort_by_key(|time| known.iter().map(|known| known.abs_diff(*time)).min());
    for time in rest {
        let views: Vec<usize> =
            (0..fit.views.len()).filter(|view| fit.views[*view].time_index == time).collect();
        let Some(pose) = fit.pose_at(time) else { continue };
        fit.poses.insert(time, between(&pose, &pose, 0.0));
        let seen = views.iter().map(|view| fit.views[*view].visible).fold(0.0, f64::max);
        let level = *fit.levels().first().unwrap_or(&0);
        for step in 0..if seen > 0.1 { ADDED } else { 0 } {
            fit.step(views[step % views.len()], level.min(1), None, 0.5);
        }
    }
}
