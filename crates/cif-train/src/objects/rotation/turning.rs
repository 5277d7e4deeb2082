//! How a ball turns that stays in place, as a globe on its stand: its outline never changes, so that its paint alone
//! shows the turns. Every pixel shows a known place of it. Of axes all around, the turns about each are found under which
//! light that stays and paint that turns explain all times together; they are what the pictures show where these
//! explain pixels that were left out better than light alone does.

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

use glam::DVec3;
use rayon::prelude::*;

use super::super::sequence::{least, unwind};
use super::super::view::ObjectView;
use super::compare::{gains, standard_errors};
use super::evidence::Evidence;
use super::hull::Hit;
use super::judge::{APART, GRAZING, SIGMAS};
use super::layered::{Layers, Observation, layered};

/// Axes that are tried, about 23 degrees apart, and those that are tried further.
const AXES: usize = 40;
const TRIED: usize = 6;

/// Places of the sequence from which turns are followed.
const SEEDS: [f64; 5] = [1.0 / 6.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 5.0 / 6.0];

/// Pixels of a view that are looked at.
const PIXELS: usize = 400;

/// Rows of cells from pole to pole.
const ROWS: usize = 24;

/// Turns that are tried of every time, of a whole turn: at first, and at the end.
const TURNS: [usize; 2] = [72, 240];

/// Rounds in which the turns of all times are found by the paint of others: at first, of what is tried further, and of an
/// axis that is moved a little.
const ROUNDS: [usize; 3] = [2, 5, 3];

/// Parts of the times of which each is turned by the paint that the others show, and times in a row that belong together.
const PARTS: usize = 3;
const TOGETHER: usize = 2;

/// Sweeps of back-fitting of the layers.
const SWEEPS: usize = 4;

/// Cost of turning evenly by a radian over the whole sequence, summed over its times, of the error of a time with light
/// alone. Turning that far from one of 48 times to the next costs as much as what paint explains of half a time.
const UNEVEN: f64 = 0.0125;

/// Largest error of a pixel, of that with light alone: highlights and masks that are a little off.
const CAP: f64 = 4.0;

/// Fastest turn that is followed, radians per time, and differences that are tried.
const FASTEST: f64 = 0.8;
const STEP: f64 = 0.05;

/// Angles by which the axis is moved, radians.
const MOVED: [f64; 3] = [PI / 18.0, PI / 36.0, PI / 72.0];

/// A ball in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in super::super) struct Ball {
    pub(in super::super) centre: DVec3,
    pub(in super::super) radius: f64,
}

/// How a ball turns in place.
#[derive(Clone, Debug)]
pub(in super::super) struct Turning {
    /// Unit, in the world.
    pub(in super::super) axis: DVec3,
    /// Radians about it by time.
    pub(in super::super) angles: BTreeMap<usize, f64>,
    /// Mean residuals of pixels left out: with the turns, and by light alone.
    pub(in super::super) errors: [f64; 2],
}

/// The turns of a ball in place that its views (in the order of times) show; `None` where they show none of more than 30
/// degrees.
pub(in super::super) fn turning<'a>(
    views: impl Iterator<Item = &'a ObjectView>,
    ball: &Ball,
) -> Option<Turning> {
    let evidence = Evidence::of(views)?;
    let all = Seen::of(&evidence, ball, usize::MAX);
    let resting = Turned { axis: DVec3::Z, angles: vec![0.0; all.times.len()], cost: 0.0 };
    let still = all.residuals(&evidence, &resting, false);
    let error = mean(&still)?;
    let mut seen = Seen { error, ..Seen::of(&evidence, ball, PIXELS) };
    let alone = |spot: &Spot| f64::from(still[spot.pixel]);
    let known = |alone: f64| if alone.is_nan() { error } else { alone.min(CAP * error) };
    seen.alone = seen.spots.iter().map(alone).map(known).collect();
    let middle = seen.times.len() / 2;
    let rough = |axis: DVec3| seen.painted(axis).found(middle, ROUNDS[0]);
    let mut found: Vec<Turned> = hemisphere(AXES).into_par_iter().map(rough).collect();
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let further = |turned: Turned| {
        let painted = seen.painted(turned.axis);
        let seeds = SEEDS.map(|seed| (seen.times.len() as f64 * seed) as usize);
        let again = painted.improved(turned, ROUNDS[1], TURNS[0]);
        let found = seeds.into_par_iter().map(|seed| painted.found(seed, ROUNDS[1])).chain([again]);
        found.min_by(|a, b| a.cost.total_cmp(&b.cost))
    };
    let tried = found.into_par_iter().take(TRIED).filter_map(further);
    let best = tried.min_by(|a, b| a.cost.total_cmp(&b.cost))?;
    let best = seen.moved(best);
    let best = seen.painted(best.axis).improved(best, 1, TURNS[1]);
    let turned = all.residuals(&evidence, &best, true);
    let is_shown = standard_errors(&gains(&evidence, &turned, &still)) > SIGMAS && best.reach() > APART;
    let angles = all.times.iter().copied().zip(best.angles.iter().copied()).collect();
    is_shown.then_some(Turning { axis: best.axis, angles, errors: [mean(&turned)?, error] })
}

