//! The judge of rotations: which of several hypotheses about the turns of an object on a known path explains its pixels,
//! and whether the pixels decide. Source: motion reference, second part, 5.
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
//! (0.01 is one percent of brightness). Only the layered model shows a turn; that there is none, the
//! shaded one shows too. Outlines decide as well where poses follow them: turned otherwise, the object does not cover its
//! masks. Elsewhere places that are a little off make them argue for no turn, as of bars that roll.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::super::view::ObjectView;
use super::compare::compared;
use super::evidence::{Evidence, Look};
use super::folds::FEWEST;
use super::hull::{Course, Hit, Hull, voxel};
use super::layered::{LayerCells, layered};
use super::shaded::shaded;

/// Standard errors by which a hypothesis must beat another.
pub(super) const SIGMAS: f64 = 2.0;

/// Difference of two courses of rotation, radians, up to which they are the same to the judge: the truth lies within half
/// of it of something that is tried.
pub(super) const APART: f64 = 30.0 / 180.0 * std::f64::consts::PI;

/// Cosine at which a surface is seen too flat to be compared.
pub(super) const GRAZING: f64 = 0.3;

/// Volume of a hull, of the largest, below which a hypothesis contradicts the outlines.
const LEAST_VOLUME: f64 = 1.0 / 3.0;

/// Difference of mean residuals, nat, below which hypotheses are alike: what rounding to 8 bits leaves at middle brightness.
const ROUNDING: f64 = 0.002;

/// Share of the pixels of an object that its hull leaves out, and another does not, from which outlines decide between them:
/// under poses that were found right, of thirteen objects of random captures that do not roll, it leaves out up to 0.005 of
/// twelve, and 0.01 of one.
const LEFT_OUT: f64 = 0.01;

/// Finding of the judge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Verdict {
    /// Place of the best hypothesis.
    pub(super) best: usize,
    /// True where it beats every rival that differs by more than 30 degrees by two standard errors.
    pub(super) is_observed: bool,
    /// True where it differs from no turn by more than 30 degrees.
    pub(super) turns: bool,
}

/// Turns that the poses of an object are held against.
pub(in super::super) struct Rivals {
    /// Course without turns.
    pub(in super::super) unturned: Course,
    /// Courses of rolling.
    pub(in super::super) rolls: Vec<Course>,
    /// All others.
    pub(in super::super) others: Vec<Course>,
    /// True where the poses follow the outlines from time to time, so that these judge them, too.
    pub(in super::super) by_outlines: bool,
}

/// True where the images of an object of this size (the larger of half height and radius, metres) show that it turns as in
/// poses: these, or others within 30 degrees of them, beat all rivals that differ by more. That it does not turn, shading
/// shows of a plain thing that rolls, too, and layers of any plain thing: it is shown where outlines contradict these rivals.
pub(in super::super) fn shown(views: &[ObjectView], size: f64, poses: &Course, rivals: Rivals) -> bool {
    let Rivals { unturned, rolls, others, by_outlines } = rivals;
    let Some(mut judge) = Judge::new(views, size, unturned) else { return false };
    let first_roll = 2 + others.len();
    judge.add(std::iter::once(poses.clone()).chain(others).chain(rolls).collect());
    let compared = judge.compared();
    let angles = &compared.angles;
    let is_of_poses = |found: &Verdict| angles[found.best][1] <= APART;
    let seen = |compared: &[Vec<f64>]| judge.verdict(compared, angles).filter(|found| found.is_observed);
    if let Some(turn) = seen(&compared.layered).filter(|found| found.turns) {
        return is_of_poses(&turn);
    }
    if by_outlines && seen(&compared.both).is_some_and(|found| found.turns && is_of_poses(&found)) {
        return true;
    }
    let contradicted = |stays: &Verdict, from: usize| {
        let rivals = (from..judge.courses.len()).filter(|rival| angles[stays.best][*rival] > APART);
        rivals.map(|rival| compared.missed[stays.best][rival]).all(|sigmas| sigmas > SIGMAS)
    };
    // To layers places that are a little off look like turns, and whatever is plain like none.
    [(&compared.shaded, first_roll), (&compared.layered, 0)].into_iter().any(|(compared, from)| {
        seen(compared).is_some_and(|found| !found.turns && is_of_poses(&found) && contradicted(&found, from))
    })
}

