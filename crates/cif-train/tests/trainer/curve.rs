//! The curve of a run: quality against time, on a clock of the tests' own.

use std::sync::Arc;

use crate::support::{Manual, Scene, capture, small_config, train, without_record};
use cif_train::{
    Control, Curve, CurveFrames, Outcome, Phase, Phases, Stage, Start, Stop, TrainEvent, Trainer,
};

#[test]
fn a_run_records_its_curve_and_ends_as_without_it() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 3, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (40, 210, 110);
    config.report.step_every = 1;
    // Decoding takes 5 s, each step 1 s, and each point a quarter.
    let clock = Arc::new(Manual::default());
    let phases = Phases::new(Arc::clone(&clock) as _, Stop::default()).reported_to({
        let clock = Arc::clone(&clock);
        move |event| {
            match event {
                TrainEvent::PhaseStarted { phase: Phase::Decode, .. } => clock.pass(5.0),
                TrainEvent::PhaseStarted { phase: Phase::Measure, .. } => clock.pass(0.25),
                _ => {}
            }
            Control::Continue
        }
    });
    let mut trainer = Trainer::new(Start { dataset: dataset.clone(), phases }, config.clone()).unwrap();
    let mut measured = Vec::new();
    let outcome = trainer.run(&mut |event, _| {
        if let TrainEvent::Step { .. } = event {
            clock.pass(1.0);
        }
        if let TrainEvent::Measured { point, frames, .. } = event {
            assert_eq!(*frames, 3, "as many held-out frames as there are");
            measured.push(point.clone());
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    let curve = trainer.curve().clone();
    assert_eq!(curve.points, measured);
    let at: Vec<(Stage, u32, u64)> =
        curve.points.iter().map(|point| (point.stage, point.iteration, point.step)).collect();
    use Stage::{Fine, Identity, Instance};
    assert_eq!(
        at,
        [
            (Fine, 100, 140),
            (Fine, 200, 240),
            (Fine, 210, 250),
            (Identity, 0, 250),
            (Instance, 100, 350),
            (Instance, 110, 360)
        ],
        "short stages have no point of their own"
    );
    let walls: Vec<f64> = curve.points.iter().map(|point| point.wall_s).collect();
    assert_eq!(walls, [145.0, 245.0, 255.0, 255.0, 355.0, 365.0], "everything but measuring is counted");
    assert_eq!(curve.points[0].cpu_s, 290.0);
    assert_eq!(curve.measuring.wall_s, 6.0 * 0.25);
    assert_eq!(trainer.time_of_training().wall_s, 365.0);
    assert_eq!((curve.frames, curve.frame_names.len()), (CurveFrames::HeldOut, 3));
    assert!(
        curve.points[..3]
            .iter()
            .all(|point| point.miou.is_none() && point.iou.is_none() && point.psnr > Some(10.0))
    );
    assert!(
        curve.points[3..]
            .iter()
            .all(|point| point.miou > Some(30.0) && point.iou > Some(10.0) && point.ssim > Some(0.3))
    );
    let recorded: Curve = serde_json::from_value(trainer.field().record.curve.clone().unwrap()).unwrap();
    assert_eq!(recorded, curve);
    let record = trainer.field().record.to_json()["train"].clone();
    assert_eq!((&record["wall_s"], &record["cpu_s"]), (&366.5.into(), &733.0.into()));
    assert_eq!(record["wall_s_by_phase"]["fine"], 210.0);
    assert_eq!(record["wall_s_by_phase"]["measure"], 1.5);

    config.report.curve_frames = 0;
    let without = train(dataset, config);
    assert!(without.curve().points.is_empty() && without.field().record.curve.is_none());
    assert!(
        without_record(trainer.field()) == without_record(without.field()),
        "measuring changed the result"
    );
}

#[test]
fn a_resumed_run_goes_on_with_its_curve() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 230, 100);
    (config.report.step_every, config.report.withhold) = (1, 2);
    let whole = train(dataset.clone(), config.clone());
    let mut stopped = Trainer::new(dataset.clone(), config).unwrap();
    let outcome = stopped.run(&mut |event, _| match event {
        TrainEvent::Step { stage: Stage::Fine, iteration: 150, .. } => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    let path = folder.path().join("stopped.cif");
    stopped.checkpoint(true).save(&path).unwrap();
    let mut resumed = Trainer::resume(dataset, cif_field::Checkpoint::load(&path).unwrap()).unwrap();
    resumed.run(&mut |_, _| Control::Continue).unwrap();
    assert!(without_record(resumed.field()) == without_record(whole.field()));
    let values = |trainer: &Trainer| -> Vec<_> {
        trainer.curve().points.iter().map(|point| (point.step, point.psnr, point.ssim, point.miou)).collect()
    };
    assert_eq!(values(&resumed), values(&whole));
    assert!(resumed.curve().measuring.wall_s > stopped.curve().measuring.wall_s);
}

#[test]
fn withheld_frames_are_not_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let mut dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (0, 20, 0);
    config.report.withhold = 2;
    let trainer = train(dataset.clone(), config.clone());
    let curve = trainer.curve();
    assert_eq!((curve.frames, curve.frame_names.len()), (CurveFrames::Withheld, 2));
    // Whatever these frames show, the result is the same.
    for frame in dataset.frames.iter_mut().filter(|frame| curve.frame_names.contains(&frame.name)) {
        frame.image = folder.path().join("black.png");
    }
    image::RgbImage::new(crate::support::WIDTH, crate::support::HEIGHT)
        .save(folder.path().join("black.png"))
        .unwrap();
    let other = train(dataset.clone(), config.clone());
    assert!(without_record(trainer.field()) == without_record(other.field()));
    assert!(other.curve().points[0].psnr < trainer.curve().points[0].psnr);
    // Never more than every fourth.
    config.report.withhold = 1_000;
    assert_eq!(train(dataset, config).curve().frame_names.len(), 3);
}
