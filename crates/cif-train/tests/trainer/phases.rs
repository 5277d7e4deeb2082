//! Where the time of a run goes, and how it is stopped and limited inside what is no step.

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use crate::support::{Manual, Scene, capture, small_config, train, without_record};
use cif_dataset::{Dataset, PointSource};
use cif_field::Checkpoint;
use cif_train::budget::{Budget, BudgetClock};
use cif_train::{
    Clock, Control, Outcome, Phase, Phases, Seconds, Stage, Start, Stop, TrainConfig, TrainError, TrainEvent,
    Trainer,
};

/// A clock that moves on by a tenth of a second whenever it is read.
#[derive(Default)]
struct Ticking(AtomicU64);

impl Ticking {
    fn at(ticks: u64) -> f64 {
        0.1 * ticks as f64
    }
}

impl Clock for Ticking {
    fn now(&self) -> Seconds {
        let seconds = Self::at(self.0.fetch_add(1, Ordering::SeqCst));
        Seconds { wall_s: seconds, cpu_s: seconds }
    }
}

/// A ball that rolls over a floor, between two that rest, seen by one moving camera.
fn rolling(folder: &Path) -> Dataset {
    let scene = Scene { times: 8, views: 8, rolls: Some(0.9), one_camera: true, ..Scene::default() };
    let mut dataset = capture(folder, scene);
    dataset.points.positions.drain(300..450);
    dataset.points.colors.drain(300..450);
    dataset.points.source = PointSource::File(folder.join("points.ply"));
    dataset
}

fn guided() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 30, 10);
    (config.motion.guidance, config.motion.stillness, config.motion.rehearsal) = (10.0, 1.0, 20);
    (config.motion.rigid, config.motion.gaussians) = (true, 60);
    config.report.evaluate_every = 25;
    config
}

type Events = Arc<Mutex<Vec<TrainEvent>>>;

/// Phases whose events are kept, on a clock; stopped when `stops` says so of an event.
fn kept(
    clock: Arc<dyn Clock>,
    stops: impl Fn(&TrainEvent) -> bool + Send + Sync + 'static,
) -> (Phases, Events) {
    let events = Events::default();
    let phases = Phases::new(clock, Stop::default()).reported_to({
        let events = Arc::clone(&events);
        move |event| {
            events.lock().unwrap().push(event.clone());
            if stops(event) { Control::Stop } else { Control::Continue }
        }
    });
    (phases, events)
}

#[test]
fn every_phase_is_reported_and_all_of_them_add_up_to_the_time_that_passed() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = rolling(folder.path());
    let clock = Arc::new(Ticking::default());
    let (phases, events) = kept(Arc::clone(&clock) as _, |_| false);
    let command = phases.enter(Phase::Other, 0);
    let start = Start { dataset, phases: phases.clone() };
    let mut trainer = Trainer::new(start, guided()).unwrap();
    assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    let sum: f64 = trainer.wall_s_by_phase().values().sum();
    // The last reading is that of the sum, the next one is a tick later; the first was 0.
    let passed = clock.now().wall_s - Ticking::at(1);
    assert!((sum - passed).abs() < 1e-6, "{sum} of {passed}: {:?}", trainer.wall_s_by_phase());
    drop(command);

    let events = events.lock().unwrap();
    let mut open: Vec<Phase> = Vec::new();
    let mut seen: Vec<Phase> = Vec::new();
    for event in events.iter() {
        match event {
            TrainEvent::PhaseStarted { phase, .. } => {
                open.push(*phase);
                seen.push(*phase);
            }
            TrainEvent::PhaseProgress { phase, done, total, .. } => {
                assert_eq!(open.last(), Some(phase));
                assert!(*total == 0 || done <= total, "{event:?}");
            }
            TrainEvent::PhaseEnded { phase, done, total, wall_s, .. } => {
                assert_eq!(open.pop(), Some(*phase), "phases end inside out");
                assert!(*wall_s > 0.0, "{event:?}");
                assert!(!matches!(phase, Phase::Decode | Phase::Search | Phase::Objects) || done == total);
            }
            other => panic!("no event of a phase: {other:?}"),
        }
    }
    assert!(open.is_empty(), "{open:?}");
    use Phase::{
        Coarse, Decode, Evaluate, Fine, Identity, Instance, Masks, Measure, Objects, Paths, Presence,
    };
    for phase in
        [Decode, Masks, Paths, Coarse, Objects, Presence, Fine, Identity, Instance, Measure, Evaluate]
    {
        assert!(seen.contains(&phase), "{phase} is missing: {seen:?}");
    }
    let progresses = |phase: Phase| {
        events.iter().any(|event| {
            matches!(event, TrainEvent::PhaseProgress { phase: of, steps, .. } if *of == phase && *steps > 0)
        })
    };
    assert!(progresses(Objects), "fits of objects show how far they are");
    let position = |phase: Phase| seen.iter().position(|of| *of == phase).unwrap();
    assert!(position(Decode) < position(Masks) && position(Paths) < position(Coarse));
    assert!(position(Coarse) < position(Objects) && position(Objects) < position(Fine));
}

