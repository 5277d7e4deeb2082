//! Travelling objects, seen by one moving camera.

use crate::support::{Scene, capture, small_config, stopped_after, train, without_record};
use cif_dataset::{Dataset, PointSource};
use cif_field::{Checkpoint, Field, RotationEvidence};
use cif_train::config::DensifyRule;
use cif_train::{Control, ObjectMotion, Outcome, Stage, TrainConfig, TrainError, TrainEvent, Trainer};
use glam::DVec3;

const TRAVEL: f64 = 0.9;

fn dataset(folder: &std::path::Path, times: usize) -> Dataset {
    let scene = Scene { times, views: times, rolls: Some(TRAVEL), one_camera: true, ..Scene::default() };
    let mut dataset = capture(folder, scene);
    // Nothing is known of the ball that moves.
    dataset.points.positions.drain(300..450);
    dataset.points.colors.drain(300..450);
    dataset
}

/// The same with points that are declared to be where things are at rest, which rigid objects need.
fn with_support(folder: &std::path::Path, times: usize) -> Dataset {
    let mut dataset = dataset(folder, times);
    dataset.points.source = PointSource::File(folder.join("points.ply"));
    dataset
}

fn guided() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (100, 300, 60);
    (config.motion.guidance, config.motion.stillness, config.motion.rehearsal) = (10.0, 1.0, 100);
    (config.motion.rigid, config.motion.gaussians) = (true, 100);
    config.model.time_resolution = 12;
    config.densify.max_gaussians = 1_500;
    config
}

/// Mean displacement of the opaque Gaussians of an instance until half-time.
fn path(field: &Field, instance: usize) -> DVec3 {
    let [first, last] = [0.0, 0.5].map(|time| field.deformed(time).means);
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    for row in field.members(instance) {
        let row = row as usize;
        // The floor is nobody's, but every Gaussian has a most probable instance.
        if last[row][1] > 0.35 {
            continue;
        }
        let opacity = 1.0 / (1.0 + f64::from(-field.gaussians.opacity_logits[row]).exp());
        let point = |p: [f32; 3]| DVec3::from(p.map(f64::from));
        sum += opacity * (point(last[row]) - point(first[row]));
        weight += opacity;
    }
    sum / weight
}

/// The same with densification as in 3DGS: of the many Gaussians that a set by errors puts on what moves, a run of this
/// length leaves too many off the path.
fn by_gradient() -> TrainConfig {
    let mut config = guided();
    config.densify.rule = DensifyRule::Gradient;
    config
}

#[test]
fn a_travelling_object_is_followed() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = dataset(folder.path(), 12);
    let truth = DVec3::new(TRAVEL, 0.0, 0.0);
    let mut config = by_gradient();
    let mut noted = false;
    let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
    trainer
        .run(&mut |event, _| {
            noted |= matches!(event, TrainEvent::Note { message } if message.contains("ball 9"));
            Control::Continue
        })
        .unwrap();
    assert!(noted, "what is guided is a finding");
    let field = trainer.into_field();
    let followed = path(&field, 2);
    assert!((followed - truth).length() < 0.15, "{followed}");
    for still in [0, 1] {
        assert!(path(&field, still).length() < 0.05, "{}", path(&field, still));
    }
    // Without guidance one camera is not enough.
    (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
    let unguided = train(dataset, config).into_field();
    let strayed = (path(&unguided, 2) - truth).length();
    assert!(strayed.is_nan() || strayed > 2.0 * (followed - truth).length(), "{strayed}");
}

#[test]
fn a_travelling_object_is_followed_while_errors_decide_what_is_split() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = dataset(folder.path(), 12);
    // One camera leaves depth open, and a run may miss by twice as much as another: the median of three seeds, metres.
    let missed = |guidance: f32, stillness: f32| {
        let mut missed = [2, 3, 4].map(|seed| {
            let mut config = guided();
            (config.seed, config.densify.max_gaussians) = (seed, 800);
            (config.motion.guidance, config.motion.stillness) = (guidance, stillness);
            let followed = path(&train(dataset.clone(), config).into_field(), 2);
            // Without a member that could be followed.
            let length = (followed - DVec3::new(TRAVEL, 0.0, 0.0)).length();
            if length.is_nan() { f64::INFINITY } else { length }
        });
        missed.sort_by(f64::total_cmp);
        missed[1]
    };
    let (guided, unguided) = (missed(10.0, 1.0), missed(0.0, 0.0));
    assert!(guided < 0.25 && unguided > 2.0 * guided, "{guided} guided, {unguided} unguided");
}

