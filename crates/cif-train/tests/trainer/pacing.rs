//! Runs that end by a budget or by a target, on a clock of the tests' own.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::support::{Manual, Scene, capture, small_config};
use cif_train::budget::{Budget, BudgetClock};
use cif_train::curve::Targets;
use cif_train::fit::{Workload, calibrate, choose};
use cif_train::{Clock, Control, Outcome, Seconds, Stage, TrainConfig, TrainEvent, Trainer};

/// A clock that moves on by a tenth of a second whenever it is read: a step reads it three times.
#[derive(Default)]
struct Ticking(AtomicU64);

impl Clock for Ticking {
    fn now(&self) -> Seconds {
        let seconds = 0.1 * self.0.fetch_add(1, Ordering::SeqCst) as f64;
        Seconds { wall_s: seconds, cpu_s: 2.0 * seconds }
    }
}

fn budget(seconds: f64, clock: &Arc<dyn Clock>, on: BudgetClock) -> Budget {
    Budget { seconds, clock: on, threads: 2, start: clock.now() }
}

#[test]
fn a_budget_ends_every_stage_on_time() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    for on in [BudgetClock::Wall, BudgetClock::Cpu] {
        let clock: Arc<dyn Clock> = Arc::new(Ticking::default());
        let budget = budget(60.0, &clock, on);
        let mut trainer = Trainer::new(dataset.clone(), small_config()).unwrap();
        trainer.set_clock(Arc::clone(&clock));
        trainer.set_budget(budget);
        let mut stages = Vec::new();
        let outcome = trainer.run(&mut |event, _| {
            if let TrainEvent::StageStarted { stage, .. } = event {
                stages.push(*stage);
            }
            Control::Continue
        });
        assert_eq!(outcome.unwrap(), Outcome::Finished);
        use Stage::{Coarse, Fine, Identity, Instance, Objects, Search};
        assert_eq!(stages, [Search, Coarse, Objects, Fine, Identity, Instance]);
        let used = budget.used(clock.now());
        assert!((54.0..=62.0).contains(&used), "{used}");
        let record = trainer.field().record.to_json()["train"].clone();
        let steps = |stage: &str| record["iterations_by_stage"][stage].as_u64().unwrap();
        let planned = small_config().stages;
        assert!(steps("coarse") < u64::from(planned.coarse) && steps("coarse") > 5);
        assert!(steps("fine") < u64::from(planned.fine) && steps("fine") > 60, "{record:#}");
        assert!(steps("instance") < u64::from(planned.instance) && steps("instance") > 20);
        let config = trainer.config();
        assert_eq!(u64::from(config.stages.fine), steps("fine"), "the settings state what was done");
        assert!(config.densify.until < config.stages.fine && config.resample.until < config.stages.instance);
        assert_eq!(record["goals"]["budget"]["seconds"], 60.0);
        trainer.into_field().validate().unwrap();
    }
}

