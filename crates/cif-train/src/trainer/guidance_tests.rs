//! Objects with poses next to objects on paths.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::Path;

use cif_dataset::Dataset;
use cif_field::{Gaussians, RotationEvidence};
use glam::{DQuat, DVec2, DVec3};

use super::Trainer;
use super::guard_tests::support::{Scene, capture, small_config, stopped_after};
use super::objects::is_rigid;
use crate::guidance::Guidance;
use crate::losses::displacement::FREE;
use crate::objects::{Bending, Fitted, Found};
use crate::stage::Stage;

/// An object without poses yet, which is explained in full.
pub(super) fn explained(gaussians: Gaussians) -> Fitted {
    Fitted {
        poses: BTreeMap::new(),
        shares: BTreeMap::new(),
        gaussians,
        reference: (DQuat::IDENTITY, DVec3::ZERO),
        rotation: RotationEvidence::Observed,
        is_turned: true,
        error: 0.0,
        unturned: None,
        bent: None,
        is_ball: false,
        is_surrounded: false,
        way: "explained".to_owned(),
    }
}

#[test]
fn poses_are_kept_of_balls_with_rough_masks_and_of_what_turns() {
    let fitted = |(error, unturned), rotation, is_ball| Fitted {
        rotation,
        is_turned: rotation == RotationEvidence::Observed,
        error,
        unturned: Some(unturned),
        is_ball,
        is_surrounded: true,
        ..explained(Gaussians::from_points(&[[0.0; 3]], &[[0.5; 3]]).unwrap())
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
    let bends = |error: f64, bent: f64, is_surrounded: bool| {
        let fitted = fitted((error, error), observed, false);
        is_rigid(&Fitted { bent: Some(bent), is_surrounded, ..fitted }, 0.22)
    };
    assert!(bends(0.3, 1.0, false) && !bends(0.3, 0.95, false) && !bends(0.45, 1.0, false));
    assert!(bends(0.15, 0.9, false) && !bends(0.15, 0.7, false));
    // Of what is seen from other sides all the time, bending does not show.
    assert!(!bends(0.15, 1.0, true));
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
    let gaussians =
        Gaussians::from_points(&[[0.0; 3], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], &[[0.5; 3]; 3]).unwrap();
    let fitted = Fitted {
        poses: BTreeMap::from([(0, pose), (4, pose)]),
        shares: BTreeMap::from([(0, 1.0), (4, 0.1)]),
        reference: pose,
        ..explained(gaussians)
    };
    trainer.state.objects.rigid.insert(2, Found::Moves(Box::new(fitted)));
    trainer.enter(Stage::Fine).unwrap();
    let guidance = &trainer.state.guidance;
    assert_eq!((guidance.guides.len(), guidance.guide_of.len()), (2, trainer.state.field.len()));
    for guide in [1, 2] {
        assert_eq!(guidance.guide_of.iter().filter(|of| **of == guide).count(), 50);
    }
    let tracks = trainer.state.field.tracks.as_ref().unwrap();
    let posed = (0..trainer.state.field.len()).filter(|row| tracks.group(*row).is_some());
    assert!(posed.map(|row| guidance.guide_of[row]).eq([0; 3]));
    let still = &trainer.state.field.deformation.as_ref().unwrap().still;
    assert_eq!(still.len(), trainer.state.field.len(), "those after the one in between, too");
    assert_eq!(trainer.state.pose_moments.shares, [1.0, 0.1]);
}

#[test]
fn what_deforms_is_taught_how_before_the_first_image() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let times = dataset.times.clone();
    let mut config = small_config();
    (config.motion.guidance, config.motion.rehearsal, config.motion.rigid) = (10.0, 300, false);
    let mut trainer = Trainer::new(dataset, config).unwrap();
    trainer.state.guidance.travelling = vec![false, true, false, false];
    // Sheared to the side in the middle of the sequence, the more the higher.
    let size = 0.15;
    let sheared = |time: usize| 0.1 * (PI * time as f64 / (times.len() - 1) as f64).sin();
    let knot = |time: usize| {
        let mut coefficients = [[0.0; 3]; 10];
        coefficients[3] = [sheared(time.min(times.len() - 1)), 0.0, 0.0];
        coefficients
    };
    let knots: Vec<_> = (0..=times.len()).map(knot).collect();
    let shifts = serde_json::json!({ "first": 0, "knot": 1, "size": size, "knots": knots });
    let grid: Vec<[f32; 3]> =
        (0..27).map(|k| [k % 3, k / 3 % 3, k / 9].map(|step| 0.12 * (step as f32 - 1.0))).collect();
    let bending = Bending {
        gaussians: Gaussians::from_points(&grid, &[[0.5; 3]; 27]).unwrap(),
        shifts: serde_json::from_value(shifts).unwrap(),
        place: DVec3::new(0.5, 0.1, 0.3),
        error: 0.04,
    };
    trainer.state.objects.bending.insert(1, bending);
    let first = trainer.state.field.len();
    trainer.enter(Stage::Fine).unwrap();
    let field = &trainer.state.field;
    let shift = |row: usize, moved: &Gaussians| {
        let [from, to] = [&field.gaussians, moved].map(|all| DVec3::from(all.means[row].map(f64::from)));
        to - from
    };
    let mut off = 0.0;
    for (place, time) in times.iter().enumerate() {
        let moved = field.deformed(*time);
        for row in first..first + 27 {
            let height = f64::from(field.gaussians.means[row][2]) - 0.3;
            let meant = DVec3::new(sheared(place) * height / size, 0.0, 0.0);
            off += (shift(row, &moved) - meant).length() / (27 * times.len()) as f64;
        }
        let others = (0..first).map(|row| shift(row, &moved).length()).sum::<f64>() / first as f64;
        assert!(others < 0.01, "{others} at {time}");
    }
    // The mean shift is 0.034.
    assert!(off < 0.012, "{off}");
    // Nothing pulls it back to its place while images train it, after a pause as well.
    let mut restored = Guidance::default();
    let stored = trainer.state.guidance.tensors();
    let mut stored = stored.into_iter().map(|(name, tensor)| (name.to_owned(), tensor)).collect();
    restored.restore(&mut stored, field.len(), times.len()).unwrap();
    let of = |row: usize| if (first..first + 27).contains(&row) { FREE } else { 0 };
    assert!(restored.guide_of.into_iter().eq((0..field.len()).map(of)));
}

