//! Size of an object, and where it is by time.

use std::collections::BTreeMap;

use glam::DVec3;

use super::plane::Plane;

/// Height above that at which it stands, of that of its outline, from which an object is off its support.
pub(super) const RAISED: f64 = 0.2;

/// Room that an object has around its height and radius, of them.
pub(super) const ROOM: f64 = 1.1;

/// Path and size of an object.
#[derive(Clone, Debug)]
pub(super) struct Outline {
    /// Height of the centre above the plane in contact, and radius, metres.
    pub(super) height: f64,
    pub(super) radius: f64,
    /// Mean overlap of the masks with their ellipses of equal moments: 1 for round things.
    pub(super) roundness: f64,
    /// Centre by time.
    pub(super) path: BTreeMap<usize, DVec3>,
    /// Times at which the object is off the plane, or may be.
    pub(super) air: Vec<usize>,
    /// Weight of the bending of the path: large where depths are guesses.
    pub(super) stiffness: f64,
    /// True where views of several sides, of one time or of few, show where it is.
    pub(super) is_surrounded: bool,
    /// Times at which the rays of several cameras do not meet, though it stands: it is at rest, or stands before and after.
    pub(super) held: Vec<usize>,
    /// Those at which they do not, and nothing shows that it stands: its place is a guess.
    pub(super) guessed: Vec<usize>,
    /// True of what is tried only where no other outline explains what is seen: a plane gives depths better than few
    /// rays.
    pub(super) is_resort: bool,
}

impl Outline {
    /// The larger of half height and radius.
    pub(super) fn size(&self) -> f64 {
        self.height.max(self.radius)
    }

    /// Test of places about the centre, as the object stands on a plane: few views do not show how deep it is, its
    /// outline on the plane does. True of all places without a plane.
    pub(super) fn upright(&self, plane: Option<&Plane>) -> impl Fn(DVec3) -> bool + use<> {
        let (height, radius) = (ROOM * self.height, ROOM * self.radius);
        let normal = plane.map(|plane| plane.normal);
        move |place| {
            normal.is_none_or(|normal| {
                let up = normal.dot(place);
                let across = (place.length_squared() - up * up).max(0.0).sqrt();
                up.abs() < height && across < radius
            })
        }
    }
}
