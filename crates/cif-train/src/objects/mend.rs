//! Mending of poses: of those that jump, as following a few times may end on a wrong side of what they show, from which
//! following the times behind them comes back; and of those aside of their masks, as a path that bends little passes by
//! where something bounces, and nothing draws an object onto a mask that it does not touch.

use glam::DVec3;

use super::fit::{Fit, TimedPose, log, onward};
use super::shape::{Pose, Shape};
use super::view::{ObjectView, WITHIN, median, meeting_point};
use crate::error::TrainError;
use crate::phases::Phases;

/// Turn per time, degrees, and shift, of the size, from which poses may jump, and how much more than the typical ones
/// around them.
const JUMP: (f64, f64, f64) = (8.0, 0.1, 2.5);

/// Steps from one time to the next, before and after, among which one is typical.
const AROUND: usize = 5;

/// Steps of a pose from where the times before it lead.
const SETTLE: usize = 60;

/// Loss, of that of the present pose, up to which a pose explains more; up to which poses that close a jump are kept, as
/// they move more evenly; and beyond which following ends, of all poses so far and of one.
const GAIN: f64 = 0.98;
const EVEN: f64 = 1.03;
const MOST: [f64; 2] = [1.1, 1.5];

/// Turn, degrees, and distance, of the size, from the present pose up to which a jump is closed.
const CLOSED: (f64, f64) = (8.0, 0.1);

/// Visible share below which a view does not distinguish poses.
const SEEN: f64 = 0.2;

/// Follows the object anew across jumps, from either side, as far as that explains more than the poses it has.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn mend(fit: &mut Fit<'_>, phases: &Phases) -> Result<(), TrainError> {
    let times: Vec<usize> = fit.poses.keys().copied().collect();
    for after in jumps(fit, &times) {
        phases.check()?;
        let earlier: Vec<usize> = times[..after].iter().rev().copied().collect();
        march(fit, &earlier, &times[after..]);
        march(fit, &times[after..], &earlier);
    }
    Ok(())
}

/// Moves poses onto masks from which they lie aside, farther than these reach, where that explains more of what is seen.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn onto_masks(fit: &mut Fit<'_>, phases: &Phases) -> Result<(), TrainError> {
    let times: Vec<usize> = fit.poses.keys().copied().filter(|time| fit.run(*time).is_empty()).collect();
    for time in times {
        phases.check()?;
        let pose = fit.poses[&time];
        let Some(place) = masked_place(fit, time, pose.translation) else { continue };
        // As far away as now, and as its outline tells.
        let places = [Some(place), fit.outline.path.get(&time).copied()].into_iter().flatten();
        let guesses: Vec<Pose> = places.map(|translation| Pose { translation, ..pose }).collect();
        if let Some(Compared { present, found, pose }) = compared(fit, time, &guesses)
            && found < GAIN * present
        {
            fit.poses.insert(time, pose);
            fit.moments.remove(&time);
        }
    }
    Ok(())
}

/// Where the masks of a time are, as far away as a place aside of all of them; `None` where it is on one, or none shows it.
fn masked_place(fit: &Fit<'_>, time: usize, place: DVec3) -> Option<DVec3> {
    let of_time = fit.views.iter().filter(|view| view.time_index == time && view.is_reliable());
    let mut views: Vec<&ObjectView> = Vec::new();
    for view in of_time {
        let (pixel, _) = view.camera.project(place)?;
        if (pixel - view.centroid).length() <= view.reach(WITHIN) {
            return None;
        }
        views.push(view);
    }
    match views[..] {
        [] => None,
        [view] => {
            let (_, depth) = view.camera.project(place)?;
            Some(view.camera.centre() + depth * view.camera.ray(view.centroid))
        }
        _ => meeting_point(views.into_iter().map(|view| (view, view.visible.powi(2)))),
    }
}

/// Places of times before which poses jump.
fn jumps(fit: &Fit<'_>, times: &[usize]) -> Vec<usize> {
    let speed = |pair: &[usize]| {
        let (turn, shift) = apart(&fit.poses[&pair[0]], &fit.poses[&pair[1]], fit.size());
        let steps = (pair[1] - pair[0]) as f64;
        (turn / steps, shift / steps)
    };
    let speeds: Vec<(f64, f64)> = times.windows(2).map(speed).collect();
    let typical = |k: usize, of: fn(&(f64, f64)) -> f64| {
        let near = k.saturating_sub(AROUND)..(k + AROUND + 1).min(speeds.len());
        median(&mut speeds[near].iter().map(of).collect::<Vec<_>>())
    };
    let (turn, shift, more) = JUMP;
    let is_jump = |k: &usize| {
        let (turns, shifts) = speeds[*k];
        (turns > turn && turns > more * typical(*k, |speed| speed.0))
            || (shifts > shift && shifts > more * typical(*k, |speed| speed.1))
    };
    (0..speeds.len()).filter(is_jump).map(|k| k + 1).collect()
}