/// Directions of a half sphere, about equally far apart.
fn hemisphere(count: usize) -> Vec<DVec3> {
    let golden = PI * (1.0 + 5.0_f64.sqrt());
    let direction = |k: usize| {
        let place = k as f64 + 0.5;
        let z = place / count as f64;
        let (sine, cosine) = (golden * place).sin_cos();
        let across = (1.0 - z * z).sqrt();
        DVec3::new(across * cosine, across * sine, z)
    };
    (0..count).map(direction).collect()
}

/// Mean of what is predicted.
fn mean(residuals: &[f32]) -> Option<f64> {
    let known = || residuals.iter().filter(|residual| !residual.is_nan());
    let count = known().count();
    (count > 0).then(|| known().map(|residual| f64::from(*residual)).sum::<f64>() / count as f64)
}

/// A place of the ball that a pixel shows.
struct Spot {
    pixel: usize,
    look: usize,
    /// Unit, from the middle of the ball, in the world.
    outward: DVec3,
    value: DVec3,
}

/// Places of the ball that views show.
struct Seen {
    spots: Vec<Spot>,
    /// Ranges of the spots of views, the places of their times, and these times.
    ranges: Vec<std::ops::Range<usize>>,
    time_of: Vec<usize>,
    times: Vec<usize>,
    /// Error of every spot with light alone, which is what paint that no other time shows predicts, and their mean.
    alone: Vec<f64>,
    error: f64,
}

/// Turns about an axis at all times, and what they cost.
#[derive(Clone)]
struct Turned {
    axis: DVec3,
    angles: Vec<f64>,
    cost: f64,
}

impl Turned {
    /// Difference of the largest and the least angle.
    fn reach(&self) -> f64 {
        let ends = |(low, high): (f64, f64), angle: &f64| (low.min(*angle), high.max(*angle));
        let (low, high) = self.angles.iter().fold((f64::INFINITY, f64::NEG_INFINITY), ends);
        high - low
    }
}

impl Seen {
    /// Places that at most so many pixels of each view show.
    fn of(evidence: &Evidence<'_>, ball: &Ball, most: usize) -> Self {
        let mut times: Vec<usize> = evidence.looks.iter().map(|look| look.view.time_index).collect();
        let time_of = |time: usize, times: &[usize]| times.binary_search(&time).unwrap_or(0);
        times.dedup();
        let mut seen = Self {
            spots: Vec::new(),
            ranges: Vec::new(),
            time_of: evidence.looks.iter().map(|look| time_of(look.view.time_index, &times)).collect(),
            times,
            alone: Vec::new(),
            error: 0.0,
        };
        let mut first = 0;
        for (look, shown) in evidence.looks.iter().enumerate() {
            let start = seen.spots.len();
            let origin = shown.view.camera.centre();
            let spot = |(k, pixel): (usize, &super::evidence::Pixel)| {
                let (outward, facing) = ball.outward(origin, pixel.ray.normalize())?;
                (facing > GRAZING).then_some(Spot { pixel: first + k, look, outward, value: pixel.value })
            };
            let found: Vec<Spot> = shown.pixels.iter().enumerate().filter_map(spot).collect();
            let step = found.len().div_ceil(most).max(1);
            seen.spots.extend(found.into_iter().step_by(step));
            seen.ranges.push(start..seen.spots.len());
            first += shown.pixels.len();
        }
        seen
    }

    /// Cost of turning by a radian from one time of the sequence to the next.
    fn uneven(&self) -> f64 {
        let length = self.times.last().zip(self.times.first()).map_or(0, |(last, first)| last - first);
        UNEVEN * length as f64 * self.error
    }

