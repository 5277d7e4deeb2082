//! Ways in which an object may move: what its path and the plane suggest, and what following it from time to time
//! found.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use super::outline::Outline;
use super::rotation::Course;
use super::shape::Pose;
use super::view::{ObjectView, median};

/// Turns of slides, degrees apart.
const SLIDE: i32 = 30;

/// Turns in place, degrees, and the smallest of them.
const SPINS: [i32; 12] = [-240, -200, -160, -120, -80, -40, 40, 80, 120, 160, 200, 240];
pub(super) const SMALLEST_SPIN: i32 = 40;

/// Rolling radii tried of balls, of the height.
const ROLLS: [f64; 9] = [0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08];

/// Rolling radii tried of other things, whose height gives it less well.
const OTHER_ROLLS: [f64; 12] = [0.64, 0.68, 0.72, 0.76, 0.8, 0.84, 0.88, 0.92, 0.96, 1.0, 1.04, 1.08];

/// Roundness of masks from which an object may roll as a ball.
const ROUND: f64 = 0.93;

/// Pixels of a mask from which its texture may show a turn.
const TEXTURED: f64 = 400.0;

/// Height of the centre, in radii, up to which an object may roll: what is taller stands.
const ROLLS_UP_TO: f64 = 2.0;

/// Reach of a path, in sizes, from which an object moves as a whole, and from which it may roll.
const SHIFTS: f64 = 0.6;
const ROLLS_FROM: f64 = 1.2;

/// A way of moving.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Way {
    /// Not at all.
    Rest,
    /// Along the path, turning about the normal, degrees in all.
    Slide(i32),
    /// In place, turning about the normal at a constant rate, degrees in all.
    Spin(i32),
    /// Along the path without slip, with this radius of the height.
    Roll(f64),
    /// As following it from time to time found.
    Followed,
    /// Along the path, turning as its texture shows.
    Textured,
    /// Along the path, rolling about an axis that lies across it.
    Lies,
    /// In place, turning about the upright axis as its paint shows it.
    Turns,
}

impl Way {
    /// The way in words.
    pub(super) fn in_words(self) -> String {
        match self {
            Self::Rest => "rests".to_owned(),
            Self::Slide(degrees) => format!("slides, turning {degrees} deg"),
            Self::Spin(degrees) => format!("turns {degrees} deg in place"),
            Self::Roll(factor) => format!("rolls with {factor:.2} of its height"),
            Self::Followed => "followed from time to time".to_owned(),
            Self::Textured => "turns as its texture tells".to_owned(),
            Self::Lies => "rolls on its side".to_owned(),
            Self::Turns => "turns in place, as its texture shows".to_owned(),
        }
    }

    /// Turn about the normal, degrees, of ways that are distinguished by it.
    pub(super) fn degrees(self) -> Option<i32> {
        match self {
            Self::Slide(degrees) | Self::Spin(degrees) => Some(degrees),
            _ => None,
        }
    }
}

/// Paths that ways follow.
pub(super) struct Paths<'a> {
    /// Centre at reliable times, smoothed.
    pub(super) along: BTreeMap<usize, DVec3>,
    /// Centre, had it stayed in place.
    pub(super) place: DVec3,
    pub(super) outline: &'a Outline,
    /// Direction away from the support, or upwards in the images where there is none.
    pub(super) up: DVec3,
    /// True where there is a support.
    pub(super) stands: bool,
    /// Time at which all ways have the same pose.
    pub(super) reference: usize,
    /// Poses that following found, where it did.
    pub(super) followed: Option<BTreeMap<usize, Pose>>,
    /// Times at which it may be off its support in these.
    pub(super) off: Vec<usize>,
    /// Poses with turns that its texture shows, on its way or in place, or of rolling on its side.
    pub(super) turned: Option<BTreeMap<usize, Pose>>,
}

/// True where masks are round enough for a ball.
pub(super) fn is_round(outline: &Outline) -> bool {
    outline.roundness > ROUND
}

