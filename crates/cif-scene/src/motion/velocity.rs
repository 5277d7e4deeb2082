//! Velocity of a node, for simulators that take over from the recording.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::Node;
use crate::graph::pose_at;

/// Velocity of a node's local frame, world axes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Velocity {
    /// Of the origin of the local frame, world units per second.
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
        // Of the two quaternions of a rotation, the one with the shorter way.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        Velocity {
            linear: (b.translation - a.translation) / seconds,
            angular: turn.to_scaled_axis() / seconds,
        }
    }
}