#[test]
fn a_stop_inside_fits_is_obeyed_at_once_and_the_run_goes_on_to_the_same_end() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = rolling(folder.path());
    let config = guided();
    let whole = train(dataset.clone(), config.clone());
    for (phase, has_begun) in [(Phase::Search, false), (Phase::Objects, true)] {
        let (phases, events) = kept(
            Arc::new(Ticking::default()),
            move |event| matches!(event, TrainEvent::PhaseProgress { phase: of, steps, .. } if *of == phase && *steps > 0),
        );
        let start = Start { dataset: dataset.clone(), phases };
        let mut trainer = Trainer::new(start, config.clone()).unwrap();
        assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Interrupted, "{phase}");
        assert_eq!(trainer.has_begun(), has_begun, "{phase}");
        let steps = events.lock().unwrap().iter().find_map(|event| match event {
            TrainEvent::PhaseEnded { phase: of, steps, .. } if *of == phase => Some(*steps),
            _ => None,
        });
        // A fit has thousands of steps; those under way when it is stopped are counted.
        assert!(steps.unwrap() < 600, "{phase}: {steps:?}");
        let path = folder.path().join("stopped.cif");
        trainer.checkpoint(true).save(&path).unwrap();
        let mut resumed = Trainer::resume(dataset.clone(), Checkpoint::load(&path).unwrap()).unwrap();
        assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        assert!(without_record(resumed.field()) == without_record(whole.field()), "{phase}");
    }
}

