//! Start of an object: ways of turning along its path are tried, the one that explains pixels it was not fitted to
//! is kept, times that hardly show the object are added, and everything is trained together.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::fit::{Fit, Turns, between, hull};
use super::outline::Outline;
use super::path::smooth;
use super::plane::Plane;
use super::shape::Pose;
use super::view::ObjectView;
use crate::error::TrainError;
use crate::random::{Purpose, stream};
use crate::stop::Stop;

/// Reliable times below which ways of turning cannot be told apart.
const FEWEST_TIMES: usize = 8;

/// Gaussians of a trial.
const GAUSSIANS: usize = 150;

/// Steps of a trial until hopeless ones are given up, and all of them.
const STEPS: [usize; 2] = [300, 900];

/// Loss beyond the best at which a trial is hopeless.
const HOPELESS: f64 = 1.2;

/// Turns of the slides, degrees apart.
const SLIDE: i32 = 30;

/// Rolling radii tried, of the height.
const ROLLS: [f64; 9] = [0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08];

/// Roundness of masks from which an object may roll.
const ROUND: f64 = 0.93;

/// Largest error of rolling, relative to that of sliding, at which rolling is preferred.
const ROLL_GAIN: f64 = 0.97;

/// Error by which rivals must be told apart, relative: of most objects, and of round ones, whose shading prefers no
/// turn; and the turn from which they are rivals, degrees.
const RIVAL: ([f64; 2], i32) = ([1.02, 1.06], 60);

/// Path in sizes below which an object stays in place: turns are a function of time then.
const STAYS: f64 = 1.5;

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

