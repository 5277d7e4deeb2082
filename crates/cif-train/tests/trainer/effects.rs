//! Effects that a capture does not call for are not run, and what is left out costs no quality.

use crate::support::{
    Scene, capture, relative_gain, small_config, stopped_after, train, with_known_points, without_record,
};
use cif_dataset::{Dataset, Frame, Split};
use cif_train::exposure::Exposure;
use cif_train::metrics::{EvaluationError, EvaluationOptions, evaluate};
use cif_train::plan::EffectKind;
use cif_train::{Control, EffectChoice, EffectPlan, Outcome, Stage, TrainConfig, TrainEvent, Trainer};

/// The settings with what a capture calls for.
fn planned(dataset: &Dataset, config: &TrainConfig, choice: &str) -> TrainConfig {
    let choice: EffectChoice = choice.parse().unwrap();
    let mut config = config.clone();
    EffectPlan::new(dataset, &config, &choice).unwrap().apply(&mut config);
    config
}

/// [`small_config`] with tests that fall into its few steps.
fn still_config() -> TrainConfig {
    let mut config = small_config();
    config.effects.still_every = 40;
    config.effects.still_from = 0.3;
    config.effects.still_loss = 0.1;
    (config.effects.still_displacement, config.effects.still_shape) = (0.03, 0.5);
    config
}

/// Mean score of a run and of another with the next seed: between seeds, runs of so few steps waver by half a
/// decibel.
fn mean_score(run: &Trainer, config: &TrainConfig) -> f64 {
    let next = TrainConfig { seed: config.seed + 1, ..config.clone() };
    (score(run) + score(&train(run.dataset().clone(), next))) / 2.0
}

#[test]
fn a_static_capture_without_masks_trains_plain_splats_only() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 1, masks: false, ..Scene::default() });
    let config = planned(&dataset, &small_config(), "auto");
    let trainer = train(dataset, config);
    let times = trainer.times();
    assert!(times.steps > 0 && times.evaluated_pairs > 0);
    assert_eq!((times.deformed, times.deformed_backward), (0, 0));
    assert_eq!((times.labelled_tiles, times.identity_rows, times.instance_pairs), (0, 0, 0));
    assert!(trainer.field().deformation.is_none() && trainer.field().identities.is_none());
    // The scene records as much.
    let work = trainer.field().record.to_json()["train"]["work"].clone();
    assert_eq!(work, serde_json::json!(trainer.work()));
    let nothing = ["deformed", "deformed_backward", "labelled_tiles", "identity_rows", "instance_pairs"];
    assert!(nothing.iter().all(|name| work[name] == 0), "{work}");
    assert_eq!(work["views"], trainer.steps_done());
}

#[test]
fn motion_and_instances_can_be_switched_off() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let config = planned(&dataset, &small_config(), "none");
    let mut stages = Vec::new();
    let mut trainer = Trainer::new(dataset, config).unwrap();
    trainer
        .run(&mut |event, _| {
            if let TrainEvent::StageStarted { stage, .. } = event {
                stages.push(*stage);
            }
            Control::Continue
        })
        .unwrap();
    assert_eq!(stages, [Stage::Fine]);
    assert_eq!((trainer.times().deformed, trainer.times().identity_rows), (0, 0));
    assert_eq!(trainer.field().sh_degree, 0);
}

