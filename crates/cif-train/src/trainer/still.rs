//! Gaussians that stand still: found by probing the network, taken out of it, and tested again. Source: methods
//! reference 11 (idea 5).
//!
//! A Gaussian that stands still keeps the mean of what the network did to it: that is added to its canonical
//! parameters once, and the network then leaves it alone, forward and backward. What has not learnt to move yet
//! looks like what never will: so nothing settles among others that move, and a changing few of those that stand
//! still go through the network all the same. Where these learn to move, their neighbours are handed back. Where all
//! cameras stay in place, their images tell from the start: what they see change stays in the network for half of the
//! fine stage, and the rest leaves it at once.

use std::collections::BTreeMap;

use cif_field::deformation::Deformation;
use cif_field::deformation::evaluate::Deltas;
use cif_field::{Field, Gaussians};
use rand::RngExt;
use rayon::prelude::*;

use super::Trainer;
use super::changes::{Changes, Sight};
use super::earned::gain;
use crate::config::EffectsConfig;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::random::{Purpose, stream};

/// Times at which the network is probed.
const PROBES: usize = 8;

/// Gaussians probed together, which bounds the memory.
const CHUNK: usize = 4_096;

/// Motion, in limits, from which a Gaussian that stands still is handed back; more than 1, so that none goes back
/// and forth.
const RELEASE: f32 = 2.0;

/// Side of the cells in which Gaussians have neighbours, relative to the extent.
const AROUND: f32 = 0.02;

/// Share of its neighbours that must move for a Gaussian to be kept awake, and fewest of them.
const RESTLESS: f64 = 0.2;
const FEWEST_MOVING: u32 = 3;

/// Rungs of the ladder of limits, each half of the one above.
pub(super) const RUNGS: u32 = 3;

/// What the network does to a Gaussian over the probe times.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Motion {
    /// Mean of the deltas.
    pub mean: Deltas<f32>,
    /// Largest distance of the displacement from its mean, metres.
    pub displacement: f32,
    /// Largest difference of the other deltas from their mean; quaternions are measured as if of unit length.
    pub shape: f32,
}

impl Trainer {
    /// Whether Gaussians are tested after a step.
    pub(super) fn settles(&self, stage: Stage, iteration: u32) -> bool {
        let last = self.plan.iterations(&self.config, stage);
        self.field.deformation.is_some()
            && falls_due(&self.config.effects, self.first_test(), stage, iteration, last)
    }

