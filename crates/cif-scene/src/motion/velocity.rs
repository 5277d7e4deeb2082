//! Velocity of a node, for simulators that take over from the recording.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::Node;
use crate::graph::{Motion, PoseSample, pose_at};

/// Velocity of a node, world axes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Velocity {
    /// Of the centre of mass, world units per second.
    pub linear: DVec3,
    /// Axis times angular speed, radians per second.
    pub angular: DVec3,
}

impl Node {
    /// Velocity at a time code: the difference between the poses one time code before and after, as far as
    /// the track reaches. Parts and deformation do not count; a node without track stands still.
    #[must_use]
    pub fn initial_velocity(&self, time_code: f64, frames_per_second: f64) -> Velocity {
        let track = self.track();
        let (Some(first), Some(last)) = (track.first(), track.last()) else { return Velocity::default() };
        let within = |time_code: f64| time_code.clamp(first.time_code, last.time_code);
        let at = within(time_code);
        let (start, end) = (within(at - 1.0), within(at + 1.0));
        let seconds = (end - start) / frames_per_second;
        if !(seconds > 0.0 && seconds.is_finite()) {
            return Velocity::default();
        }
        let (a, b) = (pose_at(track, self.pivot, start), pose_at(track, self.pivot, end));
        let turn = b.rotation * a.rotation.inverse();
        // Of the two quaternions of a rotation, the one with the shorter arc.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let centre = self.centre_of_mass(at);
        let place = |pose: &PoseSample| pose.rotation * centre + pose.translation;
        Velocity { linear: (place(&b) - place(&a)) / seconds, angular: turn.to_scaled_axis() / seconds }
    }

    /// Centre of mass in the local frame: that of the colliders, filled evenly, which is what simulators move; the
    /// origin without any.
    fn centre_of_mass(&self, time_code: f64) -> DVec3 {
        let (mut moment, mut volume) = (DVec3::ZERO, 0.0);
        for hull in &self.colliders {
            let part = match (&self.motion, hull.part) {
                (Motion::Parts(motion), Some(part)) => motion.parts.get(part),
                _ => None,
            };
            let pose = part.map(|part| pose_at(&part.track, part.pivot, time_code).transform());
            let corner = |index: u32| {
                let corner = DVec3::from_array(hull.points.get(index as usize)?.map(f64::from));
                Some(pose.map_or(corner, |pose| pose.rotation * corner + pose.translation))
            };
            // Tetrahedra between the origin and every triangle; those outside of the hull have a negative volume.
            for &[a, b, c] in &hull.triangles {
                let (Some(a), Some(b), Some(c)) = (corner(a), corner(b), corner(c)) else { continue };
                let tetrahedron = a.dot(b.cross(c)) / 6.0;
                moment += tetrahedron * (a + b + c) / 4.0;
                volume += tetrahedron;
            }
        }
        if volume > 0.0 { moment / volume } else { DVec3::ZERO }
    }
}