#[test]
fn the_plan_of_a_capture_follows_what_is_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let moving = capture(folder.path(), Scene { times: 6, views: 3, ..Scene::default() });
    let config = small_config();
    let plan = |dataset: &Dataset| EffectPlan::new(dataset, &config, &EffectChoice::default()).unwrap();
    let words = |plan: &EffectPlan, kind| plan.decision(kind).map(ToString::to_string);
    let found = plan(&moving);
    assert_eq!(words(&found, EffectKind::Motion).unwrap(), "where it is");
    assert_eq!(words(&found, EffectKind::Instances).unwrap(), "on");
    let motion = &found.effects[0].evidence;
    assert!(motion.starts_with("6 times; up to ") && motion.contains("fixed camera"), "{motion}");
    // The same pictures at every time: fixed cameras see nothing change.
    let mut still = moving.clone();
    for frame in &mut still.frames {
        frame.image = folder.path().join(format!("{}_0.png", frame.name.split('_').next().unwrap()));
    }
    assert_eq!(words(&plan(&still), EffectKind::Motion).unwrap(), "off");
    // One camera that moves sees the third ball roll, by its masks.
    let rolls = tempfile::tempdir().unwrap();
    let scene = Scene { times: 12, views: 12, rolls: Some(1.5), one_camera: true, ..Scene::default() };
    let found = plan(&capture(rolls.path(), scene));
    assert!(found.effects[0].evidence.contains("ball 9"), "{}", found.effects[0].evidence);
}

#[test]
fn what_stands_still_skips_the_network_and_what_moves_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let mut settled = Vec::new();
    let [some, every] = [still_config(), small_config()];
    let mut trainer = Trainer::new(dataset.clone(), some.clone()).unwrap();
    let outcome = trainer.run(&mut |event, _| {
        if let TrainEvent::Settled { still, .. } = event {
            settled.push(*still);
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    let whole = train(dataset, every.clone());
    assert!(!settled.is_empty() && settled[settled.len() - 1] > 0, "{settled:?}");

    let (part, all) = (trainer.times(), whole.times());
    assert!((part.deformed as f64) < 0.8 * all.deformed as f64, "{} of {}", part.deformed, all.deformed);
    assert!(part.deformed_backward < all.deformed_backward);
    let field = trainer.field();
    let still = |row: u32| field.deformation.as_ref().unwrap().is_still(row as usize);
    let share = |instance: usize| {
        let members = field.members(instance);
        members.iter().filter(|row| still(**row)).count() as f64 / members.len() as f64
    };
    // The third ball moves, the others do not.
    assert!(share(2) < 0.3 && share(0) > 0.5, "{} {} {}", share(0), share(1), share(2));
    let (with, without) = (mean_score(&trainer, &some), mean_score(&whole, &every));
    assert!(with > without - 0.5, "{with} dB against {without} dB");
}

#[test]
fn cameras_that_stay_in_place_tell_from_the_first_step_what_stands_still() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let mut config = still_config();
    config.stages.coarse = 40;
    // The first test of the fine stage: on which step, and the share of Gaussians that it settles.
    let first_test = |dataset: &Dataset| {
        let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
        let mut first = None;
        let outcome = trainer.run(&mut |event, _| {
            if let TrainEvent::Settled { stage: Stage::Fine, iteration, still, gaussians, .. } = event {
                first.get_or_insert((*iteration, *still as f64 / *gaussians as f64));
            }
            if first.is_some() { Control::Stop } else { Control::Continue }
        });
        assert_eq!(outcome.unwrap(), Outcome::Interrupted);
        first.unwrap()
    };
    let (step, share) = first_test(&dataset);
    assert_eq!(step, 1);
    assert!(share > 0.1 && share < 0.95, "the third ball and its shadow are seen to change: {share}");

    let mut moving = dataset;
    let frame = moving.frames.iter_mut().find(|frame| frame.split == Split::Train).unwrap();
    frame.camera.camera_from_world.translation.x += 1e-3;
    assert_ne!(first_test(&moving).0, 1, "images of a camera that moves change everywhere");
}

#[test]
fn a_resumed_run_keeps_what_stands_still_and_what_was_judged() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = still_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (40, 110, 60);
    (config.densify.from, config.densify.every) = (10, 20);
    (config.effects.still_every, config.resample.every) = (20, 10);
    config.model.sh_interval = 30;
    // What no output and no degree can gain.
    (config.effects.sh_gain, config.effects.head_gain) = (90.0, 90.0);
    config.report.step_every = 1;
    let (mut judged, mut stopped) = (Vec::new(), 0);
    let mut whole = Trainer::new(dataset.clone(), config.clone()).unwrap();
    whole
        .run(&mut |event, _| {
            if let TrainEvent::Judged { what, kept, .. } = event {
                judged.push((what.clone(), *kept));
            }
            Control::Continue
        })
        .unwrap();
    for what in ["view-dependent colour of degree 1", "motion of scales", "motion of rotations"] {
        let last = judged.iter().rfind(|(name, _)| name == what);
        assert!(last.is_some_and(|(_, kept)| !kept), "{what}: {judged:?}");
    }
    let deformation = whole.field().deformation.as_ref().unwrap();
    assert!(deformation.still.contains(&true) && !deformation.config.heads.rotation);
    assert_eq!(whole.field().sh_degree, 0);
    for stop_at in [72_u64, 73, 131] {
        let trainer = stopped_after(&dataset, &config, stop_at);
        let path = folder.path().join("stopped.cif");
        trainer.checkpoint(true).save(&path).unwrap();
        let loaded = cif_field::Checkpoint::load(&path).unwrap();
        let mut resumed = Trainer::resume(dataset.clone(), loaded).unwrap();
        assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        assert_eq!(without_record(resumed.field()), without_record(whole.field()), "stopped after {stop_at}");
        stopped += 1;
    }
    assert_eq!(stopped, 3);
}