    /// The test for Gaussians that stand still, where it falls on this step: of a ladder of limits, the highest
    /// one counts that does not show in the held-out pixels. What the network moves again is handed back unless
    /// that shows.
    pub(super) fn settle(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let last = self.plan.iterations(&self.config, stage);
        let due = self.settles(stage, iteration);
        let Some(deformation) = self.field.deformation.as_ref().filter(|_| due) else { return Ok(()) };
        let effects = &self.config.effects;
        let highest = Limits {
            displacement: effects.still_displacement * self.field.extent,
            shape: effects.still_shape,
        };
        let allowed = f64::from(effects.still_loss);
        let rows: Vec<u32> = (0..self.field.len() as u32).collect();
        let mut motions = probe(deformation, &self.field.gaussians, &rows, &probe_times(&self.dataset.times));
        let sights = self.sights(&motions)?;
        for (motion, _) in motions.iter_mut().zip(&sights).filter(|(_, sight)| **sight == Sight::Steady) {
            // Nothing tells this motion from none.
            (motion.displacement, motion.shape) = (0.0, 0.0);
        }
        let settings = self.color_settings();
        let before = self.judged_error(None, &settings)?;
        let mut watched = self.draw_watched(stage);
        for (watched, _) in watched.iter_mut().zip(&sights).filter(|(_, sight)| **sight == Sight::Steady) {
            *watched = false;
        }
        let restless = restless(&self.field, &motions, highest);
        let awake: Vec<bool> = (0..motions.len())
            .map(|row| match sights.get(row) {
                Some(Sight::Steady) => false,
                // By then the network has learnt what moves.
                Some(Sight::Changing) if stage == Stage::Fine && iteration <= last / 2 => true,
                _ => watched[row] || restless[row],
            })
            .collect();
        // Not far above the rung that held last time, so that few are tried in vain.
        let mut rung = self.progress.still_rung.saturating_sub(1);
        let (mut settled, mut error) = (0, before);
        while rung < RUNGS {
            let limits = highest.scaled(0.5_f32.powi(rung as i32));
            let mut trial = self.field.clone();
            let (found, _) = rest(&mut trial, &motions, limits, Limits::NEVER, &awake);
            if found == 0 {
                break;
            }
            let after = self.judged_error(Some(&trial), &settings)?;
            if gain(after, before) <= allowed {
                (self.field, settled, error) = (trial, found, after);
                break;
            }
            rung += 1;
        }
        self.progress.still_rung = rung.min(RUNGS - 1);
        // Where nothing is trained, the network may do anything: what it says must fit the pictures.
        let mut trial = self.field.clone();
        let (_, mut released) = rest(&mut trial, &motions, Limits::NONE, highest.scaled(RELEASE), &awake);
        if trial != self.field && gain(self.judged_error(Some(&trial), &settings)?, error) > allowed {
            (trial, released) = (self.field.clone(), 0);
            rest(&mut trial, &motions, Limits::NONE, Limits::NEVER, &watched);
        }
        self.field = trial;
        #[cfg(feature = "wgpu")]
        self.gaussians_changed();
        let still = self.field.deformation.as_ref().map_or(0, |d| d.still.iter().filter(|s| **s).count());
        let gaussians = self.field.len();
        events.push(TrainEvent::Settled { stage, iteration, still, settled, released, gaussians });
        Ok(())
    }

    /// Whether Gaussians will be tested on this step or a later one.
    pub(super) fn tests_to_come(&self, stage: Stage, iteration: u32) -> bool {
        let every = self.config.effects.still_every;
        if every == 0 || !self.plan.is_dynamic {
            return false;
        }
        let last = self.plan.iterations(&self.config, Stage::Fine);
        match stage {
            Stage::Coarse => true,
            // The instance stage begins with a test; else the last one is in this stage.
            Stage::Fine => {
                self.plan.has_instances
                    || (iteration..last)
                        .take(every as usize)
                        .any(|later| falls_due(&self.config.effects, self.first_test(), stage, later, last))
                    || iteration < self.first_test()
            }
            _ => iteration <= 1,
        }
    }

    /// Step of the fine stage on which the first test falls: its first, where images tell what moves.
    fn first_test(&self) -> u32 {
        if self.shows_changes {
            return 1;
        }
        let fine_steps = f64::from(self.plan.iterations(&self.config, Stage::Fine));
        ((f64::from(self.config.effects.still_from) * fine_steps).round() as u32).max(1)
    }

    /// What cameras that stay in place see at each Gaussian, where it is in the mean; empty without such cameras.
    fn sights(&mut self, motions: &[Motion]) -> Result<Vec<Sight>, TrainError> {
        if !self.shows_changes {
            return Ok(Vec::new());
        }
        if self.changes.is_none() {
            self.changes = Some(Changes::find(&self.dataset, &self.frames)?);
        }
        let (Some(changes), Some(deformation)) = (&self.changes, &self.field.deformation) else {
            return Ok(Vec::new());
        };
        let sight = |(row, motion): (usize, &Motion)| {
            let mut place = self.field.gaussians.means[row];
            if !deformation.is_still(row) {
                accumulate(&mut place, &motion.mean.position, 1.0);
            }
            changes.at(place)
        };
        Ok(motions.par_iter().enumerate().map(sight).collect())
    }

    /// Which Gaussians go through the network until the next test though they could stand still. None in the
    /// instance stage, where nothing learns to move any more.
    fn draw_watched(&self, stage: Stage) -> Vec<bool> {
        let share = if stage == Stage::Fine { self.config.effects.still_awake } else { 0.0 };
        let mut rng = stream(self.config.seed, Purpose::Still, self.progress.total_steps);
        (0..self.field.len()).map(|_| rng.random::<f32>() < share).collect()
    }