    /// The places by their cells about an axis.
    fn painted(&self, axis: DVec3) -> Painted<'_> {
        let (first, second) = axis.any_orthonormal_pair();
        let mut starts = vec![0; ROWS];
        let mut columns = vec![0.0; ROWS];
        let mut cells = 0;
        for row in 0..ROWS {
            let polar = PI * (row as f64 + 0.5) / ROWS as f64;
            columns[row] = (2.0 * ROWS as f64 * polar.sin()).round().max(1.0);
            starts[row] = cells;
            cells += columns[row] as usize;
        }
        let place = |spot: &Spot| {
            let polar = spot.outward.dot(axis).clamp(-1.0, 1.0).acos();
            let row = ((polar / PI * ROWS as f64) as usize).min(ROWS - 1);
            (row, spot.outward.dot(second).atan2(spot.outward.dot(first)))
        };
        Painted { seen: self, axis, places: self.spots.iter().map(place).collect(), starts, columns, cells }
    }

    /// Residuals of all pixels that are left out, by the layered model.
    fn residuals(&self, evidence: &Evidence<'_>, turned: &Turned, turns: bool) -> Vec<f32> {
        let painted = self.painted(turned.axis);
        let mut hits: Vec<Option<Hit>> = vec![None; evidence.len()];
        let mut light: Vec<Option<u32>> = vec![None; evidence.len()];
        for (k, spot) in self.spots.iter().enumerate() {
            let cell = painted.cell(k, turned.angles[self.time_of[spot.look]]) as u32;
            hits[spot.pixel] = Some(Hit { cell, normal: spot.outward, facing: 1.0 });
            light[spot.pixel] = Some(painted.cell(k, 0.0) as u32);
        }
        layered(evidence, (&hits, painted.cells), &(light, painted.cells), turns)
    }

    /// Turns about an axis near that of others, where they cost less.
    fn moved(&self, mut best: Turned) -> Turned {
        for angle in MOVED {
            loop {
                let (first, second) = best.axis.any_orthonormal_pair();
                let moved = |aside: DVec3| {
                    let axis = (best.axis + angle.tan() * aside).normalize();
                    self.painted(axis).improved(best.clone(), ROUNDS[2], TURNS[0])
                };
                let tried: Vec<Turned> =
                    [first, -first, second, -second].into_par_iter().map(moved).collect();
                match tried.into_iter().min_by(|a, b| a.cost.total_cmp(&b.cost)) {
                    Some(better) if better.cost < best.cost * (1.0 - 1e-3) => best = better,
                    _ => break,
                }
            }
        }
        best
    }
}

impl Ball {
    /// Unit vector from the middle to where a ray of unit length meets the ball, with the cosine at which it does; `None`
    /// where it passes by.
    pub(in super::super) fn outward(&self, origin: DVec3, ray: DVec3) -> Option<(DVec3, f64)> {
        let offset = origin - self.centre;
        let (along, beyond) = (offset.dot(ray), offset.length_squared() - self.radius * self.radius);
        let inside = along * along - beyond;
        if inside < 0.0 {
            return None;
        }
        let outward = (offset - (along + inside.sqrt()) * ray) / self.radius;
        Some((outward, -outward.dot(ray)))
    }
}

/// Places of the ball by their cells about an axis: rows from pole to pole, columns around.
struct Painted<'s> {
    seen: &'s Seen,
    axis: DVec3,
    /// Row and angle of every place.
    places: Vec<(usize, f64)>,
    /// First cell of every row, and its columns.
    starts: Vec<usize>,
    columns: Vec<f64>,
    cells: usize,
}

