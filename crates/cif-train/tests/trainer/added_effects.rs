//! An effect that is declared here alone.

use std::sync::Arc;

use crate::support::{Scene, capture, small_config, without_record};
use cif_field::{Checkpoint, Field};
use cif_train::effects::{Bench, Effect, Standing};
use cif_train::schedule::Moment;
use cif_train::{Control, Outcome, Stage, TrainConfig, TrainError, TrainEvent, Trainer};

/// Steps of the fine stage behind which it is judged.
const STEPS: [u32; 2] = [7, 14];

/// Colours of their own: the field goes on in black where that loses no more than so many dB.
struct Colours {
    allowed_db: f64,
}

impl Colours {
    fn in_black(field: &Field) -> Field {
        let mut trial = field.clone();
        trial.gaussians.sh_coefficients.iter_mut().for_each(|of| of[..3].fill(-3.0));
        trial
    }
}

impl Effect for Colours {
    fn name(&self) -> &'static str {
        "colours"
    }

    fn due(&self, step: &Moment<'_>, standing: &Standing<'_>) -> bool {
        !standing.field.is_empty() && step.stage == Stage::Fine && STEPS.contains(&step.iteration)
    }

    fn holds_out(&self, step: &Moment<'_>) -> bool {
        step.stage == Stage::Fine && step.iteration <= STEPS[1]
    }

    fn judge(&self, bench: &mut Bench<'_>) -> Result<(), TrainError> {
        let trial = Self::in_black(bench.field());
        let (with, without) = (bench.error(None)?, bench.error(Some(&trial))?);
        let gain_db = 10.0 * (without / with).log10();
        let kept = gain_db > self.allowed_db;
        bench.report("colours".to_owned(), gain_db, kept);
        if !kept {
            bench.take(trial);
        }
        Ok(())
    }
}

/// Settings of a run of a few steps in which nothing else is judged.
fn config() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (10, 20, 10);
    config.stages.fine_includes_coarse = false;
    (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
    (config.effects.still_every, config.effects.sh_gain, config.effects.head_gain) = (0, 0.0, 0.0);
    config.report.step_every = 1;
    config
}

/// Runs on, at most to a step of all stages; judgements as stage, step, gain and verdict.
fn run(trainer: &mut Trainer, effect: Colours, stop_behind: u64) -> Vec<(Stage, u32, f64, bool)> {
    trainer.add_effect(Arc::new(effect));
    let (mut judged, mut done) = (Vec::new(), trainer.steps_done());
    let outcome = trainer.run(&mut |event, _| {
        if let TrainEvent::Judged { stage, iteration, gain_db, kept, .. } = event {
            judged.push((*stage, *iteration, *gain_db, *kept));
        }
        done += u64::from(matches!(event, TrainEvent::Step { .. }));
        if done >= stop_behind { Control::Stop } else { Control::Continue }
    });
    outcome.unwrap();
    judged
}

#[test]
fn an_added_effect_is_judged_on_its_steps_and_taken_back_by_its_evidence() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let begun = || Trainer::new(dataset.clone(), config()).unwrap();
    let mut without = begun();
    assert_eq!(without.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);

    let mut kept = begun();
    let judged = run(&mut kept, Colours { allowed_db: -90.0 }, u64::MAX);
    assert_eq!(
        judged.iter().map(|of| (of.0, of.1, of.3)).collect::<Vec<_>>(),
        [(Stage::Fine, STEPS[0], true), (Stage::Fine, STEPS[1], true)]
    );
    assert!(judged.iter().all(|(.., gain_db, _)| *gain_db > 0.0), "black is worse: {judged:?}");
    // What is judged by trains nothing meanwhile, so that the run ends elsewhere.
    assert!(without_record(kept.field()) != without_record(without.field()));
    let seconds = kept.field().record.to_json()["train"]["seconds_by_effect"].clone();
    assert!(seconds["colours"].as_f64().unwrap() > 0.0, "{seconds}");

    let mut taken = begun();
    let judged = run(&mut taken, Colours { allowed_db: 90.0 }, 10 + u64::from(STEPS[0]));
    assert!(!judged[0].3, "{judged:?}");
    let is_black = |field: &Field| field.gaussians.sh_coefficients.iter().all(|of| of[..3] == [-3.0; 3]);
    assert!(is_black(taken.field()) && !is_black(kept.field()));
}

#[test]
fn a_resumed_run_that_is_given_its_effect_again_ends_where_an_uninterrupted_one_ends() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut whole = Trainer::new(dataset.clone(), config()).unwrap();
    let judged = run(&mut whole, Colours { allowed_db: 90.0 }, u64::MAX);
    assert_eq!(judged.len(), 2);
    let mut stopped = Trainer::new(dataset.clone(), config()).unwrap();
    run(&mut stopped, Colours { allowed_db: 90.0 }, 20);
    let path = folder.path().join("stopped.cif");
    stopped.checkpoint(true).save(&path).unwrap();
    let mut resumed = Trainer::resume(dataset, Checkpoint::load(&path).unwrap()).unwrap();
    assert_eq!(run(&mut resumed, Colours { allowed_db: 90.0 }, u64::MAX), judged[1..]);
    assert!(without_record(resumed.field()) == without_record(whole.field()));
}
