//! Groups that move as a whole, on a GPU compared with the processor. `CIF_TEST_GPU=off|auto|require`.

use std::sync::Arc;

use cif_field::tracks::{NO_GROUP, TrackGroup, TrackPose};
use cif_field::{Joint, JointKind, RotationEvidence, Tracks};
use cif_render::Gradients;
use cif_render::wgpu::{Gpu, testing};
use glam::{DQuat, DVec3};
use tempfile::TempDir;

use super::Trainer;
use super::gpu_tests::{assert_alike, device, drawn, on_processor, state, step, trainer_with};
use crate::density::adaptive::Adaptive;
use crate::engine::Changed;
use crate::events::TrainEvent;
use crate::poses::PoseMoments;
use crate::stage::Stage;

/// A run at the start of its fine stage, in which all poses move. Two thirds of the Gaussians are in groups, one of
/// which has poses at the first and the last time alone, whose turns are assumed.
fn trainer(gpu: Option<&Gpu>) -> (Trainer, TempDir) {
    let (mut trainer, folder) = trainer_with(gpu, |config| {
        (config.stages.fine, config.motion.guidance) = (3, 0.0);
        (config.resample.from, config.resample.every, config.resample.until) = (1, 3, 100);
        config.stages.instance = 12;
    });
    trainer.enter(Stage::Fine).unwrap();
    let n = trainer.state.field.len() as u32;
    let times = trainer.state.dataset.times.clone();
    let group = |name: &str, pivot: DVec3, times: &[f64]| TrackGroup {
        deformed: false,
        poses: (times.iter())
            .map(|time| TrackPose {
                time: *time,
                translation: pivot + *time * DVec3::new(0.04, -0.02, 0.01),
                rotation: DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -2.0) / 3.0, 0.2 * time),
            })
            .collect(),
        ..TrackGroup::still(name, pivot)
    };
    let mut groups = vec![
        group("often", DVec3::new(0.1, 0.2, 0.0), &times),
        group("rarely", DVec3::new(-0.2, 0.1, 0.1), &[times[0], times[2]]),
    ];
    groups[1].rotation = Some(RotationEvidence::Assumed);
    // A part on a base that moves, and one on that.
    let values = |from: f64| times.iter().map(|time| (*time, from + 0.3 * time)).collect::<Vec<_>>();
    for (base, kind) in [(0, JointKind::Revolute), (2, JointKind::Prismatic)] {
        let joint = Joint { base, kind, axis: DVec3::new(2.0, -1.0, 2.0) / 3.0 };
        let part = TrackGroup::jointed("part", DVec3::new(0.2, 0.1, -0.1), joint, &values(0.1), &groups);
        groups.push(part);
    }
    let group_of = (0..n).map(|row| [0, NO_GROUP, 1, 2, NO_GROUP, 3][row as usize % 6]).collect();
    let tracks = Tracks { group_of, groups };
    trainer.state.pose_moments = PoseMoments::default();
    let shares: Vec<f64> = (0..tracks.poses()).map(|pose| [1.0, 0.25, 0.5][pose % 3]).collect();
    trainer.state.pose_moments.extend(&shares);
    trainer.state.field.tracks = Some(tracks);
    trainer.state.field.validate().unwrap();
    trainer.state.gradients = Gradients::zeros(&trainer.state.field);
    trainer.engine.changed(Changed::Everything);
    (trainer, folder)
}

/// Poses and moments on the host.
fn poses(trainer: &Trainer) -> (Vec<TrackPose>, PoseMoments) {
    let tracks = trainer.state.field.tracks.as_ref().unwrap();
    let poses = tracks.groups.iter().flat_map(|group| group.poses.clone()).collect();
    (poses, trainer.state.pose_moments.clone())
}

/// Largest difference, relative to the largest of the expected values.
fn worst(found: &[[f64; 6]], expected: &[[f64; 6]]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let largest = expected.as_flattened().iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    let pairs = found.as_flattened().iter().zip(expected.as_flattened());
    pairs.map(|(a, b)| (a - b).abs() / largest).fold(0.0, f64::max)
}

/// Turns and translations between two sets of poses.
fn moves(from: &[TrackPose], to: &[TrackPose]) -> Vec<[f64; 6]> {
    let pairs = from.iter().zip(to);
    pairs
        .map(|(a, b)| {
            let turn = (a.rotation.inverse() * b.rotation).to_scaled_axis().to_array();
            let [x, y, z] = (b.translation - a.translation).to_array();
            [turn[0], turn[1], turn[2], x, y, z]
        })
        .collect()
}

#[test]
fn poses_move_as_on_the_processor() {
    let Some(gpu) = testing::gpu() else { return };
    let (mut on_gpu, _one) = trainer(Some(&gpu));
    let (mut expected, _two) = trainer(None);
    let start = poses(&expected).0;
    for steps in 1..=3 {
        for trainer in [&mut on_gpu, &mut expected] {
            step(trainer).0.unwrap();
            trainer.fetch().unwrap();
        }
        let ((found, moments), (expected, of_processor)) = (poses(&on_gpu), poses(&expected));
        assert_eq!((&moments.steps, &moments.shares), (&of_processor.steps, &of_processor.shares));
        assert!(moments.steps.contains(&steps), "{:?}", moments.steps);
        let errors = [
            worst(&moments.first, &of_processor.first),
            worst(&moments.second, &of_processor.second),
            worst(&moves(&start, &found), &moves(&start, &expected)),
        ];
        eprintln!(
            "after {steps} steps: moments {:.1e} {:.1e}, poses {:.1e}",
            errors[0], errors[1], errors[2]
        );
        // Later steps start from Gaussians whose vanishing gradients were rounded otherwise.
        let tolerance = if steps == 1 { 1e-3 } else { 1e-2 };
        assert!(errors.iter().all(|error| *error < tolerance), "after {steps} steps: {errors:?}");
    }
    // The network leaves the Gaussians of groups alone on both, and they train.
    let before = trainer(None).0.state.field;
    let (a, b) = (&on_gpu.state.field.gaussians.means, &expected.state.field.gaussians.means);
    let sums = (0..before.len()).step_by(3).fold([0.0, 0.0], |[off, moved], row| {
        let distance = |p: [f32; 3], q: [f32; 3]| f64::from(glam::Vec3::from(p).distance(q.into()));
        [off + distance(a[row], b[row]), moved + distance(b[row], before.gaussians.means[row])]
    });
    assert!(sums[1] > 0.0 && sums[0] < 0.1 * sums[1], "{sums:?}");
}

