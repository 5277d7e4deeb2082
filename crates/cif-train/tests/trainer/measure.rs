//! Steps for measuring do the work of training steps, and only that.

use crate::support::{Scene, capture, small_config, train};
use cif_train::{InstancePass, Stage, TrainError, Trainer};

#[test]
fn a_longer_table_of_instances_changes_labels_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (20, 20, 2);
    let scene = train(dataset.clone(), config.clone()).into_field();
    let start = |table: usize| {
        let scene = Some(scene.clone());
        let mut trainer =
            Trainer::for_measuring(dataset.clone(), config.clone(), scene, Stage::Instance, 0).unwrap();
        trainer.spread_instances(table);
        let times = trainer.measure_step(InstancePass::On).unwrap();
        trainer.measure_step(InstancePass::On).unwrap();
        (trainer, times)
    };
    let (plain, times) = start(3);
    let (spread, spread_times) = start(64);
    assert_eq!(times.evaluated_pairs, spread_times.evaluated_pairs);
    let field = spread.field();
    field.validate().unwrap();
    assert_eq!(field.instances.len(), 64);
    // Entries name the instances they named, and calibrations moved as without padding.
    let entries = |trainer: &Trainer| -> Vec<Vec<(u16, f32, f32)>> {
        let field = trainer.field();
        let rows = field.identities.as_ref().unwrap();
        let entry = |at: usize| {
            let id = field.instances[usize::from(rows.labels[at])].id;
            (id, rows.log_estimates[at], rows.log_calibrations[at])
        };
        let sorted = |row: usize| {
            let mut entries: Vec<_> = rows.range(row).map(entry).collect();
            entries.sort_by_key(|(id, ..)| *id);
            entries
        };
        (0..rows.len()).map(sorted).collect()
    };
    let (a, b) = (entries(&plain).concat(), entries(&spread).concat());
    assert!(a.len() == b.len() && a.iter().any(|(.., calibration)| *calibration != 0.0));
    for (a, b) in a.iter().zip(&b) {
        assert!(a.0 == b.0 && a.1 == b.1 && (a.2 - b.2).abs() < 1e-4, "{a:?} {b:?}");
    }
    for (a, b) in plain.field().gaussians.means.iter().zip(&field.gaussians.means) {
        for axis in 0..3 {
            assert!((a[axis] - b[axis]).abs() < 1e-4, "{a:?} {b:?}");
        }
    }
}

#[test]
fn every_stage_can_be_measured_from_points_and_from_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (5, 5, 5);
    let scene = train(dataset.clone(), config.clone()).into_field();
    for scene in [None, Some(scene.clone())] {
        for stage in [Stage::Coarse, Stage::Fine, Stage::Instance] {
            let mut trainer =
                Trainer::for_measuring(dataset.clone(), config.clone(), scene.clone(), stage, 2).unwrap();
            assert_eq!((trainer.stage(), trainer.iteration()), (stage, 0));
            let on = trainer.measure_step(InstancePass::On).unwrap();
            trainer.repeat_views();
            let off = trainer.measure_step(InstancePass::Off).unwrap();
            assert_eq!((trainer.iteration(), on.steps, off.steps), (1, 1, 1));
            assert_eq!(on.deformed_backward > 0, stage != Stage::Coarse);
            assert!(on.visible > 0 && on.visible <= on.gaussians);
            assert!(on.total >= on.losses + on.render.rasterize);
            // Past the end of the stage.
            for _ in 0..6 {
                trainer.measure_step(InstancePass::On).unwrap();
            }
            assert_eq!((trainer.stage(), trainer.iteration()), (stage, 7));
        }
    }

    let mut other = scene;
    other.instances[0].id = 99;
    let refused = Trainer::for_measuring(dataset.clone(), config.clone(), Some(other), Stage::Instance, 0);
    assert!(matches!(refused.err().unwrap(), TrainError::OtherCapture { .. }));
    let mut unlabelled = dataset;
    unlabelled.instances.clear();
    let refused = Trainer::for_measuring(unlabelled, config, None, Stage::Instance, 0);
    assert!(matches!(refused.err().unwrap(), TrainError::NoLabels { .. }));
}
