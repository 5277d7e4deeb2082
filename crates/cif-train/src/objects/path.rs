//! The path of an object's centre: smoothed, or found where the rays of one camera cross that sees it from other sides
//! soon after.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector};

use super::outline::Outline;
use super::view::{ObjectView, WITHIN, are_discs, median};

/// Weights of squared second differences, in steps of a 60th of the sequence: of paths that a plane cuts from rays,
/// of those where the rays of several cameras meet, and of those where the rays of neighbouring times cross.
pub(super) const CUT_BY_PLANE: f64 = 20.0;
pub(super) const MEETING: f64 = 0.3;
pub(super) const CROSSING: f64 = 0.01;

/// Weight of a time whose masks are all cut by the border.
pub(super) const CUT: f64 = 0.05;

/// Distance of a place from between those before and after, in sizes and in median ones, from which it is aside, and the
/// largest share of such places.
const ASIDE: f64 = 1.0;
const OF_MEDIAN: f64 = 5.0;
const ASIDE_SHARE: f64 = 0.2;

/// Times on either side among which rays cross, and the angle from which they do, radians.
const NEIGHBOURS: usize = 2;
const CROSSES: f64 = 0.7;

/// Distance of a ray from the path, in reaches of its mask, from which this shows something else.
const ELSEWHERE: f64 = 2.0;

/// Times on either side of one that show where it belongs.
const LED_BY: usize = 6;

/// Rounds of reweighting of rays, by their distances from the path.
const ROUNDS: usize = 5;

/// The same of what bounces, the rounds of these in which all rays are sure, and times at the ends that stay as they are.
const BOUNCING: (usize, usize, usize) = (8, 3, 3);

/// Second difference, in middles of these, from which a path bends as where something bounces, and its least stiffness
/// there, of that elsewhere.
const KINK: f64 = 4.0;
const LOOSE: f64 = 0.05;

/// The path that stays near `raw` where the object is well seen, and bends little, by its stiffness; `times` of the
/// whole sequence. Of an object that one camera sees stay on its support it passes by places that are far aside of those
/// before and after them, where a mask shows something else as well.
pub(super) fn smooth(
    raw: &BTreeMap<usize, DVec3>,
    views: &[ObjectView],
    times: usize,
    outline: &Outline,
) -> BTreeMap<usize, DVec3> {
    let keys: Vec<usize> = raw.keys().copied().collect();
    if keys.len() < 3 {
        return raw.clone();
    }
    // Where the rays of several cameras meet it is, however far it jumps.
    let may_be_wrong = outline.air.is_empty() && outline.stiffness != MEETING;
    let aside = if may_be_wrong { places_aside(raw, outline.size()) } else { BTreeSet::new() };
    let near = |time: &usize| {
        let of = || views.iter().filter(|view| view.time_index == *time);
        let seen = of().map(|view| view.visible).fold(0.0, f64::max);
        let cut = if of().all(|view| view.cut) { CUT } else { 1.0 };
        let weight = if aside.contains(time) { 0.0 } else { seen * seen * cut } + 1e-4;
        (DMat3::IDENTITY * weight, weight * raw[time])
    };
    let near: Vec<(DMat3, DVec3)> = keys.iter().map(near).collect();
    even(&keys, &near, &vec![outline.stiffness; keys.len()], times).unwrap_or_else(|| raw.clone())
}

/// Parts of a path that lie far from where their neighbours lead, which `missed` gives for one of those that are left: by
/// what distance, and what is far; `None` where nothing leads.
fn aside<T>(mut kept: Vec<T>, missed: impl Fn(&[T], usize) -> Option<(f64, f64)>) -> Vec<T> {
    let most = (ASIDE_SHARE * kept.len() as f64) as usize;
    let mut found = Vec::new();
    while found.len() < most && kept.len() > 3 {
        let missed: Vec<Option<(f64, f64)>> = (0..kept.len()).map(|k| missed(&kept, k)).collect();
        let middle =
            |of: fn(&(f64, f64)) -> f64| median(&mut missed.iter().flatten().map(of).collect::<Vec<_>>());
        let far = middle(|missed| missed.1).max(OF_MEDIAN * middle(|missed| missed.0));
        let distance = |k: &usize| missed[*k].map_or(0.0, |(distance, _)| distance);
        let largest = (0..kept.len()).max_by(|a, b| distance(a).total_cmp(&distance(b)));
        let Some(k) = largest.filter(|k| distance(k) > far) else { break };
        found.push(kept.remove(k));
    }
    found
}

