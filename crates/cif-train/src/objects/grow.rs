//! Times that show little of an object: cut by the border, hidden, or seen by one of several cameras. What is known of it
//! from others is moved onto their masks.

use std::collections::BTreeMap;

use glam::DVec3;

use super::fit::Fit;
use super::mend::settled;
use super::shape::Pose;
use super::view::{ObjectView, look_alike};

/// Places that are moved onto masks, of those that a time may have.
const TRIED: usize = 2;

/// Distances from the middle of a mask beyond the border that cuts it, of the size of the object, at which its middle may be.
const BEYOND: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];

/// Loss, of that where the object is not drawn at all, beyond which a pose does not explain its masks.
const MISSED: f64 = 0.5;

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
        let mut guesses = led(fit, time, path);
        let Some(first) = guesses.first().copied() else { continue };
        let shows_place =
            |view: &usize| fit.views[*view].time_index == time && fit.views[*view].shows_place();
        let views: Vec<usize> = (0..fit.views.len()).filter(shows_place).collect();
        if views.iter().any(|view| fit.views[*view].cut) && is_missed(fit, &views, &guesses) {
            let cut: Vec<Pose> = views.iter().flat_map(|view| beyond(fit, *view, &guesses)).collect();
            guesses.extend(cut);
        }
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

/// Poses in which the border of an image would cut the object as it does its mask, where it stands or, where it does not, as
/// far away as neighbours lead: what lies beyond the border, or covers all of the mask, is not drawn onto it.
fn beyond(fit: &Fit<'_>, view: usize, led: &[Pose]) -> Vec<Pose> {
    let view = &fit.views[view];
    let (Some(outward), Some(near)) = (view.outward(), led.first()) else { return Vec::new() };
    let (origin, stands) = (view.camera.centre(), fit.outline.held.contains(&view.time_index));
    let at = |led: &Pose| {
        let Some((_, depth)) = view.camera.project(led.translation) else { return Vec::new() };
        let size = fit.size() * view.camera.focal_px.x / depth;
        let moved = |share: f64| {
            let ray = view.camera.ray(view.centroid + share * size * outward);
            let plane = fit.plane.filter(|_| stands);
            let depth = plane.and_then(|plane| plane.meet(origin, ray, fit.outline.height)).unwrap_or(depth);
            Pose { translation: origin + depth * ray, ..*near }
        };
        BEYOND.map(moved).to_vec()
    };
    led.iter().take(2).flat_map(at).collect()
}

/// True where the best of some poses leaves most of what views show unexplained, as if the object were not there.
fn is_missed(fit: &Fit<'_>, views: &[usize], led: &[Pose]) -> bool {
    let mut shape = fit.shape.copied();
    let level = fit.trial_level();
    let mut loss = |pose: &dyn Fn(&ObjectView) -> Pose| -> f64 {
        views.iter().map(|view| fit.loss_with(&mut shape, *view, level, &pose(&fit.views[*view]))).sum()
    };
    let behind = |view: &ObjectView| {
        let forward = view.camera.camera_from_world.rotation.row(2);
        Pose::at(view.camera.centre() - 10.0 * fit.size() * forward)
    };
    let unseen = loss(&behind);
    led.iter().all(|pose| loss(&|_| *pose) > MISSED * unseen)
}