    /// Follows a change of the set of Gaussians: copies and children of what stands still stand still.
    pub(super) fn gather_still(&mut self, parents: &[u32]) {
        if let Some(deformation) = &mut self.field.deformation {
            deformation.still = deformation.gather_still(parents);
        }
    }

    /// Follows a relocation of one Gaussian to another.
    pub(super) fn copy_still(&mut self, to: u32, from: u32) {
        if let Some(deformation) = &mut self.field.deformation
            && !deformation.still.is_empty()
        {
            deformation.still[to as usize] = deformation.is_still(from as usize);
        }
    }
}

/// Whether a test falls on a step: at a share of the fine stage, then every so many steps, never at its end, where
/// nothing is left to make good for it; and once more when the instance stage begins.
fn falls_due(effects: &EffectsConfig, first_test: u32, stage: Stage, iteration: u32, last: u32) -> bool {
    if effects.still_every == 0 || iteration >= last {
        return false;
    }
    match stage {
        Stage::Fine => {
            iteration >= first_test && (iteration - first_test).is_multiple_of(effects.still_every)
        }
        Stage::Instance => iteration == 1,
        _ => false,
    }
}

/// Evenly spread captured times.
pub(super) fn probe_times(times: &[f64]) -> Vec<f64> {
    let mut probes: Vec<f64> =
        (0..PROBES).map(|k| times[k * times.len().saturating_sub(1) / (PROBES - 1)]).collect();
    probes.dedup();
    probes
}

/// Limits of motion.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Limits {
    /// Metres.
    displacement: f32,
    shape: f32,
}

impl Limits {
    /// What everything keeps to.
    const NEVER: Self = Self { displacement: f32::INFINITY, shape: f32::INFINITY };
    /// What nothing keeps to.
    const NONE: Self = Self { displacement: -1.0, shape: -1.0 };

    fn scaled(self, factor: f32) -> Self {
        Self { displacement: factor * self.displacement, shape: factor * self.shape }
    }

    fn hold(self, motion: &Motion) -> bool {
        motion.displacement <= self.displacement && motion.shape <= self.shape
    }
}

/// Gaussians among others that move: of those that go through the network around them, a share moves more than the
/// limits. Things move as wholes, and what moves little learns it late.
fn restless(field: &Field, motions: &[Motion], limits: Limits) -> Vec<bool> {
    let Some(deformation) = &field.deformation else { return vec![false; motions.len()] };
    let cell_of = |row: usize, motion: &Motion| -> [i64; 3] {
        let moved = if deformation.is_still(row) { [0.0; 3] } else { motion.mean.position };
        std::array::from_fn(|axis| {
            let place = field.gaussians.means[row][axis] + moved[axis];
            (f64::from(place) / f64::from(AROUND * field.extent)).floor() as i64
        })
    };
    // Rows that go through the network, and of these those that move, by cell.
    let mut cells: BTreeMap<[i64; 3], [u32; 2]> = BTreeMap::new();
    for (row, motion) in motions.iter().enumerate().filter(|(row, _)| !deformation.is_still(*row)) {
        let counts = cells.entry(cell_of(row, motion)).or_default();
        counts[0] += 1;
        counts[1] += u32::from(!limits.hold(motion));
    }
    let mut known: BTreeMap<[i64; 3], bool> = BTreeMap::new();
    let around = |[x, y, z]: [i64; 3]| {
        let (mut all, mut moving) = (0, 0);
        for (near_x, near_y) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (x + dx, y + dy))) {
            for (_, counts) in cells.range([near_x, near_y, z - 1]..=[near_x, near_y, z + 1]) {
                (all, moving) = (all + counts[0], moving + counts[1]);
            }
        }
        moving >= FEWEST_MOVING && f64::from(moving) >= RESTLESS * f64::from(all)
    };
    let of_row = |(row, motion)| {
        let cell = cell_of(row, motion);
        *known.entry(cell).or_insert_with(|| around(cell))
    };
    motions.iter().enumerate().map(of_row).collect()
}