/// A capture of one camera that jumps, in which a rod as thin as two pixels that turns and travels is in the place of the
/// third ball.
fn with_rod(folder: &Path) -> Dataset {
    let scene = Scene { times: 8, views: 8, rolls: Some(1.0), one_camera: true, ..Scene::default() };
    let mut dataset = capture(folder, scene);
    // Nothing was measured of it.
    dataset.points.positions.drain(300..450);
    dataset.points.colors.drain(300..450);
    for frame in &dataset.frames {
        let mut ids = image::open(frame.mask.as_ref().unwrap()).unwrap().into_luma8();
        let mut colors = image::open(&frame.image).unwrap().into_rgb8();
        let (sin, cos) = (0.4 + 2.0 * frame.time).sin_cos();
        let middle = frame.camera.project(DVec3::new((PI * frame.time).sin() - 0.5, 0.25, -0.75)).unwrap().0;
        for (x, y, id) in ids.enumerate_pixels_mut() {
            let from = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - middle;
            let (along, across) = (cos * from.x + sin * from.y, cos * from.y - sin * from.x);
            if along.abs() < 7.0 && across.abs() < 1.0 {
                id.0 = [9];
                colors.put_pixel(x, y, image::Rgb([40, 60, 210]));
            } else if id.0 == [9] {
                id.0 = [0];
            }
        }
        ids.save(frame.mask.as_ref().unwrap()).unwrap();
        colors.save(&frame.image).unwrap();
    }
    dataset
}

/// Gaussians that show up inside the mask of the third instance in the view that shows most of it, in which they lie.
fn inside_its_mask(trainer: &Trainer) -> usize {
    let state = &trainer.state;
    let shown = |view: &usize| {
        let labels = state.frames.get(&state.dataset, *view).unwrap();
        labels.labels.as_ref().unwrap().pixels.iter().filter(|label| **label == 3).count()
    };
    let inside = |view: usize| {
        let data = state.frames.get(&state.dataset, view).unwrap();
        let camera = &state.dataset.frames[state.frames.index(view)].camera;
        let is_inside = |row: &usize| {
            let place = DVec3::from(state.field.gaussians.means[*row].map(f64::from));
            camera.pixel_of(place).is_some_and(|[x, y]| *data.labels.as_ref().unwrap().at(x, y) == 3)
        };
        let owned = state.made_for();
        (0..state.field.len()).filter(|row| owned[*row] > 0).filter(is_inside).count()
    };
    inside((0..state.frames.len()).max_by_key(shown).unwrap())
}

