//! Objects with poses beside objects on paths.

use std::collections::BTreeMap;

use cif_field::{Gaussians, RotationEvidence};
use glam::{DQuat, DVec3};

use super::Trainer;
use super::guard_tests::support::{Scene, capture, small_config};
use super::objects::is_rigid;
use crate::objects::Fitted;
use crate::stage::Stage;

#[test]
fn poses_are_kept_of_balls_with_rough_masks_and_of_what_turns() {
    let fitted = |(error, unturned), rotation, is_ball| Fitted {
        poses: BTreeMap::new(),
        gaussians: Gaussians::from_points(&[[0.0; 3]], &[[0.5; 3]]).unwrap(),
        reference: (DQuat::IDENTITY, DVec3::ZERO),
        rotation,
        error,
        unturned: Some(unturned),
        is_ball,
        is_settled: true,
        way: "told".to_owned(),
    };
    let (observed, assumed) = (RotationEvidence::Observed, RotationEvidence::Assumed);
    let kept = |errors, rotation, is_ball| is_rigid(&fitted(errors, rotation, is_ball), 0.22);
    assert!(kept((0.09, 0.09), assumed, false));
    // Something that deforms moves no better when it turns.
    assert!(!kept((0.12, 0.13), observed, false));
    assert!(kept((0.12, 0.3), observed, false));
    assert!(!kept((0.12, 0.3), assumed, false));
    assert!(kept((0.2, 0.2), assumed, true));
    assert!(!kept((0.3, 0.5), observed, true));
}

#[test]
fn paths_hold_no_object_that_has_poses() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let mut config = small_config();
    (config.motion.guidance, config.motion.rehearsal, config.motion.gaussians) = (10.0, 1, 50);
    config.motion.rigid = false;
    let mut trainer = Trainer::new(dataset, config).unwrap();
    trainer.state.guidance.travelling = vec![false, true, true, true];
    // The one in between is fitted.
    let pose = (DQuat::IDENTITY, DVec3::new(0.5, 0.1, 0.3));
    let fitted = Fitted {
        poses: BTreeMap::from([(0, pose), (4, pose)]),
        gaussians: Gaussians::from_points(&[[0.0; 3], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], &[[0.5; 3]; 3])
            .unwrap(),
        reference: pose,
        rotation: RotationEvidence::Observed,
        error: 0.0,
        unturned: None,
        is_ball: false,
        is_settled: false,
        way: "told".to_owned(),
    };
    trainer.fits.insert(2, fitted);
    trainer.enter(Stage::Fine).unwrap();
    let guidance = &trainer.state.guidance;
    assert_eq!((guidance.guides.len(), guidance.guide_of.len()), (2, trainer.state.field.len()));
    for guide in [1, 2] {
        assert_eq!(guidance.guide_of.iter().filter(|of| **of == guide).count(), 50);
    }
    let tracks = trainer.state.field.tracks.as_ref().unwrap();
    let posed = (0..trainer.state.field.len()).filter(|row| tracks.group(*row).is_some());
    assert!(posed.map(|row| guidance.guide_of[row]).eq([0; 3]));
}