/// Settles what moves inside one limit and releases what moves beyond another; returns their numbers. What is to be
/// `awake` goes through the network either way. A field without a deformation stays as it is.
fn rest(
    field: &mut Field,
    motions: &[Motion],
    settle: Limits,
    release: Limits,
    awake: &[bool],
) -> (usize, usize) {
    let Some(deformation) = &mut field.deformation else { return (0, 0) };
    deformation.still.resize(motions.len(), false);
    let (mut settled, mut released) = (0, 0);
    for (row, motion) in motions.iter().enumerate() {
        let still = &mut deformation.still[row];
        let moves = !release.hold(motion);
        if !*still && !awake[row] && settle.hold(motion) {
            add(&mut field.gaussians, row, &motion.mean, 1.0);
            (*still, settled) = (true, settled + 1);
        } else if *still && (moves || awake[row]) {
            add(&mut field.gaussians, row, &motion.mean, -1.0);
            *still = false;
            released += usize::from(moves);
        }
    }
    if !deformation.still.contains(&true) {
        deformation.still.clear();
    }
    (settled, released)
}

/// What the network does to rows over some times, whether they stand still or not.
pub(super) fn probe(
    deformation: &Deformation,
    gaussians: &Gaussians,
    rows: &[u32],
    times: &[f64],
) -> Vec<Motion> {
    let mut motions = Vec::with_capacity(rows.len());
    for rows in rows.chunks(CHUNK) {
        let positions: Vec<[f32; 3]> = rows.iter().map(|row| gaussians.means[*row as usize]).collect();
        let deltas: Vec<Vec<Deltas<f32>>> =
            times.iter().map(|time| deformation.deltas_at(&positions, *time)).collect();
        for (k, row) in rows.iter().enumerate() {
            let norm = length(&gaussians.quaternions[*row as usize]).max(1e-6);
            let of_row: Vec<&Deltas<f32>> = deltas.iter().map(|at| &at[k]).collect();
            motions.push(motion(&of_row, norm));
        }
    }
    motions
}

fn motion(deltas: &[&Deltas<f32>], quaternion_norm: f32) -> Motion {
    let share = 1.0 / deltas.len() as f32;
    let mut mean =
        Deltas { position: [0.0; 3], scale: [0.0; 3], rotation: [0.0; 4], opacity: 0.0, sh: [0.0; 48] };
    for delta in deltas {
        accumulate(&mut mean.position, &delta.position, share);
        accumulate(&mut mean.scale, &delta.scale, share);
        accumulate(&mut mean.rotation, &delta.rotation, share);
        mean.opacity += share * delta.opacity;
        accumulate(&mut mean.sh, &delta.sh, share);
    }
    let (mut displacement, mut shape) = (0.0_f32, 0.0_f32);
    for delta in deltas {
        displacement = displacement.max(distance(&delta.position, &mean.position));
        shape = shape
            .max(distance(&delta.scale, &mean.scale))
            .max(distance(&delta.rotation, &mean.rotation) / quaternion_norm)
            .max((delta.opacity - mean.opacity).abs())
            .max(distance(&delta.sh, &mean.sh));
    }
    Motion { mean, displacement, shape }
}

/// Adds deltas to the canonical parameters of a row.
fn add(gaussians: &mut Gaussians, row: usize, deltas: &Deltas<f32>, sign: f32) {
    accumulate(&mut gaussians.means[row], &deltas.position, sign);
    accumulate(&mut gaussians.log_scales[row], &deltas.scale, sign);
    accumulate(&mut gaussians.quaternions[row], &deltas.rotation, sign);
    gaussians.opacity_logits[row] += sign * deltas.opacity;
    accumulate(&mut gaussians.sh_coefficients[row], &deltas.sh, sign);
}

fn accumulate<const LENGTH: usize>(totals: &mut [f32; LENGTH], values: &[f32; LENGTH], weight: f32) {
    for (total, value) in totals.iter_mut().zip(values) {
        *total += weight * value;
    }
}

fn distance<const LENGTH: usize>(a: &[f32; LENGTH], b: &[f32; LENGTH]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt()
}