/// Times at which a path of an object of this size jumps aside, and back.
fn places_aside(raw: &BTreeMap<usize, DVec3>, size: f64) -> BTreeSet<usize> {
    // From between its neighbours; at the ends from where the next two lead.
    let jump = |kept: &[usize], k: usize| {
        let last = kept.len() - 1;
        let [a, b] = if k == 0 {
            [1, 2]
        } else if k == last {
            [last - 1, last - 2]
        } else {
            [k - 1, k + 1]
        };
        let [time, a, b] = [k, a, b].map(|k| kept[k]);
        let share = (time as f64 - a as f64) / (b as f64 - a as f64);
        Some(((raw[&time] - raw[&a].lerp(raw[&b], share)).length(), ASIDE * size))
    };
    aside(raw.keys().copied().collect(), jump).into_iter().collect()
}

/// The path that passes near the rays of one view per time and bends little; nothing where neighbouring rays hardly
/// cross. Rays far from it count less: what hides a part of an object moves the middle of its mask.
pub(super) fn crossing(views: &[ObjectView], times: usize) -> BTreeMap<usize, DVec3> {
    // Balls bounce.
    let bounces = are_discs(views.iter().filter(|view| !view.cut));
    along_rays(views, times, bounces)
}

/// The same, where it is known whether it bounces: the middle of its masks is then sure, so that a path that bends
/// somewhere is found before rays are taken to be off it. Nothing else shows where its ends are.
fn along_rays(views: &[ObjectView], times: usize, bounces: bool) -> BTreeMap<usize, DVec3> {
    let mut views: Vec<&ObjectView> = views.iter().filter(|view| !view.cut).collect();
    let rays: Vec<DVec3> = views.iter().map(|view| view.ray().direction).collect();
    let widest = |k: usize| {
        let near = k.saturating_sub(NEIGHBOURS)..=(k + NEIGHBOURS).min(rays.len() - 1);
        near.map(|other| rays[k].angle_between(rays[other])).fold(0.0, f64::max)
    };
    let mut angles: Vec<f64> = (0..rays.len()).map(widest).collect();
    let is_one_camera = views.windows(2).all(|pair| pair[0].time_index != pair[1].time_index);
    if !is_one_camera || median(&mut angles) < CROSSES {
        return BTreeMap::new();
    }
    // Masks that show something else as well, or something else.
    let wrong = aside(views.clone(), |kept, k| missed(kept, k, times));
    views.retain(|view| !wrong.iter().any(|wrong| wrong.time_index == view.time_index));
    let keys: Vec<usize> = views.iter().map(|view| view.time_index).collect();
    if keys.len() < 3 {
        return BTreeMap::new();
    }
    let mut weights: Vec<f64> = views.iter().map(|view| weight(view)).collect();
    let mut stiffness = vec![CROSSING; keys.len()];
    let (rounds, sure, ends) = if bounces { BOUNCING } else { (ROUNDS, 0, 0) };
    let inner = ends..keys.len().saturating_sub(ends);
    let mut path = BTreeMap::new();
    for round in 0..rounds {
        let near: Vec<(DMat3, DVec3)> =
            views.iter().zip(&weights).map(|(view, weight)| ray(view, *weight)).collect();
        let Some(found) = even(&keys, &near, &stiffness, times) else { return BTreeMap::new() };
        let distances: Vec<f64> =
            views.iter().map(|view| view.ray().distance(found[&view.time_index])).collect();
        let large = 2.0 * median(&mut distances.clone());
        for k in inner.clone().filter(|_| round >= sure) {
            weights[k] = weight(views[k]) / (1.0 + (distances[k] / large.max(1e-12)).powi(2));
        }
        if bounces {
            let bends: Vec<f64> = (0..keys.len()).map(|k| bend(&keys, &found, k).length()).collect();
            let large = KINK * median(&mut bends.clone());
            for k in inner.clone() {
                stiffness[k] = CROSSING * (1.0 / (1.0 + (bends[k] / large.max(1e-12)).powi(2))).max(LOOSE);
            }
        }
        path = found;
    }
    path
}

