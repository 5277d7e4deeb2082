//! Gaussians that stand still: found by probing the network, taken out of it, and tested again. Source: methods
//! reference 11 (idea 5).
//!
//! A Gaussian that stands still keeps the mean of what the network did to it: that is added to its canonical
//! parameters once, and the network then leaves it alone, forward and backward. What has not learnt to move yet
//! looks like what never will: so nothing settles among others that move, and a changing few of those that stand
//! still go through the network all the same. Where these learn to move, their neighbours are handed back. Where all
//! cameras stay in place, their images tell from the start: what they see change stays in the network for half of the
//! fine stage, and the rest leaves it at once. Where masks tell which objects travel, the same holds for these from
//! an early step of a long stage on, provided that it hardly shows; what else moves is then handed back.

use rand::RngExt;
use rayon::prelude::*;

use super::Trainer;
use super::changes::{Changes, Sight};
use super::judged::gain;
use super::motions::{Limits, Motion, accumulate, probe, probe_times, put_to_rest, restless, wake};
use crate::engine::Changed;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::random::{Purpose, stream};
use crate::schedule::Due;
use crate::stage::Stage;

/// Motion, in limits, from which a Gaussian that stands still is handed back; more than 1, so that none goes back
/// and forth.
const RELEASE: f32 = 2.0;

/// Where masks tell the travelling objects: loss, dB on held-out pixels, up to which everything else is taken to
/// stand still on the first test.
const TOLD_LOSS: f64 = 0.1;

/// Rungs of the ladder of limits, each half of the one above.
pub(super) const RUNGS: u32 = 3;

impl Trainer {
    /// The test for Gaussians that stand still, where it falls on this step: of a ladder of limits, the highest
    /// one counts that does not show in the held-out pixels. What the network moves again is handed back unless
    /// that shows; then only those watched are, of which the network says that they hardly move.
    pub(super) fn settle(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let last = self.stages.iterations(&self.state.config, stage);
        let by_masks = self.moment(stage, iteration, self.state.progress.total_steps).has(Due::StillByMasks);
        let Some(deformation) = &self.state.field.deformation else { return Ok(()) };
        let effects = &self.state.config.effects;
        let highest = Limits {
            displacement: effects.still_displacement * self.state.field.extent,
            shape: effects.still_shape,
        };
        let allowed = f64::from(effects.still_loss);
        let rows: Vec<u32> = (0..self.state.field.len() as u32).collect();
        let mut motions =
            probe(deformation, &self.state.field.gaussians, &rows, &probe_times(&self.state.dataset.times));
        let sights = self.sights(&motions)?;
        let mut watched = self.draw_watched(stage);
        for (row, _) in sights.iter().enumerate().filter(|(_, sight)| **sight == Sight::Steady) {
            // Nothing tells this motion from none.
            (motions[row].displacement, motions[row].shape) = (0.0, 0.0);
            watched[row] = false;
        }
        let travels: Vec<bool> = (0..motions.len()).map(|row| self.state.guidance.travels(row)).collect();
        let restless = restless(&self.state.field, &motions, highest);
        // In the second half the network has learnt what moves.
        let learns = stage == Stage::Fine && iteration <= last / 2;
        let awake: Vec<bool> = (0..motions.len())
            .map(|row| match sights.get(row) {
                Some(Sight::Steady) => false,
                Some(Sight::Changing) if learns => true,
                _ => watched[row] || restless[row] || (learns && travels[row]),
            })
            .collect();
        let settings = self.state.color_settings();
        let mut error = self.judged_error(None, &settings)?;
        let mut settled = None;
        if by_masks {
            let stands = |row: usize| !watched[row] && !travels[row];
            settled = self.try_to_settle(&motions, stands, &mut error, TOLD_LOSS)?;
        }
        let mut released = 0;
        if settled.is_none() {
            // Not far above the rung that held last time, so that few are tried in vain.
            let mut rung = self.state.progress.still_rung.saturating_sub(1);
            while settled.is_none() && rung < RUNGS {
                let limits = highest.scaled(0.5_f32.powi(rung as i32));
                let rests = |row: usize| !awake[row] && limits.hold(&motions[row]);
                settled = self.try_to_settle(&motions, rests, &mut error, allowed)?;
                rung += u32::from(settled.is_none());
            }
            self.state.progress.still_rung = rung.min(RUNGS - 1);
            let mut trial = self.state.field.clone();
            released = wake(&mut trial, &motions, |row| !highest.scaled(RELEASE).hold(&motions[row]));
            let woken = released + wake(&mut trial, &motions, |row| awake[row]);
            // Where nothing is trained, the network may do anything: what it says must fit the pictures.
            if woken > 0 && gain(self.judged_error(Some(&trial), &settings)?, error) > allowed {
                trial = self.state.field.clone();
                released = 0;
                wake(&mut trial, &motions, |row| watched[row] && highest.hold(&motions[row]));
            }
            self.state.field = trial;
        }
        let rested = if stage == Stage::Instance { self.rest_instances(&motions)? } else { 0 };
        self.engine.changed(Changed::Gaussians);
        let still =
            self.state.field.deformation.as_ref().map_or(0, |d| d.still.iter().filter(|s| **s).count());
        let gaussians = self.state.field.len();
        let settled = settled.unwrap_or(0) + rested;
        events.push(TrainEvent::Settled { stage, iteration, still, settled, released, gaussians });
        Ok(())
    }