fn length(values: &[f32; 4]) -> f32 {
    distance(values, &[0.0; 4])
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic;

    use super::*;

    const ALL: Limits = Limits::NEVER;

    /// Nobody is kept awake.
    const NOBODY: [bool; 60] = [false; 60];

    fn field() -> Field {
        let mut field = synthetic::generate(&synthetic::SyntheticConfig {
            gaussians: 60,
            heads: Some(synthetic::ALL_HEADS),
            ..Default::default()
        })
        .field;
        field.extent = 1.0;
        field
    }

    #[test]
    fn tests_fall_after_the_warm_up_and_never_at_the_end() {
        let effects = EffectsConfig { still_every: 50, still_from: 0.25, ..EffectsConfig::default() };
        let due = |stage, last: u32| -> Vec<u32> {
            let first_test = (0.25 * f64::from(last)).round() as u32;
            (1..=last).filter(|step| falls_due(&effects, first_test, stage, *step, last)).collect()
        };
        assert_eq!(due(Stage::Fine, 200), [50, 100, 150]);
        assert_eq!(due(Stage::Fine, 170), [43, 93, 143]);
        assert_eq!(due(Stage::Instance, 101), [1]);
        assert!(due(Stage::Coarse, 200).is_empty());
        let never = EffectsConfig { still_every: 0, ..effects };
        assert!(!falls_due(&never, 50, Stage::Fine, 50, 200));
    }

    #[test]
    fn probe_times_are_captured_times_from_first_to_last() {
        let times: Vec<f64> = (0..50).map(|k| f64::from(k) / 49.0).collect();
        let probes = probe_times(&times);
        assert_eq!((probes.len(), probes[0], probes[7]), (8, 0.0, 1.0));
        assert!(probes.iter().all(|probe| times.contains(probe)));
        assert_eq!(probe_times(&[0.0, 1.0]), [0.0, 1.0]);
        assert_eq!(probe_times(&[0.3]), [0.3]);
    }

    #[test]
    fn what_settles_stays_at_its_mean_and_what_moves_is_left_alone() {
        let mut field = field();
        let times = probe_times(&[0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0]);
        let before = field.clone();
        let rows: Vec<u32> = (0..field.len() as u32).collect();
        let motions = probe(before.deformation.as_ref().unwrap(), &before.gaussians, &rows, &times);
        let mut sizes: Vec<f32> = motions.iter().map(|motion| motion.displacement).collect();
        sizes.sort_by(f32::total_cmp);
        let limit = sizes[30];
        let limits = Limits { displacement: limit, shape: f32::INFINITY };
        assert_eq!(rest(&mut field, &motions, limits, limits, &NOBODY), (31, 0));
        for (row, motion) in motions.iter().enumerate() {
            let is_still = motion.displacement <= limit;
            assert_eq!(field.deformation.as_ref().unwrap().is_still(row), is_still);
            if !is_still {
                assert_eq!(field.gaussians.means[row], before.gaussians.means[row]);
            }
            // At no probe is anything farther from where it was than the limit.
            for time in &times {
                let (now, then) = (field.deformed(*time), before.deformed(*time));
                let moved = distance(&now.means[row], &then.means[row]);
                assert!(moved <= if is_still { limit * 1.001 } else { 0.0 }, "{row}: {moved}");
            }
        }
    }

    #[test]
    fn what_the_network_moves_again_is_released_near_where_it_was() {
        let mut field = field();
        let times = [0.0, 0.25, 0.5, 0.75, 1.0];
        let motions = |field: &Field| {
            let rows: Vec<u32> = (0..60).collect();
            probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &times)
        };
        let (none, all) = (Limits { displacement: 0.0, shape: 0.0 }, ALL);
        let first = motions(&field);
        assert_eq!(rest(&mut field, &first, all, all, &NOBODY), (60, 0));
        let still = field.deformed(0.4);
        assert_eq!(still, field.gaussians, "nothing goes through the network");
        let second = motions(&field);
        assert_eq!(rest(&mut field, &second, none, none, &NOBODY), (0, 60));
        assert!(field.deformation.as_ref().unwrap().still.is_empty());
        let mut farthest = 0.0_f32;
        let largest = motions(&field).iter().map(|motion| motion.displacement).fold(0.0, f32::max);
        for time in times {
            let moved = field.deformed(time);
            for row in 0..60 {
                farthest = farthest.max(distance(&moved.means[row], &still.means[row]));
            }
        }
        assert!(farthest < 3.0 * largest, "{farthest} against a motion of {largest}");
    }

    #[test]
    fn those_kept_awake_go_through_the_network_from_where_they_stood() {
        let mut field = field();
        let times = [0.0, 0.5, 1.0];
        let rows: Vec<u32> = (0..60).collect();
        let motions =
            |field: &Field| probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &times);
        let awake: Vec<bool> = (0..60).map(|row| row % 4 == 0).collect();
        let first = motions(&field);
        assert_eq!(rest(&mut field, &first, ALL, ALL, &awake), (45, 0));
        let others: Vec<bool> = awake.iter().map(|awake| !awake).collect();
        assert_eq!(field.deformation.as_ref().unwrap().still, others);
        let (before, second) = (field.clone(), motions(&field));
        // Those that stood still wake, the others settle.
        assert_eq!(rest(&mut field, &second, ALL, ALL, &others), (15, 0));
        assert_eq!(field.deformation.as_ref().unwrap().still, awake);
        let farthest = second.iter().map(|motion| motion.displacement).fold(0.0, f32::max);
        for time in times {
            let (now, then) = (field.deformed(time), before.deformed(time));
            for row in 0..60 {
                let moved = distance(&now.means[row], &then.means[row]);
                assert!(moved <= 3.0 * farthest, "{row}: {moved} against a motion of {farthest}");
            }
        }
    }

    #[test]
    fn what_is_among_others_that_move_stays_awake() {
        let mut field = field();
        // One crowd at the origin, one far away; a third of the first moves.
        for (row, place) in field.gaussians.means.iter_mut().enumerate() {
            let side = if row < 30 { 0.0 } else { 0.5 };
            *place = [side + 0.001 * (row % 5) as f32, 0.0, 0.0];
        }
        let still =
            Deltas { position: [0.0; 3], scale: [0.0; 3], rotation: [0.0; 4], opacity: 0.0, sh: [0.0; 48] };
        let mut motions: Vec<Motion> = (0..60)
            .map(|row| Motion {
                mean: still.clone(),
                displacement: if row < 30 && row % 3 == 0 { 0.1 } else { 0.0 },
                shape: 0.0,
            })
            .collect();
        let limits = Limits { displacement: 0.01, shape: 1.0 };
        let first_crowd: Vec<bool> = (0..60).map(|row| row < 30).collect();
        assert_eq!(restless(&field, &motions, limits), first_crowd);
        // Only those that are looked at count: where few of many are awake, these tell for all.
        field.deformation.as_mut().unwrap().still = (0..60).map(|row| row % 3 != 0).collect();
        assert_eq!(restless(&field, &motions, limits), first_crowd);
        field.deformation.as_mut().unwrap().still = (0..60).map(|row| row % 3 == 0).collect();
        assert_eq!(restless(&field, &motions, limits), [false; 60]);
        // Two are too few to tell.
        field.deformation.as_mut().unwrap().still.clear();
        motions.iter_mut().skip(4).for_each(|motion| motion.displacement = 0.0);
        assert_eq!(restless(&field, &motions, limits), [false; 60]);
    }

    #[test]
    fn shape_counts_like_displacement() {
        let mut field = field();
        let rows: Vec<u32> = (0..60).collect();
        let motions = probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &[0.0, 0.5, 1.0]);
        let only = Limits { displacement: f32::INFINITY, shape: 0.0 };
        assert_eq!(rest(&mut field, &motions, only, ALL, &NOBODY), (0, 0));
        field.deformation = None;
        assert_eq!(rest(&mut field, &motions, ALL, ALL, &NOBODY), (0, 0));
    }
}
