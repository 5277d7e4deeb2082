//! Whole runs on a tiny capture.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use crate::support::{Scene, capture, small_config, stopped_after, train, without_record};
use cif_field::{Field, Gaussians};
use cif_train::config::InstanceGeometry;
use cif_train::metrics::{EvaluationError, EvaluationOptions, evaluate};
use cif_train::{
    Ablation, Clock, Control, Outcome, Phase, Phases, Seconds, Stage, Start, Stop, TrainConfig, TrainError,
    TrainEvent, Trainer,
};

fn assert_equal(a: &Field, b: &Field) {
    assert_eq!(a.gaussians.len(), b.gaussians.len());
    assert!(without_record(a) == without_record(b), "the fields differ");
}

#[test]
fn a_run_reaches_its_quality_and_reports_its_stages() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 4, views: 6, ..Scene::default() });
    let mut config = small_config();
    (config.stages.fine, config.motion.rigid) = (500, true);
    config.report.evaluate_every = 200;
    let mut trainer = Trainer::new(dataset.clone(), config).unwrap();
    let (mut stages, mut names) = (Vec::new(), BTreeSet::new());
    let outcome = trainer
        .run(&mut |event, view| {
            let json = serde_json::to_value(event).unwrap();
            names.insert(json["event"].as_str().unwrap().to_owned());
            match event {
                TrainEvent::StageStarted { stage, .. } => stages.push(*stage),
                TrainEvent::Step { gaussians, loss, .. } => {
                    assert_eq!(*gaussians, view.field().gaussians.len());
                    assert!(loss.is_finite());
                }
                TrainEvent::IdentityEstimated { instances, empty_instances, .. } => {
                    assert_eq!((*instances, empty_instances.len()), (3, 0));
                }
                _ => {}
            }
            Control::Continue
        })
        .unwrap();
    assert_eq!(outcome, Outcome::Finished);
    use Stage::{Coarse, Fine, Identity, Instance, Objects, Search};
    assert_eq!(stages, [Search, Coarse, Objects, Fine, Identity, Instance]);
    for name in
        ["stage_ended", "step", "densified", "resampled", "identity_estimated", "evaluated", "finished"]
    {
        assert!(names.contains(name), "{name} missing in {names:?}");
    }
    let field = trainer.into_field();
    field.validate().unwrap();
    assert_eq!(field.record.to_json()["train"]["complete"], true);
    assert_eq!(field.record.to_json()["train"]["iterations"], 720);
    let scores =
        evaluate::<EvaluationError>(&field, &dataset, &EvaluationOptions::held_out(&field), |_| Ok(()))
            .unwrap()
            .overall;
    let (psnr, miou) = (scores.psnr.unwrap(), scores.instance.miou.unwrap());
    assert!(psnr > 21.5, "PSNR {psnr}");
    assert!(miou > 78.0, "mIoU {miou}");
}

#[test]
fn a_resumed_run_ends_where_the_uninterrupted_one_ends() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (30, 60, 30);
    (config.densify.from, config.densify.every, config.stages.batch) = (10, 20, 2);
    config.densify.opacity_reset_every = 35;
    let whole = train(dataset.clone(), config.clone());
    let total = Trainer::new(dataset.clone(), config.clone()).unwrap().steps_left();
    // Interruptions inside every stage, and on both sides of a densification.
    for stop_at in [7_u64, 49, 51, 105] {
        let trainer = stopped_after(&dataset, &config, stop_at);
        assert_eq!(trainer.steps_left(), total - stop_at);
        let path = folder.path().join("stopped.cif");
        trainer.checkpoint(true).save(&path).unwrap();
        let loaded = cif_field::Checkpoint::load(&path).unwrap();
        let mut resumed = Trainer::resume(dataset.clone(), loaded).unwrap();
        assert_eq!(resumed.steps_left(), total - stop_at);
        assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        assert_equal(resumed.field(), whole.field());
    }
}

