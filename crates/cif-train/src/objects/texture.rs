//! Turns of an object about the upright axis, as several cameras see it, read from its texture: solids of revolution, whose
//! outline is the same from all sides, show them by nothing else. The surface is unrolled from a cylinder at every time;
//! what stays in place between times is light, and what moves around shows the turn.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::outline::Outline;
use super::view::ObjectView;

/// Places around and along the axis at which the surface is looked at.
const AROUND: usize = 72;
const ALONG: usize = 12;

/// Share of radius and half height of the cylinder that is looked at, so that it lies inside the outline.
const INSIDE: [f64; 2] = [0.85, 0.9];

/// Cosine of the angle to the surface from which a place is looked at.
const FACING: f64 = 0.3;

/// Places on either side whose mean brightness is taken away, which shading has too.
const NEIGHBOURS: usize = 9;

/// Largest turn from one time to the next, degrees, and the difference of total turns, degrees, between those tried.
const FASTEST: f64 = 40.0;
const APART: f64 = 10.0;

/// Total turn, degrees, from which the texture has been seen elsewhere than at the start.
const SMALLEST: f64 = 60.0;

/// Share of the brightness that the turn must explain, and the difference of total turns, degrees, from which another
/// is a rival.
const EXPLAINED: f64 = 0.2;
const RIVAL: f64 = 120.0;

/// How many times what the middle of all turns explains, and the best rival, the turn must.
const ABOVE_CHANCE: f64 = 3.0;
const ABOVE_RIVAL: f64 = 1.5;

/// Root mean square of the texture, relative to its brightness, below which it may be noise.
const FAINT: f64 = 0.02;

/// Turns around what a constant rate gives that are tried at each time, places around, and rounds of that.
const REFINED: (i64, usize) = (3, 3);

/// Fewest times that are compared.
pub(super) const FEWEST: usize = 8;

/// Brightness of the unrolled surface at one time, and its weight where it was seen.
struct Surface {
    values: Vec<f64>,
    weights: Vec<f64>,
}

/// The cylinder whose surface is looked at, at one time.
struct Cylinder {
    centre: DVec3,
    /// Unit vectors along its axis, and across it, from which angles are counted.
    axis: DVec3,
    across: DVec3,
    radius: f64,
    half_length: f64,
}

/// Views by time.
type Views<'a> = BTreeMap<usize, Vec<&'a ObjectView>>;

/// Rotations about `up` by time that explain how the texture goes around; `None` where it does not show them. `path`
/// is that of the centre.
pub(super) fn turns<'a>(
    views: impl Iterator<Item = &'a ObjectView>,
    path: &BTreeMap<usize, DVec3>,
    outline: &Outline,
    up: DVec3,
) -> Option<BTreeMap<usize, DQuat>> {
    let at = by_time(views, |time| path.contains_key(&time))?;
    // One camera shows too little of the surface at a time to distinguish a turn from a roll.
    if at.values().any(|views| views.len() < 2) {
        return None;
    }
    let cylinder = |time: &usize| Cylinder {
        centre: path[time],
        axis: up,
        across: up.any_orthonormal_vector(),
        radius: outline.radius,
        half_length: outline.height,
    };
    let (first, last) = (*at.keys().next()?, *at.keys().next_back()?);
    let shares: Vec<f64> = at.keys().map(|time| (time - first) as f64 / (last - first) as f64).collect();
    let surfaces = unrolled(&at, cylinder);
    let found = best_turns(&surfaces, &shares, FASTEST * (last - first) as f64)?;
    Some(at.keys().zip(found).map(|(time, turn)| (*time, DQuat::from_scaled_axis(turn * up))).collect())
}

/// Views by time, where there are enough.
fn by_time<'a>(
    views: impl Iterator<Item = &'a ObjectView>,
    is_needed: impl Fn(usize) -> bool,
) -> Option<Views<'a>> {
    let mut at = Views::new();
    for view in views.filter(|view| is_needed(view.time_index)) {
        at.entry(view.time_index).or_default().push(view);
    }
    (at.len() >= FEWEST).then_some(at)
}

