//! Gaussians that stand still: found by probing the network, taken out of it, and tested again. Source: methods
//! reference 11 (idea 5).
//!
//! A Gaussian that stands still keeps the mean of what the network did to it: that is added to its canonical
//! parameters once, and the network then leaves it alone, forward and backward. A Gaussian that the network,
//! trained by its neighbours, would move again is handed back the same way.

use cif_field::deformation::Deformation;
use cif_field::deformation::evaluate::Deltas;
use cif_field::{Field, Gaussians};

use super::Trainer;
use super::earned::{gain, judged_error};
use crate::config::EffectsConfig;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::schedule::falls_on;

/// Times at which the network is probed.
const PROBES: usize = 8;

/// Gaussians probed together, which bounds the memory.
const CHUNK: usize = 4_096;

/// Motion, in highest limits, from which a Gaussian that stands still is handed back; more than 1, so that none
/// goes back and forth.
const RELEASE: f32 = 2.0;

/// Rungs of the ladder of limits, each half of the one above.
pub(super) const RUNGS: u32 = 6;

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
    /// The test for Gaussians that stand still, where it falls on this step: of a ladder of limits, the highest
    /// one counts that does not show in the held-out pixels.
    pub(super) fn settle(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let last = self.plan.iterations(&self.config, stage);
        let due = falls_due(&self.config.effects, stage, iteration, last);
        let Some(deformation) = self.field.deformation.as_ref().filter(|_| due) else { return Ok(()) };
        let effects = &self.config.effects;
        let highest = Limits {
            displacement: effects.still_displacement * self.field.extent,
            shape: effects.still_shape,
        };
        let rows: Vec<u32> = (0..self.field.len() as u32).collect();
        let motions = probe(deformation, &self.field.gaussians, &rows, &probe_times(&self.dataset.times));
        let settings = self.color_settings();
        let views = (&self.frames, &self.dataset);
        let before = judged_error(&mut self.renderer, views, &self.field, &settings)?;
        // Not far above the rung that held last time, so that few are tried in vain.
        let (mut rung, mut settled, mut released) = (self.progress.still_rung.saturating_sub(1), 0, 0);
        while rung < RUNGS {
            let limits = highest.scaled(0.5_f32.powi(rung as i32));
            let mut trial = self.field.clone();
            let counts = rest(&mut trial, &motions, limits, highest.scaled(RELEASE));
            if counts == (0, 0) {
                break;
            }
            let views = (&self.frames, &self.dataset);
            let after = judged_error(&mut self.renderer, views, &trial, &settings)?;
            if gain(after, before) <= f64::from(effects.still_loss) {
                self.field = trial;
                (settled, released) = counts;
                break;
            }
            rung += 1;
        }
        self.progress.still_rung = rung.min(RUNGS - 1);
        let still = self.field.deformation.as_ref().map_or(0, |d| d.still.iter().filter(|s| **s).count());
        let gaussians = self.field.len();
        events.push(TrainEvent::Settled { stage, iteration, still, settled, released, gaussians });
        Ok(())
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

/// Whether a test falls on a step: at a share of the fine stage, then every so many steps, never at the end of a
/// stage, where nothing is left to make good for it.
fn falls_due(effects: &EffectsConfig, stage: Stage, iteration: u32, last: u32) -> bool {
    if effects.still_every == 0 || iteration >= last {
        return false;
    }
    match stage {
        Stage::Fine => {
            let from = first_test(effects.still_from, last);
            iteration == from || (iteration > from && falls_on(iteration - from, effects.still_every))
        }
        Stage::Instance => falls_on(iteration, effects.still_every),
        _ => false,
    }
}

/// Step of the fine stage on which the first test falls.
pub(super) fn first_test(share: f32, fine_steps: u32) -> u32 {
    ((f64::from(share) * f64::from(fine_steps)).round() as u32).max(1)
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
    fn scaled(self, factor: f32) -> Self {
        Self { displacement: factor * self.displacement, shape: factor * self.shape }
    }

    fn hold(self, motion: &Motion) -> bool {
        motion.displacement <= self.displacement && motion.shape <= self.shape
    }
}

/// Settles what moves inside one limit and releases what moves beyond another; returns their numbers. A field
/// without a deformation stays as it is.
fn rest(field: &mut Field, motions: &[Motion], settle: Limits, release: Limits) -> (usize, usize) {
    let Some(deformation) = &mut field.deformation else { return (0, 0) };
    deformation.still.resize(motions.len(), false);
    let (mut settled, mut released) = (0, 0);
    for (row, motion) in motions.iter().enumerate() {
        let still = &mut deformation.still[row];
        if !*still && settle.hold(motion) {
            add(&mut field.gaussians, row, &motion.mean, 1.0);
            (*still, settled) = (true, settled + 1);
        } else if *still && !release.hold(motion) {
            add(&mut field.gaussians, row, &motion.mean, -1.0);
            (*still, released) = (false, released + 1);
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

    const ALL: Limits = Limits { displacement: f32::INFINITY, shape: f32::INFINITY };

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
            (1..=last).filter(|step| falls_due(&effects, stage, *step, last)).collect()
        };
        assert_eq!(due(Stage::Fine, 200), [50, 100, 150]);
        assert_eq!(due(Stage::Fine, 170), [43, 93, 143]);
        assert_eq!(due(Stage::Instance, 101), [50, 100]);
        assert!(due(Stage::Coarse, 200).is_empty());
        let never = EffectsConfig { still_every: 0, ..effects };
        assert!(!falls_due(&never, Stage::Fine, 50, 200));
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
        assert_eq!(rest(&mut field, &motions, limits, limits), (31, 0));
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
        assert_eq!(rest(&mut field, &first, all, all), (60, 0));
        let still = field.deformed(0.4);
        assert_eq!(still, field.gaussians, "nothing goes through the network");
        let second = motions(&field);
        assert_eq!(rest(&mut field, &second, none, none), (0, 60));
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
    fn shape_counts_like_displacement() {
        let mut field = field();
        let rows: Vec<u32> = (0..60).collect();
        let motions = probe(field.deformation.as_ref().unwrap(), &field.gaussians, &rows, &[0.0, 0.5, 1.0]);
        let only = Limits { displacement: f32::INFINITY, shape: 0.0 };
        assert_eq!(rest(&mut field, &motions, only, ALL), (0, 0));
        field.deformation = None;
        assert_eq!(rest(&mut field, &motions, ALL, ALL), (0, 0));
    }
}