impl Painted<'_> {
    /// Cell of the ball that a place shows when it is turned by an angle.
    fn cell(&self, place: usize, turn: f64) -> usize {
        let (row, angle) = self.places[place];
        let share = (angle - turn) / TAU;
        let columns = self.columns[row];
        self.starts[row] + ((share - share.floor()) * columns).min(columns - 1.0) as usize
    }

    /// Turns that are followed from a time in both directions, by the paint that was met on the way, and then improved.
    fn found(&self, from: usize, rounds: usize) -> Turned {
        let seen = self.seen;
        let count = seen.times.len();
        let mut paint = vec![(DVec3::ZERO, 0.0); self.cells];
        let mut angles = vec![0.0; count];
        let looks_at = |time: usize| (0..seen.ranges.len()).filter(move |look| seen.time_of[*look] == time);
        let gain = |look: usize| {
            let spots = &seen.spots[seen.ranges[look].clone()];
            spots.iter().map(|spot| spot.value).sum::<DVec3>() / spots.len().max(1) as f64
        };
        let gains: Vec<DVec3> = (0..seen.ranges.len()).map(gain).collect();
        let met = |time: usize, angle: f64, paint: &mut [(DVec3, f64)]| {
            for look in looks_at(time) {
                for k in seen.ranges[look].clone() {
                    let (sum, weight) = &mut paint[self.cell(k, angle)];
                    *sum += seen.spots[k].value - gains[look];
                    *weight += 1.0;
                }
            }
        };
        met(from, 0.0, &mut paint);
        let (before, behind) = ((0..from).rev(), from + 1..count);
        let orders: [Vec<usize>; 2] = [behind.collect(), before.collect()];
        for order in orders {
            let mut last = from;
            for time in order {
                let apart = seen.times[time].abs_diff(seen.times[last]) as f64;
                let reach = (FASTEST / STEP) as i32;
                let error = |turn: f64| {
                    let of_look = |look: usize| {
                        let range = seen.ranges[look].clone();
                        let count = range.len().max(1) as f64;
                        let error = |k: usize| {
                            let (sum, weight) = paint[self.cell(k, turn)];
                            if weight < 1.0 {
                                return seen.alone[k];
                            }
                            let apart = seen.spots[k].value - gains[look] - sum / weight;
                            apart.length().min(CAP * seen.error)
                        };
                        range.map(error).sum::<f64>() / count
                    };
                    let (mut sum, mut looks) = (0.0, 0.0);
                    for look in looks_at(time) {
                        sum += of_look(look);
                        looks += 1.0;
                    }
                    let turned = turn - angles[last];
                    sum / f64::max(looks, 1.0) + seen.uneven() * turned * turned / apart
                };
                let turns = (-reach..=reach).map(|k| angles[last] + STEP * apart * f64::from(k));
                let best = turns.map(|turn| (turn, error(turn))).min_by(|a, b| a.1.total_cmp(&b.1));
                angles[time] = best.map_or(angles[last], |(turn, _)| turn);
                met(time, angles[time], &mut paint);
                last = time;
            }
        }
        self.improved(Turned { axis: self.axis, angles, cost: f64::INFINITY }, rounds, TURNS[0])
    }

    /// Turns found anew, of each part of the times by the light and the paint of the others, until they stay.
    fn improved(&self, from: Turned, rounds: usize, turns: usize) -> Turned {
        let mut best = Turned { axis: self.axis, ..from };
        for _ in 0..rounds {
            let errors = self.errors(&best.angles, turns);
            let (angles, cost) = self.evenest(&errors, turns);
            let stays = angles.iter().zip(&best.angles).all(|(a, b)| (a - b).abs() < 1e-6);
            (best.angles, best.cost) = (angles, cost);
            if stays {
                break;
            }
        }
        best
    }

    /// Mean error of every time at every turn, by the light and the paint that other times show in some turns.
    fn errors(&self, angles: &[f64], turns: usize) -> Vec<Vec<f64>> {
        let seen = self.seen;
        let observation = |(k, spot): (usize, &Spot)| Observation {
            pixel: spot.pixel,
            look: spot.look,
            paint: self.cell(k, angles[seen.time_of[spot.look]]),
            light: self.cell(k, 0.0),
            value: spot.value,
        };
        let observations: Vec<Observation> = seen.spots.iter().enumerate().map(observation).collect();
        let part = |look: usize| seen.time_of[look] / TOGETHER % PARTS;
        let mut errors = vec![vec![0.0; turns]; seen.times.len()];
        let mut looks = vec![0.0; seen.times.len()];
        for left_out in 0..PARTS {
            let sizes = (self.cells, self.cells, seen.ranges.len());
            let mut layers = Layers::start(&observations, sizes, |o| part(o.look) != left_out);
            for _ in 0..SWEEPS {
                layers.sweep(&observations, true);
            }
            for look in (0..seen.ranges.len()).filter(|look| part(*look) == left_out) {
                let time = seen.time_of[look];
                looks[time] += 1.0;
                let count = seen.ranges[look].len().max(1) as f64;
                for k in seen.ranges[look].clone() {
                    let value = layers.unpainted(&observations[k]);
                    for (turn, error) in errors[time].iter_mut().enumerate() {
                        let cell = self.cell(k, TAU * turn as f64 / turns as f64);
                        *error += if layers.paint.weights[cell] < 1.0 {
                            seen.alone[k]
                        } else {
                            (value - layers.paint.values[cell]).length().min(CAP * seen.error)
                        } / count;
                    }
                }
            }
        }
        for (row, looks) in errors.iter_mut().zip(looks) {
            row.iter_mut().for_each(|error| *error /= f64::max(looks, 1.0));
        }
        errors
    }

    /// The sequence of turns of least error that changes little from time to time, and its mean cost.
    fn evenest(&self, errors: &[Vec<f64>], turns: usize) -> (Vec<f64>, f64) {
        let step = TAU / turns as f64;
        let (times, uneven) = (&self.seen.times, self.seen.uneven());
        let cost = |time: usize, from: usize, to: usize| {
            let apart = (times[time] - times[time.saturating_sub(1)]).max(1) as f64;
            let turned = from.abs_diff(to);
            uneven * (step * turned.min(turns - turned) as f64).powi(2) / apart
        };
        let (places, sum) = least(errors, cost);
        let mut angles: Vec<f64> = places.iter().map(|place| step * *place as f64).collect();
        unwind(angles.iter_mut());
        (angles, sum / errors.len() as f64)
    }
}