#[test]
fn threads_do_not_change_what_stands_still() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = still_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (40, 100, 30);
    (config.effects.sh_gain, config.effects.head_gain) = (0.01, 0.01);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| without_record(train(dataset.clone(), config.clone()).field()))
    };
    assert_eq!(on(1), on(3));
}

/// Mean PSNR on the held-out frames, dB.
pub(crate) fn score(trainer: &Trainer) -> f64 {
    let field = trainer.field();
    let options = EvaluationOptions::held_out(field);
    let scores = evaluate::<EvaluationError>(field, trainer.dataset(), &options, |_| Ok(())).unwrap();
    scores.overall.psnr.unwrap()
}

#[test]
fn exposures_are_learnt_where_cameras_disagree() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { times: 2, disagree: true, ..Scene::default() };
    let dataset = with_known_points(capture(folder.path(), scene));
    let dark = TrainConfig { background: Some([0.0; 3]), ..small_config() };
    let config = planned(&dataset, &dark, "auto");
    assert!(config.effects.exposure);
    let (with, without) = (
        train(dataset.clone(), config.clone()),
        train(dataset.clone(), planned(&dataset, &config, "auto,-exposure")),
    );
    let (gained, plain) = (score(&with), score(&without));
    println!("cameras disagree: {gained:.2} dB with exposures, {plain:.2} dB without");
    assert!(gained > plain + 0.2, "{gained} dB with exposures, {plain} dB without");
    // What was learnt is what was put in, relative to the average camera.
    let learnt = with.field().record.drawing.exposures.clone();
    assert_eq!(learnt.len(), 4);
    for view in 0..4 {
        let Exposure { gain, offset } = learnt[&format!("cam{view}")];
        for (channel, truth) in relative_gain(view).into_iter().enumerate() {
            let of_grey = f64::from(gain[channel] + offset[channel] / 0.5);
            assert!((of_grey / truth - 1.0).abs() < 0.12, "{view} {channel}: {of_grey} for {truth}");
        }
    }
    assert!(without.field().record.drawing.exposures.clone().is_empty());

    let folder = tempfile::tempdir().unwrap();
    let agree = with_known_points(capture(folder.path(), Scene { times: 2, ..Scene::default() }));
    let config = planned(&agree, &small_config(), "auto");
    assert!(!config.effects.exposure);
    let forced = planned(&agree, &config, "auto,+exposure");
    assert!(forced.effects.exposure);
    let [without, with] =
        [config, forced].map(|config| mean_score(&train(agree.clone(), config.clone()), &config));
    println!("cameras agree: {with:.2} dB with exposures, {without:.2} dB without");
    assert!(without > with - 0.3, "{with} dB with exposures, {without} dB without");
}