#[test]
fn masks_tell_early_what_stands_still() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = dataset(folder.path(), 12);
    let mut config = guided();
    (config.effects.still_every, config.effects.still_told) = (100, 15);
    config.motion.rigid = false;
    // Behind 300 steps this seed is at the bound below, on either side of it by rounding.
    config.stages.fine = 400;
    // Step and share of Gaussians that stand still after each test of the fine stage.
    let tests = |config: &TrainConfig| {
        let mut tests = Vec::new();
        let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
        trainer
            .run(&mut |event, _| {
                if let TrainEvent::Settled { stage: Stage::Fine, iteration, still, gaussians, .. } = event {
                    tests.push((*iteration, *still as f64 / *gaussians as f64));
                }
                Control::Continue
            })
            .unwrap();
        (tests, trainer.into_field())
    };
    let (tested, field) = tests(&config);
    assert!(tested[0].0 == 15 && tested[0].1 > 0.5, "{tested:?}");
    let followed = path(&field, 2);
    assert!((followed - DVec3::new(TRAVEL, 0.0, 0.0)).length() < 0.25, "{followed}");
    let still = &field.deformation.as_ref().unwrap().still;
    let share =
        |rows: &[u32]| rows.iter().filter(|row| still[**row as usize]).count() as f64 / rows.len() as f64;
    // Where the ball is first; the floor is nobody's, and every Gaussian has a most probable instance.
    let start = DVec3::new(-TRAVEL / 2.0, 0.25, -0.75);
    let means = field.deformed(0.0).means;
    let mut ball = field.members(2);
    ball.retain(|row| (DVec3::from(means[*row as usize].map(f64::from)) - start).length() < 0.25);
    assert!(ball.len() > 10 && share(&ball) < 0.1, "{} of {}", share(&ball), ball.len());
    assert!(share(&field.members(0)) > 0.5, "{}", share(&field.members(0)));
    // Without paths, what the network learns first has to decide.
    (config.stages.fine, config.motion.guidance) = (guided().stages.fine, 0.0);
    assert_eq!(tests(&config).0[0].0, 45);
}

#[test]
fn a_rigid_object_moves_by_poses_of_its_own() {
    check_rigid_object([100, 300, 60], |_| {});
}

#[cfg(feature = "wgpu")]
#[test]
#[ignore = "long: make test-long"]
fn a_rigid_object_moves_by_poses_of_its_own_on_a_gpu() {
    let Some(gpu) = cif_render::wgpu::testing::gpu() else { return };
    check_rigid_object([60, 160, 20], |trainer| trainer.use_gpu(&gpu).unwrap());
}

/// A run with so many steps on what `use_engine` sets, and one that is resumed.
fn check_rigid_object([coarse, fine, instance]: [u32; 3], use_engine: impl Fn(&mut Trainer)) {
    let folder = tempfile::tempdir().unwrap();
    let dataset = with_support(folder.path(), 12);
    let mut config = guided();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (coarse, fine, instance);
    (config.effects.still_every, config.effects.still_told) = (100, 15);
    // Inside the fine stage.
    config.report.checkpoint_every = coarse + fine / 2;
    let mut notes = Vec::new();
    let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
    use_engine(&mut trainer);
    let (mut saved, mut densified) = (None, false);
    trainer
        .run(&mut |event, view| {
            match event {
                TrainEvent::Note { message } => notes.push(message.clone()),
                TrainEvent::Densified { stage: Stage::Fine, .. } => densified = true,
                TrainEvent::CheckpointDue { stage: Stage::Fine, .. } if densified => {
                    saved = Some(view.checkpoint(true));
                }
                _ => {}
            }
            Control::Continue
        })
        .unwrap();
    assert!(notes.iter().any(|w| w.contains("ball 9 moves as a whole")), "{notes:?}");
    let field = trainer.into_field();
    field.validate().unwrap();
    let tracks = field.tracks.as_ref().unwrap();
    assert_eq!((tracks.groups.len(), tracks.groups[0].poses.len()), (1, 12));
    let evidence = match notes.iter().any(|w| w.contains("moves as a whole") && w.contains("assumed")) {
        true => RotationEvidence::Assumed,
        false => RotationEvidence::Observed,
    };
    assert_eq!(tracks.groups[0].rotation, Some(evidence), "{notes:?}");
    // Where the ball is, from the first time to half-time.
    let place = |time: f64| tracks.groups[0].pose(time).1;
    let followed = place(0.5) - place(0.0);
    assert!((followed - DVec3::new(TRAVEL, 0.0, 0.0)).length() < 0.1, "{followed}");
    let rows: Vec<usize> = (0..field.len()).filter(|row| tracks.group(*row).is_some()).collect();
    assert!(rows.len() >= 50, "{}", rows.len());
    let still = &field.deformation.as_ref().unwrap().still;
    assert!(rows.iter().all(|row| still[*row]), "the network leaves them alone");
    let ball = field.members(2);
    let of_ball = ball.iter().filter(|row| tracks.group(**row as usize).is_some()).count();
    assert!(10 * of_ball > 8 * rows.len(), "{of_ball} of {}", rows.len());
    // Saved inside the fine stage, it goes on bit for bit.
    let checkpoint = saved.expect("Gaussians were added");
    let path = folder.path().join("inside.cif");
    checkpoint.save(&path).unwrap();
    let mut resumed = Trainer::resume(dataset, Checkpoint::load(&path).unwrap()).unwrap();
    use_engine(&mut resumed);
    assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    assert!(without_record(&resumed.into_field()) == without_record(&field));
}

