//! Where a graph lies in the world of its capture.
//!
//! Captures far from their origin, or in units far from metres, are trained in a frame of their own, where single
//! precision is fine enough (see [`cif_dataset::CaptureFrame`]). Graphs keep it:
//! `x_graph = scale (x_world - offset)`. Files place the whole scene, each in its way, and queries answer in the
//! world.

use cif_dataset::CaptureFrame;
use cif_field::Field;
use cif_geometry::{Bounds, RigidTransform};
use glam::{DAffine3, DMat3, DMat4, DVec3};

use crate::SceneError;

/// The frame that a field was trained or imported in, as its record has it.
///
/// # Errors
/// When it places the field nowhere.
pub fn frame_of(field: &Field) -> Result<CaptureFrame, SceneError> {
    let frame = field.record.frame;
    if frame.is_valid() {
        return Ok(frame);
    }
    let what = format!("the frame of the capture is recorded as {frame:?}; train the scene again");
    Err(SceneError::Inconsistent { what })
}

/// `world_from_graph`, for column vectors.
#[must_use]
pub fn world_from_graph(frame: &CaptureFrame) -> DAffine3 {
    DAffine3 {
        matrix3: DMat3::from_diagonal(DVec3::splat(1.0 / frame.scale)),
        translation: frame.offset.into(),
    }
}

/// A box of the graph in the world.
#[must_use]
pub fn world_bounds(frame: &CaptureFrame, bounds: Bounds) -> Bounds {
    if frame.is_identity() || bounds.is_empty() {
        return bounds;
    }
    Bounds { low: frame.capture_from_dataset(bounds.low), high: frame.capture_from_dataset(bounds.high) }
}

/// `world_from_local` of something whose frame lies so in the graph, `[row][column]`, acting on column vectors.
#[must_use]
pub fn world_matrix(frame: &CaptureFrame, graph_from_local: &RigidTransform) -> [[f64; 4]; 4] {
    let matrix = DMat4::from_mat3_translation(graph_from_local.rotation, graph_from_local.translation);
    let matrix = if frame.is_identity() { matrix } else { DMat4::from(world_from_graph(frame)) * matrix };
    matrix.transpose().to_cols_array_2d()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;

    #[test]
    fn frames_come_from_the_record_and_nothing_is_guessed() {
        let mut field = testing::recorded_field(1, 3);
        assert!(frame_of(&field).unwrap().is_identity());
        field.record.frame = CaptureFrame { offset: [3e6, -2e5, 14.5], scale: 1e-3 };
        assert_eq!(frame_of(&field).unwrap(), field.record.frame);
        field.record.frame.scale = 0.0;
        let message = frame_of(&field).unwrap_err().to_string();
        assert!(message.contains("train the scene again"), "{message}");
    }

    #[test]
    fn places_of_the_graph_are_found_in_the_world() {
        let frame = CaptureFrame { offset: [1e6, 2e6, -5.0], scale: 0.01 };
        let pose =
            RigidTransform { rotation: DMat3::from_rotation_z(0.5), translation: DVec3::new(1.0, 2.0, 3.0) };
        let matrix = world_matrix(&frame, &pose);
        let local = DVec3::new(0.1, -0.2, 0.3);
        let expected = frame.capture_from_dataset(pose.apply(local));
        let found = DMat4::from_cols_array_2d(&matrix).transpose().transform_point3(local);
        assert!((found - expected).length() < 1e-8, "{found} {expected}");
        let bounds = world_bounds(&frame, Bounds { low: DVec3::ZERO, high: DVec3::ONE });
        assert_eq!(
            [bounds.low, bounds.high],
            [DVec3::new(1e6, 2e6, -5.0), DVec3::new(1e6 + 100.0, 2e6 + 100.0, 95.0)]
        );
        assert!(world_bounds(&frame, Bounds::EMPTY).is_empty());
    }
}
