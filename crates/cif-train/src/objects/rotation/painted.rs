//! Paint on a surface about an axis: which turns of all times explain the pixels that show it.

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

use glam::DVec3;
use rayon::prelude::*;

use super::super::sequence::{least, unwind};
use super::evidence::{Evidence, Look, Pixel};
use super::judge::GRAZING;
use super::layered::{LayerCells, LayerSizes, Layers, Observation, layered};

/// Places of the sequence from which turns are followed.
const SEEDS: [f64; 5] = [1.0 / 6.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 5.0 / 6.0];

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

/// Angle from turns that are expected up to which others are looked for, radians: what a radius that is off by a twentieth
/// makes of a whole turn.
const NEAR: f64 = 0.35;

/// Angles by which the axis is moved, radians.
const MOVED: [f64; 3] = [PI / 18.0, PI / 36.0, PI / 72.0];

/// How something turns.
#[derive(Clone, Debug)]
pub(in super::super) struct Turning {
    /// Unit, in the frame of the course without turns: the world, of a ball in place.
    pub(in super::super) axis: DVec3,
    /// Radians about it by time.
    pub(in super::super) angles: BTreeMap<usize, f64>,
}

/// Mean of what is predicted.
pub(super) fn mean(residuals: &[f32]) -> Option<f64> {
    let known = || residuals.iter().filter(|residual| !residual.is_nan());
    let count = known().count();
    (count > 0).then(|| known().map(|residual| f64::from(*residual)).sum::<f64>() / count as f64)
}