/// Settings under which a short run does everything that a run can do between its steps.
fn eventful_config() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 40, 30);
    (config.motion.guidance, config.motion.stillness, config.motion.rehearsal) = (10.0, 1.0, 30);
    (config.motion.rigid, config.motion.gaussians) = (true, 40);
    (config.densify.from, config.densify.every, config.densify.max_gaussians) = (5, 10, 1_200);
    (config.effects.still_every, config.effects.still_from, config.effects.still_told) = (10, 0.2, 10);
    (config.effects.sh_gain, config.effects.head_gain, config.model.sh_interval) = (0.01, 0.01, 7);
    (config.identity.refresh_every, config.report.evaluate_every) = (10, 25);
    config
}

fn eventful_capture(folder: &std::path::Path) -> cif_dataset::Dataset {
    capture(folder, Scene { times: 12, views: 12, rolls: Some(0.9), one_camera: true, ..Scene::default() })
}

#[test]
fn a_run_may_be_stopped_inside_everything_it_does() {
    const FIRST: u32 = 40;
    let folder = tempfile::tempdir().unwrap();
    let dataset = eventful_capture(folder.path());
    let config = eventful_config();
    let whole = train(dataset.clone(), config.clone());
    assert!(whole.field().deformation.is_some());
    // Each part of the run is stopped at one of its first questions, later where it would come no further.
    let (mut state, mut stopped, mut limit) = (None::<cif_field::Checkpoint>, Vec::new(), FIRST);
    let finished = (0..500).find_map(|_| {
        // Fits ask at every step, so that it takes many of their questions to come anywhere.
        let (asked, fits) = (AtomicU32::new(0), Arc::new(AtomicBool::new(false)));
        let is_fitting = Arc::clone(&fits);
        let stop = Stop::when(move || {
            let most = if is_fitting.load(Ordering::Relaxed) { 2_000 * limit } else { limit };
            asked.fetch_add(1, Ordering::Relaxed) >= most
        });
        let phases = Phases::from(stop).reported_to(move |event| {
            if let TrainEvent::PhaseStarted { phase, .. } = event {
                fits.store(matches!(phase, Phase::Search | Phase::Objects), Ordering::Relaxed);
            }
            Control::Continue
        });
        let start = Start { dataset: dataset.clone(), phases };
        let begun = match state.clone() {
            None => Trainer::new(start, config.clone()),
            Some(state) => Trainer::resume(start, state),
        };
        let mut trainer = match begun {
            Ok(trainer) => trainer,
            Err(TrainError::Stopped) => {
                limit += 5;
                return None;
            }
            Err(error) => panic!("{error}"),
        };
        let outcome = trainer.run(&mut |_, _| Control::Continue).unwrap();
        if outcome == Outcome::Finished {
            return Some(trainer);
        }
        trainer.field().validate().unwrap();
        let checkpoint = trainer.checkpoint(true);
        let progress = checkpoint.training.as_ref().unwrap().json["progress"].clone();
        let place = (trainer.stage(), trainer.iteration(), progress["after_step"].clone());
        limit = if stopped.last() == Some(&place) { limit + 5 } else { FIRST };
        stopped.push(place);
        state = Some(checkpoint);
        None
    });
    assert_equal(finished.unwrap().field(), whole.field());
    let at = |stage: Stage, iteration: u32| stopped.iter().any(|(s, i, _)| (*s, *i) == (stage, iteration));
    assert!(at(Stage::Search, 0), "search: {stopped:?}");
    assert!(at(Stage::Objects, 0), "fits and rehearsal: {stopped:?}");
    assert!(at(Stage::Identity, 0), "identities: {stopped:?}");
    let behind_steps: BTreeSet<&str> = stopped.iter().filter_map(|(_, _, after)| after.as_str()).collect();
    assert!(behind_steps.len() >= 3, "judgements and the like: {stopped:?}");
}

