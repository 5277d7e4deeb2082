//! The curve of a run: quality against time, on a clock of the tests' own.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::support::{Scene, capture, small_config, train, without_record};
use cif_train::{Clock, Control, Curve, CurveFrames, Outcome, Seconds, Stage, TrainEvent, Trainer};

/// A clock that moves on by a quarter of a second whenever it is read.
struct Ticking(AtomicU64);

impl Clock for Ticking {
    fn now(&self) -> Seconds {
        let ticks = self.0.fetch_add(1, Ordering::SeqCst) as f64;
        Seconds { wall_s: 0.25 * ticks, cpu_s: 0.5 * ticks }
    }
}

#[test]
fn a_run_records_its_curve_and_ends_as_without_it() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 3, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (40, 210, 110);
    let mut trainer = Trainer::new(dataset.clone(), config.clone()).unwrap();
    trainer.set_clock(Arc::new(Ticking(AtomicU64::new(0))));
    let mut measured = Vec::new();
    let outcome = trainer.run(&mut |event, _| {
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
    // A step reads the clock before and after; what measuring reads falls between steps.
    let walls: Vec<f64> = curve.points.iter().map(|point| point.wall_s).collect();
    assert_eq!(walls, [35.0, 60.0, 62.5, 62.75, 87.75, 90.25]);
    assert_eq!(curve.points[0].cpu_s, 70.0);
    assert_eq!(curve.measuring.wall_s, 6.0 * 0.25);
    assert_eq!((curve.frames, curve.frame_names.len()), (CurveFrames::HeldOut, 3));
    assert!(curve.points[..3].iter().all(|point| point.miou.is_none() && point.psnr > Some(10.0)));
    assert!(curve.points[3..].iter().all(|point| point.miou > Some(30.0) && point.ssim > Some(0.3)));
    let recorded: Curve = serde_json::from_value(trainer.field().record.curve.clone().unwrap()).unwrap();
    assert_eq!(recorded, curve);
    assert_eq!(trainer.field().record.to_json()["train"]["cpu_s"], 180.5);

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