/// Directions of a half sphere, about equally far apart.
pub(super) fn hemisphere(count: usize) -> Vec<DVec3> {
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

/// Cells of paint on a surface.
#[derive(Clone, Copy, Debug)]
pub(super) enum Cells {
    /// Of a ball, in so many rows from pole to pole.
    OfBall(f64),
    /// With edges of this length.
    Edged(f64),
}

/// Depth of a cell away from the axis, in edges: of a side that is a little rough all is in one.
const DEPTH: f64 = 3.0;

impl Cells {
    /// The row of a place by its distances along the axis and from it.
    fn row(self, along: f64, out: f64) -> (i64, i64) {
        match self {
            Self::OfBall(rows) => ((out.atan2(along) / PI * rows).min(rows - 1.0) as i64, 0),
            Self::Edged(edge) => ((along / edge).floor() as i64, (out / (DEPTH * edge)) as i64),
        }
    }

    /// Cells around of a row.
    fn columns(self, (row, out): (i64, i64)) -> f64 {
        let columns = match self {
            Self::OfBall(rows) => 2.0 * rows * (PI * (row as f64 + 0.5) / rows).sin(),
            Self::Edged(_) => TAU * DEPTH * (out as f64 + 0.5),
        };
        columns.round().max(1.0)
    }
}

/// A place of the surface that a pixel shows.
#[derive(Clone)]
pub(super) struct Spot {
    pub(super) pixel: usize,
    look: usize,
    /// From the middle of the axis, in the frame in which the surface turns.
    pub(super) place: DVec3,
    /// Camera whose highlights these are.
    camera: usize,
    value: DVec3,
}

/// Places of a surface that views show.
#[derive(Clone)]
pub(super) struct Seen {
    cells: Cells,
    pub(super) cameras: usize,
    pub(super) spots: Vec<Spot>,
    /// Ranges of the spots of views, the places of their times, and these times.
    ranges: Vec<std::ops::Range<usize>>,
    time_of: Vec<usize>,
    pub(super) times: Vec<usize>,
    /// Error of every spot with light alone, which is what paint that no other time shows predicts, and their mean.
    alone: Vec<f64>,
    pub(super) error: f64,
}

/// Turns about an axis at all times, and what they cost.
#[derive(Clone)]
pub(super) struct Turned {
    pub(super) axis: DVec3,
    pub(super) angles: Vec<f64>,
    pub(super) cost: f64,
}

impl Turned {
    /// Difference of the largest and the least angle.
    pub(super) fn reach(&self) -> f64 {
        let ends = |(low, high): (f64, f64), angle: &f64| (low.min(*angle), high.max(*angle));
        let (low, high) = self.angles.iter().fold((f64::INFINITY, f64::NEG_INFINITY), ends);
        high - low
    }

    /// The place of the time at which half of the way is behind.
    fn middle(&self) -> usize {
        let turns = || self.angles.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        let half = 0.5 * turns().sum::<f64>();
        let behind = turns().scan(0.0, |way, turn| {
            *way += turn;
            Some(*way)
        });
        1 + behind.take_while(|way| *way < half).count()
    }
}

impl Seen {
    /// Places that pixels show, seen at a cosine.
    pub(super) fn of(
        evidence: &Evidence<'_>,
        cells: Cells,
        place: impl Fn(&Look<'_>, &Pixel) -> Option<(DVec3, f64)>,
    ) -> Self {
        let mut times: Vec<usize> = evidence.looks.iter().map(|look| look.view.time_index).collect();
        times.dedup();
        let time_of = |look: &Look<'_>| times.partition_point(|time| *time < look.view.time_index);
        let time_of = evidence.looks.iter().map(time_of).collect();
        let cameras = 1 + evidence.looks.iter().map(|look| look.camera as usize).max().unwrap_or(0);
        let (alone, error) = (Vec::new(), 0.0);
        let mut seen =
            Self { cells, cameras, spots: Vec::new(), ranges: Vec::new(), time_of, times, alone, error };
        let mut first = 0;
        for (look, shown) in evidence.looks.iter().enumerate() {
            let start = seen.spots.len();
            let camera = shown.camera as usize;
            let spot = |(k, pixel): (usize, &Pixel)| {
                let (place, facing) = place(shown, pixel)?;
                let spot = Spot { pixel: first + k, look, place, camera, value: pixel.value };
                (facing > GRAZING).then_some(spot)
            };
            seen.spots.extend(shown.pixels.iter().enumerate().filter_map(spot));
            seen.ranges.push(start..seen.spots.len());
            first += shown.pixels.len();
        }
        seen
    }

    /// The same of at most so many pixels of each view, with the residuals that light alone leaves of all; `None` where it
    /// predicts none.
    pub(super) fn few(&self, most: usize, still: &[f32]) -> Option<Self> {
        let error = mean(still)?;
        let mut few = Self { error, spots: Vec::new(), ranges: Vec::new(), ..self.clone() };
        for range in &self.ranges {
            let start = few.spots.len();
            let step = range.len().div_ceil(most).max(1);
            few.spots.extend(self.spots[range.clone()].iter().step_by(step).cloned());
            few.ranges.push(start..few.spots.len());
        }
        let alone = |spot: &Spot| f64::from(still[spot.pixel]);
        let known = |alone: f64| if alone.is_nan() { error } else { alone.min(CAP * error) };
        few.alone = few.spots.iter().map(alone).map(known).collect();
        Some(few)
    }

    /// Some of the places.
    pub(super) fn only(&self, is_kept: impl Fn(&Spot) -> bool) -> Self {
        let mut some = Self { spots: Vec::new(), ranges: Vec::new(), alone: Vec::new(), ..self.clone() };
        for range in &self.ranges {
            let start = some.spots.len();
            for k in range.clone().filter(|k| is_kept(&self.spots[*k])) {
                some.spots.push(self.spots[k].clone());
                some.alone.push(self.alone[k]);
            }
            some.ranges.push(start..some.spots.len());
        }
        some
    }

    /// Angle about an axis of the middle of what is seen, by time: it follows the camera.
    pub(super) fn sides(&self, axis: DVec3) -> Vec<f64> {
        let (first, second) = axis.any_orthonormal_pair();
        let mut sums = vec![(0.0, 0.0); self.times.len()];
        for spot in &self.spots {
            let sum = &mut sums[self.time_of[spot.look]];
            sum.0 += spot.place.dot(first);
            sum.1 += spot.place.dot(second);
        }
        let mut angles: Vec<f64> = sums.into_iter().map(|(x, y): (f64, f64)| y.atan2(x)).collect();
        unwind(angles.iter_mut());
        angles
    }

    /// No turns at any time.
    pub(super) fn still(&self) -> Turned {
        Turned { axis: DVec3::Z, angles: vec![0.0; self.times.len()], cost: 0.0 }
    }

    /// Cost of turning by a radian from one time of the sequence to the next.
    fn uneven(&self) -> f64 {
        let length = self.times.last().zip(self.times.first()).map_or(0, |(last, first)| last - first);
        UNEVEN * length as f64 * self.error
    }

    /// The places by their cells about an axis: rows of a distance along it and from it, columns around.
    pub(super) fn painted(&self, axis: DVec3) -> Painted<'_> {
        let (first, second) = axis.any_orthonormal_pair();
        let row = |spot: &Spot| {
            let (x, y) = (spot.place.dot(first), spot.place.dot(second));
            (self.cells.row(spot.place.dot(axis), x.hypot(y)), y.atan2(x))
        };
        let found: Vec<((i64, i64), f64)> = self.spots.iter().map(row).collect();
        let mut rows: BTreeMap<(i64, i64), usize> = found.iter().map(|(row, _)| (*row, 0)).collect();
        let (mut starts, mut columns, mut cells) = (Vec::new(), Vec::new(), 0);
        for (number, (key, row)) in rows.iter_mut().enumerate() {
            *row = number;
            starts.push(cells);
            columns.push(self.cells.columns(*key));
            cells += columns[number] as usize;
        }
        let places = found.into_iter().map(|(row, angle)| (rows[&row], angle)).collect();
        Painted { seen: self, axis, places, starts, columns, cells }
    }

    /// Residuals of all pixels that are left out, by the layered model.
    pub(super) fn residuals(&self, evidence: &Evidence<'_>, turned: &Turned, turns: bool) -> Vec<f32> {
        let painted = self.painted(turned.axis);
        let cell = |k: usize, time: usize| painted.cell(k, turned.angles[time]);
        self.layered(evidence, &painted, (painted.cells, cell), turns)
    }

    /// The same where nothing turns about an axis, but all of it looks another way from the middle of the way of turns on, as
    /// where a shadow falls on it.
    pub(super) fn changed(&self, evidence: &Evidence<'_>, turned: &Turned) -> Vec<f32> {
        let painted = self.painted(turned.axis);
        let middle = turned.middle();
        let cell = |k: usize, time: usize| 2 * painted.cell(k, 0.0) + usize::from(time >= middle);
        self.layered(evidence, &painted, (2 * painted.cells, cell), true)
    }

    /// Residuals with paint in so many cells: that of a place at the place of a time.
    fn layered(
        &self,
        evidence: &Evidence<'_>,
        painted: &Painted<'_>,
        (count, cell): (usize, impl Fn(usize, usize) -> usize),
        turns: bool,
    ) -> Vec<f32> {
        let mut paint = vec![None; evidence.len()];
        let mut light = vec![None; evidence.len()];
        for (k, spot) in self.spots.iter().enumerate() {
            paint[spot.pixel] = Some(cell(k, self.time_of[spot.look]) as u32);
            light[spot.pixel] = Some(painted.light(k) as u32);
        }
        let paint = LayerCells { of_pixel: paint, count };
        let light = LayerCells { of_pixel: light, count: painted.lights() };
        layered(evidence, &paint, &light, turns)
    }

    /// The turns about an axis that explain most.
    pub(super) fn turned_about(&self, axis: DVec3) -> Turned {
        let painted = self.painted(axis);
        self.finely(painted.further(painted.roughly()))
    }

    /// The same turns in smaller steps.
    pub(super) fn finely(&self, turned: Turned) -> Turned {
        self.painted(turned.axis).improved(turned, 1, TURNS[1])
    }

    /// Turns about an axis near that of others, where they cost less.
    pub(super) fn moved(&self, mut best: Turned) -> Turned {
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

/// Places of a surface by their cells about an axis.
pub(super) struct Painted<'s> {
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
    /// Cell of the surface that a place shows when it is turned by an angle.
    fn cell(&self, place: usize, turn: f64) -> usize {
        let (row, angle) = self.places[place];
        let share = (angle - turn) / TAU;
        let columns = self.columns[row];
        self.starts[row] + ((share - share.floor()) * columns).min(columns - 1.0) as usize
    }

    /// Cell of the light at a place.
    fn light(&self, place: usize) -> usize {
        self.cell(place, 0.0) * self.seen.cameras + self.seen.spots[place].camera
    }

    /// Turns near some that are expected, which differ from them about as much at one time as at the next.
    pub(super) fn near(&self, expected: &Turned) -> Turned {
        let seen = self.seen;
        let step = TAU / TURNS[1] as f64;
        let reach = (NEAR / step) as i32;
        let apart: Vec<f64> = (-reach..=reach).map(|k| step * f64::from(k)).collect();
        let mut best = expected.clone();
        for _ in 0..ROUNDS[1] {
            let of = |(row, angle): (Vec<f64>, &f64)| -> Vec<f64> {
                let turns = TURNS[1] as f64;
                let at = |apart: &f64| row[((angle + apart) / step).round().rem_euclid(turns) as usize];
                apart.iter().map(at).collect()
            };
            let errors = self.errors(&best.angles, TURNS[1]).into_iter().zip(&expected.angles);
            let errors: Vec<Vec<f64>> = errors.map(of).collect();
            let cost = |time: usize, from: usize, to: usize| {
                let times = (seen.times[time] - seen.times[time.saturating_sub(1)]).max(1) as f64;
                seen.uneven() * (apart[to] - apart[from]).powi(2) / times
            };
            let (places, sum) = least(&errors, cost);
            best.cost = sum / errors.len() as f64;
            let angles = places.iter().zip(&expected.angles).map(|(place, angle)| angle + apart[*place]);
            best.angles = angles.collect();
        }
        best
    }

    /// Number of the cells of light.
    fn lights(&self) -> usize {
        self.cells * self.seen.cameras
    }

    /// Turns that are found from the middle of the times in a few rounds.
    pub(super) fn roughly(&self) -> Turned {
        self.found(self.seen.times.len() / 2, ROUNDS[0])
    }

    /// The best of these, and of turns that are found from other times, in more rounds.
    pub(super) fn further(&self, turned: Turned) -> Turned {
        let again = self.improved(turned, ROUNDS[1], TURNS[0]);
        let seeds = SEEDS.map(|seed| (self.seen.times.len() as f64 * seed) as usize);
        let found = seeds.into_par_iter().map(|seed| self.found(seed, ROUNDS[1]));
        found.collect::<Vec<_>>().into_iter().fold(again, |a, b| if b.cost < a.cost { b } else { a })
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
            light: self.light(k),
            value: spot.value,
        };
        let observations: Vec<Observation> = seen.spots.iter().enumerate().map(observation).collect();
        let part = |look: usize| seen.time_of[look] / TOGETHER % PARTS;
        let mut errors = vec![vec![0.0; turns]; seen.times.len()];
        let mut looks = vec![0.0; seen.times.len()];
        for left_out in 0..PARTS {
            let sizes = LayerSizes { paint: self.cells, light: self.lights(), views: seen.ranges.len() };
            let mut layers = Layers::start(&observations, &sizes, |o| part(o.look) != left_out);
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