impl Paths<'_> {
    /// Largest distance of the path from its beginning, metres.
    fn reach(&self) -> f64 {
        let from = self.along.values().next().copied().unwrap_or_default();
        self.along.values().map(|place| (*place - from).length()).fold(0.0, f64::max)
    }

    /// True where the path goes so far that it is more than the middle of a mask whose object deforms, or opens.
    pub(super) fn shifts(&self) -> bool {
        self.reach() >= SHIFTS * self.outline.size()
    }

    /// True where an object on the path may roll: what its rays show off the support flies, and what is tall stands.
    pub(super) fn may_roll(&self) -> bool {
        let flies = self.outline.is_surrounded && !self.outline.air.is_empty();
        let is_low = self.outline.height <= ROLLS_UP_TO * self.outline.radius;
        self.stands && !flies && is_low && self.reach() >= ROLLS_FROM * self.outline.size()
    }

    /// Axis about which what rolls along the path turns forward; `None` where it ends where it began.
    pub(super) fn across(&self) -> Option<DVec3> {
        let (first, last) = self.along.values().next().zip(self.along.values().next_back())?;
        self.up.cross(*last - *first).try_normalize()
    }

    /// Ways of moving along the path worth a trial, in addition to sliding without a turn.
    pub(super) fn ways(&self) -> Vec<Way> {
        let mut ways = Vec::new();
        ways.extend(turns().map(Way::Slide));
        if self.may_roll() {
            let radii: &[f64] = if is_round(self.outline) { &ROLLS } else { &OTHER_ROLLS };
            ways.extend(radii.iter().map(|radius| Way::Roll(*radius)));
        }
        if self.followed.is_some() {
            ways.push(Way::Followed);
        }
        ways
    }

    /// Rotations of the ways of rolling.
    pub(super) fn rolls(&self) -> Vec<BTreeMap<usize, DQuat>> {
        let rolls = self.ways().into_iter().filter(|way| matches!(way, Way::Roll(_)));
        let rotations =
            |way: Way| self.poses(way).into_iter().map(|(time, pose)| (time, pose.rotation)).collect();
        rolls.map(rotations).collect()
    }

    /// True where an object may turn in place without a change of its outline, and texture would show it.
    pub(super) fn may_turn_unseen(&self, views: &[ObjectView]) -> bool {
        let mut areas: Vec<f64> = views.iter().map(ObjectView::area).collect();
        is_round(self.outline) && median(&mut areas) >= TEXTURED
    }

    /// Ways of turning in place, and resting.
    pub(super) fn spins(&self) -> Vec<Way> {
        std::iter::once(Way::Rest).chain(SPINS.map(Way::Spin)).collect()
    }

    /// Poses along the path with turns, from none at the reference; between times that have one it turns evenly.
    pub(super) fn along_with(&self, turns: &BTreeMap<usize, DQuat>) -> BTreeMap<usize, Pose> {
        let turn = |time: usize| {
            let before = turns.range(..=time).next_back();
            let after = turns.range(time..).next();
            match (before, after) {
                (Some((a, from)), Some((b, to))) if a < b => {
                    from.slerp(*to, (time - a) as f64 / (b - a) as f64)
                }
                (Some((_, turn)), _) | (None, Some((_, turn))) => *turn,
                (None, None) => DQuat::IDENTITY,
            }
        };
        let back = turn(self.reference).inverse();
        let pose = |(time, place): (&usize, &DVec3)| {
            (*time, Pose { rotation: turn(*time) * back, translation: *place })
        };
        self.along.iter().map(pose).collect()
    }

    /// Poses with more turn about the object's own upright axis, by as much as slides turn: an outline that is much the same
    /// from all sides, as of a bottle, does not show it.
    pub(super) fn twisted(&self, poses: &Course) -> Vec<Course> {
        let Some(upright) = poses.get(&self.reference).map(|pose| pose.rotation.inverse() * self.up) else {
            return Vec::new();
        };
        let shares = shares(&poses.values().map(|pose| pose.translation).collect::<Vec<_>>());
        let origin = poses.range(..self.reference).count();
        let twisted = |degrees: i32| {
            let twist = |share: &f64| {
                let angle = f64::from(degrees).to_radians() * (share - shares[origin]);
                DQuat::from_scaled_axis(upright * angle)
            };
            let pose = |((time, pose), share): ((&usize, &Pose), &f64)| {
                (*time, Pose { rotation: pose.rotation * twist(share), ..*pose })
            };
            poses.iter().zip(&shares).map(pose).collect()
        };
        turns().map(twisted).collect()
    }

    /// Poses of a way at the times of the path.
    pub(super) fn poses(&self, way: Way) -> BTreeMap<usize, Pose> {
        let times: Vec<usize> = self.along.keys().copied().collect();
        let places: Vec<DVec3> = self.along.values().copied().collect();
        let origin = times.iter().position(|time| *time == self.reference).unwrap_or(0);
        let turned = |shares: &[f64], degrees: i32| -> Vec<DQuat> {
            let angle = f64::from(degrees).to_radians();
            let of = |share: &f64| DQuat::from_scaled_axis(self.up * angle * (share - shares[origin]));
            shares.iter().map(of).collect()
        };
        let rotations = match way {
            Way::Rest => vec![DQuat::IDENTITY; times.len()],
            Way::Slide(degrees) => turned(&shares(&places), degrees),
            Way::Spin(degrees) => {
                let steps: Vec<f64> = times.iter().map(|time| *time as f64).collect();
                turned(&of_whole(&steps), degrees)
            }
            Way::Roll(factor) => {
                let rotations = rolled(&places, self.up, self.outline.height / factor);
                let back = rotations[origin].inverse();
                rotations.into_iter().map(|rotation| rotation * back).collect()
            }
            Way::Followed | Way::Textured | Way::Lies | Way::Turns => {
                let found = if way == Way::Followed { &self.followed } else { &self.turned };
                return found
                    .iter()
                    .flatten()
                    .filter(|(time, _)| self.along.contains_key(time))
                    .map(|(t, p)| (*t, *p))
                    .collect();
            }
        };
        let stays = matches!(way, Way::Rest | Way::Spin(_));
        let place = |k: usize| if stays { self.place } else { places[k] };
        let pose = |(k, rotation)| (times[k], Pose { rotation, translation: place(k) });
        rotations.into_iter().enumerate().map(pose).collect()
    }
}