#[test]
fn a_bad_gradient_of_a_pose_moves_nothing_and_the_steps_after_it_are_done() {
    let Some(gpu) = testing::gpu() else { return };
    for value in [f32::NAN, f32::NEG_INFINITY] {
        let (mut trainer, _one) = self::trainer(Some(&gpu));
        step(&mut trainer).0.unwrap();
        let iteration = trainer.iteration();
        state(&mut trainer);
        device(&mut trainer).damage_poses(value);
        let mut reported = Vec::new();
        for _ in 0..2 {
            let (result, events) = step(&mut trainer);
            result.unwrap();
            reported.extend(events);
        }
        state(&mut trainer);
        reported.extend(std::mem::take(&mut trainer.arrived));
        let [TrainEvent::RolledBack { iteration: at, fault, in_a_row: 1, .. }] = &reported[..] else {
            panic!("{reported:?}")
        };
        assert_eq!(*at, iteration + 1);
        assert_eq!((fault.part, fault.tensor.as_str()), ("gradients", "gradient of poses"));
        // The same steps without the bad one.
        let (mut other, _two) = self::trainer(Some(&gpu));
        step(&mut other).0.unwrap();
        other.state.progress.iteration += 1;
        other.state.progress.total_steps += 1;
        step(&mut other).0.unwrap();
        assert!(state(&mut trainer) == state(&mut other));
        assert!(poses(&trainer) == poses(&other));
    }
}

#[test]
fn rows_of_groups_that_stay_on_the_device_end_as_those_that_the_host_rearranges() {
    let Some(gpu) = testing::gpu() else { return };
    let run = |fetches: bool| {
        let (mut trainer, _folder) = trainer(Some(&gpu));
        trainer.state.config.stages.fine = 8;
        trainer.set_density(Arc::new(Adaptive));
        let densify = &mut trainer.state.config.densify;
        (densify.from, densify.every, densify.gradient_threshold, densify.until) = (1, 3, 1e-7, 100);
        let (mut gaussians, mut relocated) = (Vec::new(), 0);
        for done in 0..18 {
            if done == 8 {
                trainer.fetch().unwrap();
                trainer.estimate_identities(true).unwrap();
                trainer.begin(Stage::Instance);
            }
            if fetches {
                device(&mut trainer).make_far_ahead();
            }
            let (stepped, events) = step(&mut trainer);
            stepped.unwrap();
            for event in events {
                if let TrainEvent::Resampled { pairs, .. } = event {
                    relocated += pairs;
                }
            }
            assert_eq!(device(&mut trainer).is_ahead(), !fetches);
            gaussians.push(trainer.state.field.len());
        }
        assert!(relocated > 0, "rows were relocated");
        let (field, optimiser, ..) = state(&mut trainer);
        (field, optimiser, poses(&trainer), gaussians)
    };
    let (on_device, on_host) = (run(false), run(true));
    assert!(on_device.3[0] < on_device.3[17], "{:?}", on_device.3);
    assert_eq!(on_device.3, on_host.3);
    let members =
        |group: u32| on_device.0.tracks.as_ref().unwrap().group_of.iter().filter(|of| **of == group).count();
    assert!(members(0) > on_device.3[0] / 6, "rows of a group were added: {}", members(0));
    assert!(on_device.2 == on_host.2, "poses and their moments");
    assert!(on_device.1 == on_host.1, "moments");
    assert!(on_device.0 == on_host.0, "parameters and groups");
}

#[test]
fn views_of_groups_between_steps_are_those_of_the_processor() {
    let Some(gpu) = testing::gpu() else { return };
    let (mut trainer, _folder) = trainer(Some(&gpu));
    for _ in 0..3 {
        step(&mut trainer).0.unwrap();
    }
    trainer.fetch().unwrap();
    let mut still = trainer.state.field.clone();
    still.deformation.as_mut().unwrap().still = vec![true; still.len()];
    let mut undeformed = trainer.state.field.clone();
    undeformed.deformation = None;
    let mut ungrouped = undeformed.clone();
    ungrouped.tracks = None;
    let trials = [
        ("field", None),
        ("still", Some(&still)),
        ("undeformed", Some(&undeformed)),
        ("none", Some(&ungrouped)),
    ];
    let mut images = Vec::new();
    for (what, trial) in trials {
        let found = drawn(&mut trainer, trial);
        let expected = on_processor(&mut trainer, |trainer| drawn(trainer, trial));
        assert_alike(&found, &expected, what);
        images.push(found);
    }
    assert!(images[2] != images[3], "groups show");
    assert!(drawn(&mut trainer, None) == images[0], "a trial leaves no trace");
}