/// A way of turning.
#[derive(Clone, Debug, PartialEq)]
enum Way {
    /// About the normal, degrees in all, along the path.
    Slide(i32),
    /// Without slip, with this radius of the height.
    Roll(f64),
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

/// Turns of a ball that rolls without slip from place to place.
fn rolled(places: &[DVec3], normal: DVec3, radius: f64) -> Vec<DQuat> {
    let mut rotations = vec![DQuat::IDENTITY];
    for pair in places.windows(2) {
        let turn = normal.cross(pair[1] - pair[0]) / radius;
        let last = rotations[rotations.len() - 1];
        rotations.push((DQuat::from_scaled_axis(turn) * last).normalize());
    }
    rotations
}

/// Turns along a path of every time, relative to a reference time.
fn turns(
    way: &Way,
    path: &BTreeMap<usize, DVec3>,
    outline: &Outline,
    normal: DVec3,
    reference: usize,
) -> Vec<DQuat> {
    let times: Vec<usize> = path.keys().copied().collect();
    let places: Vec<DVec3> = path.values().copied().collect();
    let origin = times.iter().position(|time| *time == reference).unwrap_or(0);
    match way {
        Way::Slide(degrees) => {
            let mut lengths = vec![0.0];
            for pair in places.windows(2) {
                lengths.push(lengths[lengths.len() - 1] + (pair[1] - pair[0]).length());
            }
            if lengths[lengths.len() - 1] < STAYS * outline.size() {
                lengths = times.iter().map(|time| (time - times[0]) as f64).collect();
            }
            let whole = lengths[lengths.len() - 1].max(1e-9);
            let angle = f64::from(*degrees).to_radians();
            lengths
                .iter()
                .map(|s| DQuat::from_scaled_axis(normal * angle * (s - lengths[origin]) / whole))
                .collect()
        }
        Way::Roll(factor) => {
            let rotations = rolled(&places, normal, outline.height / factor);
            let back = rotations[origin].inverse();
            rotations.into_iter().map(|rotation| rotation * back).collect()
        }
    }
}

/// Fits an object; `None` where its masks do not tell enough.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(crate) fn fit_object(
    label: u16,
    views: &[ObjectView],
    plane: &Plane,
    outline: &Outline,
    surroundings: Surroundings<'_>,
) -> Result<Option<Fitted>, TrainError> {
    let Surroundings { times, near, seed, gaussians, stop } = surroundings;
    let path = smooth(&outline.path, views, times);
    let reliable: Vec<usize> = (0..views.len())
        .filter(|view| views[*view].is_reliable() && path.contains_key(&views[*view].time_index))
        .collect();
    let mut good: Vec<usize> = reliable.iter().map(|view| views[*view].time_index).collect();
    good.dedup();
    if good.len() < FEWEST_TIMES {
        return Ok(None);
    }
    let raw: BTreeMap<usize, DVec3> = good.iter().map(|time| (*time, outline.path[time])).collect();
    let start = smooth(&raw, views, times);
    // Best seen: the largest mask that is whole.
    let seen = |time: usize| -> f64 {
        let of = views.iter().filter(|view| view.time_index == time);
        of.map(|view| view.area() * (1.0 - 0.7 * view.touched)).sum()
    };
    let reference = good.iter().copied().max_by(|a, b| seen(*a).total_cmp(&seen(*b))).unwrap_or(good[0]);
    let (train, left_out) = split(views, &reliable, &good);
    let left_out_times: Vec<usize> = left_out.iter().map(|view| views[*view].time_index).collect();
    let interpolates = left_out_times.iter().all(|time| !train.iter().any(|v| views[*v].time_index == *time));
    let mut ways: Vec<Way> = (-180 / SLIDE..=180 / SLIDE).map(|k| Way::Slide(k * SLIDE)).collect();
    if outline.roundness > ROUND {
        ways.extend(ROLLS.map(Way::Roll));
    }
    let begin = |way: Way| -> Option<Trial<'_>> {
        let mut rng = stream(seed, Purpose::Objects, u64::from(label));
        let turned = turns(&way, &start, outline, plane.normal, reference);
        let mut poses: BTreeMap<usize, Pose> = start
            .iter()
            .zip(turned)
            .map(|((time, place), rotation)| (*time, Pose { rotation, translation: *place }))
            .collect();
        let shape = hull(views, &poses, outline.size(), GAUSSIANS, near, &mut rng)?;
        if interpolates {
            left_out_times.iter().for_each(|time| {
                poses.remove(time);
            });
        }
        let mut fit = Fit::new(views, (Some(*plane), outline), times, poses, shape, rng);
        (fit.turns, fit.rolls) = match way {
            Way::Slide(_) => (Turns::Upright, false),
            Way::Roll(_) => (Turns::Free, true),
        };
        Some(Trial { way, fit, losses: [0.0; 2] })
    };
    let mut trials: Vec<Trial<'_>> = ways.into_par_iter().filter_map(begin).collect();
    if trials.is_empty() {
        return Ok(None);
    }
    let advance = |trials: &mut Vec<Trial<'_>>, from: usize, to: usize| {
        trials.par_iter_mut().for_each(|trial| {
            let level = trial.fit.trial_level();
            trial.fit.steps(&train, to - from, |share| {
                let done = from as f64 + share * (to - from) as f64;
                let rate = if done < 0.5 * STEPS[1] as f64 { 1.0 } else { 0.5 };
                (rate, rate, level)
            });
            trial.losses[0] = trial.fit.mean_loss(&train, level);
        });
    };
    stop.check()?;
    advance(&mut trials, 0, STEPS[0]);
    stop.check()?;
    let best = trials.iter().map(|trial| trial.losses[0]).fold(f64::INFINITY, f64::min);
    trials.retain(|trial| trial.losses[0] <= HOPELESS * best || trial.way == Way::Roll(1.0));
    advance(&mut trials, STEPS[0], STEPS[1]);
    stop.check()?;
    trials.par_iter_mut().for_each(|trial| {
        if interpolates {
            for time in &left_out_times {
                if let Some(pose) = trial.fit.pose_at(*time) {
                    trial.fit.poses.insert(*time, pose);
                }
            }
        }
        let level = trial.fit.trial_level();
        let judged = if left_out.is_empty() { &train } else { &left_out };
        trial.losses[1] = trial.fit.mean_loss(judged, level);
    });
    let in_contact = outline.air.is_empty();
    let (way, rotation) = decide(&trials, outline.roundness > ROUND, in_contact);
    // The path of a ball whose turn does not show is best where none is looked for; its rolling is put on afterwards.
    let rolls_unseen = rotation == Rotation::Assumed && matches!(way, Way::Roll(_));
    let fitted = if rolls_unseen { Way::Slide(0) } else { way.clone() };
    let place = trials.iter().position(|trial| trial.way == fitted).unwrap_or(0);
    let Trial { mut fit, losses, .. } = trials.swap_remove(place);
    drop(trials);
    (fit.turns, fit.rolls) = match (rotation, &way) {
        (Rotation::Assumed, Way::Slide(_)) => (Turns::Given, false),
        (Rotation::Assumed, Way::Roll(_)) => (Turns::Free, false),
        (_, Way::Roll(_)) => (Turns::Free, true),
        (_, Way::Slide(_)) => (Turns::Free, false),
    };
    grow(&mut fit, &path);
    stop.check()?;
    let all: Vec<usize> =
        (0..views.len()).filter(|view| fit.poses.contains_key(&views[*view].time_index)).collect();
    let levels = fit.levels();
    fit.steps(&all, JOINT, |share| {
        let decay = 0.05_f64.powf(share);
        let level = if share < 0.2 && levels.len() > 1 { 1 } else { 0 };
        (0.6 * decay, 1.5 * decay, level)
    });
    stop.check()?;
    if rolls_unseen {
        roll_along(&mut fit, plane, outline.height);
        let mut rng = stream(seed, Purpose::Objects, u64::from(label));
        if let Some(shape) = hull(views, &fit.poses, outline.size(), GAUSSIANS, near, &mut rng) {
            fit.shape = shape;
            fit.turns = Turns::Given;
            fit.steps(&all, STEPS[1], |share| (0.6 * 0.2_f64.powf(share), 0.1, 0));
        }
    }
    // More Gaussians, in poses that hardly move any more.
    let mut rng = stream(seed, Purpose::Objects, u64::from(label));
    if let Some(shape) = hull(views, &fit.poses, outline.size(), gaussians, near, &mut rng) {
        fit.shape = shape;
        fit.steps(&all, STEPS[1], |share| (0.6 * 0.05_f64.powf(share), 0.1, 0));
    }
    stop.check()?;
    let turns = match way {
        Way::Slide(degrees) => format!("slides, turning {degrees} deg"),
        Way::Roll(factor) => format!("rolls with {factor:.2} of its height"),
    };
    Ok(Some(Fitted {
        poses: fit.poses.iter().map(|(time, pose)| (*time, (pose.rotation, pose.translation))).collect(),
        gaussians: fit.shape.gaussians().clone(),
        reference: fit
            .poses
            .get(&reference)
            .map_or((DQuat::IDENTITY, DVec3::ZERO), |p| (p.rotation, p.translation)),
        rotation,
        error: losses[1],
        turns,
    }))
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

