//! Gaussians that stand still: found by probing the network, taken out of it, and tested again. Source: methods
//! reference 11 (idea 5).
//!
//! A Gaussian that stands still keeps the mean of what the network did to it: that is added to its canonical
//! parameters once, and the network then leaves it alone, forward and backward. What has not learnt to move yet
//! looks like what never will: so nothing settles among others that move, and a changing few of those that stand
//! still go through the network all the same. Where these learn to move, their neighbours are handed back. Where all
//! cameras stay in place, their images show it from the start: what they see change stays in the network for half of the
//! fine stage, and the rest leaves it at once. Where masks show which objects travel, the same holds for these from
//! an early step of a long stage on, provided that it hardly shows; what else moves is then handed back.

use cif_field::Field;
use rand::RngExt;
use rayon::prelude::*;

use super::bench::gain;
use super::changes::{Changes, Sight};
use super::motions::{Limits, Motion, accumulate, probe, probe_times, put_to_rest, restless, wake};
use super::resting::rest_instances;
use super::{Bench, Effect, Standing, Step};
use crate::engine::Changed;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::random::{Purpose, stream};
use crate::schedule::{Due, Moment};
use crate::stage::Stage;

/// Motion, in limits, from which a Gaussian that stands still is handed back; more than 1, so that none goes back
/// and forth.
const RELEASE: f32 = 2.0;

/// Where masks show the travelling objects: loss, dB on held-out pixels, up to which everything else is taken to
/// stand still on the first test.
const MASKS_LOSS: f64 = 0.1;

/// Rungs of the ladder of limits, each half of the one above.
const RUNGS: u32 = 3;

/// Gaussians that stand still.
pub(crate) struct Still;

impl Effect for Still {
    fn name(&self) -> &'static str {
        "still"
    }

    fn due(&self, step: &Moment<'_>, standing: &Standing<'_>) -> bool {
        standing.field.deformation.is_some() && step.has(Due::TestStill)
    }

    /// Of a ladder of limits, the highest one counts that does not show in the held-out pixels. What the network moves
    /// again is handed back unless that shows; then only those watched are, of which the network says that they hardly
    /// move.
    fn judge(&self, bench: &mut Bench<'_>) -> Result<(), TrainError> {
        let Some(evidence) = Evidence::of(bench)? else { return Ok(()) };
        let mut error = bench.error(None)?;
        let mut settled = None;
        if bench.moment().has(Due::StillByMasks) {
            let stands = |row: usize| !evidence.watched[row] && !evidence.moves[row];
            settled = try_to_settle(bench, &evidence.motions, stands, &mut error, MASKS_LOSS)?;
        }
        let mut released = 0;
        if settled.is_none() {
            settled = climb_down(bench, &evidence, &mut error)?;
            released = hand_back(bench, &evidence, error)?;
        }
        let Step { stage, iteration, .. } = bench.step;
        let rested = if stage == Stage::Instance { rest_instances(bench, &evidence.motions)? } else { 0 };
        bench.engine.changed(Changed::Gaussians);
        let field = &bench.state.field;
        let still = field.deformation.as_ref().map_or(0, |d| d.still.iter().filter(|s| **s).count());
        let (gaussians, settled) = (field.len(), settled.unwrap_or(0) + rested);
        bench.events.push(TrainEvent::Settled { stage, iteration, still, settled, released, gaussians });
        Ok(())
    }
}

/// Evidence for which Gaussians stand still.
struct Evidence {
    /// Motion that the network gives every Gaussian.
    motions: Vec<Motion>,
    /// Motion above which nothing settles.
    highest: Limits,
    /// Those that go through the network until the next test though they could stand still.
    watched: Vec<bool>,
    /// Those that were made for an object that travels or deforms.
    moves: Vec<bool>,
    /// Those that are not to settle, whatever the network does to them.
    awake: Vec<bool>,
}

impl Evidence {
    /// `None` without a network.
    fn of(bench: &mut Bench<'_>) -> Result<Option<Self>, TrainError> {
        let Step { stage, iteration, .. } = bench.step;
        let state = &*bench.state;
        let Some(deformation) = &state.field.deformation else { return Ok(None) };
        let effects = &state.config.effects;
        let highest = Limits {
            displacement: effects.still_displacement * state.field.extent,
            shape: effects.still_shape,
        };
        let rows: Vec<u32> = (0..state.field.len() as u32).collect();
        let mut motions =
            probe(deformation, &state.field.gaussians, &rows, &probe_times(&state.dataset.times));
        let sights = sights(bench, &motions)?;
        let mut watched = draw_watched(bench);
        for (row, _) in sights.iter().enumerate().filter(|(_, sight)| **sight == Sight::Steady) {
            // Nothing distinguishes this motion from none.
            (motions[row].displacement, motions[row].shape) = (0.0, 0.0);
            watched[row] = false;
        }
        let state = &*bench.state;
        let moves: Vec<bool> = (0..motions.len()).map(|row| state.guidance.moves(row)).collect();
        let restless = restless(&state.field, &motions, highest);
        // In the second half the network has learnt what moves.
        let last = bench.step.facts.stages.iterations(&state.config, stage);
        let learns = stage == Stage::Fine && iteration <= last / 2;
        let awake: Vec<bool> = (0..motions.len())
            .map(|row| match sights.get(row) {
                Some(Sight::Steady) => false,
                Some(Sight::Changing) if learns => true,
                _ => watched[row] || restless[row] || (learns && moves[row]),
            })
            .collect();
        Ok(Some(Self { motions, highest, watched, moves, awake }))
    }
}

