//! Runs that begin with the reconstruction of another run.

use crate::support::{Scene, capture, small_config, stopped_after, train, without_record};
use cif_dataset::{Dataset, InstanceLabel, Split};
use cif_field::{Checkpoint, Field, Gaussians};
use cif_train::{Control, Outcome, Stage, TrainConfig, TrainError, TrainEvent, Trainer};

fn short() -> TrainConfig {
    let mut config = small_config();
    // With guidance, masks shape the reconstruction too.
    (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (30, 60, 40);
    (config.densify.from, config.densify.every) = (10, 20);
    config.report.step_every = 1;
    config
}

fn without_occupancy(gaussians: &Gaussians) -> Gaussians {
    Gaussians { occupancy_logits: Vec::new(), ..gaussians.clone() }
}

fn without_masks(dataset: &Dataset) -> Dataset {
    let mut bare = dataset.clone();
    bare.instances.clear();
    bare.frames.iter_mut().for_each(|frame| frame.mask = None);
    bare
}

fn finish(mut trainer: Trainer) -> Field {
    assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    trainer.into_field()
}

fn refusal(dataset: Dataset, scene: Checkpoint) -> String {
    Trainer::from_scene(dataset, short(), scene, "table.cif").err().unwrap().to_string()
}

#[test]
fn it_begins_where_the_reconstruction_of_a_whole_run_ends() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let config = short();
    let whole = train(dataset.clone(), config.clone()).into_field();
    let at_end = stopped_after(&dataset, &config, 90);
    assert_eq!(at_end.stage(), Stage::Identity);

    // With its state, through a file: the same field in the end, bit for bit.
    let path = folder.path().join("reconstruction.cif");
    at_end.checkpoint(true).save(&path).unwrap();
    let scene = Checkpoint::load(&path).unwrap();
    let mut begun = Trainer::from_scene(dataset.clone(), config.clone(), scene.clone(), "a.cif").unwrap();
    assert_eq!((begun.stage(), begun.steps_left()), (Stage::Identity, 40));
    let mut stages = Vec::new();
    begun
        .run(&mut |event, _| {
            if let TrainEvent::StageStarted { stage, .. } = event {
                stages.push(*stage);
            }
            Control::Continue
        })
        .unwrap();
    assert_eq!(stages, [Stage::Identity, Stage::Instance]);
    let begun = begun.into_field();
    assert!(without_record(&begun) == without_record(&whole));
    let from = begun.record.to_json()["train"]["from"].clone();
    assert_eq!(
        (&from["scene"], &from["gaussians"], &from["train"]["seed"]),
        (&"a.cif".into(), &at_end.field().len().into(), &config.seed.into())
    );
    assert!(whole.record.to_json()["train"].get("from").is_none());

    // A scene trained without masks has the same reconstruction; only its moments are not stored.
    let bare = train(without_masks(&dataset), config.clone());
    let begun =
        Trainer::from_scene(dataset.clone(), config.clone(), bare.checkpoint(false), "b.cif").unwrap();
    assert_eq!(without_occupancy(&begun.field().gaussians), without_occupancy(&at_end.field().gaussians));
    assert_eq!(begun.field().deformation, at_end.field().deformation);
    assert_eq!(begun.field().instances, whole.instances);
    let field = finish(begun);
    field.validate().unwrap();
    assert!(field.identities.is_some());

    // An interrupted one goes on, and still records where it came from.
    let mut begun = Trainer::from_scene(dataset.clone(), config.clone(), scene, "a.cif").unwrap();
    let mut steps = 0;
    let outcome = begun.run(&mut |event, _| {
        steps += u32::from(matches!(event, TrainEvent::Step { .. }));
        if steps >= 7 { Control::Stop } else { Control::Continue }
    });
    assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    let resumed = finish(Trainer::resume(dataset, begun.checkpoint(true)).unwrap());
    assert!(without_record(&resumed) == without_record(&whole));
    assert_eq!(resumed.record.to_json()["train"]["from"]["scene"], "a.cif");
}

#[test]
fn scenes_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let config = short();
    let scene = stopped_after(&dataset, &config, 91).checkpoint(false);

    let change = |edit: &dyn Fn(&mut Dataset)| {
        let mut other = dataset.clone();
        edit(&mut other);
        refusal(other, scene.clone())
    };
    let expect = |message: &str, parts: &[&str]| {
        for part in parts {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    };
    expect(&change(&|other| other.times.push(1.5)), &["number of times was 3", "is 4"]);
    expect(&change(&|other| other.times[1] = 0.25), &["a time was 0.5", "is 0.25"]);
    expect(&change(&|other| other.frames.truncate(7)), &["number of frames was 9", "is 7"]);
    expect(
        &change(&|other| other.frames[0].split = Split::Val),
        &["cam0 at time 0, trained on", "cam0 at time 0, held out"],
    );
    expect(
        &change(&|other| other.frames[4].camera.camera_from_world.translation.x += 0.01),
        &["the pose of a camera", "cam1 at time 1"],
    );
    let no_labels = Trainer::from_scene(without_masks(&dataset), config.clone(), scene.clone(), "table.cif");
    assert!(matches!(no_labels.err().unwrap(), TrainError::NoLabels { .. }));

    let mut still = scene.clone();
    still.field.deformation = None;
    expect(&refusal(dataset.clone(), still), &["table.cif has no deformation", "3 times"]);
    for (steps, stage) in [(10, "coarse"), (50, "fine")] {
        let unfinished = stopped_after(&dataset, &config, steps).checkpoint(true);
        expect(&refusal(dataset.clone(), unfinished), &["table.cif", stage, "--resume"]);
    }
}

#[test]
fn the_longest_table_of_instances_trains() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 1, ..Scene::default() });
    let mut config = short();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (2, 2, 2);
    // Counts of 65 535 instances x 2 700 Gaussians would take 1.4 GB if they were dense.
    let mut crowded = dataset.clone();
    let label = |id| InstanceLabel {
        id,
        label: format!("{id}"),
        category: "thing".into(),
        taxonomies: Default::default(),
    };
    crowded.instances = (1..=u16::MAX).map(label).collect();
    let points = crowded.points.clone();
    for shift in 1..6 {
        let moved = points.positions.iter().map(|p| [p[0] + 0.01 * shift as f32, p[1], p[2]]);
        crowded.points.positions.extend(moved);
        crowded.points.colors.extend(&points.colors);
    }
    let mut trainer = Trainer::new(crowded.clone(), config.clone()).unwrap();
    trainer.run(&mut |_, _| Control::Continue).unwrap();
    let path = folder.path().join("crowded.cif");
    trainer.checkpoint(true).save(&path).unwrap();
    let kept = Checkpoint::load(&path).unwrap();
    let identities = kept.field.identities.as_ref().unwrap();
    assert_eq!((kept.field.instances.len(), identities.len()), (65_535, 2700));
    assert!(identities.labels.len() <= 64 * 2700, "{} entries", identities.labels.len());
    let again = finish(Trainer::from_scene(crowded, config.clone(), kept.clone(), "kept.cif").unwrap());
    assert_eq!(again.instances.len(), 65_535);
    let field = finish(Trainer::from_scene(dataset, config, kept, "kept.cif").unwrap());
    assert_eq!((field.len(), field.instances.len()), (2700, 3));
}