/// Events of phases and stages of a run that goes on from a state.
fn resumed_from(dataset: &Dataset, state: Checkpoint) -> (Trainer, Vec<TrainEvent>) {
    let (phases, events) = kept(Arc::new(Ticking::default()), |_| false);
    let mut resumed = Trainer::resume(Start { dataset: dataset.clone(), phases }, state).unwrap();
    let outcome = resumed.run(&mut |event, _| {
        events.lock().unwrap().push(event.clone());
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    let events = std::mem::take(&mut *events.lock().unwrap());
    (resumed, events)
}

#[test]
fn fits_of_objects_are_stages_that_a_resumed_run_does_not_repeat() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = rolling(folder.path());
    let mut config = guided();
    config.report.checkpoint_seconds = 1;
    let mut trainer = Trainer::new(dataset.clone(), config).unwrap();
    trainer.set_clock(Arc::new(Ticking::default()));
    let (mut states, mut seconds) = (Vec::new(), Vec::new());
    let outcome = trainer.run(&mut |event, view| {
        match event {
            TrainEvent::CheckpointDue { stage, .. } => states.push((*stage, view.checkpoint(true))),
            TrainEvent::StageEnded { stage, wall_s, .. } => seconds.push((*stage, *wall_s)),
            _ => {}
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    let expected = without_record(trainer.field());

    use Stage::{Coarse, Fine, Identity, Instance, Objects, Search};
    let order: Vec<Stage> = seconds.iter().map(|(stage, _)| *stage).collect();
    assert_eq!(order, [Search, Coarse, Objects, Fine, Identity, Instance]);
    assert!(seconds.iter().all(|(_, wall_s)| *wall_s > 0.0), "{seconds:?}");
    let record = trainer.field().record.to_json()["train"]["seconds_by_stage"].clone();
    assert!(
        record["search"].as_f64().unwrap() > 0.0 && record["objects"].as_f64().unwrap() > 0.0,
        "{record}"
    );

    let begun = |events: &[TrainEvent], phase: Phase| {
        let is_begin =
            |e: &TrainEvent| matches!(e, TrainEvent::PhaseStarted { phase: of, .. } if *of == phase);
        events.iter().any(is_begin)
    };
    let at = |stage: Stage| states.iter().find(|(of, _)| *of == stage).unwrap().1.clone();
    let (resumed, events) = resumed_from(&dataset, at(Coarse));
    assert!(!begun(&events, Phase::Search) && begun(&events, Phase::Objects));
    assert!(without_record(resumed.field()) == expected, "behind the search");
    let (resumed, events) = resumed_from(&dataset, at(Fine));
    for phase in [Phase::Paths, Phase::Search, Phase::Objects, Phase::Presence, Phase::Rehearsal] {
        assert!(!begun(&events, phase), "{phase} is done again");
    }
    assert!(without_record(resumed.field()) == expected, "behind the fits");

    // Version 1 had no stages of fits, and kept no more of them than what was fitted so far.
    let mut old = at(Coarse);
    let json = &mut old.training.as_mut().unwrap().json;
    json["version"] = 1.into();
    for key in ["objects", "travelling"] {
        assert!(json.as_object_mut().unwrap().remove(key).is_some(), "{key} is saved");
    }
    let (resumed, events) = resumed_from(&dataset, old);
    assert!(begun(&events, Phase::Search), "it searches anew");
    assert!(without_record(resumed.field()) == expected, "from a state of version 1");
}

#[test]
fn a_stop_while_frames_are_decoded_ends_the_preparation() {
    let folder = tempfile::tempdir().unwrap();
    let (phases, _) = kept(Arc::new(Ticking::default()), |event| {
        matches!(event, TrainEvent::PhaseProgress { phase: Phase::Decode, .. })
    });
    let stopped = Trainer::new(Start { dataset: rolling(folder.path()), phases }, guided());
    assert!(matches!(stopped.err(), Some(TrainError::Stopped)));
}

#[test]
fn what_does_not_fit_into_a_budget_is_left_out_and_noted() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = rolling(folder.path());
    // Every step takes a second, and the first steps of fits so many more.
    let run = |fits_s: f64| {
        let clock = Arc::new(Manual::default());
        let (phases, _) = kept(Arc::clone(&clock) as _, {
            let clock = Arc::clone(&clock);
            move |event| {
                if let TrainEvent::PhaseProgress { phase: Phase::Objects, steps: 1.., .. } = event {
                    clock.pass(fits_s);
                }
                false
            }
        });
        let budget = Budget { seconds: 90.0, clock: BudgetClock::Wall, threads: 1, start: clock.now() };
        let mut config = guided();
        config.report.step_every = 1;
        let mut trainer = Trainer::new(Start { dataset: dataset.clone(), phases }, config).unwrap();
        trainer.set_budget(budget);
        let mut notes = Vec::new();
        let outcome = trainer.run(&mut |event, _| {
            match event {
                TrainEvent::Note { message } => notes.push(message.clone()),
                TrainEvent::Step { .. } => clock.pass(1.0),
                _ => {}
            }
            Control::Continue
        });
        assert_eq!(outcome.unwrap(), Outcome::Finished);
        (trainer.into_field(), notes, budget.used(clock.now()))
    };
    let (field, notes, used) = run(40.0);
    assert!((85.0..=92.0).contains(&used), "{used}");
    assert!(field.tracks.is_none(), "no object was fitted");
    let left_out = "the budget leaves no time to fit ball 9: moved by the deformation network";
    assert!(notes.iter().any(|note| note.starts_with(left_out)), "{notes:?}");
    field.validate().unwrap();
    // With time for it, it is fitted, and the steps get what it leaves.
    let (field, notes, used) = run(0.0);
    assert!(field.tracks.is_some(), "{notes:?}");
    assert!(!notes.iter().any(|note| note.contains("the budget")), "{notes:?}");
    assert!((85.0..=92.0).contains(&used), "{used}");
}
