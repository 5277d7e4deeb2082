//! The judge of rotations: which of several hypotheses about the turns of an object on a known path explains its pixels,
//! and whether the pixels tell. Source: motion reference, second part, 5.
//!
//! Light stays where it is while a surface turns, so that colours fixed to an object argue against every rotation of it.
//! Two models take light out, and are fitted to all pixels but those of a block of times, on which they are judged:
//!
//! - layered: `y = g[view] + b[cell of the hull without turns] + a[cell of the hull with turns]`: a layer of light fixed
//!   to the world, and a layer of paint that turns;
//! - shaded: `y = a[cell] + s . h(n)`, of brightness alone, with the eight spherical harmonics of degrees 1 and 2 of the
//!   world normal `n`.
//!
//! Errors are mean absolute residuals, of the layered model the length over brightness and two ratios of colours, in nat
//! (0.01 is one percent of brightness). Only the layered model tells a turn; that there is none, the
//! shaded one tells too.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

use super::evidence::{Evidence, Look};
use super::hull::{Grid, Hit, Hull};
use super::pauses;
use crate::objects::{ObjectView, Pose};

/// Standard errors by which a hypothesis must beat another to be told from it.
const SIGMAS: f64 = 2.0;

/// Difference of two courses of rotation, radians, up to which they are the same to the judge: the truth lies within half
/// of it of something that is tried.
const APART: f64 = 30.0 / 180.0 * std::f64::consts::PI;

/// Folds of left-out pixels, and the times in a row of a block: neighbouring times of one camera show nearly the same.
const FOLDS: usize = 6;
const BLOCK: usize = 3;

/// Blocks of time of the jackknife, and the fewest with which a standard error is one.
const JACKKNIFE: usize = 12;
const FEWEST_BLOCKS: usize = 5;

/// Sweeps of back-fitting of the layers.
const SWEEPS: usize = 5;

/// Cosine at which a surface is seen too flat to be compared.
const GRAZING: f64 = 0.3;

/// Pixels that two hypotheses must predict in a view to be compared there, and in all for a layer to be fitted.
const COMMON: u32 = 15;
const FEWEST: usize = 60;

/// Observations of a cell outside the fold, from which it predicts.
const OBSERVED: f64 = 2.0;

/// Edge of a voxel, in pixels at the distance of the object: cells of paint are as fine as what is seen of them. Most
/// voxels along an object, and edge of those of a first rough hull, of its size.
const VOXEL: f64 = 1.5;
const MOST_ALONG: f64 = 64.0;
const ROUGH: f64 = 0.12;

/// Reach of the first hull, in sizes of the object.
const REACH: f64 = 1.3;

/// Volume of a hull, of the largest, below which a hypothesis contradicts the outlines.
const LEAST_VOLUME: f64 = 1.0 / 3.0;

/// A hypothesis: world from object by time.
pub(crate) type Course = BTreeMap<usize, Pose>;

/// Finding of the judge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Verdict {
    /// Place of the best hypothesis.
    pub(crate) best: usize,
    /// Standard errors by which it beats the nearest rival that differs by more than 30 degrees.
    pub(crate) margin: f64,
    /// True where it beats every such rival by two standard errors: the rotation is observed.
    pub(crate) is_observed: bool,
    /// True where it differs from no turn by more than 30 degrees.
    pub(crate) turns: bool,
}

/// Residuals of one hypothesis by pixel; NaN where it predicts nothing.
struct Residuals {
    layered: Vec<f32>,
    shaded: Vec<f32>,
    /// Volume of its hull, cubic metres.
    volume: f64,
}

/// Hypotheses about one object, and how well each explains its pixels.
pub(crate) struct Judge<'a> {
    evidence: Evidence<'a>,
    /// Size of the object and edge of a voxel, metres.
    size: f64,
    voxel: f64,
    /// Cells of the layer of light by pixel, and their number.
    light: (Vec<Option<u32>>, usize),
    /// What pixels see of the hull without turns.
    unturned: Vec<Option<Hit>>,
    courses: Vec<Course>,
    residuals: Vec<Residuals>,
}