/// A clock by which minutes pass between any two looks.
struct Hasty(AtomicU32);

impl Clock for Hasty {
    fn now(&self) -> Seconds {
        Seconds { wall_s: 100.0 * f64::from(self.0.fetch_add(1, Ordering::Relaxed)), cpu_s: 0.0 }
    }
}

#[test]
fn saving_by_time_changes_nothing_and_every_state_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = eventful_capture(folder.path());
    let run = |seconds: u32| {
        let mut config = eventful_config();
        config.report.checkpoint_seconds = seconds;
        let mut trainer = Trainer::new(dataset.clone(), config).unwrap();
        trainer.set_clock(Arc::new(Hasty(AtomicU32::new(0))));
        let mut states = Vec::new();
        trainer
            .run(&mut |event, view| {
                if let TrainEvent::CheckpointDue { stage, iteration } = event {
                    states.push((*stage, *iteration, view.checkpoint(true)));
                }
                Control::Continue
            })
            .unwrap();
        (trainer.into_field(), states)
    };
    let (never, none) = run(0);
    assert!(none.is_empty());
    let (often, states) = run(TrainConfig::default().report.checkpoint_seconds);
    assert_equal(&often, &never);
    for stage in [Stage::Fine, Stage::Identity, Stage::Instance] {
        assert!(states.iter().any(|(at, done, _)| (*at, *done) == (stage, 0)), "one as {stage} begins");
    }
    assert!(states.iter().any(|(_, done, _)| *done > 0), "and others by time");
    for (_, _, state) in states.into_iter().step_by(5) {
        let mut resumed = Trainer::resume(dataset.clone(), state).unwrap();
        assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        assert_equal(resumed.field(), &never);
    }
}

#[test]
fn threads_do_not_change_the_result() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (50, 60, 40);
    config.loss.lambda_dssim = 0.2;
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| train(dataset.clone(), config.clone()))
    };
    assert_equal(on(1).field(), on(2).field());
}

#[test]
fn another_seed_gives_another_result() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (5, 5, 5);
    let first = train(dataset.clone(), config.clone());
    config.seed += 1;
    assert!(first.field().gaussians != train(dataset, config).field().gaussians);
}

#[test]
fn the_instance_loss_moves_gaussians_only_where_it_may() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let gaussians = |geometry, weight: f32| {
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 20, 20);
        config.instance.ablate.insert(Ablation::NoResampling);
        (config.instance.geometry, config.loss.lambda_instance) = (geometry, weight);
        train(dataset.clone(), config).into_field().gaussians
    };
    let shape = |gaussians: &Gaussians| (gaussians.log_scales.clone(), gaussians.quaternions.clone());
    let [off, off_strong] = [0.01, 0.5].map(|weight| gaussians(InstanceGeometry::Off, weight));
    assert!(
        off.means == off_strong.means && shape(&off) == shape(&off_strong),
        "only colours move Gaussians"
    );
    assert!(off.occupancy_logits != off_strong.occupancy_logits, "the loss is there");
    let means_only = gaussians(InstanceGeometry::MeansOnly, 0.5);
    assert!(means_only.means != off.means);
    let full = gaussians(InstanceGeometry::Full, 0.5);
    assert!(full.means != off.means && shape(&full) != shape(&off));
}

#[test]
fn without_masks_it_trains_colour_only_and_says_so() {
    for scene in [Scene { masks: false, ..Scene::default() }, Scene { empty_masks: true, ..Scene::default() }]
    {
        let folder = tempfile::tempdir().unwrap();
        let scene = Scene { times: 2, views: 2, ..scene };
        let dataset = capture(folder.path(), scene);
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine) = (10, 10);
        let mut trainer = Trainer::new(dataset, config).unwrap();
        let mut warnings = Vec::new();
        trainer
            .run(&mut |event, _| {
                if let TrainEvent::Warning { message } | TrainEvent::Note { message } = event {
                    warnings.push(message.clone());
                }
                assert!(!matches!(event, TrainEvent::StageStarted { stage: Stage::Instance, .. }));
                Control::Continue
            })
            .unwrap();
        assert!(warnings.iter().any(|message| message.contains("colour only")), "{warnings:?}");
        assert!(trainer.field().identities.is_none());
        trainer.field().validate().unwrap();
    }
}