/// Turns of slides, degrees in all, but none.
fn turns() -> impl Iterator<Item = i32> {
    (-180 / SLIDE..=180 / SLIDE).filter(|k| *k != 0).map(|k| k * SLIDE)
}

/// Share of the length of a path that lies before each place.
fn shares(places: &[DVec3]) -> Vec<f64> {
    let mut lengths = vec![0.0];
    for pair in places.windows(2) {
        lengths.push(lengths[lengths.len() - 1] + (pair[1] - pair[0]).length());
    }
    of_whole(&lengths)
}

/// Values from the first on, as shares of the whole.
fn of_whole(values: &[f64]) -> Vec<f64> {
    let whole = (values[values.len() - 1] - values[0]).max(1e-9);
    values.iter().map(|value| (value - values[0]) / whole).collect()
}

/// Turns of a ball that rolls without slip from place to place.
pub(super) fn rolled(places: &[DVec3], normal: DVec3, radius: f64) -> Vec<DQuat> {
    let mut rotations = vec![DQuat::IDENTITY];
    for pair in places.windows(2) {
        let turn = normal.cross(pair[1] - pair[0]) / radius;
        let last = rotations[rotations.len() - 1];
        rotations.push((DQuat::from_scaled_axis(turn) * last).normalize());
    }
    rotations
}

#[cfg(test)]
mod tests {
    use super::super::testing::shaped;
    use super::*;

    #[test]
    fn poses_are_twisted_about_the_upright_axis_of_the_object() {
        let along: BTreeMap<usize, DVec3> = (0..11).map(|k| (k, DVec3::X * (0.02 * k as f64))).collect();
        let outline = shaped(0.1, 0.03, 0.8, along.clone());
        let paths = paths(&along, &outline);
        // It is tilted on its way.
        let tilted = |k: usize| DQuat::from_rotation_y(0.05 * k as f64);
        let pose = |(k, place): (&usize, &DVec3)| (*k, Pose { rotation: tilted(*k), translation: *place });
        let poses: Course = along.iter().map(pose).collect();
        let twisted = paths.twisted(&poses);
        assert_eq!(twisted.len(), turns().count());
        for (course, degrees) in twisted.iter().zip(turns()) {
            assert_eq!(course[&0], poses[&0], "the reference stays");
            for (k, pose) in course {
                let about_itself = poses[k].rotation.inverse() * pose.rotation;
                let turn = f64::from(degrees).to_radians() * 0.1 * *k as f64;
                assert!(about_itself.angle_between(DQuat::from_rotation_z(turn)) < 1e-6);
                assert!(
                    (pose.rotation * DVec3::Z).abs_diff_eq(tilted(*k) * DVec3::Z, 1e-9),
                    "tilted as before"
                );
                assert_eq!(pose.translation, poses[k].translation);
            }
        }
    }

    fn paths<'a>(along: &BTreeMap<usize, DVec3>, outline: &'a Outline) -> Paths<'a> {
        Paths {
            along: along.clone(),
            place: DVec3::ZERO,
            outline,
            up: DVec3::Z,
            stands: true,
            reference: 0,
            followed: None,
            off: Vec::new(),
            turned: None,
        }
    }

    #[test]
    fn what_is_tall_slides_and_what_is_low_may_roll() {
        let along: BTreeMap<usize, DVec3> = (0..20).map(|k| (k, DVec3::X * (0.02 * k as f64))).collect();
        let rolls = |height: f64, radius: f64| {
            let outline = shaped(height, radius, 0.85, along.clone());
            paths(&along, &outline).ways().iter().any(|way| matches!(way, Way::Roll(_)))
        };
        assert!(rolls(0.03, 0.1) && rolls(0.05, 0.04));
        assert!(!rolls(0.09, 0.03));
    }
}