impl<'a> Judge<'a> {
    /// A judge of an object of this size (the larger of half height and radius, metres) with a first hypothesis, under
    /// which it does not turn; `None` where the views are too few.
    pub(crate) fn new(views: &'a [ObjectView], size: f64, unturned: Course) -> Option<Self> {
        let evidence = Evidence::of(views)?;
        let footprint = |look: &Look<'_>| {
            let pose = unturned.get(&look.view.time_index)?;
            Some(look.footprint * (pose.translation - look.view.camera.centre()).length())
        };
        let mut footprints: Vec<f64> = evidence.looks.iter().filter_map(footprint).collect();
        let voxel = VOXEL * cif_geometry::stats::median(&mut footprints)?;
        let voxel = voxel.max(2.0 * REACH * size / MOST_ALONG);
        let mut judge = Self {
            evidence,
            size,
            voxel,
            light: (Vec::new(), 0),
            unturned: Vec::new(),
            courses: Vec::new(),
            residuals: Vec::new(),
        };
        let (hull, hits) = judge.seen(&unturned);
        judge.light = light_cells(&judge.evidence, &hull, &hits);
        judge.residuals.push(judge.residuals_of(&unturned, (&hull, &hits), false));
        judge.unturned = hits;
        judge.courses.push(unturned);
        Some(judge)
    }

    /// Adds hypotheses.
    pub(crate) fn add(&mut self, courses: Vec<Course>) {
        let of = |course: &Course| {
            let (hull, hits) = self.seen(course);
            self.residuals_of(course, (&hull, &hits), true)
        };
        let found: Vec<Residuals> = courses.par_iter().map(of).collect();
        self.residuals.extend(found);
        self.courses.extend(courses);
    }

    /// Share of all turning in place that is done by each time; `None` where no pauses are seen.
    pub(crate) fn pauses(&self) -> Option<BTreeMap<usize, f64>> {
        pauses::shares(&self.evidence, &self.unturned)
    }

    /// True where the last hypothesis explains more than another.
    pub(crate) fn prefers_last(&self, other: usize) -> bool {
        let last = self.residuals.len() - 1;
        let fields: Vec<&[f32]> = [last, other].map(|k| &self.residuals[k].layered[..]).to_vec();
        compared(&self.evidence, &fields)[0][1] > 0.0
    }

    /// The finding about the hypotheses so far; `None` where none can be compared with another.
    pub(crate) fn verdict(&self) -> Option<Verdict> {
        let times: Vec<usize> = self.evidence.looks.iter().map(|look| look.view.time_index).collect();
        let angles = angles(&self.courses, &times);
        let largest = self.residuals.iter().map(|residuals| residuals.volume).fold(0.0, f64::max);
        let is_out: Vec<bool> = self.residuals.iter().map(|r| r.volume < LEAST_VOLUME * largest).collect();
        let verdict = |of: fn(&Residuals) -> &[f32]| {
            let fields: Vec<&[f32]> = self.residuals.iter().map(of).collect();
            verdict(&compared(&self.evidence, &fields), &angles, &is_out)
        };
        let by_layers = verdict(|residuals| &residuals.layered);
        if by_layers.is_some_and(|found| found.is_observed && found.turns) {
            return by_layers;
        }
        // Places that are a little off look like turns to it, so that it does not tell one alone.
        let by_shading = verdict(|residuals| &residuals.shaded)?;
        let is_observed = by_shading.is_observed && !by_shading.turns;
        Some(Verdict { is_observed, ..by_shading })
    }

    /// Hull of a hypothesis, and what pixels see of it.
    fn seen(&self, course: &Course) -> (Hull, Vec<Option<Hit>>) {
        let views: Vec<&ObjectView> = self.evidence.looks.iter().map(|look| look.view).collect();
        let reach = DVec3::splat(REACH * self.size);
        let rough = Grid::over(-reach, reach, ROUGH * self.size);
        let bounds = Hull::carved(rough, &views, course).bounds().unwrap_or((DVec3::ZERO, DVec3::ZERO));
        let margin = DVec3::splat(0.5 * ROUGH * self.size);
        let grid = Grid::over(bounds.0 - margin, bounds.1 + margin, self.voxel);
        let hull = Hull::carved(grid, &views, course);
        let hits = hits(&self.evidence, &hull, course);
        (hull, hits)
    }

    fn residuals_of(&self, course: &Course, (hull, hits): (&Hull, &[Option<Hit>]), turns: bool) -> Residuals {
        Residuals {
            layered: layered(&self.evidence, (hits, hull.cells()), &self.light, turns),
            shaded: shaded(&self.evidence, (hits, hull.cells()), course),
            volume: hull.volume(),
        }
    }
}

