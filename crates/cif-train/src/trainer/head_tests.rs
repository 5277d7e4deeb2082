//! Plans of steps that train heads of other systems.

use cif_geometry::PinholeCamera;

use super::Trainer;
use super::guard_tests::support::{Scene, capture, small_config};
use crate::config::HeadName;
use crate::stage::Stage;
use crate::step::StepPlan;

/// The plan of the first step of a head.
fn plan(scene: Scene, head: HeadName) -> (StepPlan, Vec<PinholeCamera>) {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), scene);
    let mut config = small_config();
    config.head.name = head;
    let mut trainer = Trainer::for_measuring(dataset, config, None, Stage::Instance, 0).unwrap();
    let plan = trainer.plan_step(Stage::Instance, 1).unwrap();
    let cameras = trainer.state.dataset.frames.iter().map(|frame| frame.camera).collect();
    (plan, cameras)
}

#[test]
fn cameras_between_views_of_one_time_are_held_to_both() {
    let several = Scene { times: 2, ..Scene::default() };
    let (plan_of_several, cameras) = plan(several, HeadName::Vlgs);
    let [view, between] = &plan_of_several.head_targets[..] else { panic!("a view and a camera in between") };
    assert_eq!((view.masks.len(), view.masks[0].1, between.masks.len()), (1, 1.0, 2));
    assert_eq!(view.time, between.time);
    assert!(cameras.contains(&view.camera) && !cameras.contains(&between.camera));
    let [first, second] = [between.masks[0].1, between.masks[1].1];
    let ratio = second / (first + second);
    assert!(first + second < 1.2 && first + second > 0.1, "weighted by how alike the images are");
    assert!((0.3..0.7).contains(&ratio), "{ratio}");
    // What moved in between has no common target.
    let alone = Scene { times: 4, one_camera: true, ..Scene::default() };
    assert_eq!(plan(alone, HeadName::Vlgs).0.head_targets.len(), 1);
    assert_eq!(plan(several, HeadName::GaussianGrouping).0.head_targets.len(), 1);
}

#[test]
fn the_reconstruction_is_frozen_but_for_opacities_of_their_own() {
    let moving = |head: HeadName| {
        let (plan, _) = plan(Scene { times: 2, ..Scene::default() }, head);
        assert!(!plan.trains_colors || head == HeadName::Trace3d);
        let moves = |parameter: &cif_field::Parameter| plan.rates.of(parameter).move_anything();
        let table = cif_field::parameters::TABLE;
        table.into_iter().filter(moves).map(|parameter| parameter.name).collect::<Vec<_>>()
    };
    assert!(moving(HeadName::GaussianGrouping).is_empty() && moving(HeadName::Sa4d).is_empty());
    assert_eq!(moving(HeadName::Vlgs), ["occupancy_logits"]);
    assert!(moving(HeadName::Trace3d).contains(&"means"), "it begins with steps by colour");
}