/// Residuals of one hypothesis by pixel; NaN where it predicts nothing.
struct Residuals {
    layered: Vec<f32>,
    shaded: Vec<f32>,
    /// 1 where the hull passes by, 0 where it does not.
    missed: Vec<f32>,
    /// Volume of its hull, cubic metres.
    volume: f64,
}

/// Standard errors by which hypotheses beat others.
pub(super) struct Compared {
    pub(super) layered: Vec<Vec<f64>>,
    pub(super) shaded: Vec<Vec<f64>>,
    /// By what hulls leave out of the masks; 0 where they leave out about as much.
    missed: Vec<Vec<f64>>,
    /// The larger one of layers and outlines; 0 where these contradict each other.
    both: Vec<Vec<f64>>,
    /// Largest angles between them, radians.
    pub(super) angles: Vec<Vec<f64>>,
}

/// Hypotheses about one object, and how well each explains its pixels.
pub(super) struct Judge<'a> {
    evidence: Evidence<'a>,
    /// Size of the object and edge of a voxel, metres.
    size: f64,
    voxel: f64,
    /// Cells of the layer of light.
    light: LayerCells,
    courses: Vec<Course>,
    residuals: Vec<Residuals>,
}

impl<'a> Judge<'a> {
    /// A judge of an object of this size (the larger of half height and radius, metres) with a first hypothesis, under
    /// which it does not turn; `None` where the views are too few.
    pub(super) fn new(views: &'a [ObjectView], size: f64, unturned: Course) -> Option<Self> {
        let evidence = Evidence::of(views.iter().filter(|view| view.is_reliable()))?;
        let voxel = voxel(&evidence, size, &unturned)?;
        let mut judge = Self {
            evidence,
            size,
            voxel,
            light: LayerCells { of_pixel: Vec::new(), count: 0 },
            courses: Vec::new(),
            residuals: Vec::new(),
        };
        let (hull, hits) = judge.seen(&unturned);
        judge.light = light_cells(&judge.evidence, &hull, &compared_hits(&hits));
        judge.residuals.push(judge.residuals_of(&unturned, &hull, &hits, false));
        judge.courses.push(unturned);
        Some(judge)
    }

    /// Adds hypotheses.
    pub(super) fn add(&mut self, courses: Vec<Course>) {
        let of = |course: &Course| {
            let (hull, hits) = self.seen(course);
            self.residuals_of(course, &hull, &hits, true)
        };
        let found: Vec<Residuals> = courses.par_iter().map(of).collect();
        self.residuals.extend(found);
        self.courses.extend(courses);
    }