/// Largest angle between two courses at some times, radians, for every pair: both are taken relative to the middle of the
/// times at which they have poses, for frames of objects are arbitrary.
fn angles(courses: &[Course], times: &[usize]) -> Vec<Vec<f64>> {
    let between = |a: &Course, b: &Course| {
        let of = |time: &usize| Some((a.get(time)?.rotation, b.get(time)?.rotation));
        let shared: Vec<(DQuat, DQuat)> = times.iter().filter_map(of).collect();
        let Some((first, second)) = shared.get(shared.len() / 2) else { return 0.0 };
        let (first, second) = (first.inverse(), second.inverse());
        shared.iter().map(|(a, b)| (*a * first).angle_between(*b * second)).fold(0.0, f64::max)
    };
    courses.iter().map(|a| courses.iter().map(|b| between(a, b)).collect()).collect()
}

/// Surface points of all pixels.
fn hits(evidence: &Evidence<'_>, hull: &Hull, course: &Course) -> Vec<Option<Hit>> {
    let mut found = Vec::with_capacity(evidence.len());
    for look in &evidence.looks {
        let Some(pose) = course.get(&look.view.time_index) else {
            found.extend(look.pixels.iter().map(|_| None));
            continue;
        };
        let back = pose.rotation.inverse();
        let origin = back * (look.view.camera.centre() - pose.translation);
        let hit = |ray: DVec3| hull.hit(origin, back * ray).filter(|hit| hit.facing > GRAZING);
        found.extend(look.pixels.iter().map(|pixel| hit(pixel.ray)));
    }
    found
}

/// Cells of the layer of light by pixel: voxels of the hull without turns, of each camera apart where several stay in
/// place, since highlights move with them. All pixels share one where that hull is hardly hit.
fn light_cells(evidence: &Evidence<'_>, hull: &Hull, hits: &[Option<Hit>]) -> (Vec<Option<u32>>, usize) {
    let cameras = evidence.looks.iter().map(|look| look.camera).max().unwrap_or(0) + 1;
    if hits.iter().flatten().count() < FEWEST {
        return (vec![Some(0); hits.len()], 1);
    }
    let of_pixel = evidence.looks.iter().flat_map(|look| look.pixels.iter().map(|_| look.camera));
    let cell = |(hit, camera): (&Option<Hit>, u32)| hit.map(|hit| hit.cell * cameras + camera);
    (hits.iter().zip(of_pixel).map(cell).collect(), hull.cells() * cameras as usize)
}

/// Fold of each view.
fn folds(evidence: &Evidence<'_>) -> Vec<usize> {
    let block = if evidence.is_rig { 1 } else { BLOCK };
    evidence.looks.iter().map(|look| look.view.time_index / block % FOLDS).collect()
}

/// A pixel that a model predicts.
struct Observation {
    pixel: usize,
    look: usize,
    paint: usize,
    light: usize,
    value: DVec3,
}

