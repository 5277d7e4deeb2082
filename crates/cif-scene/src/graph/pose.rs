//! Poses over time.

use cif_geometry::RigidTransform;
use glam::{DMat3, DQuat, DVec3};

/// Pose of a node's local frame in the world at a time code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample {
    /// Time code.
    pub time_code: f64,
    /// Origin of the local frame, world.
    pub translation: DVec3,
    /// Unit; successive samples lie in one hemisphere.
    pub rotation: DQuat,
}

impl PoseSample {
    /// A transform at a time code.
    #[must_use]
    pub fn new(time_code: f64, transform: &RigidTransform) -> Self {
        let rotation = DQuat::from_mat3(&transform.rotation).normalize();
        Self { time_code, translation: transform.translation, rotation }
    }

    /// The pose between this and another one, by the share of the other: linear in translation, spherical in rotation.
    #[must_use]
    pub(crate) fn towards(&self, other: &Self, share: f64, time_code: f64) -> Self {
        Self {
            time_code,
            translation: self.translation.lerp(other.translation, share),
            rotation: self.rotation.slerp(other.rotation, share),
        }
    }

    /// The pose as `world_from_local`.
    #[must_use]
    pub fn transform(&self) -> RigidTransform {
        RigidTransform { rotation: DMat3::from_quat(self.rotation), translation: self.translation }
    }
}

/// Pose on a track at a time code: linear in translation, spherical in rotation between samples, held outside
/// them; without samples unturned at `rest`.
#[must_use]
pub fn pose_at(track: &[PoseSample], rest: DVec3, time_code: f64) -> PoseSample {
    let Some((first, last)) = track.first().zip(track.last()) else {
        return PoseSample { time_code, translation: rest, rotation: DQuat::IDENTITY };
    };
    let after = track.partition_point(|sample| sample.time_code <= time_code);
    if after == 0 {
        return PoseSample { time_code, ..*first };
    }
    if after == track.len() {
        return PoseSample { time_code, ..*last };
    }
    let (a, b) = (&track[after - 1], &track[after]);
    a.towards(b, (time_code - a.time_code) / (b.time_code - a.time_code), time_code)
}