/// Surfaces by time, without what is light.
fn unrolled(at: &Views<'_>, cylinder: impl Fn(&usize) -> Cylinder + Sync) -> Vec<Surface> {
    let unrolled = |(time, views): (&usize, &Vec<&ObjectView>)| unroll(views, &cylinder(time));
    let mut surfaces: Vec<Surface> = at.par_iter().map(unrolled).collect();
    take_light_away(&mut surfaces);
    surfaces
}

/// Turns of surfaces, radians, by the total turn, at most `most` degrees either way, that explains them best when they turn
/// by shares of it; `None` where the texture does not show them.
fn best_turns(surfaces: &[Surface], shares: &[f64], most: f64) -> Option<Vec<f64>> {
    let places = |total: f64| -> Vec<f64> {
        shares.iter().map(|share| share * total / 360.0 * AROUND as f64).collect()
    };
    let count = (most / APART) as i64;
    let totals: Vec<f64> = (-count..=count).map(|k| k as f64 * APART).collect();
    let scores: Vec<f64> = totals.par_iter().map(|total| explained(surfaces, &places(*total))).collect();
    let best = (0..totals.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]))?;
    let mut sorted = scores.clone();
    sorted.sort_by(f64::total_cmp);
    let chance = sorted[sorted.len() / 2];
    let is_rival = |k: &usize| (totals[*k] - totals[best]).abs() > RIVAL;
    let rival = (0..totals.len()).filter(is_rival).map(|k| scores[k]).fold(0.0, f64::max);
    let is_clear = scores[best] > EXPLAINED.max(ABOVE_CHANCE * chance).max(ABOVE_RIVAL * rival);
    let seen: f64 = surfaces.iter().flat_map(|surface| &surface.weights).sum();
    let strength = (scores[best] * surfaces.iter().map(power).sum::<f64>() / seen.max(1e-9)).sqrt();
    if !is_clear || strength < FAINT || totals[best].abs() < SMALLEST {
        return None;
    }
    let found = refined(surfaces, places(totals[best]));
    Some(found.iter().map(|place| place / AROUND as f64 * TAU).collect())
}

/// The surface of a cylinder, as views of one time show it.
fn unroll(views: &[&ObjectView], cylinder: &Cylinder) -> Surface {
    let Cylinder { centre, axis, across, radius, half_length } = *cylinder;
    let perpendicular = axis.cross(across);
    let mut surface = Surface { values: vec![0.0; AROUND * ALONG], weights: vec![0.0; AROUND * ALONG] };
    for place in 0..AROUND * ALONG {
        let angle = ((place / ALONG) as f64 + 0.5) / AROUND as f64 * TAU;
        let share = ((place % ALONG) as f64 + 0.5) / ALONG as f64 * 2.0 - 1.0;
        let outward = angle.cos() * across + angle.sin() * perpendicular;
        let point = centre + INSIDE[0] * radius * outward + INSIDE[1] * share * half_length * axis;
        let mut sum = 0.0;
        for view in views {
            let facing = outward.dot((view.camera.centre() - point).normalize_or_zero());
            if facing < FACING {
                continue;
            }
            let Some(brightness) = brightness(view, point) else { continue };
            sum += facing * brightness;
            surface.weights[place] += facing;
        }
        surface.values[place] = sum / surface.weights[place].max(1e-9);
    }
    surface
}

/// Logarithm of the brightness at a point, between the nearest pixels; `None` where one of them is not the object's.
fn brightness(view: &ObjectView, point: DVec3) -> Option<f64> {
    let crop = &view.crops[0];
    let (pixel, _) = crop.camera.project(point)?;
    let corner = pixel - 0.5;
    let (first, share) = (corner.floor(), corner - corner.floor());
    if first.min_element() < 0.0 {
        return None;
    }
    let (x, y) = (first.x as u32, first.y as u32);
    if x + 1 >= crop.camera.width || y + 1 >= crop.camera.height {
        return None;
    }
    let mut sum = 0.0;
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let pixel = ((y + dy) * crop.camera.width + x + dx) as usize;
        if crop.mask[pixel] < 0.5 {
            return None;
        }
        let weight =
            (if dx == 1 { share.x } else { 1.0 - share.x }) * (if dy == 1 { share.y } else { 1.0 - share.y });
        sum += weight * f64::from(crop.colors[pixel].iter().sum::<f32>() / 3.0);
    }
    Some((sum + 0.02).ln())
}