/// Absolute residuals of the layered model on left-out pixels, each layer shrunk by one pseudo-observation per cell.
fn layered(
    evidence: &Evidence<'_>,
    (hits, cells): (&[Option<Hit>], usize),
    (light, light_cells): &(Vec<Option<u32>>, usize),
    turns: bool,
) -> Vec<f32> {
    let mut found = vec![f32::NAN; hits.len()];
    let mut seen = Vec::new();
    let mut pixel = 0;
    for (look, shown) in evidence.looks.iter().enumerate() {
        for value in shown.pixels.iter().map(|pixel| pixel.value) {
            if let (Some(hit), Some(light)) = (hits[pixel], light[pixel]) {
                let (paint, light) = (hit.cell as usize, light as usize);
                seen.push(Observation { pixel, look, paint, light, value });
            }
            pixel += 1;
        }
    }
    if seen.len() < FEWEST {
        return found;
    }
    let cells = numbered(seen.iter_mut().map(|o| &mut o.paint), cells);
    let lights = numbered(seen.iter_mut().map(|o| &mut o.light), *light_cells);
    let folds = folds(evidence);
    let views = evidence.looks.len();
    for fold in 0..FOLDS {
        let mut layers = Layers::start(&seen, (cells, lights, views), |o| folds[o.look] != fold);
        for _ in 0..SWEEPS {
            layers.sweep(&seen, turns);
        }
        for o in seen.iter().filter(|o| folds[o.look] == fold) {
            if layers.paint.weights[o.paint] >= OBSERVED && layers.light.weights[o.light] >= OBSERVED {
                found[o.pixel] = layers.residual(o).length() as f32;
            }
        }
    }
    found
}

/// Numbers the cells that are seen from 0 up, in the order of their first appearance; returns how many there are.
fn numbered<'o>(cells: impl Iterator<Item = &'o mut usize>, all: usize) -> usize {
    let mut numbers = vec![usize::MAX; all];
    let mut count = 0;
    for cell in cells {
        let number = &mut numbers[*cell];
        if *number == usize::MAX {
            *number = count;
            count += 1;
        }
        *cell = *number;
    }
    count
}

/// Means by cell, view or the like.
struct Means {
    values: Vec<DVec3>,
    weights: Vec<f64>,
}

impl Means {
    fn zeros(count: usize) -> Self {
        Self { values: vec![DVec3::ZERO; count], weights: vec![0.0; count] }
    }

    /// Divides sums by their weights, and these by so many pseudo-observations of zero.
    fn divide(&mut self, pseudo: f64) {
        for (value, weight) in self.values.iter_mut().zip(&self.weights) {
            *value /= (weight + pseudo).max(1.0);
        }
    }
}

/// The layers of the model, fitted to the observations outside a fold; gains of views to all.
struct Layers {
    gain: Means,
    light: Means,
    paint: Means,
    is_fitted: Vec<bool>,
}

impl Layers {
    fn start(
        seen: &[Observation],
        (cells, lights, views): (usize, usize, usize),
        is_fitted: impl Fn(&Observation) -> bool,
    ) -> Self {
        let is_fitted: Vec<bool> = seen.iter().map(is_fitted).collect();
        let (mut gain, mut light, mut paint) =
            (Means::zeros(views), Means::zeros(lights), Means::zeros(cells));
        for (o, is_fitted) in seen.iter().zip(&is_fitted) {
            gain.weights[o.look] += 1.0;
            gain.values[o.look] += o.value;
            if *is_fitted {
                light.weights[o.light] += 1.0;
                paint.weights[o.paint] += 1.0;
            }
        }
        gain.divide(0.0);
        Self { gain, light, paint, is_fitted }
    }

    fn residual(&self, o: &Observation) -> DVec3 {
        o.value - self.gain.values[o.look] - self.light.values[o.light] - self.paint.values[o.paint]
    }

    /// One sweep of back-fitting: light, paint, gains.
    fn sweep(&mut self, seen: &[Observation], turns: bool) {
        let fitted = || seen.iter().zip(&self.is_fitted).filter(|(_, is_fitted)| **is_fitted).map(|(o, _)| o);
        let mut light = vec![DVec3::ZERO; self.light.values.len()];
        for o in fitted() {
            light[o.light] += o.value - self.gain.values[o.look] - self.paint.values[o.paint];
        }
        self.light.values = light;
        self.light.divide(1.0);
        if turns {
            let fitted =
                || seen.iter().zip(&self.is_fitted).filter(|(_, is_fitted)| **is_fitted).map(|(o, _)| o);
            let mut paint = vec![DVec3::ZERO; self.paint.values.len()];
            for o in fitted() {
                paint[o.paint] += o.value - self.gain.values[o.look] - self.light.values[o.light];
            }
            self.paint.values = paint;
            self.paint.divide(1.0);
        }
        let mut gain = vec![DVec3::ZERO; self.gain.values.len()];
        for o in seen {
            gain[o.look] += o.value - self.light.values[o.light] - self.paint.values[o.paint];
        }
        self.gain.values = gain;
        self.gain.divide(0.0);
    }
}