    /// The hypotheses so far against each other.
    pub(super) fn compared(&self) -> Compared {
        let compared = |of: fn(&Residuals) -> &[f32], least: f64| {
            let fields: Vec<&[f32]> = self.residuals.iter().map(of).collect();
            compared(&self.evidence, &fields, least)
        };
        let layered = compared(|r| &r.layered, ROUNDING);
        let shaded = compared(|r| &r.shaded, ROUNDING);
        let missed = compared(|r| &r.missed, LEFT_OUT);
        let of_row = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| both(*a, *b)).collect();
        let both = layered.iter().zip(&missed).map(of_row).collect();
        let count = self.courses.len();
        let angles = (0..count).map(|a| (0..count).map(|b| self.angle(a, b)).collect()).collect();
        Compared { layered, shaded, missed, both, angles }
    }

    /// The finding by a comparison of hypotheses at angles; `None` where none can be compared with another.
    pub(super) fn verdict(&self, compared: &[Vec<f64>], angles: &[Vec<f64>]) -> Option<Verdict> {
        let largest = self.residuals.iter().map(|residuals| residuals.volume).fold(0.0, f64::max);
        let is_out: Vec<bool> = self.residuals.iter().map(|r| r.volume < LEAST_VOLUME * largest).collect();
        verdict(compared, angles, &is_out)
    }

    /// Largest angle between two hypotheses, radians: both are taken relative to the middle of the times at which they have
    /// poses, for frames of objects are arbitrary.
    fn angle(&self, a: usize, b: usize) -> f64 {
        let of = |look: &Look<'_>| {
            let rotation = |k: usize| Some(self.courses[k].get(&look.view.time_index)?.rotation);
            Some((rotation(a)?, rotation(b)?))
        };
        let shared: Vec<(DQuat, DQuat)> = self.evidence.looks.iter().filter_map(of).collect();
        let Some((first, second)) = shared.get(shared.len() / 2) else { return 0.0 };
        let (first, second) = (first.inverse(), second.inverse());
        shared.iter().map(|(a, b)| (*a * first).angle_between(*b * second)).fold(0.0, f64::max)
    }

    /// Hull of a hypothesis, and what pixels see of it.
    fn seen(&self, course: &Course) -> (Hull, Vec<Option<Hit>>) {
        let hull = Hull::of(&self.evidence, self.size, self.voxel, course);
        let hits = hits(&self.evidence, &hull, course);
        (hull, hits)
    }

    fn residuals_of(&self, course: &Course, hull: &Hull, hits: &[Option<Hit>], turns: bool) -> Residuals {
        let missed = hits.iter().map(|hit| if hit.is_some() { 0.0 } else { 1.0 }).collect();
        let hits = &compared_hits(hits);
        let of_pixel = hits.iter().map(|hit| hit.map(|hit| hit.cell)).collect();
        let paint = LayerCells { of_pixel, count: hull.cells() };
        Residuals {
            layered: layered(&self.evidence, &paint, &self.light, turns),
            shaded: shaded(&self.evidence, hits, hull.cells(), course),
            missed,
            volume: hull.volume(),
        }
    }
}

/// Surface points of all pixels.
fn hits(evidence: &Evidence<'_>, hull: &Hull, course: &Course) -> Vec<Option<Hit>> {
    let mut found = Vec::with_capacity(evidence.len());
    for look in &evidence.looks {
        let Some(pose) = course.get(&look.view.time_index) else {
            found.extend(look.pixels.iter().map(|_| None));
            continue;
        };
        let origin = look.view.camera.centre();
        let hit = |ray: DVec3| hull.met(pose, origin, ray);
        found.extend(look.pixels.iter().map(|pixel| hit(pixel.ray)));
    }
    found
}

/// Those of surface points that are seen well enough to be compared.
fn compared_hits(hits: &[Option<Hit>]) -> Vec<Option<Hit>> {
    hits.iter().map(|hit| hit.filter(|hit| hit.facing > GRAZING)).collect()
}

/// The larger one of the standard errors of two kinds of evidence; 0 where both decide, and contradict each other.
fn both(layered: f64, missed: f64) -> f64 {
    let contradict = layered.min(missed) < -SIGMAS && layered.max(missed) > SIGMAS;
    match (layered.is_nan(), missed.is_nan()) {
        (true, _) => missed,
        (_, true) => layered,
        _ if contradict => 0.0,
        _ if layered.abs() > missed.abs() => layered,
        _ => missed,
    }
}

/// Cells of the layer of light by pixel: voxels of the hull without turns, of each camera apart where several stay in
/// place, since highlights move with them. All pixels share one where that hull is hardly hit.
fn light_cells(evidence: &Evidence<'_>, hull: &Hull, hits: &[Option<Hit>]) -> LayerCells {
    let cameras = evidence.looks.iter().map(|look| look.camera).max().unwrap_or(0) + 1;
    if hits.iter().flatten().count() < FEWEST {
        return LayerCells { of_pixel: vec![Some(0); hits.len()], count: 1 };
    }
    let of_pixel = evidence.looks.iter().flat_map(|look| look.pixels.iter().map(|_| look.camera));
    let cell = |(hit, camera): (&Option<Hit>, u32)| hit.map(|hit| hit.cell * cameras + camera);
    let of_pixel = hits.iter().zip(of_pixel).map(cell).collect();
    LayerCells { of_pixel, count: hull.cells() * cameras as usize }
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
    Some(Verdict { best, is_observed: margin > SIGMAS, turns: angles[best][0] > APART })
}