    /// Puts rows to rest where the `error` in the held-out pixels grows by no more dB than allowed; returns how many
    /// and leaves the new error, or `None`.
    fn try_to_settle(
        &mut self,
        motions: &[Motion],
        wanted: impl Fn(usize) -> bool,
        error: &mut f64,
        allowed: f64,
    ) -> Result<Option<usize>, TrainError> {
        let mut trial = self.state.field.clone();
        let found = put_to_rest(&mut trial, motions, wanted);
        if found > 0 {
            let after = self.judged_error(Some(&trial), &self.state.color_settings())?;
            if gain(after, *error) > allowed {
                return Ok(None);
            }
            (self.state.field, *error) = (trial, after);
        }
        Ok(Some(found))
    }

    /// Change that cameras which stay in place see at the mean position of each Gaussian; empty without such cameras.
    fn sights(&mut self, motions: &[Motion]) -> Result<Vec<Sight>, TrainError> {
        if !self.shows_changes {
            return Ok(Vec::new());
        }
        if self.changes.is_none() {
            self.changes = Some(Changes::find(&self.state.dataset, &self.state.frames)?);
        }
        let (Some(changes), Some(deformation)) = (&self.changes, &self.state.field.deformation) else {
            return Ok(Vec::new());
        };
        let sight = |(row, motion): (usize, &Motion)| {
            let mut place = self.state.field.gaussians.means[row];
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
        let share = if stage == Stage::Fine { self.state.config.effects.still_awake } else { 0.0 };
        let mut rng = stream(self.state.config.seed, Purpose::Still, self.state.progress.total_steps);
        (0..self.state.field.len()).map(|_| rng.random::<f32>() < share).collect()
    }

    /// Follows a change of the set of Gaussians: copies and children of what stands still stand still.
    pub(super) fn gather_still(&mut self, parents: &[u32]) {
        if let Some(deformation) = &mut self.state.field.deformation {
            deformation.still = deformation.gather_still(parents);
        }
    }

    /// Follows a relocation of one Gaussian to another.
    pub(super) fn copy_still(&mut self, to: u32, from: u32) {
        if let Some(deformation) = &mut self.state.field.deformation
            && !deformation.still.is_empty()
        {
            deformation.still[to as usize] = deformation.is_still(from as usize);
        }
    }
}

#[cfg(test)]
mod tests {
    use cif_dataset::Split;

    use super::super::guard_tests::support::{Scene, capture, small_config, stopped_after};
    use super::*;

    #[test]
    fn nothing_is_handed_back_where_the_network_learnt_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut dataset = capture(folder.path(), Scene { views: 2, ..Scene::default() });
        // So that its images do not tell what changes.
        let frame = dataset.frames.iter_mut().find(|frame| frame.split == Split::Train).unwrap();
        frame.camera.camera_from_world.translation.x += 1e-3;
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine) = (20, 100);
        config.motion.guidance = 0.0;
        let effects = &mut config.effects;
        (effects.still_every, effects.still_from, effects.still_awake) = (10, 0.1, 0.5);
        let mut trainer = stopped_after(&dataset, &config, 25);
        assert_eq!(trainer.stage(), Stage::Fine);
        let rows: Vec<u32> = (0..trainer.state.field.len() as u32).collect();
        let times = probe_times(&trainer.state.dataset.times);
        let probed = |trainer: &Trainer| {
            let deformation = trainer.state.field.deformation.as_ref().unwrap();
            probe(deformation, &trainer.state.field.gaussians, &rows, &times)
        };
        let motions = probed(&trainer);
        put_to_rest(&mut trainer.state.field, &motions, |_| true);
        let settings = trainer.state.color_settings();
        let before = trainer.judged_error(None, &settings).unwrap();
        for value in &mut trainer.state.field.deformation.as_mut().unwrap().mlp {
            *value *= 20.0;
        }
        let wild = probed(&trainer);
        assert!(wild.iter().filter(|motion| motion.displacement > 0.1).count() > rows.len() / 2);
        let mut events = Vec::new();
        trainer.settle(Stage::Fine, 10, &mut events).unwrap();
        let [TrainEvent::Settled { still, settled: 0, released: 0, .. }] = events[..] else {
            panic!("{events:?}")
        };
        assert!(still > rows.len() / 2, "{still} of {}", rows.len());
        let after = trainer.judged_error(None, &settings).unwrap();
        assert!(gain(after, before) < 0.1, "{before} before, {after} after");
    }
}