/// Spherical harmonics of degrees 1 and 2 of a unit normal, up to constant factors.
fn harmonics(n: DVec3) -> SVector<f64, 8> {
    SVector::from([
        n.x,
        n.y,
        n.z,
        n.x * n.y,
        n.y * n.z,
        n.x * n.z,
        n.x * n.x - n.y * n.y,
        3.0 * n.z * n.z - 1.0,
    ])
}

/// An observation of the shaded model: pixel, view, cell, logarithm of the brightness and harmonics of its normal.
struct Shaded {
    pixel: usize,
    look: usize,
    cell: usize,
    value: f64,
    light: SVector<f64, 8>,
}

/// Absolute residuals of the brightness under the shaded model on left-out pixels; light is fitted to all, within cells.
fn shaded(evidence: &Evidence<'_>, (hits, cells): (&[Option<Hit>], usize), course: &Course) -> Vec<f32> {
    let mut found = vec![f32::NAN; hits.len()];
    let mut seen = Vec::new();
    let mut pixel = 0;
    for (look, shown) in evidence.looks.iter().enumerate() {
        let pose = course.get(&shown.view.time_index);
        for value in shown.pixels.iter().map(|pixel| pixel.value.x) {
            if let (Some(hit), Some(pose)) = (hits[pixel], pose) {
                let light = harmonics(pose.rotation * hit.normal);
                seen.push(Shaded { pixel, look, cell: hit.cell as usize, value, light });
            }
            pixel += 1;
        }
    }
    if seen.len() < FEWEST {
        return found;
    }
    let cells = numbered(seen.iter_mut().map(|o| &mut o.cell), cells);
    let Some(shading) = shading(&seen, cells) else { return found };
    let folds = folds(evidence);
    // Sums of unshaded values and counts by cell: of all, and of each fold.
    let mut all = vec![(0.0, 0.0); cells];
    let mut own = vec![vec![(0.0, 0.0); cells]; FOLDS];
    for o in &mut seen {
        o.value -= shading.dot(&o.light);
        for (sum, count) in [&mut all[o.cell], &mut own[folds[o.look]][o.cell]] {
            *sum += o.value;
            *count += 1.0;
        }
    }
    for o in &seen {
        let (own_sum, own_count) = own[folds[o.look]][o.cell];
        let (sum, count): (f64, f64) = (all[o.cell].0 - own_sum, all[o.cell].1 - own_count);
        if count >= OBSERVED {
            found[o.pixel] = ((o.value - sum / count) / (1.0 + 1.0 / count).sqrt()).abs() as f32;
        }
    }
    found
}

/// Coefficients of the light that explains most of the differences of brightness within cells.
fn shading(seen: &[Shaded], cells: usize) -> Option<SVector<f64, 8>> {
    let mut sums = vec![(0.0, 0.0, SVector::<f64, 8>::zeros()); cells];
    for o in seen {
        let (count, value, light) = &mut sums[o.cell];
        *count += 1.0;
        *value += o.value;
        *light += o.light;
    }
    let mut normal = SMatrix::<f64, 8, 8>::identity() * (1e-3 * seen.len() as f64);
    let mut right = SVector::<f64, 8>::zeros();
    for o in seen {
        let (count, value, light) = &sums[o.cell];
        if *count >= OBSERVED {
            let light = o.light - light / *count;
            normal += light * light.transpose();
            right += (o.value - value / *count) * light;
        }
    }
    Some(normal.cholesky()?.solve(&right))
}