#[test]
fn one_frame_is_a_static_capture() {
    let folder = tempfile::tempdir().unwrap();
    let mut dataset = capture(folder.path(), Scene { times: 1, views: 1, ..Scene::default() });
    dataset.frames.truncate(1);
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (10, 20, 10);
    let trainer = train(dataset, config);
    assert!(trainer.field().deformation.is_none());
    assert_eq!(trainer.field().record.to_json()["train"]["iterations_by_stage"]["fine"], 30);
    assert!(trainer.field().identities.is_some());
}

#[test]
fn an_observer_is_obeyed() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.report.step_every, config.report.checkpoint_every) = (1, 7);
    let mut trainer = Trainer::new(dataset, config).unwrap();
    let (mut steps, mut due) = (0, Vec::new());
    let outcome = trainer.run(&mut |event, view| match event {
        TrainEvent::CheckpointDue { iteration, .. } => {
            assert!(view.checkpoint(true).training.is_some() && view.checkpoint(false).training.is_none());
            due.push(*iteration);
            Control::Continue
        }
        TrainEvent::Step { .. } => {
            steps += 1;
            match steps {
                10 => Control::Save,
                16 => Control::Stop,
                _ => Control::Continue,
            }
        }
        _ => Control::Continue,
    });
    assert_eq!((outcome.unwrap(), steps), (Outcome::Interrupted, 16));
    assert_eq!(due, [7, 10, 14]);
}

#[test]
fn a_checkpoint_is_refused_without_state_or_for_another_capture() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let trainer = Trainer::new(dataset.clone(), small_config()).unwrap();
    let refuse = |dataset, checkpoint| Trainer::resume(dataset, checkpoint).err().unwrap();
    assert!(matches!(refuse(dataset.clone(), trainer.checkpoint(false)), TrainError::NoState));
    let mut other = dataset.clone();
    other.frames.remove(0);
    let error = refuse(other, trainer.checkpoint(true));
    assert!(error.to_string().contains("training frames was 4, and is 3"), "{error}");
    let mut damaged = trainer.checkpoint(true);
    damaged.training.as_mut().unwrap().tensors.remove("adam.means.second");
    let error = refuse(dataset.clone(), damaged);
    assert!(error.to_string().contains("adam.means.second"), "{error}");
    let exposures =
        serde_json::json!({"cameras": ["a", "b"], "values": [0.0], "first": [], "second": [], "steps": 0});
    for (key, value, problem) in [
        ("sh_judged", 255.into(), "spherical harmonics"),
        ("total_steps", u64::MAX.into(), "steps"),
        ("exposures", exposures, "exposures"),
    ] {
        let mut wild = trainer.checkpoint(true);
        wild.training.as_mut().unwrap().json["progress"][key] = value;
        let error = refuse(dataset.clone(), wild).to_string();
        assert!(error.contains("not usable") && error.contains(problem), "{error}");
    }
    let mut newer = trainer.checkpoint(true);
    newer.training.as_mut().unwrap().json["version"] = 99.into();
    let error = refuse(dataset, newer);
    assert!(matches!(error, TrainError::BadState { .. }));
    let named = error.of_scene(std::path::Path::new("table.cif")).to_string();
    assert!(named.starts_with("table.cif: the training state"), "{named}");
}

