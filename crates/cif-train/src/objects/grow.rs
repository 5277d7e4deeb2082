//! Times that show little of an object: cut by the border, hidden, or seen by one of several cameras. What is known of it
//! from others is moved onto their masks.

use std::collections::BTreeMap;

use glam::DVec3;

use super::fit::Fit;
use super::mend::settled;
use super::shape::Pose;
use super::view::look_alike;

/// Places that are moved onto masks, of those that a time may have.
const TRIED: usize = 2;

/// Adds the times that are seen, but not reliable, nearest first: where their masks are, near where their neighbours or
/// the path lead.
pub(super) fn grow(fit: &mut Fit<'_>, path: &BTreeMap<usize, DVec3>) {
    let known: Vec<usize> = fit.poses.keys().copied().collect();
    let mut rest: Vec<usize> = path.keys().copied().filter(|time| !fit.poses.contains_key(time)).collect();
    rest.sort_by_key(|time| known.iter().map(|known| known.abs_diff(*time)).min());
    // Between times at which it may be off its support, it may.
    let is_off = |time: Option<&usize>| time.is_none_or(|time| fit.air.contains(time));
    let between = |time: usize| {
        let after = known.partition_point(|known| *known < time);
        is_off(known[..after].last()) && is_off(known.get(after))
    };
    let off: Vec<usize> =
        rest.iter().copied().filter(|time| !fit.air.contains(time) && between(*time)).collect();
    fit.air.extend(off);
    fit.runs = runs(fit, &rest);
    for time in rest {
        let of_run = fit.run(time).iter().find_map(|time| fit.poses.get(time)).copied();
        if let Some(pose) = of_run {
            fit.poses.insert(time, pose);
            continue;
        }
        let guesses = led(fit, time, path);
        let Some(first) = guesses.first().copied() else { continue };
        let shows_place =
            |view: &usize| fit.views[*view].time_index == time && fit.views[*view].shows_place();
        let views: Vec<usize> = (0..fit.views.len()).filter(shows_place).collect();
        let pose = settled(fit, &views, &guesses, TRIED).map_or(first, |(_, pose)| pose);
        fit.poses.insert(time, pose);
    }
}

/// Runs of times, one after the other, at which all cameras see the same: it stands still.
fn runs(fit: &Fit<'_>, times: &[usize]) -> Vec<Vec<usize>> {
    let mut times = times.to_vec();
    times.sort_unstable();
    let at_rest = |a: &usize, b: &usize| look_alike(fit.views, *a, *b);
    times.chunk_by(at_rest).filter(|run| run.len() > 1).map(<[usize]>::to_vec).collect()
}

/// Poses that a time may have: where its neighbours lead, as the nearest of them, as far from it as the path is, in either
/// of their turns, and on the path.
fn led(fit: &Fit<'_>, time: usize, path: &BTreeMap<usize, DVec3>) -> Vec<Pose> {
    let Some(onward) = fit.pose_at(time) else { return Vec::new() };
    let Some(near) = fit.neighbours(time).into_iter().flatten().min_by_key(|near| near.abs_diff(time)) else {
        return vec![onward];
    };
    let last = fit.poses[&near];
    let mut led = vec![onward, last];
    if let (Some(from), Some(to)) = (path.get(&near), path.get(&time)) {
        let translation = last.translation + *to - *from;
        led.extend([onward, last].map(|pose| Pose { translation, ..pose }));
        led.push(Pose { translation: *to, ..last });
    }
    led
}
