//! The same seed gives the same scene: byte for byte on any number of threads, and as good with any vector
//! instructions.

use std::path::Path;

use cif_dataset::{Dataset, OpenOptions};
use cif_field::{Checkpoint, Field};
use cif_render::cpu::SimdLevel;
use cif_test::capture;
use cif_train::metrics::{EvaluationError, EvaluationOptions, evaluate};
use cif_train::{Control, Outcome, TrainConfig, Trainer};

fn config() -> TrainConfig {
    let mut config = TrainConfig { seed: 5, ..TrainConfig::default() };
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 160, 60);
    // Fits on one thread and two are compared in `cif-train/tests/trainer/guidance.rs`.
    config.motion.rigid = false;
    config.model.spatial_resolution = [8; 3];
    config.model.channels = 4;
    config.model.width = 16;
    config.model.sh_interval = 40;
    (config.densify.from, config.densify.every, config.densify.until) = (20, 20, 120);
    config.densify.max_gaussians = 900;
    (config.resample.from, config.resample.every, config.resample.until) = (10, 10, 50);
    config
}

fn train(dataset: &Dataset, threads: usize, simd: SimdLevel) -> Trainer {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let mut trainer = Trainer::new(dataset.clone(), config()).unwrap();
        trainer.set_simd(simd);
        assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        trainer
    })
}

/// Everything that is saved, the record of wall times and memory left out.
fn bytes(trainer: &Trainer) -> Vec<u8> {
    let mut checkpoint = trainer.checkpoint(true);
    checkpoint.field.record = Default::default();
    let state = checkpoint.training.as_mut().unwrap();
    for key in ["wall_s", "cpu_s", "stages_s", "effects_s", "curve"] {
        state.json["progress"][key] = serde_json::Value::Null;
    }
    let mut bytes = Vec::new();
    checkpoint.write(&mut bytes, Path::new("memory")).unwrap();
    bytes
}

fn scores(field: &Field, dataset: &Dataset) -> (f64, f64) {
    let options = EvaluationOptions::held_out(field);
    let scores = evaluate::<EvaluationError>(field, dataset, &options, |_| Ok(())).unwrap().overall;
    (scores.psnr.unwrap(), scores.instance.miou.unwrap())
}

#[test]
fn one_and_two_threads_write_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    capture::write(folder.path(), 9);
    let dataset = Dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let one = train(&dataset, 1, SimdLevel::Auto);
    let two = train(&dataset, 2, SimdLevel::Auto);
    assert!(bytes(&one) == bytes(&two), "the checkpoints differ");
    // The comparison must be able to fail.
    let path = folder.path().join("one.cif");
    one.checkpoint(true).save(&path).unwrap();
    let loaded = Checkpoint::load(&path).unwrap();
    assert_eq!(loaded.field.gaussians, two.field().gaussians);
    let mut other = two;
    other.reset_times();
    let steps = other.steps_done();
    assert_eq!(steps, one.steps_done());

    // Other instructions round differently, and end as well.
    let reference = scores(one.field(), &dataset);
    for simd in SimdLevel::available() {
        let (psnr, miou) = scores(train(&dataset, 2, simd).field(), &dataset);
        assert!((psnr - reference.0).abs() < 0.5, "{simd:?}: PSNR {psnr} compared with {}", reference.0);
        assert!((miou - reference.1).abs() < 3.0, "{simd:?}: mIoU {miou} compared with {}", reference.1);
    }
}