#[test]
fn a_camera_that_adapts_while_it_films_is_recognised_from_what_it_sees() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { times: 8, views: 8, one_camera: true, disagree: true, ..Scene::default() };
    let mut dataset = with_known_points(capture(folder.path(), scene));
    // What other cameras are elsewhere is one camera here.
    let of_training = |frame: &&mut Frame| frame.split == Split::Train;
    dataset.frames.iter_mut().filter(of_training).for_each(|frame| frame.camera_name = "phone".into());
    let dark = TrainConfig { background: Some([0.0; 3]), ..small_config() };
    let config = planned(&dataset, &dark, "auto");
    assert!(config.effects.exposure_in_time && !config.effects.exposure);
    let (with, without) = (
        train(dataset.clone(), config.clone()),
        train(dataset.clone(), planned(&dataset, &config, "auto,-exposure-in-time")),
    );
    let (gained, plain) = (score(&with), score(&without));
    println!("a camera adapts: {gained:.2} dB with exposures, {plain:.2} dB without");
    // Over eight seeds the gain is 0.28 dB, with a standard deviation of 0.2 dB.
    assert!(gained > plain, "{gained} dB with exposures, {plain} dB without");
    // One image shows little of what it was exposed by: most of it is found.
    let drawing = &with.field().record.drawing;
    let (mut missed, mut all) = (0.0, 0.0);
    for (view, time) in dataset.times.iter().enumerate() {
        let Exposure { gain, offset } = drawing.exposure("phone", *time).unwrap();
        for (channel, truth) in relative_gain(view).into_iter().enumerate() {
            let of_grey = f64::from(gain[channel] + offset[channel] / 0.5);
            missed += (of_grey / truth).ln().abs();
            all += truth.ln().abs();
        }
    }
    assert!(missed < 0.4 * all, "{:.0} % missed", 100.0 * missed / all);
    assert!(!without.field().record.drawing.has_exposures());
}

#[test]
fn a_resumed_run_goes_on_with_its_exposures() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, disagree: true, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 30, 20);
    (config.densify.from, config.densify.every, config.resample.every) = (10, 20, 10);
    config.effects.exposure = true;
    config.report.step_every = 1;
    let whole = train(dataset.clone(), config.clone());
    let (expected, work) = (whole.field().record.drawing.exposures.clone(), whole.work());
    assert!(expected.values().any(|exposure| *exposure != Exposure::NEUTRAL));
    for stop_at in [11_u64, 35, 60] {
        let path = folder.path().join("stopped.cif");
        stopped_after(&dataset, &config, stop_at).checkpoint(true).save(&path).unwrap();
        let loaded = cif_field::Checkpoint::load(&path).unwrap();
        let mut resumed = Trainer::resume(dataset.clone(), loaded).unwrap();
        assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        assert_eq!(without_record(resumed.field()), without_record(whole.field()), "stopped after {stop_at}");
        assert_eq!(
            (resumed.field().record.drawing.exposures.clone(), resumed.work()),
            (expected.clone(), work)
        );
    }
}

#[test]
fn instances_that_appear_are_found() {
    let evidence = |scene: Scene| {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), scene);
        let plan = EffectPlan::new(&dataset, &small_config(), &EffectChoice::default()).unwrap();
        let row = plan.effects.into_iter().find(|effect| effect.effect == EffectKind::Appearing).unwrap();
        (row.evidence, planned(&dataset, &small_config(), "auto").model.heads.opacity)
    };
    let (found, switched) = evidence(Scene { times: 6, appears: true, ..Scene::default() });
    assert!(found.contains("ball 9") && switched, "{found}");
    // Balls that are always there, one of which rolls, hidden at times.
    for scene in [
        Scene { times: 6, ..Scene::default() },
        Scene { times: 12, views: 12, rolls: Some(1.5), one_camera: true, ..Scene::default() },
    ] {
        let (found, switched) = evidence(scene);
        assert!(found.contains("none appears") && !switched, "{found}");
    }
}
