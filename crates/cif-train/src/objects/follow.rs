//! Following an object outward from the time that shows it best. Source: methods reference of motion, 4.5.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use rand::RngExt;
use rayon::prelude::*;

use super::fit::{Fit, MovingPose, log};
use super::hull::hull;
use super::shape::Pose;
use crate::error::TrainError;
use crate::phases::Phases;

/// Steps of the shape at the first time, per level.
const FIRST: usize = 120;

/// Steps of the shape at several first times.
const BEGIN: usize = 600;

/// Steps of a pose, per level; of a second time, whose speed is not known, twice as many.
const POSE: usize = 25;

/// Steps of shape and poses after a time was added, and rates of both.
const SETTLE: (usize, f64, f64) = (50, 0.2, 0.3);

/// Steps of a shape that is made anew.
const CARVE: usize = 300;

/// Turns tried around what speed suggests, degrees.
const AROUND: [f64; 3] = [10.0, 20.0, 35.0];

/// Loss per radian of these, which prefers small ones.
const TURN_COST: f64 = 0.01;

/// Turns kept of those tried.
const KEPT: usize = 3;

/// Visible share below which a pose is taken from its neighbours.
const UNSEEN: f64 = 0.1;

/// Visible share from which turns are tried.
const SEEN: f64 = 0.3;

/// Finds poses of further times, nearest to `reference` first, which has one, as others may; `path` says where the
/// object is.
///
/// # Errors
/// [`TrainError::Stopped`] when the run is to stop.
pub(super) fn follow(
    fit: &mut Fit<'_>,
    reference: usize,
    path: &BTreeMap<usize, DVec3>,
    views: &[usize],
    phases: &Phases,
) -> Result<(), TrainError> {
    let levels = fit.levels();
    let mut at: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for view in views {
        at.entry(fit.views[*view].time_index).or_default().push(*view);
    }
    let Some(first) = at.get(&reference).cloned() else { return Ok(()) };
    let mut order: Vec<usize> =
        at.keys().copied().filter(|t| !fit.poses.contains_key(t) && path.contains_key(t)).collect();
    let starts: Vec<usize> = fit.poses.keys().copied().collect();
    let start = |time: usize| nearest(starts.iter().copied(), time).unwrap_or(reference);
    order.sort_by_key(|time| time.abs_diff(start(*time)));
    if fit.poses.len() > 1 {
        let known: Vec<usize> = fit.poses.keys().flat_map(|time| at[time].iter().copied()).collect();
        // What is at rest does not move at all.
        let pose_rate = if fit.outline.is_surrounded { 1.0 } else { 0.0 };
        let level = fit.trial_level();
        fit.steps(&known, BEGIN, |share| (if share < 0.5 { 1.0 } else { 0.5 }, pose_rate, level));
    } else {
        for level in levels {
            for step in 0..FIRST {
                fit.step(first[step % first.len()], *level, Some(1.0), 0.0);
            }
        }
    }
    for time in order {
        phases.check()?;
        let views = &at[&time];
        let pose = found(fit, time, path, views, start(time));
        fit.poses.insert(time, pose);
        let mut near: Vec<usize> = fit.poses.keys().copied().collect();
        if near.len().is_power_of_two() && near.len() > 2 {
            carve(fit, &at, CARVE, SETTLE.2);
        }
        near.sort_by_key(|other| other.abs_diff(time));
        for _ in 0..SETTLE.0 {
            let among = if fit.rng.random::<f64>() < 0.5 { near.len().min(5) } else { near.len() };
            let views = &at[&near[fit.rng.random_range(0..among)]];
            let view = views[fit.rng.random_range(0..views.len())];
            let level = usize::from(levels.len() > 1 && fit.rng.random::<f64>() < 0.3);
            fit.step(view, level, Some(SETTLE.1), SETTLE.2);
        }
    }
    Ok(())
}

/// The one of some times, in their order, that is nearest to another.
pub(super) fn nearest(times: impl Iterator<Item = usize>, to: usize) -> Option<usize> {
    times.min_by_key(|time| time.abs_diff(to))
}

/// Makes the shape anew from all times that are known, and fits it in so many steps, poses at a rate: what few views
/// show of its far side is a guess.
fn carve(fit: &mut Fit<'_>, at: &BTreeMap<usize, Vec<usize>>, steps: usize, pose_rate: f64) {
    let count = fit.shape.gaussians().len();
    let upright = fit.outline.upright(fit.plane.as_ref());
    let bound: Option<&dyn Fn(DVec3) -> bool> = if fit.outline.is_surrounded { None } else { Some(&upright) };
    let hull = hull(fit.views, &fit.poses, fit.outline.size(), bound, count, &mut fit.rng);
    let Some(shape) = hull.and_then(|hull| hull.shape(fit.near, fit.shape.phases())) else { return };
    fit.shape = shape;
    let known: Vec<usize> = fit.poses.keys().flat_map(|time| at[time].iter().copied()).collect();
    let level = fit.trial_level();
    fit.steps(&known, steps, |share| (if share < 0.5 { 1.0 } else { 0.5 }, pose_rate, level));
}