#[test]
fn a_thin_rod_that_travels_begins_inside_its_mask() {
    for travels in [true, false] {
        let folder = tempfile::tempdir().unwrap();
        let mut config = small_config();
        (config.motion.guidance, config.motion.rehearsal, config.motion.rigid) = (10.0, 1, false);
        let mut trainer = Trainer::new(with_rod(folder.path()), config).unwrap();
        trainer.state.guidance.travelling = vec![false, false, false, travels];
        trainer.enter(Stage::Fine).unwrap();
        let inside = inside_its_mask(&trainer);
        assert!(inside >= 10, "{inside} where it travels: {travels}");
        trainer.state.field.validate().unwrap();
    }
}

#[test]
fn objects_with_gaussians_get_no_others() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let mut config = small_config();
    (config.motion.guidance, config.motion.rehearsal, config.motion.rigid) = (10.0, 1, false);
    let mut trainer = Trainer::new(dataset, config).unwrap();
    assert!(trainer.without_gaussians(&[]).unwrap().is_empty());
    let balls = trainer.state.field.len();
    trainer.state.guidance.travelling = vec![false; 4];
    trainer.enter(Stage::Fine).unwrap();
    assert_eq!(trainer.state.field.len(), balls);
    // Too faint to be drawn.
    trainer.state.field.gaussians.opacity_logits[150..300].fill(-8.0);
    assert_eq!(trainer.without_gaussians(&[]).unwrap(), [2]);
    assert!(trainer.without_gaussians(&[2]).unwrap().is_empty());
}

/// Changes of visibility that the third ball, which has poses where masks show it, is given.
fn hidden(scene: Scene, keeps_masks: bool) -> Vec<(f64, bool)> {
    let folder = tempfile::tempdir().unwrap();
    let mut dataset = capture(folder.path(), scene);
    // Its points would stay for many steps.
    dataset.points.positions.drain(300..450);
    dataset.points.colors.drain(300..450);
    let early = |frame: &cif_dataset::Frame| frame.time < 0.5;
    for frame in dataset.frames.iter().filter(|frame| early(frame) && !keeps_masks) {
        let mask = frame.mask.as_ref().unwrap();
        let mut ids = image::open(mask).unwrap().into_luma8();
        ids.pixels_mut().filter(|id| id.0 == [9]).for_each(|id| id.0 = [0]);
        ids.save(mask).unwrap();
    }
    let mut config = small_config();
    (config.motion.guidance, config.motion.rehearsal, config.motion.rigid) = (10.0, 1, false);
    let mut trainer = stopped_after(&dataset, &config, config.stages.coarse.into());
    trainer.state.guidance.travelling = vec![false, false, false, true];
    let when = |time: f64| if scene.frozen { 0.0 } else { time };
    let pose = |time: f64| (DQuat::IDENTITY, DVec3::new((PI * when(time)).sin() - 0.5, 0.25, -0.75));
    let places: Vec<[f32; 3]> =
        (0..27).map(|k| [k % 3, k / 3 % 3, k / 9].map(|step| 0.12 * (step as f32 - 1.0))).collect();
    let mut gaussians = Gaussians::from_points(&places, &[[0.2, 0.3, 0.85]; 27]).unwrap();
    gaussians.log_scales.fill([-3.0; 3]);
    gaussians.opacity_logits.fill(4.0);
    let late = dataset.times.iter().enumerate().filter(|(_, time)| **time >= 0.5);
    let poses: BTreeMap<usize, (DQuat, DVec3)> = late.map(|(index, time)| (index, pose(*time))).collect();
    let fitted = Fitted {
        shares: poses.keys().map(|time| (*time, 1.0)).collect(),
        poses,
        reference: pose(1.0),
        ..explained(gaussians)
    };
    trainer.state.objects.rigid.insert(3, Found::Moves(Box::new(fitted)));
    trainer.prepare_fine().unwrap();
    trainer.enter(Stage::Fine).unwrap();
    trainer.state.field.validate().unwrap();
    let group = &trainer.state.field.tracks.as_ref().unwrap().groups[0];
    group.visibility.iter().map(|step| (step.time, step.visible)).collect()
}

#[test]
fn what_is_not_there_is_hidden_where_the_images_agree_with_the_masks() {
    let appears = Scene { times: 6, appears: true, rolls: Some(1.0), ..Scene::default() };
    assert_eq!(hidden(appears, true), [(0.0, false), (0.6, true)]);
    // A tracker that found it late.
    let there = Scene { times: 6, frozen: true, rolls: Some(1.0), ..Scene::default() };
    assert_eq!(hidden(there, false), []);
    assert_eq!(hidden(there, true), []);
}