/// Standard errors by which every hypothesis beats every other (positive: it is better); NaN where they cannot be
/// compared. Differences are means over the pixels of a view that both predict, then over views; their standard error is
/// that of a jackknife over blocks of time.
fn compared(evidence: &Evidence<'_>, fields: &[&[f32]]) -> Vec<Vec<f64>> {
    let mut bounds = vec![0];
    for look in &evidence.looks {
        bounds.push(bounds[bounds.len() - 1] + look.pixels.len());
    }
    let mut times: Vec<usize> = evidence.looks.iter().map(|look| look.view.time_index).collect();
    times.dedup();
    let of_view = |a: &[f32], b: &[f32], view: usize| {
        let range = bounds[view]..bounds[view + 1];
        let (mut sum, mut count) = (0.0_f64, 0_u32);
        for (a, b) in a[range.clone()].iter().zip(&b[range]) {
            if !a.is_nan() && !b.is_nan() {
                sum += f64::from(b - a);
                count += 1;
            }
        }
        (count >= COMMON).then(|| sum / f64::from(count))
    };
    let pair = |a: usize, b: usize| {
        let views = (0..evidence.looks.len()).filter_map(|view| {
            Some((evidence.looks[view].view.time_index, of_view(fields[a], fields[b], view)?))
        });
        standard_errors(&views.collect::<Vec<_>>())
    };
    let count = fields.len();
    let rows: Vec<Vec<f64>> =
        (0..count).into_par_iter().map(|a| (0..a).map(|b| pair(a, b)).collect()).collect();
    let at = |a: usize, b: usize| match a.cmp(&b) {
        std::cmp::Ordering::Greater => rows[a][b],
        std::cmp::Ordering::Less => -rows[b][a],
        std::cmp::Ordering::Equal => 0.0,
    };
    (0..count).map(|a| (0..count).map(|b| at(a, b)).collect()).collect()
}

/// Mean of differences by time over its standard error, by a jackknife over blocks of time; NaN where these are few.
pub(crate) fn standard_errors(differences: &[(usize, f64)]) -> f64 {
    let mut times: Vec<usize> = differences.iter().map(|(time, _)| *time).collect();
    times.sort_unstable();
    times.dedup();
    let blocks = JACKKNIFE.min(times.len());
    if blocks < FEWEST_BLOCKS {
        return f64::NAN;
    }
    let (mut sums, mut counts) = (vec![0.0; blocks], vec![0.0; blocks]);
    for (time, difference) in differences {
        let block = times.partition_point(|other| other < time) * blocks / times.len();
        sums[block] += difference;
        counts[block] += 1.0;
    }
    let (sum, count): (f64, f64) = (sums.iter().sum(), counts.iter().sum());
    let without: Vec<f64> = sums.iter().zip(&counts).map(|(s, c)| (sum - s) / (count - c)).collect();
    let mean = without.iter().sum::<f64>() / blocks as f64;
    let spread: f64 = without.iter().map(|value| (value - mean).powi(2)).sum();
    let error = ((blocks as f64 - 1.0) / blocks as f64 * spread).sqrt();
    sum / count / (error + 1e-12)
}

/// The hypothesis that its nearest rival is farthest behind. A comparison that cannot be made counts as a draw, which
/// blocks the claim.
fn verdict(compared: &[Vec<f64>], angles: &[Vec<f64>], is_out: &[bool]) -> Option<Verdict> {
    let count = compared.len();
    let is_compared = |a: usize, b: usize| a != b && !is_out[b] && !compared[a][b].is_nan();
    let is_live: Vec<bool> =
        (0..count).map(|a| !is_out[a] && (0..count).any(|b| is_compared(a, b))).collect();
    let margin = |a: usize| {
        let rivals = (0..count).filter(|b| is_live[*b] && angles[a][*b] > APART);
        let margins = rivals.map(|b| if compared[a][b].is_nan() { 0.0 } else { compared[a][b] });
        margins.min_by(f64::total_cmp)
    };
    let margins = (0..count).filter(|a| is_live[*a]).filter_map(|a| Some((a, margin(a)?)));
    let (best, margin) = margins.max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(Verdict { best, margin, is_observed: margin > SIGMAS, turns: angles[best][0] > APART })
}