/// Pose of a time next to those that are known, of which those on the side of `origin` show how it moves.
fn found(fit: &Fit<'_>, time: usize, path: &BTreeMap<usize, DVec3>, views: &[usize], origin: usize) -> Pose {
    let levels = fit.levels();
    let mut known: Vec<usize> =
        fit.poses.keys().copied().filter(|t| (*t < time) == (origin < time) || *t == origin).collect();
    known.sort_by_key(|other| other.abs_diff(time));
    let near = known[0];
    let last = fit.poses[&near];
    let ahead = time as f64 - near as f64;
    let shift = match (path.get(&time), path.get(&near)) {
        (Some(to), Some(from)) => *to - *from,
        _ => DVec3::ZERO,
    };
    let mut turns = vec![DVec3::ZERO];
    let mut places = vec![last.translation + shift];
    if let Some(before) = known.get(1) {
        let share = ahead / (near as f64 - *before as f64);
        let before = fit.poses[before];
        turns.push(share * log(last.rotation * before.rotation.inverse()));
        if views.iter().all(|view| fit.views[*view].cut) {
            // The middle of a mask that the border cuts is not that of the object.
            places.insert(0, last.translation + share * (last.translation - before.translation));
        }
    }
    if let [view] = views {
        // Seen by one camera: as far away as before, where its mask is now.
        let view = &fit.views[*view];
        if let Some((_, depth)) = view.camera.project(last.translation) {
            let middle = view.camera.centre() + depth * view.camera.ray(view.centroid);
            places.push(middle);
        }
    }
    let normal = fit.plane.map(|plane| plane.normal);
    if let Some(normal) = normal {
        turns.push(normal.cross(shift) / fit.outline.height.max(1e-9));
    }
    let visible = views.iter().map(|view| fit.views[*view].visible).fold(0.0, f64::max);
    let posed = |(turn, place): (DVec3, DVec3)| Pose {
        rotation: (DQuat::from_scaled_axis(turn) * last.rotation).normalize(),
        translation: place,
    };
    if visible < UNSEEN {
        return posed((turns.get(1).copied().unwrap_or_default(), places[0]));
    }
    let judge = |candidates: Vec<((DVec3, DVec3), f64)>| {
        let level = levels[0];
        let judged = candidates.into_par_iter().map_init(
            || fit.shape.copied(),
            |shape, (at, cost)| {
                let of = |view: &usize| fit.loss_with(shape, *view, level, &posed(at));
                (views.iter().map(of).sum::<f64>() / views.len() as f64 + cost, at)
            },
        );
        let mut judged: Vec<(f64, (DVec3, DVec3))> = judged.collect();
        judged.sort_by(|a, b| a.0.total_cmp(&b.0));
        judged
    };
    let both = |turn: &DVec3| places.iter().map(|place| ((*turn, *place), 0.0)).collect::<Vec<_>>();
    let plain = judge(turns.iter().flat_map(both).collect());
    let mut tried: Vec<(DVec3, DVec3)> = plain.iter().take(2).map(|(_, at)| *at).collect();
    if visible > SEEN {
        let place = tried[0].1;
        let up = normal.unwrap_or(DVec3::Z);
        let across = up.any_orthonormal_vector();
        let axes = [up, across, up.cross(across)];
        let around = AROUND.iter().flat_map(|degrees| {
            axes.iter().flat_map(move |axis| [1.0, -1.0].map(|sign| sign * degrees.to_radians() * *axis))
        });
        let candidates = around.flat_map(|more| {
            let turned = |turn: &DVec3| log(DQuat::from_scaled_axis(more) * DQuat::from_scaled_axis(*turn));
            turns.iter().map(|turn| ((turned(turn), place), TURN_COST * more.length())).collect::<Vec<_>>()
        });
        tried.extend(judge(candidates.collect()).iter().take(KEPT).map(|(_, at)| *at));
    }
    let steps = if known.len() > 1 { POSE } else { 2 * POSE };
    let mut refined: Vec<(f64, MovingPose)> =
        tried.into_iter().map(|at| (0.0, MovingPose::from(posed(at)))).collect();
    for level in levels {
        let rate = if *level > 0 || levels.len() == 1 { 1.0 } else { 0.5 };
        let moved = refined.into_par_iter().map_init(
            || fit.shape.copied(),
            |shape, (_, mut moving)| {
                for step in 0..steps {
                    let view = views[step % views.len()];
                    fit.pose_step(shape, view, *level, &mut moving, rate);
                }
                let loss = views.iter().map(|view| fit.loss_with(shape, *view, *level, &moving.pose)).sum();
                (loss, moving)
            },
        );
        refined = moved.collect();
        refined.sort_by(|a, b| a.0.total_cmp(&b.0));
        // A few pixels show which are worth more of them.
        refined.truncate(refined.len().div_ceil(2));
    }
    refined.first().map_or(last, |(_, moving)| moving.pose)
}
