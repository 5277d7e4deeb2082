//! Exported motion against known motion: that of `motion.json` of a capture (see [`cif_dataset::motion_truth`]).
//!
//! An exported object has a frame of its own, so the two are aligned at the first exported time; what is
//! compared is how they move from there. Translation is compared at the centre of the object's box, so that a
//! wrong turn far from the object's origin is not counted twice.

use cif_dataset::{MotionTruth, TrueMotion};
use cif_geometry::RigidTransform;
use cif_geometry::transform::angle_between;
use cif_scene::{CaptureFrame, MotionModel, NodeKind, SceneGraph};
use glam::DMat3;
use serde::Serialize;

/// Error of an exported object's motion against its known motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MotionError {
    /// Mask id.
    pub id: u16,
    /// Human name.
    pub label: String,
    /// True motion of the object: `static`, `rigid`, ...
    pub truth: String,
    /// Exported motion model.
    pub model: MotionModel,
    /// Times compared.
    pub samples: usize,
    /// Root mean square over the times, millimetres.
    pub translation_rms_mm: f64,
    /// Largest, millimetres.
    pub translation_max_mm: f64,
    /// Root mean square over the times, degrees.
    pub rotation_rms_deg: f64,
    /// Largest, degrees.
    pub rotation_max_deg: f64,
}

/// A pose of the scene where it is in the world of the capture, in which motion is known.
fn in_world(frame: &CaptureFrame, pose: &RigidTransform) -> RigidTransform {
    RigidTransform { translation: frame.capture_from_dataset(pose.translation), ..*pose }
}

/// Compares every exported instance that is static or rigid in truth, in the order of the scene.
///
/// `meters_per_unit` of the scene turns world units into millimetres.
#[must_use]
pub fn compare(graph: &SceneGraph, truth: &MotionTruth) -> Vec<MotionError> {
    let codes = &graph.time_codes;
    let frames: Vec<usize> = codes.samples.iter().map(|code| *code as usize).collect();
    let step_of = truth.steps_at(&codes.times, &frames);
    graph
        .nodes
        .iter()
        .filter_map(|node| {
            let NodeKind::Instance { id, .. } = node.kind else { return None };
            let known = truth.instances.get(&id)?;
            if known.kind != "rigid" && known.kind != "static" {
                return None;
            }
            // (exported pose, index of the known time), in time order, where the object exists.
            let (first, last) = node.source_frames;
            let pairs: Vec<(RigidTransform, usize)> = graph
                .time_codes
                .samples
                .iter()
                .zip(&step_of)
                .filter(|(code, _)| (first as f64..=last as f64).contains(*code))
                .filter_map(|(code, step)| {
                    Some((in_world(&graph.frame, &node.world_transform(*code)), (*step)?))
                })
                .collect();
            let mut error = MotionError {
                id,
                label: known.label.clone(),
                truth: known.kind.clone(),
                model: node.model(),
                samples: pairs.len(),
                translation_rms_mm: 0.0,
                translation_max_mm: 0.0,
                rotation_rms_deg: 0.0,
                rotation_max_deg: 0.0,
            };
            let to_mm = 1000.0 * graph.meters_per_unit;
            let &(world_from_local, step) = pairs.first()?;
            let world_from_object = pose(known, step);
            let local_from_object = world_from_local.inverse().compose(&world_from_object);
            let centre_in_object = world_from_object.inverse().apply(known.boxes[step].centre());
            for (world_from_local, step) in &pairs {
                let expected = pose(known, *step);
                let exported = world_from_local.compose(&local_from_object);
                let distance =
                    (exported.apply(centre_in_object) - expected.apply(centre_in_object)).length() * to_mm;
                let degrees = angle_between(&exported.rotation, &expected.rotation).to_degrees();
                error.translation_rms_mm += distance * distance / pairs.len() as f64;
                error.rotation_rms_deg += degrees * degrees / pairs.len() as f64;
                error.translation_max_mm = error.translation_max_mm.max(distance);
                error.rotation_max_deg = error.rotation_max_deg.max(degrees);
            }
            error.translation_rms_mm = error.translation_rms_mm.sqrt();
            error.rotation_rms_deg = error.rotation_rms_deg.sqrt();
            Some(error)
        })
        .collect()
}