#[test]
fn the_motion_of_an_object_can_be_declared() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = with_support(folder.path(), 12);
    let mut config = guided();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 20, 0);
    let grouped = |config: &TrainConfig| {
        let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
        trainer.run(&mut |_, _| Control::Continue).unwrap();
        let tracks = trainer.into_field().tracks;
        tracks.map_or(Vec::new(), |tracks| tracks.groups.into_iter().map(|group| group.name).collect())
    };
    assert_eq!(grouped(&config), ["ball 9"]);
    config.motion.of.insert("ball 9".to_owned(), ObjectMotion::Free);
    assert!(grouped(&config).is_empty());
    config.motion.of.insert("bal 9".to_owned(), ObjectMotion::Rigid);
    let refused = Trainer::new(dataset.clone(), config).err().unwrap();
    let TrainError::UnknownObject { label, known, .. } = refused else { panic!("{refused}") };
    assert_eq!(label, "bal 9");
    assert!(known.contains("ball 9"), "{known}");
}

#[test]
fn an_object_of_which_nothing_shows_the_distance_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = guided();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (2, 2, 0);
    let warnings = |dataset: Dataset, config: &TrainConfig| {
        let mut warned = Vec::new();
        let mut trainer = Trainer::new(dataset, config.clone()).unwrap();
        let outcome = trainer.run(&mut |event, _| {
            if let TrainEvent::Warning { message } = event {
                warned.push(message.clone());
            }
            Control::Continue
        });
        assert_eq!(outcome.unwrap(), Outcome::Finished);
        warned.into_iter().filter(|message| message.contains("depth uncertain")).collect::<Vec<_>>()
    };
    let mut dataset = dataset(folder.path(), 12);
    // A camera that goes round would show it.
    let camera = dataset.frames[0].camera;
    dataset.frames.iter_mut().for_each(|frame| frame.camera = camera);
    let found = warnings(dataset.clone(), &config);
    assert!(found.iter().any(|message| message.starts_with("ball 9: depth uncertain")), "{found:?}");
    assert!(found.iter().all(|message| !message.contains("rigid")), "{found:?}");
    config.motion.of.insert("ball 9".to_owned(), ObjectMotion::Rigid);
    let found = warnings(dataset, &config);
    assert!(
        found.iter().any(|message| message.contains("a second camera")),
        "says what is missing: {found:?}"
    );
}

#[test]
#[ignore = "long: make test-long"]
fn neither_threads_nor_interruptions_change_the_result() {
    let folder = tempfile::tempdir().unwrap();
    same_result(folder.path(), &dataset(folder.path(), 6), &[30, 60]);
}

#[test]
fn neither_threads_nor_interruptions_change_the_result_with_poses() {
    let folder = tempfile::tempdir().unwrap();
    same_result(folder.path(), &with_support(folder.path(), 6), &[60, 80]);
}