/// Distance of the ray of a view from the path of those around it, of those that typical gaps between them leave open, and
/// that at which its mask shows something else; `None` near the ends, and where these do not show it.
fn missed(views: &[&ObjectView], at: usize, times: usize) -> Option<(f64, f64)> {
    if at < NEIGHBOURS || at + NEIGHBOURS >= views.len() {
        return None;
    }
    let near = at.saturating_sub(LED_BY)..(at + LED_BY + 1).min(views.len());
    let time = |k: usize| views[k].time_index as f64;
    let mean_gap = (time(views.len() - 1) - time(0)) / (views.len() - 1) as f64;
    let gap = ((time(at + 1) - time(at - 1)) / (2.0 * mean_gap)).max(1.0);
    let keys: Vec<usize> = views[near.clone()].iter().map(|view| view.time_index).collect();
    let of = |k: usize| ray(views[k], if k == at { 0.0 } else { weight(views[k]) });
    let rays: Vec<(DMat3, DVec3)> = near.map(of).collect();
    let place = even(&keys, &rays, &vec![CROSSING; keys.len()], times)?[&views[at].time_index];
    let (view, camera) = (views[at], &views[at].camera);
    let depth = camera.project(place)?.1;
    Some((
        view.ray().distance(place) / gap.powi(2),
        ELSEWHERE * view.reach(WITHIN) * depth / camera.focal_px.x,
    ))
}

/// The ray of a view with a weight, as [`even`] takes what is near.
fn ray(view: &ObjectView, weight: f64) -> (DMat3, DVec3) {
    let ray = view.ray();
    let across = weight * ray.across();
    (across, across * ray.origin)
}

/// Weight of a ray by the visible share of its view.
fn weight(view: &ObjectView) -> f64 {
    view.visible.powi(2) + 1e-4
}

/// The path of least bending near some places: minimises `(c - c0) . A (c - c0)`, given as `A` and `A c0` for every
/// time, and the squared second differences; `None` where nothing determines it.
fn even(
    keys: &[usize],
    near: &[(DMat3, DVec3)],
    stiffness: &[f64],
    times: usize,
) -> Option<BTreeMap<usize, DVec3>> {
    let n = keys.len();
    let mut matrix = DMatrix::<f64>::zeros(3 * n, 3 * n);
    let mut target = DVector::<f64>::zeros(3 * n);
    for (k, (weight, place)) in near.iter().enumerate() {
        for i in 0..3 {
            target[3 * k + i] = place[i];
            (0..3).for_each(|j| matrix[(3 * k + i, 3 * k + j)] += weight.col(j)[i]);
        }
    }
    let scale = (times as f64 / 60.0).powi(4);
    for k in 1..n - 1 {
        let stiffness = stiffness[k] * scale;
        let row = second_difference(keys, k);
        for (i, a) in row {
            for (j, b) in row {
                (0..3).for_each(|axis| matrix[(3 * i + axis, 3 * j + axis)] += stiffness * a * b);
            }
        }
    }
    let solved = matrix.cholesky()?.solve(&target);
    let place = |k: usize| DVec3::new(solved[3 * k], solved[3 * k + 1], solved[3 * k + 2]);
    Some(keys.iter().enumerate().map(|(k, time)| (*time, place(k))).collect())
}

/// Places and factors of the second difference of a path at one of its times, which is not the first or the last.
fn second_difference(keys: &[usize], k: usize) -> [(usize, f64); 3] {
    let (before, after) = ((keys[k] - keys[k - 1]) as f64, (keys[k + 1] - keys[k]) as f64);
    let scale = 2.0 / (before + after);
    [(k - 1, scale / before), (k, -scale * (1.0 / before + 1.0 / after)), (k + 1, scale / after)]
}

