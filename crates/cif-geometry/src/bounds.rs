//! Axis-aligned boxes.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::RigidTransform;

/// An axis-aligned box; empty when any `low > high`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Smallest corner.
    pub low: DVec3,
    /// Largest corner.
    pub high: DVec3,
}

impl Bounds {
    /// The box that holds nothing.
    pub const EMPTY: Self = Self { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY };

    /// The smallest box around points.
    #[must_use]
    pub fn around(points: impl IntoIterator<Item = DVec3>) -> Self {
        points.into_iter().fold(Self::EMPTY, |bounds, point| bounds.including(point))
    }

    /// This box, grown to hold `point`.
    #[must_use]
    pub fn including(self, point: DVec3) -> Self {
        Self { low: self.low.min(point), high: self.high.max(point) }
    }

    /// The smallest box around two boxes.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    /// True when the box holds nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        !(self.low.cmple(self.high).all())
    }

    /// The smallest box around this one after `transform`.
    #[must_use]
    pub fn transformed(&self, transform: &RigidTransform) -> Self {
        if self.is_empty() {
            return *self;
        }
        let centre = transform.apply(self.centre());
        let half = self.size() / 2.0;
        let rotation = transform.rotation;
        let reach =
            rotation.x_axis.abs() * half.x + rotation.y_axis.abs() * half.y + rotation.z_axis.abs() * half.z;
        Self { low: centre - reach, high: centre + reach }
    }

    /// Edge lengths; zero when empty.
    #[must_use]
    pub fn size(&self) -> DVec3 {
        if self.is_empty() { DVec3::ZERO } else { self.high - self.low }
    }

    /// Middle of the box; the origin when empty.
    #[must_use]
    pub fn centre(&self) -> DVec3 {
        if self.is_empty() { DVec3::ZERO } else { (self.low + self.high) / 2.0 }
    }
}