/// The way of turning that is kept, and whether the pictures tell it.
fn decide(trials: &[Trial<'_>], is_round: bool, in_contact: bool) -> (Way, Rotation) {
    let best = |wanted: &dyn Fn(&Way) -> bool| {
        let of = trials.iter().filter(|trial| wanted(&trial.way));
        of.min_by(|a, b| a.losses[1].total_cmp(&b.losses[1]))
            .map(|trial| (trial.way.clone(), trial.losses[1]))
    };
    let roll = best(&|way| matches!(way, Way::Roll(_)));
    let Some((slide, slide_error)) = best(&|way| matches!(way, Way::Slide(_))) else {
        return roll.map_or((Way::Slide(0), Rotation::Assumed), |(way, _)| (way, Rotation::Observed));
    };
    if let Some((way, error)) = roll
        && error <= ROLL_GAIN * slide_error
    {
        return (way, Rotation::Observed);
    }
    let Way::Slide(degrees) = slide else { return (slide, Rotation::Observed) };
    let apart = |other: i32| {
        let difference = (other - degrees).rem_euclid(360);
        difference.min(360 - difference) >= RIVAL.1
    };
    let rival = best(&|way| matches!(way, Way::Slide(other) if apart(*other)));
    if rival.is_some_and(|(_, error)| error < RIVAL.0[usize::from(is_round)] * slide_error) {
        let has = |wanted: &Way| trials.iter().any(|trial| trial.way == *wanted);
        if is_round && in_contact && has(&Way::Roll(1.0)) {
            return (Way::Roll(1.0), Rotation::Assumed);
        }
        if has(&Way::Slide(0)) {
            return (Way::Slide(0), Rotation::Assumed);
        }
        return (slide, Rotation::Assumed);
    }
    (slide, Rotation::Observed)
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

/// Adds the times that are seen but not reliable, nearest first.
fn grow(fit: &mut Fit<'_>, path: &BTreeMap<usize, DVec3>) {
    let known: Vec<usize> = fit.poses.keys().copied().collect();
    let mut rest: Vec<usize> = path.keys().copied().filter(|time| !fit.poses.contains_key(time)).collect();
    rest.sort_by_key(|time| known.iter().map(|known| known.abs_diff(*time)).min());
    for time in rest {
        let Some(pose) = fit.pose_at(time) else { continue };
        fit.poses.insert(time, between(&pose, &pose, 0.0));
        let views: Vec<usize> =
            (0..fit.views.len()).filter(|view| fit.views[*view].time_index == time).collect();
        let seen = views.iter().map(|view| fit.views[*view].visible).fold(0.0, f64::max);
        let level = *fit.levels().first().unwrap_or(&0);
        for step in 0..if seen > 0.1 { ADDED } else { 0 } {
            fit.step(views[step % views.len()], level.min(1), None, 0.5);
        }
    }
}