/// Turn from one pose to another, degrees, and shift, of the size.
fn apart(a: &Pose, b: &Pose, size: f64) -> (f64, f64) {
    let turn = log(b.rotation * a.rotation.inverse()).length().to_degrees();
    (turn, (b.translation - a.translation).length() / size)
}

/// Follows times outward from those on the other side of a jump, nearest first: until it meets the poses that they have,
/// or as long as it explains them better. What looks the same from two sides never meets them, and explains all of them
/// as well.
fn march(fit: &mut Fit<'_>, times: &[usize], known: &[usize]) {
    let at = |time: &usize| TimedPose { time: *time, pose: fit.poses[time] };
    let mut run: Vec<TimedPose> = known.iter().take(2).rev().map(at).collect();
    let (begin, mut better) = (run.len(), run.len());
    let (mut before, mut after) = (0.0, 0.0);
    let mut is_even = false;
    for time in times.iter().copied() {
        let guesses = led(time, &run);
        let Some(Compared { present, found, pose }) = compared(fit, time, &guesses) else {
            // It decides nothing: onward to those that do.
            run.extend(guesses.last().map(|pose| TimedPose { time, pose: *pose }));
            continue;
        };
        (before, after) = (before + present, after + found);
        let ends = after > MOST[0] * before || found > MOST[1] * present;
        is_even = !ends && after < EVEN * before;
        if ends {
            break;
        }
        if better == run.len() && found < GAIN * present {
            better += 1;
        }
        run.push(TimedPose { time, pose });
        let (turn, shift) = apart(&fit.poses[&time], &pose, fit.size());
        if turn < CLOSED.0 && shift < CLOSED.1 {
            break;
        }
    }
    // It met the poses that they have, or the last of them.
    if is_even {
        better = run.len();
    }
    for TimedPose { time, pose } in run.drain(..better).skip(begin) {
        fit.poses.insert(time, pose);
        fit.moments.remove(&time);
    }
}

/// Poses in which a time may be where the last ones of a run lead: as the last one, and as far on as its speed leads.
fn led(time: usize, run: &[TimedPose]) -> Vec<Pose> {
    let Some(near) = run.last() else { return Vec::new() };
    let far = run.len().checked_sub(2).map(|k| run[k]);
    std::iter::once(near.pose).chain(far.map(|far| onward(*near, far, time))).collect()
}

/// A time in its present pose, held against the best of others.
struct Compared {
    /// Loss in the present pose.
    present: f64,
    /// Loss in the best of the others.
    found: f64,
    /// The best of the others.
    pose: Pose,
}

/// The present pose of a time held against those that guesses lead to; `None` where the time decides nothing.
fn compared(fit: &Fit<'_>, time: usize, guesses: &[Pose]) -> Option<Compared> {
    let is_seen = |view: &usize| fit.views[*view].time_index == time && fit.views[*view].visible >= SEEN;
    let views: Vec<usize> = (0..fit.views.len()).filter(is_seen).collect();
    let (found, pose) = settled(fit, &views, guesses, guesses.len())?;
    let present = loss(fit, &mut fit.shape.copied(), &views, fit.poses.get(&time)?);
    Some(Compared { present, found, pose })
}

/// The best of some poses by their loss on views of a time, which is given too, after so many of them that explain most
/// were moved onto these; `None` without views.
pub(super) fn settled(fit: &Fit<'_>, views: &[usize], guesses: &[Pose], tried: usize) -> Option<(f64, Pose)> {
    if views.is_empty() {
        return None;
    }
    let mut shape = fit.shape.copied();
    let mut begun: Vec<(f64, Pose)> =
        guesses.iter().map(|guess| (loss(fit, &mut shape, views, guess), *guess)).collect();
    begun.sort_by(|a, b| a.0.total_cmp(&b.0));
    let found = begun.into_iter().take(tried).map(|(_, guess)| {
        let pose = fit.settled(&mut shape, views, fit.trial_level(), guess, SETTLE);
        (loss(fit, &mut shape, views, &pose), pose)
    });
    found.min_by(|a, b| a.0.total_cmp(&b.0))
}

/// Loss of a shape on views in a pose.
fn loss(fit: &Fit<'_>, shape: &mut Shape, views: &[usize], pose: &Pose) -> f64 {
    views.iter().map(|view| fit.loss_with(shape, *view, fit.trial_level(), pose)).sum()
}