/// A short run with one thread, with two, and stopped after some steps.
fn same_result(folder: &std::path::Path, dataset: &Dataset, stops: &[u64]) {
    let mut config = guided();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (30, 50, 30);
    config.densify.from = 10;
    config.motion.rehearsal = 20;
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| train(dataset.clone(), config.clone()).into_field())
    };
    let whole = on(1);
    assert!(without_record(&on(2)) == without_record(&whole));
    for &stop_at in stops {
        let trainer = stopped_after(dataset, &config, stop_at);
        let file = folder.join("stopped.cif");
        trainer.checkpoint(true).save(&file).unwrap();
        let finish = |mut trainer: Trainer| {
            assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
            assert!(without_record(trainer.field()) == without_record(&whole), "stopped at {stop_at}");
        };
        let state = || Checkpoint::load(&file).unwrap();
        finish(Trainer::resume(dataset.clone(), state()).unwrap());
        if trainer.stage() == Stage::Identity {
            finish(Trainer::from_scene(dataset.clone(), config.clone(), state(), "stopped.cif").unwrap());
        }
    }
}

#[test]
fn without_anything_to_guide_nothing_changes() {
    let folder = tempfile::tempdir().unwrap();
    let still = capture(folder.path(), Scene { times: 4, views: 6, rolls: Some(0.0), ..Scene::default() });
    let mut config = guided();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (30, 50, 30);
    let mut run = |guidance: f32, stillness: f32, rehearsal: u32, gaussians: u32| {
        (config.motion.guidance, config.motion.stillness) = (guidance, stillness);
        (config.motion.rehearsal, config.motion.gaussians) = (rehearsal, gaussians);
        without_record(&train(still.clone(), config.clone()).into_field())
    };
    let off = run(0.0, 0.0, 300, 300);
    assert!(run(0.0, 0.0, 7, 9) == off, "the other settings act without weights");
    assert!(run(10.0, 0.0, 7, 9) == off, "guidance acts on what stands still");
    assert!(run(0.0, 1.0, 7, 9) != off, "stillness does nothing");
}

#[test]
fn without_masks_nothing_is_held() {
    let folder = tempfile::tempdir().unwrap();
    let moving = capture(folder.path(), Scene { times: 4, views: 4, masks: false, ..Scene::default() });
    let mut config = guided();
    (config.stages.coarse, config.stages.fine) = (30, 50);
    let held = train(moving.clone(), config.clone()).into_field();
    (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
    assert!(without_record(&train(moving, config).into_field()) == without_record(&held));
}

#[test]
fn far_points_lead_no_path_astray() {
    let folder = tempfile::tempdir().unwrap();
    let mut dataset = dataset(folder.path(), 12);
    for k in 1..=300_u32 {
        // Evenly in a box of 1000 extents.
        let place = [0.819_172_5, 0.671_043_6, 0.549_700_5].map(|step: f64| (step * f64::from(k)).fract());
        dataset.points.positions.push(place.map(|u| ((u - 0.5) * 1000.0 * dataset.extent()) as f32));
        dataset.points.colors.push([128; 3]);
    }
    let followed = path(&train(dataset, by_gradient()).into_field(), 2);
    assert!((followed - DVec3::new(TRAVEL, 0.0, 0.0)).length() < 0.15, "{followed}");
}

/// Notes and warnings of a run before its first step.
fn messages(dataset: &Dataset, config: &TrainConfig) -> Vec<String> {
    let mut messages = Vec::new();
    let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
    let outcome = trainer.run(&mut |event, _| match event {
        TrainEvent::Warning { message } | TrainEvent::Note { message } => {
            messages.push(message.clone());
            Control::Continue
        }
        TrainEvent::StageStarted { stage: Stage::Search, .. } => Control::Continue,
        _ => Control::Stop,
    });
    assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    messages
}

#[test]
fn a_wrong_camera_is_named_and_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let sound = dataset(folder.path(), 12);
    let mut config = guided();
    assert!(!messages(&sound, &config).iter().any(|message| message.contains("left out")));
    let mut wrong = sound.clone();
    let frame = wrong.frames.iter_mut().find(|frame| frame.time_index == 5).unwrap();
    let pose = &mut frame.camera.camera_from_world;
    let centre = pose.inverse().translation;
    pose.rotation = glam::DMat3::from_rotation_y(std::f64::consts::FRAC_PI_2) * pose.rotation;
    pose.translation = -(pose.rotation * centre);
    let found = messages(&wrong, &config);
    assert!(found.iter().any(|message| message.starts_with("left out of training: 5_5:")), "{found:?}");
    assert!(found.iter().any(|message| message.ends_with("masks: ball 9")), "{found:?}");
    // With the frame, everything seems to travel.
    config.motion.misfit = 0.0;
    let found = messages(&wrong, &config);
    assert!(found.iter().any(|message| message.ends_with("masks: ball 4, ball 7, ball 9")), "{found:?}");
}
