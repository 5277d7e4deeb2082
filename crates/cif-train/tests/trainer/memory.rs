//! Runs whose frames do not fit into memory.

use crate::support::{Scene, capture, small_config, train, without_record};
use cif_train::{Control, TrainConfig, Trainer};

/// Short stages with several views per step.
fn config(frame_memory_mib: u32) -> TrainConfig {
    let mut config = TrainConfig { frame_memory_mib, ..small_config() };
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (12, 30, 12);
    config.stages.batch = 2;
    config
}

#[test]
fn frames_read_ahead_make_the_same_scene_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 4, views: 4, ..Scene::default() });
    let kept = train(dataset.clone(), config(1_024)).into_field();
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let ahead = pool.install(|| train(dataset.clone(), config(0)).into_field());
        assert!(without_record(&kept) == without_record(&ahead), "{threads} threads");
    }
}

#[test]
fn a_frame_that_is_damaged_during_a_run_ends_it_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 3, ..Scene::default() });
    let frame = dataset.train_frames()[1];
    let image = dataset.frames[frame].image.clone();
    let mut trainer = Trainer::new(dataset, config(0)).unwrap();
    std::fs::write(&image, b"no image").unwrap();
    let error = trainer.run(&mut |_, _| Control::Continue).unwrap_err().to_string();
    assert!(error.contains(&*image.file_name().unwrap().to_string_lossy()), "{error}");
}

#[test]
fn more_gaussians_than_memory_holds_are_refused_before_the_first_step() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let mut config = config(16);
    config.densify.max_gaussians = u32::MAX;
    let mut trainer = Trainer::new(dataset, config).unwrap();
    if cif_system::memory::available().is_none() {
        return;
    }
    let message = trainer.run(&mut |_, _| Control::Continue).unwrap_err().to_string();
    assert!(
        message.contains("densify.max_gaussians: it takes 4123.2 GB of memory (4294967295 Gaussians x 60"),
        "{message}"
    );
    assert!(!trainer.has_begun());
}
