//! Windows of rest: times in a row at which one pose explains what a camera that moves sees as well as a pose of each. From
//! several sides it shows how far away an object is, which its size at one time hardly does.

use glam::DVec3;

use super::fit::{Fit, MovingPose};
use super::shape::{Pose, Shape};
use crate::error::TrainError;
use crate::phases::Phases;

/// Fewest times of a window: two that are alike may both be wrong.
const FEWEST: usize = 4;

/// Loss in the pose of a neighbour, of that in its own, up to which a time may belong to the same window; and loss of a window
/// in one pose, of that in a pose of each, up to which it is one.
const ALIKE: f64 = 1.1;
const EVEN: f64 = 1.03;

/// Steps of the pose of a window, per time.
const STEPS: usize = 24;

/// Share of a window from one step to the next: by the golden section times are visited evenly, those far apart soon after
/// each other.
const STRIDE: f64 = 0.618_034;

/// Ties the poses of every window of rest of an object that one camera sees.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn tie(fit: &mut Fit<'_>, phases: &Phases) -> Result<(), TrainError> {
    if !fit.one_camera || fit.stays {
        return Ok(());
    }
    let mut shape = fit.shape.copied();
    let mut open = vec![seen(fit, &mut shape)];
    let mut windows: Vec<Window> = Vec::new();
    while let Some(mut times) = open.pop() {
        phases.check()?;
        if times.len() < FEWEST {
            continue;
        }
        let split =
            (1..times.len()).max_by(|a, b| times[*a].change.total_cmp(&times[*b].change)).unwrap_or(1);
        let is_alike = times[split].change < ALIKE;
        if let Some(pose) = is_alike.then(|| common(fit, &mut shape, times.iter())).flatten() {
            windows.push(Window { times, pose });
            join_last(fit, &mut shape, &mut windows);
        } else {
            let after = times.split_off(split);
            // The earlier one is looked at first.
            open.extend([after, times]);
        }
    }
    for Window { times, pose } in windows {
        for seen in &times {
            fit.poses.insert(seen.time, pose);
            fit.moments.remove(&seen.time);
        }
        fit.runs.push(times.iter().map(|seen| seen.time).collect());
    }
    Ok(())
}

/// Times at which an object rests, and where.
struct Window {
    times: Vec<Seen>,
    pose: Pose,
}

/// Joins the last two windows if they follow each other and are one: a single pose that is wrong may be between them.
fn join_last(fit: &Fit<'_>, shape: &mut Shape, windows: &mut Vec<Window>) {
    let [.., before, after] = &mut windows[..] else { return };
    let follows =
        before.times.last().map(|seen| seen.place + 1) == after.times.first().map(|seen| seen.place);
    let both = before.times.iter().chain(&after.times);
    if let Some(pose) = follows.then(|| common(fit, shape, both)).flatten() {
        before.times.append(&mut after.times);
        before.pose = pose;
        windows.pop();
    }
}

/// A time at which a mask shows where the object is.
struct Seen {
    /// Place among those.
    place: usize,
    time: usize,
    view: usize,
    /// Loss in its pose.
    loss: f64,
    /// Loss of it and the time before in the poses of each other, of that in their own.
    change: f64,
}

/// Those of a fit, in order, but for times that share a pose already.
fn seen(fit: &Fit<'_>, shape: &mut Shape) -> Vec<Seen> {
    let is_free =
        |view: &usize| fit.views[*view].is_reliable() && fit.run(fit.views[*view].time_index).is_empty();
    let views = (0..fit.views.len()).filter(is_free);
    let of = |shape: &mut Shape, view: usize, time: usize| {
        Some(fit.loss_with(shape, view, fit.trial_level(), fit.poses.get(&time)?))
    };
    let mut found: Vec<Seen> = views
        .filter_map(|view| {
            let time = fit.views[view].time_index;
            Some(Seen { place: 0, time, view, loss: of(shape, view, time)?, change: 1.0 })
        })
        .collect();
    found.sort_by_key(|seen| seen.time);
    for k in 1..found.len() {
        found[k].place = k;
        let [a, b] = [k - 1, k].map(|k| (found[k].view, found[k].time));
        let both = of(shape, a.0, b.1).zip(of(shape, b.0, a.1));
        found[k].change = both.map_or(1.0, |(a, b)| a + b) / (found[k - 1].loss + found[k].loss);
    }
    found
}

/// The pose that explains some times as well as their own poses do; `None` where none does.
fn common<'s>(fit: &Fit<'_>, shape: &mut Shape, times: impl Iterator<Item = &'s Seen>) -> Option<Pose> {
    let times: Vec<&Seen> = times.collect();
    let level = fit.trial_level();
    // Too near as often as too far.
    let sum: DVec3 = times.iter().map(|seen| fit.poses[&seen.time].translation).sum();
    let middle = fit.poses[&times[times.len() / 2].time];
    let mut moving = MovingPose::from(Pose { translation: sum / times.len() as f64, ..middle });
    let count = STEPS * times.len();
    for step in 0..count {
        let seen = times[((step as f64 * STRIDE).fract() * times.len() as f64) as usize];
        let rate = 0.05_f64.powf(step as f64 / count as f64);
        fit.pose_step(shape, seen.view, level, &mut moving, rate);
    }
    let own: f64 = times.iter().map(|seen| seen.loss).sum();
    let one: f64 = times.iter().map(|seen| fit.loss_with(shape, seen.view, level, &moving.pose)).sum();
    (one < EVEN * own).then_some(moving.pose)
}