/// Puts to rest what the highest limit of the ladder holds that does not show; how many, or `None` where all show.
fn climb_down(
    bench: &mut Bench<'_>,
    evidence: &Evidence,
    error: &mut f64,
) -> Result<Option<usize>, TrainError> {
    let allowed = f64::from(bench.config().effects.still_loss);
    // Not far above the rung that held last time, so that few are tried in vain.
    let mut rung = bench.state.progress.still_rung.saturating_sub(1);
    let mut settled = None;
    while settled.is_none() && rung < RUNGS {
        let limits = evidence.highest.scaled(0.5_f32.powi(rung as i32));
        let at_rest = |row: usize| !evidence.awake[row] && limits.hold(&evidence.motions[row]);
        settled = try_to_settle(bench, &evidence.motions, at_rest, error, allowed)?;
        rung += u32::from(settled.is_none());
    }
    bench.state.progress.still_rung = rung.min(RUNGS - 1);
    Ok(settled)
}

/// Hands back what the network moves, and those that are to be awake; how many of the first.
fn hand_back(bench: &mut Bench<'_>, evidence: &Evidence, error: f64) -> Result<usize, TrainError> {
    let Evidence { motions, highest, watched, awake, .. } = evidence;
    let allowed = f64::from(bench.config().effects.still_loss);
    let mut trial = bench.state.field.clone();
    let mut released = wake(&mut trial, motions, |row| !highest.scaled(RELEASE).hold(&motions[row]));
    let woken = released + wake(&mut trial, motions, |row| awake[row]);
    // Where nothing is trained, the network may do anything: what it says must fit the pictures.
    if woken > 0 && gain(bench.error(Some(&trial))?, error) > allowed {
        trial = bench.state.field.clone();
        released = 0;
        wake(&mut trial, motions, |row| watched[row] && highest.hold(&motions[row]));
    }
    bench.state.field = trial;
    Ok(released)
}

/// Puts rows to rest where the `error` in the held-out pixels grows by no more dB than allowed; returns how many and
/// leaves the new error, or `None`.
fn try_to_settle(
    bench: &mut Bench<'_>,
    motions: &[Motion],
    selected: impl Fn(usize) -> bool,
    error: &mut f64,
    allowed: f64,
) -> Result<Option<usize>, TrainError> {
    let mut trial = bench.state.field.clone();
    let found = put_to_rest(&mut trial, motions, selected);
    if found > 0 {
        let after = bench.error(Some(&trial))?;
        if gain(after, *error) > allowed {
            return Ok(None);
        }
        (bench.state.field, *error) = (trial, after);
    }
    Ok(Some(found))
}

/// Change that cameras which stay in place see at the mean position of each Gaussian; empty without such cameras.
fn sights(bench: &mut Bench<'_>, motions: &[Motion]) -> Result<Vec<Sight>, TrainError> {
    if !bench.step.facts.sees_changes {
        return Ok(Vec::new());
    }
    let state = &*bench.state;
    if bench.changes.is_none() {
        *bench.changes = Some(Changes::find(&state.dataset, &state.frames)?);
    }
    let (Some(changes), Some(deformation)) = (&*bench.changes, &state.field.deformation) else {
        return Ok(Vec::new());
    };
    let sight = |(row, motion): (usize, &Motion)| {
        let mut place = state.field.gaussians.means[row];
        if !deformation.is_still(row) {
            accumulate(&mut place, &motion.mean.position, 1.0);
        }
        changes.at(place)
    };
    Ok(motions.par_iter().enumerate().map(sight).collect())
}

/// Which Gaussians go through the network until the next test though they could stand still. None in the instance
/// stage, where nothing learns to move any more.
fn draw_watched(bench: &Bench<'_>) -> Vec<bool> {
    let state = &*bench.state;
    let share = if bench.step.stage == Stage::Fine { state.config.effects.still_awake } else { 0.0 };
    let mut rng = stream(state.config.seed, Purpose::Still, state.progress.total_steps);
    (0..state.field.len()).map(|_| rng.random::<f32>() < share).collect()
}

/// Follows a change of the set of Gaussians: copies and children of what stands still stand still.
pub(crate) fn gather_still(field: &mut Field, parents: &[u32]) {
    if let Some(deformation) = &mut field.deformation {
        deformation.still = deformation.gather_still(parents);
    }
}

/// Follows a relocation of one Gaussian to another.
pub(crate) fn copy_still(field: &mut Field, to: u32, from: u32) {
    if let Some(deformation) = &mut field.deformation
        && !deformation.still.is_empty()
    {
        deformation.still[to as usize] = deformation.is_still(from as usize);
    }
}

#[cfg(test)]
mod tests {
    use cif_dataset::Split;

    use super::*;
    use crate::trainer::Trainer;
    use crate::trainer::guard_tests::support::{Scene, capture, small_config, stopped_after};

    #[test]
    fn nothing_is_handed_back_where_the_network_learnt_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut dataset = capture(folder.path(), Scene { views: 2, ..Scene::default() });
        // So that its images do not show what changes.
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
        let before = trainer.at_judgement(Stage::Fine, 10, &mut Vec::new()).error(None).unwrap();
        for value in &mut trainer.state.field.deformation.as_mut().unwrap().mlp {
            *value *= 20.0;
        }
        let wild = probed(&trainer);
        assert!(wild.iter().filter(|motion| motion.displacement > 0.1).count() > rows.len() / 2);
        let mut events = Vec::new();
        Still.judge(&mut trainer.at_judgement(Stage::Fine, 10, &mut events)).unwrap();
        let [TrainEvent::Settled { still, settled: 0, released: 0, .. }] = events[..] else {
            panic!("{events:?}")
        };
        assert!(still > rows.len() / 2, "{still} of {}", rows.len());
        let after = trainer.at_judgement(Stage::Fine, 10, &mut Vec::new()).error(None).unwrap();
        assert!(gain(after, before) < 0.1, "{before} before, {after} after");
    }
}