/// Takes away what shading and highlights do: what changes slowly around the axis, and what stays where it is.
fn take_light_away(surfaces: &mut [Surface]) {
    for surface in surfaces.iter_mut() {
        let smooth = |place: usize| {
            let (around, along) = (place / ALONG, place % ALONG);
            let near =
                (0..=2 * NEIGHBOURS).map(|k| (around + AROUND + k - NEIGHBOURS) % AROUND * ALONG + along);
            let (sum, total) = near.fold((0.0, 0.0), |(sum, total), other| {
                let weight = surface.weights[other];
                (sum + weight * surface.values[other], total + weight)
            });
            sum / total.max(1e-9)
        };
        let means: Vec<f64> = (0..AROUND * ALONG).map(smooth).collect();
        surface.values.iter_mut().zip(means).for_each(|(value, mean)| *value -= mean);
    }
    for place in 0..AROUND * ALONG {
        let (sum, total) = surfaces.iter().fold((0.0, 0.0), |(sum, total), surface| {
            (sum + surface.weights[place] * surface.values[place], total + surface.weights[place])
        });
        surfaces.iter_mut().for_each(|surface| surface.values[place] -= sum / total.max(1e-9));
    }
}

/// Mean of surfaces turned back by so many places, and its weights.
fn turned_back<'a>(surfaces: impl Iterator<Item = (&'a Surface, f64)>) -> Surface {
    let mut mean = Surface { values: vec![0.0; AROUND * ALONG], weights: vec![0.0; AROUND * ALONG] };
    for (surface, turn) in surfaces {
        let back = turned(turn);
        for place in 0..AROUND * ALONG {
            let from = (place + back * ALONG) % (AROUND * ALONG);
            mean.values[place] += surface.weights[from] * surface.values[from];
            mean.weights[place] += surface.weights[from];
        }
    }
    mean.values.iter_mut().zip(&mean.weights).for_each(|(value, weight)| *value /= weight.max(1e-9));
    mean
}

/// Whole places around of a turn.
fn turned(turn: f64) -> usize {
    (turn.round() as i64).rem_euclid(AROUND as i64) as usize
}

/// Share of the squared brightness that one texture explains which turns by so many places at each time.
fn explained(surfaces: &[Surface], turns: &[f64]) -> f64 {
    let mean = turned_back(surfaces.iter().zip(turns.iter().copied()));
    power(&mean) / surfaces.iter().map(power).sum::<f64>().max(1e-12)
}

/// Sum of squared brightness, by weight.
fn power(surface: &Surface) -> f64 {
    surface.values.iter().zip(&surface.weights).map(|(value, weight)| weight * value * value).sum()
}

/// Turns at which each surface agrees best with those of the other times.
fn refined(surfaces: &[Surface], mut turns: Vec<f64>) -> Vec<f64> {
    for _ in 0..REFINED.1 {
        for time in 0..surfaces.len() {
            let others = (0..surfaces.len()).filter(|other| *other != time);
            let model = turned_back(others.map(|other| (&surfaces[other], turns[other])));
            let agreement = |shift: &i64| -> f64 {
                let back = turned(turns[time] + *shift as f64);
                let of = |place: usize| {
                    let from = (place + back * ALONG) % (AROUND * ALONG);
                    let surface = &surfaces[time];
                    surface.weights[from] * surface.values[from] * model.values[place]
                };
                (0..AROUND * ALONG).map(of).sum()
            };
            let shifts = -REFINED.0..=REFINED.0;
            let best = shifts.max_by(|a, b| {
                // The nearest of equals.
                agreement(a).total_cmp(&agreement(b)).then(b.abs().cmp(&a.abs()))
            });
            turns[time] += best.unwrap_or(0) as f64;
        }
    }
    turns
}