#[test]
fn a_resumed_run_takes_a_budget_for_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = small_config();
    config.report.step_every = 1;
    let mut stopped = Trainer::new(dataset.clone(), config).unwrap();
    let outcome = stopped.run(&mut |event, _| match event {
        TrainEvent::Step { stage: Stage::Fine, iteration: 40, .. } => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    let path = folder.path().join("stopped.cif");
    stopped.checkpoint(true).save(&path).unwrap();
    let mut resumed = Trainer::resume(dataset, cif_field::Checkpoint::load(&path).unwrap()).unwrap();
    let clock: Arc<dyn Clock> = Arc::new(Ticking::default());
    let budget = budget(30.0, &clock, BudgetClock::Wall);
    resumed.set_clock(Arc::clone(&clock));
    resumed.set_budget(budget);
    assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    let used = budget.used(clock.now());
    assert!((27.0..=32.0).contains(&used), "{used}");
    let record = resumed.field().record.to_json()["train"]["iterations_by_stage"].clone();
    assert!(record["fine"].as_u64() > Some(60) && record["instance"].as_u64() > Some(10), "{record}");
}

#[test]
fn more_time_than_steps_need_is_not_wasted_but_used() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 1, views: 3, masks: false, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.report.step_every) = (10, 10, 1);
    let manual = Arc::new(Manual::default());
    let clock: Arc<dyn Clock> = Arc::clone(&manual) as _;
    let budget = budget(60.0, &clock, BudgetClock::Wall);
    let mut trainer = Trainer::new(dataset, config).unwrap();
    trainer.set_clock(Arc::clone(&clock));
    trainer.set_budget(budget);
    // A step takes 0.3 s.
    let outcome = trainer.run(&mut |event, _| {
        if let TrainEvent::Step { .. } = event {
            manual.pass(0.3);
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    let used = budget.used(clock.now());
    assert!((58.0..=60.5).contains(&used), "{used}");
    assert!(trainer.steps_done() > 100, "{}", trainer.steps_done());
}

fn with_target(targets: Targets, config: TrainConfig) -> (Trainer, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
    let mut trainer = Trainer::new(dataset, config).unwrap();
    trainer.set_targets(targets).unwrap();
    let mut warnings = Vec::new();
    trainer
        .run(&mut |event, _| {
            if let TrainEvent::Warning { message } = event
                && message.contains("reach")
            {
                warnings.push(message.clone());
            }
            Control::Continue
        })
        .unwrap();
    (trainer, warnings)
}

#[test]
fn targets_end_a_run_as_soon_as_they_are_reached() {
    let mut config = small_config();
    (config.stages.fine, config.stages.instance, config.report.withhold) = (2_000, 1_000, 3);
    let (trainer, warnings) = with_target(Targets { psnr: Some(16.0), miou: Some(40.0) }, config);
    assert!(trainer.reached_targets(), "{warnings:?}");
    let last = trainer.curve().points.last().unwrap();
    assert!(last.psnr >= Some(16.0) && last.miou >= Some(40.0), "{last:?}");
    assert!(trainer.steps_done() < 1_000, "{}", trainer.steps_done());
    assert!(trainer.config().stages.instance < 500, "instances follow the shorter fine stage");
    assert_eq!(trainer.field().record.to_json()["train"]["goals"]["targets"]["reached"], true);
    assert!(warnings.is_empty(), "{warnings:?}");
}

#[test]
fn targets_out_of_reach_are_reported_on_the_way_and_at_the_end() {
    let mut config = small_config();
    (config.stages.fine, config.stages.instance, config.report.withhold) = (1_000, 100, 3);
    let (trainer, warnings) = with_target(Targets { psnr: Some(60.0), miou: None }, config);
    assert!(!trainer.reached_targets());
    assert_eq!(trainer.steps_done(), 1_200, "all steps were done");
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings[0].contains("PSNR 60 is out of reach"), "{warnings:?}");
    assert!(warnings[1].starts_with("not reached on training frames withheld"), "{warnings:?}");
}

#[test]
fn instances_cannot_be_a_target_without_masks() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, masks: false, ..Scene::default() });
    let mut trainer = Trainer::new(dataset, small_config()).unwrap();
    let error = trainer.set_targets(Targets { psnr: None, miou: Some(50.0) }).unwrap_err();
    assert!(error.to_string().contains("no training mask has a labelled pixel"), "{error}");
}

#[test]
fn steps_are_measured_and_settings_chosen() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
    let clock: Arc<dyn Clock> = Arc::new(Ticking::default());
    let base = small_config();
    let calibration = calibrate(&dataset, &base, &clock, BudgetClock::Wall, 1, 0.5).unwrap();
    assert_eq!(calibration.image_size, [crate::support::WIDTH, crate::support::HEIGHT]);
    // As many as there will be.
    assert_eq!((calibration.initial, calibration.most, calibration.gaussians), (450, 800, 800));
    // The clock is read around all steps, and after each from the third on.
    assert_eq!(calibration.steps, 7);
    // Trained Gaussians take longer than those that points are split into.
    assert!((calibration.step_s - 1.3 * 0.6 / 7.0).abs() < 1e-9, "{calibration:?}");
    let work = Workload::of(&dataset, 0);
    assert_eq!((work.is_dynamic, work.has_instances, work.frames), (true, true, 12));
    let choice = choose(&base, &calibration, work, 20.0);
    assert!(choice.config.stages.fine < base.stages.fine && choice.config.downscale.is_none());
    choice.config.validate().unwrap();
}