/// Pose of an object at a step.
fn pose(known: &TrueMotion, step: usize) -> RigidTransform {
    let matrix = &known.world_from_object[step];
    // A scale belongs to the object, not to its motion.
    let axis = |column: glam::DVec4| column.truncate().normalize_or_zero();
    RigidTransform {
        rotation: DMat3::from_cols(axis(matrix.x_axis), axis(matrix.y_axis), axis(matrix.z_axis)),
        translation: matrix.w_axis.truncate(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use cif_geometry::Bounds;
    use cif_scene::{Motion, MotionReport, Node, PoseSample, ResidualStatistics, Splats, TimeCodes, UpAxis};
    use glam::{DMat4, DQuat, DVec3};

    use super::*;

    /// A scene of one instance with mask id 4 that follows `track`.
    fn scene(track: Vec<PoseSample>) -> SceneGraph {
        let count = track.len();
        let report = MotionReport {
            model: MotionModel::Rigid,
            rotation: None,
            gaussians: 0,
            size: 1.0,
            tolerance: 0.01,
            residual: ResidualStatistics::default(),
            static_residual: ResidualStatistics::default(),
            rigid_residual: None,
            parts_residual: None,
            parts: 0,
            samples: count,
            motion_bytes: 0,
            seconds: 0.0,
        };
        let node = Node {
            kind: NodeKind::Instance { id: 4, index: 0 },
            name: "box_004".into(),
            label: "box".into(),
            category: "box".into(),
            taxonomies: Default::default(),
            embedding: None,
            pivot: DVec3::ZERO,
            motion: Motion::Rigid(track),
            splats: Splats::default(),
            proxy: None,
            colliders: Vec::new(),
            appearance: cif_scene::Appearance::default(),
            visibility: Vec::new(),
            extent: Bounds::EMPTY,
            source_frames: (0, count - 1),
            mean_occupancy: 1.0,
            report,
        };
        SceneGraph {
            up_axis: UpAxis::Z,
            meters_per_unit: 1.0,
            frame: cif_scene::CaptureFrame::default(),
            time_codes: TimeCodes {
                samples: (0..count).map(|frame| frame as f64).collect(),
                times: (0..count).map(|frame| frame as f64 / (count - 1) as f64).collect(),
                frames_per_second: 24.0,
            },
            nodes: vec![node],
            windows: Vec::new(),
            cameras: Vec::new(),
            background_color: [1.0; 3],
            sort_metric: cif_field::SortMetric::Z,
            antialiased: None,
            near: None,
            omitted: Vec::new(),
            warnings: Vec::new(),
            origin: cif_scene::Origin::default(),
        }
    }

    /// Turns 0.2 rad and moves 0.1 per step.
    fn object_pose(step: usize) -> RigidTransform {
        RigidTransform {
            rotation: DMat3::from_rotation_z(0.2 * step as f64),
            translation: DVec3::new(0.1 * step as f64, 1.0, 0.0),
        }
    }

    fn truth(kind: &str) -> MotionTruth {
        let poses: Vec<RigidTransform> = (0..3).map(object_pose).collect();
        // The box is centred half a metre next to the object's origin.
        let centres = poses.iter().map(|pose| pose.apply(DVec3::X * 0.5));
        let known = TrueMotion {
            label: "box".into(),
            kind: kind.into(),
            world_from_object: poses
                .iter()
                .map(|pose| DMat4::from_mat3_translation(pose.rotation, pose.translation))
                .collect(),
            boxes: centres
                .map(|centre| Bounds { low: centre - DVec3::splat(0.1), high: centre + DVec3::splat(0.1) })
                .collect(),
            points: Vec::new(),
        };
        MotionTruth { times: vec![0.0, 0.5, 1.0], instances: BTreeMap::from([(4, known)]) }
    }

    /// The true motion, seen from a local frame that is turned and moved against the object's own; at the
    /// last step `shift` is added and `turn` applied about the centre of the box.
    fn exported(shift: DVec3, turn: f64) -> SceneGraph {
        let object_from_local =
            RigidTransform { rotation: DMat3::from_rotation_x(1.1), translation: DVec3::new(0.3, -0.2, 0.4) };
        let track = (0..3).map(|step| {
            let mut world_from_object = object_pose(step);
            if step == 2 {
                let centre = world_from_object.apply(DVec3::X * 0.5);
                let rotation = DMat3::from_rotation_y(turn);
                world_from_object = RigidTransform {
                    rotation: rotation * world_from_object.rotation,
                    translation: rotation * (world_from_object.translation - centre) + centre + shift,
                };
            }
            let pose = world_from_object.compose(&object_from_local);
            PoseSample {
                time_code: step as f64,
                translation: pose.translation,
                rotation: DQuat::from_mat3(&pose.rotation),
            }
        });
        scene(track.collect())
    }

    #[test]
    fn true_motion_has_no_error_whatever_the_local_frame() {
        let errors = compare(&exported(DVec3::ZERO, 0.0), &truth("rigid"));
        assert_eq!((errors.len(), errors[0].samples), (1, 3));
        assert!(errors[0].translation_max_mm < 1e-9, "{errors:?}");
        assert!(errors[0].rotation_max_deg < 1e-6, "{errors:?}");
    }

    #[test]
    fn motion_is_compared_in_the_world_of_the_capture() {
        // The scene lies around (2e5, 0, -30), in units of 100 of the capture's.
        let frame = CaptureFrame { offset: [2e5, 0.0, -30.0], scale: 0.01 };
        let mut graph = exported(DVec3::new(0.0, 0.0, 0.003), 0.0);
        graph.frame = frame;
        if let Motion::Rigid(track) = &mut graph.nodes[0].motion {
            for pose in track {
                pose.translation = frame.dataset_from_capture(pose.translation);
            }
        }
        let error = &compare(&graph, &truth("rigid"))[0];
        assert!((error.translation_max_mm - 3.0).abs() < 1e-6, "{error:?}");
        assert!(error.rotation_max_deg < 1e-6, "{error:?}");
    }

    #[test]
    fn shifts_and_turns_are_distinguished() {
        let shifted = &compare(&exported(DVec3::new(0.0, 0.0, 0.003), 0.0), &truth("rigid"))[0];
        assert!((shifted.translation_max_mm - 3.0).abs() < 1e-9, "{shifted:?}");
        assert!((shifted.translation_rms_mm - (9.0_f64 / 3.0).sqrt()).abs() < 1e-9, "{shifted:?}");
        assert!(shifted.rotation_max_deg < 1e-6, "{shifted:?}");
        let turned = &compare(&exported(DVec3::ZERO, 2.0_f64.to_radians()), &truth("rigid"))[0];
        assert!((turned.rotation_max_deg - 2.0).abs() < 1e-6, "{turned:?}");
        assert!(turned.translation_max_mm < 1e-9, "{turned:?}");
    }

    #[test]
    fn times_normalised_otherwise_are_matched_frame_by_frame() {
        let mut graph = exported(DVec3::new(0.0, 0.0, 0.003), 0.0);
        graph.time_codes.times = vec![0.0, 1.0 / 3.0, 2.0 / 3.0];
        let error = &compare(&graph, &truth("rigid"))[0];
        assert_eq!(error.samples, 3);
        assert!((error.translation_max_mm - 3.0).abs() < 1e-9, "{error:?}");
    }

    #[test]
    fn objects_that_deform_have_no_pose_to_compare() {
        assert!(compare(&exported(DVec3::ZERO, 0.0), &truth("deforming")).is_empty());
    }
}