#[test]
fn captures_without_training_frames_or_points_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 1, views: 1, ..Scene::default() });
    let mut no_points = dataset.clone();
    no_points.points.positions.clear();
    no_points.points.colors.clear();
    let error = Trainer::new(no_points, small_config()).err().unwrap();
    assert!(matches!(error, TrainError::NoPoints { .. }), "{error}");
    let mut no_frames = dataset.clone();
    no_frames.frames.retain(|frame| frame.split == cif_dataset::Split::Val);
    let error = Trainer::new(no_frames, small_config()).err().unwrap();
    assert!(matches!(error, TrainError::NoTrainingFrames { .. }), "{error}");
    let mut config = small_config();
    config.stages.batch = 0;
    assert!(Trainer::new(dataset, config).err().unwrap().to_string().contains("stages.batch"));
}

#[test]
fn numbers_that_are_not_finite_stop_the_run_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 1, views: 2, ..Scene::default() });
    let mut config = small_config();
    config.rates.log_scales = 1e38;
    config.rates.means = [1e38, 1e38];
    let mut trainer = Trainer::new(dataset, config).unwrap();
    let error = trainer.run(&mut |_, _| Control::Continue).expect_err("no such rate can work");
    assert!(matches!(error, TrainError::Diverged { .. }), "{error}");
    assert!(error.to_string().contains("learning rate of means[0]"), "{error}");
    trainer.field().validate().unwrap();
}

#[test]
fn a_scene_with_recorded_motion_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let mut checkpoint = Trainer::new(dataset.clone(), small_config()).unwrap().checkpoint(true);
    assert!(Trainer::resume(dataset.clone(), checkpoint.clone()).is_ok());
    let group = cif_field::TrackGroup::still("mug", glam::DVec3::ZERO);
    let group_of = vec![0; checkpoint.field.len()];
    checkpoint.field.tracks = Some(cif_field::Tracks { group_of, groups: vec![group] });
    let error = Trainer::resume(dataset, checkpoint).err().unwrap();
    assert!(matches!(error, TrainError::RecordedMotion { groups: 1 }), "{error}");
}

#[test]
fn far_points_do_not_fill_the_images() {
    let folder = tempfile::tempdir().unwrap();
    let near = capture(folder.path(), Scene { times: 1, views: 8, ..Scene::default() });
    let mut far = near.clone();
    for k in 1..=200_u32 {
        // Evenly in a box of 1000 extents.
        let place =
            [0.819_172_5, 0.671_043_6, 0.549_700_5].map(|step: f64| (0.5 + step * f64::from(k)).fract());
        far.points.positions.push(place.map(|u| ((u - 0.5) * 1000.0 * near.extent()) as f32));
        far.points.colors.push([128; 3]);
    }
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (0, 300, 0);
    config.densify.max_gaussians = 3_000;
    let n = near.points.positions.len();
    let [alone, together] =
        [&near, &far].map(|dataset| Trainer::new(dataset.clone(), config.clone()).unwrap());
    let fresh = &together.field().gaussians;
    assert_eq!(
        fresh.log_scales[..n],
        alone.field().gaussians.log_scales,
        "the scene starts as it would alone"
    );
    let nearest = |mean: [f32; 3]| {
        let centres = near.frames.iter().map(|frame| frame.camera.centre());
        centres.map(|c| c.distance(mean.map(f64::from).into())).fold(f64::INFINITY, f64::min)
    };
    for (mean, log_scale) in fresh.means[n..].iter().zip(&fresh.log_scales[n..]) {
        let angle = f64::from(log_scale[0]).exp() / nearest(*mean);
        assert!(angle < 0.04, "{mean:?} is seen under {angle} radians");
    }
    let psnr = |dataset: &cif_dataset::Dataset| {
        let field = train(dataset.clone(), config.clone()).into_field();
        let options = EvaluationOptions::held_out(&field);
        evaluate::<EvaluationError>(&field, dataset, &options, |_| Ok(())).unwrap().overall.psnr.unwrap()
    };
    let (alone, together) = (psnr(&near), psnr(&far));
    assert!(together > alone - 0.5, "{together} dB compared with {alone} dB without far points");
}