/// Second difference of a path at one of its times; zero at the first and the last.
fn bend(keys: &[usize], path: &BTreeMap<usize, DVec3>, k: usize) -> DVec3 {
    if k == 0 || k + 1 == keys.len() {
        return DVec3::ZERO;
    }
    second_difference(keys, k).iter().map(|(k, factor)| *factor * path[&keys[*k]]).sum()
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2};

    use super::super::testing::{TIMES, jumping, rig, solid, sphere_places, views};
    use super::*;

    #[test]
    fn places_aside_of_a_path_are_passed_by() {
        let straight = |time: usize| (time, DVec3::new(0.02 * time as f64, 0.1, 0.0));
        let bends = |time: usize| (time, DVec3::new((0.3 * time as f64).sin(), 0.1, 0.0));
        for wrong in [0, 7, 19] {
            let mut path: BTreeMap<usize, DVec3> = (0..20).map(straight).collect();
            assert!(places_aside(&path, 0.05).is_empty());
            path.insert(wrong, DVec3::new(0.02 * wrong as f64, -0.2, 0.0));
            assert_eq!(places_aside(&path, 0.05), BTreeSet::from([wrong]));
        }
        // Fast, but not aside.
        assert!(places_aside(&(0..20).map(bends).collect(), 0.05).is_empty());
    }

    #[test]
    fn where_several_rays_meet_nothing_is_aside() {
        // At rest, but for one bounce; a camera is cut by its border.
        let up = |time: usize| if time == 12 { 0.2 } else { 0.05 };
        let truth: Vec<(DQuat, DVec3)> =
            (0..TIMES).map(|time| (DQuat::IDENTITY, DVec3::new(0.0, 0.0, up(time)))).collect();
        let mut views = views(solid(&sphere_places(0.05), |_| [0.8, 0.5, 0.2], 0.006), &truth, rig);
        views.iter_mut().step_by(5).for_each(|view| view.cut = true);
        let outline = super::super::outlines::outlines(&views, None, TIMES).remove(0);
        let path = smooth(&outline.path, &views, TIMES, &outline);
        assert!((path[&12] - truth[12].1).length() < 0.03, "{:?}", path[&12]);
    }

    /// Place of a ball that bounces.
    fn place(time: usize) -> DVec3 {
        let share = (time % 15) as f64 / 15.0;
        DVec3::new(0.01 * time as f64 - 0.15, 0.0, 0.05 + 0.6 * share * (1.0 - share))
    }

    fn bouncing() -> Vec<ObjectView> {
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
        views(solid(&sphere_places(0.05), |_| [0.8, 0.5, 0.2], 0.006), &truth, jumping)
    }

    #[test]
    fn masks_that_show_something_else_do_not_bend_a_path() {
        let mut views = bouncing();
        let error = |path: &BTreeMap<usize, DVec3>| {
            path.iter().map(|(time, found)| (*found - place(*time)).length()).fold(0.0, f64::max)
        };
        let clean = crossing(&views, TIMES);
        assert_eq!(clean.len(), TIMES, "bounces are not aside");
        for (time, shift) in [(4, [70.0, 5.0]), (5, [55.0, -50.0]), (21, [-40.0, 15.0])] {
            views[time].centroid += DVec2::from(shift);
        }
        let found = crossing(&views, TIMES);
        assert!([4, 5, 21].iter().all(|time| !found.contains_key(time)) && found.len() == TIMES - 3);
        assert!(error(&found) < 1.2 * error(&clean), "{} m, {} m without", error(&found), error(&clean));
    }

    #[test]
    fn a_path_that_bounces_is_nearer_where_it_does() {
        let views = bouncing();
        let error = |path: &BTreeMap<usize, DVec3>| (path[&15] - place(15)).length();
        let [found, smooth] =
            [crossing(&views, TIMES), along_rays(&views, TIMES, false)].map(|path| error(&path));
        assert!(found < 0.75 * smooth, "{found} m, {smooth} m if it did not bounce");
    }
}
