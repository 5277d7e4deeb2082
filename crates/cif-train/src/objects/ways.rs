//! Ways in which an object may move: what its path and the plane suggest, and what following it from time to time
//! found.

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_geometry::scalar::direct_sigmoid;
use glam::{DQuat, DVec3};
use nalgebra::{Matrix3, Vector3};

use super::fit::log;
use super::outline::Outline;
use super::shape::Pose;

/// Turns about the normal, degrees apart: the truth lies within the 30 degrees up to which the judge takes turns as the
/// same.
const SLIDE: i32 = 45;

/// Largest turn in place, degrees: it may turn on, but then the texture comes around again.
const SPINS_TO: i32 = 360;

/// Amounts of rolling, of that without slip about the height, between which a radius is looked for: the height tells that
/// of balls well and that of other things, which roll about another axis than their middle, by half.
const ROLLS: (f64, f64) = (0.75, 1.6);

/// The same of fits where the judge does not tell, and rolling radii tried then, of the height: of balls, and of other
/// things, whose height tells it less well.
const ASSUMED: i32 = 30;
const ASSUMED_ROLLS: [f64; 9] = [0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08];
const OTHER_ROLLS: [f64; 12] = [0.64, 0.68, 0.72, 0.76, 0.8, 0.84, 0.88, 0.92, 0.96, 1.0, 1.04, 1.08];

/// Difference of the whole turns of courses that are tried, degrees: the judge takes turns within 30 degrees as the same.
const GRID: f64 = 30.0;

/// Most amounts of rolling that are tried.
const MOST_ROLLS: usize = 48;

/// Turns, of those that following found, that these are held against: following drifts.
const SCALES: [f64; 4] = [0.5, 0.75, 1.25, 1.5];

/// Difference of courses that are added on either side of the best, degrees.
const FINER: [f64; 2] = [10.0, 20.0];

/// Length of a bar in its widths, and the cosine between its long axis and the normal up to which it lies.
const BAR: (f64, f64) = (2.0, 0.3);

/// Roundness of masks from which an object may roll as a ball.
const ROUND: f64 = 0.93;

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
    /// The same with the pauses that are seen.
    Pausing(i32),
    /// Along the path without slip, with this radius of the height.
    Roll(f64),
    /// As following it from time to time found.
    Followed,
    /// The same with turns of so many of those that following found.
    Scaled(f64),
    /// Along the path, turning about the normal, or its own long axis, as its texture tells.
    Textured,
}

impl Way {
    /// The way in words.
    pub(super) fn told(self) -> String {
        match self {
            Self::Rest => "rests".to_owned(),
            Self::Slide(degrees) => format!("slides, turning {degrees} deg"),
            Self::Spin(degrees) => format!("turns {degrees} deg in place"),
            Self::Pausing(degrees) => format!("turns {degrees} deg in place, with pauses"),
            Self::Roll(factor) => format!("rolls with {factor:.2} of its height"),
            Self::Followed => "followed from time to time".to_owned(),
            Self::Scaled(share) => format!("followed from time to time, turning {share:.2} as far"),
            Self::Textured => "turns as its texture tells".to_owned(),
        }
    }

    /// Turn about the normal, degrees, of ways that are told apart by it.
    pub(super) fn degrees(self) -> Option<i32> {
        match self {
            Self::Slide(degrees) | Self::Spin(degrees) | Self::Pausing(degrees) => Some(degrees),
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
    /// Share of all turning in place that is done by each time, where pauses are seen.
    pub(super) pauses: Option<BTreeMap<usize, f64>>,
    /// Poses with turns that its texture tells, where it does.
    pub(super) textured: Option<BTreeMap<usize, Pose>>,
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

    /// Ways of moving along the path; the first does not turn.
    pub(super) fn ways(&self) -> Vec<Way> {
        let slides = (-180 / SLIDE..=180 / SLIDE).filter(|k| *k != 0).map(|k| Way::Slide(k * SLIDE));
        let mut ways: Vec<Way> = std::iter::once(Way::Slide(0)).chain(slides).collect();
        if self.may_roll() {
            ways.extend(self.amounts().into_iter().map(Way::Roll));
        } else {
            ways.extend(self.spins().into_iter().skip(1));
        }
        if self.followed.is_some() {
            ways.push(Way::Followed);
            ways.extend(SCALES.map(Way::Scaled));
        }
        if self.textured.is_some() {
            ways.push(Way::Textured);
        }
        ways
    }

    /// Rolling radii that are tried, of the height: equally far apart in the whole turn.
    fn amounts(&self) -> Vec<f64> {
        let whole = self.rolled_degrees();
        let count = ((ROLLS.1 - ROLLS.0) * whole / GRID).ceil().clamp(4.0, MOST_ROLLS as f64);
        let amount = |k: usize| ROLLS.0 + (ROLLS.1 - ROLLS.0) * k as f64 / count;
        (0..=count as usize).map(|k| 1.0 / amount(k)).collect()
    }

    /// Turn of rolling without slip about the height, degrees.
    fn rolled_degrees(&self) -> f64 {
        let places: Vec<DVec3> = self.along.values().copied().collect();
        let length: f64 = places.windows(2).map(|pair| (pair[1] - pair[0]).length()).sum();
        (length / self.outline.height.max(1e-9)).to_degrees()
    }

    /// Ways beside one.
    pub(super) fn beside(&self, way: Way) -> Vec<Way> {
        let around = FINER.iter().flat_map(|degrees| [-degrees, *degrees]);
        let whole = |more: f64| more.round() as i32;
        match way {
            Way::Slide(turn) => around.map(|more| Way::Slide(turn + whole(more))).collect(),
            Way::Spin(turn) => around.map(|more| Way::Spin(turn + whole(more))).collect(),
            Way::Pausing(turn) => around.map(|more| Way::Pausing(turn + whole(more))).collect(),
            Way::Roll(factor) => {
                let of = |more: f64| Way::Roll(1.0 / (1.0 / factor + more / self.rolled_degrees().max(GRID)));
                around.map(of).collect()
            }
            Way::Rest | Way::Followed | Way::Scaled(_) | Way::Textured => Vec::new(),
        }
    }

    /// Ways to try where the judge cannot tell; of an outline at a place beside the first what following found alone.
    pub(super) fn unobserved(&self, place: usize) -> Vec<Way> {
        let mut ways = Vec::new();
        if place == 0 || self.followed.is_none() {
            let turns = (-180 / ASSUMED..=180 / ASSUMED).filter(|k| *k != 0);
            ways.extend(turns.map(|k| Way::Slide(k * ASSUMED)));
            if self.may_roll() {
                let radii: &[f64] = if is_round(self.outline) { &ASSUMED_ROLLS } else { &OTHER_ROLLS };
                ways.extend(radii.iter().map(|radius| Way::Roll(*radius)));
            }
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

    /// Resting, and ways of turning in place.
    pub(super) fn spins(&self) -> Vec<Way> {
        let count = SPINS_TO / SLIDE;
        let turns = || (-count..=count).filter(|k| *k != 0).map(|k| k * SLIDE);
        let pausing = turns().filter(|_| self.pauses.is_some()).map(Way::Pausing);
        std::iter::once(Way::Rest).chain(turns().map(Way::Spin)).chain(pausing).collect()
    }

    /// Poses along the path with turns, from none at the reference; between times that have one it turns evenly.
    pub(super) fn turned(&self, turns: &BTreeMap<usize, DQuat>) -> BTreeMap<usize, Pose> {
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

    /// Poses that following found, with a share of the turn from each time to the next.
    fn scaled(&self, share: f64) -> BTreeMap<usize, Pose> {
        let found = self.poses(Way::Followed);
        let mut last: Option<(DQuat, DQuat)> = None;
        let mut poses = BTreeMap::new();
        for (time, pose) in &found {
            let rotation = last.map_or(pose.rotation, |(before, scaled)| {
                let turn = log(pose.rotation * before.inverse());
                (DQuat::from_scaled_axis(share * turn) * scaled).normalize()
            });
            last = Some((pose.rotation, rotation));
            poses.insert(*time, Pose { rotation, ..*pose });
        }
        poses
    }

    /// Poses of a way at the times of the path.
    pub(super) fn poses(&self, way: Way) -> BTreeMap<usize, Pose> {
        let times: Vec<usize> = self.along.keys().copied().collect();
        let places: Vec<DVec3> = self.along.values().copied().collect();
        let origin = times.iter().position(|time| *time == self.reference).unwrap_or(0);
        let turned = |shares: &[f64], degrees: i32| -> Vec<DQuat> {
            let whole = (shares[shares.len() - 1] - shares[0]).max(1e-9);
            let angle = f64::from(degrees).to_radians();
            let of =
                |share: &f64| DQuat::from_scaled_axis(self.up * angle * (share - shares[origin]) / whole);
            shares.iter().map(of).collect()
        };
        let rotations = match way {
            Way::Rest => vec![DQuat::IDENTITY; times.len()],
            Way::Slide(degrees) => {
                let mut lengths = vec![0.0];
                for pair in places.windows(2) {
                    lengths.push(lengths[lengths.len() - 1] + (pair[1] - pair[0]).length());
                }
                turned(&lengths, degrees)
            }
            Way::Spin(degrees) => {
                let steps: Vec<f64> = times.iter().map(|time| *time as f64).collect();
                turned(&steps, degrees)
            }
            Way::Pausing(degrees) => {
                let share = |time: &usize| {
                    let shares = self.pauses.iter().flat_map(|shares| shares.range(..=time)).next_back();
                    shares.map_or(0.0, |(_, share)| *share)
                };
                turned(&times.iter().map(share).collect::<Vec<f64>>(), degrees)
            }
            Way::Roll(factor) => {
                let rotations = rolled(&places, self.up, self.outline.height / factor);
                let back = rotations[origin].inverse();
                rotations.into_iter().map(|rotation| rotation * back).collect()
            }
            Way::Scaled(share) => return self.scaled(share),
            Way::Followed | Way::Textured => {
                let found = if way == Way::Followed { &self.followed } else { &self.textured };
                return found
                    .iter()
                    .flatten()
                    .filter(|(time, _)| self.along.contains_key(time))
                    .map(|(t, p)| (*t, *p))
                    .collect();
            }
        };
        let stays = !self.shifts() && matches!(way, Way::Rest | Way::Spin(_) | Way::Pausing(_));
        let place = |k: usize| if stays || way == Way::Rest { self.place } else { places[k] };
        let pose = |(k, rotation)| (times[k], Pose { rotation, translation: place(k) });
        rotations.into_iter().enumerate().map(pose).collect()
    }
}

/// A bar that lies: its poses without turns about its long axis, and that axis in its own frame.
pub(super) struct Bar {
    pub(super) poses: BTreeMap<usize, Pose>,
    pub(super) axis: DVec3,
}

impl Bar {
    /// The bar that Gaussians in poses are, if they are long and lie.
    pub(super) fn of(gaussians: &Gaussians, poses: &BTreeMap<usize, Pose>, up: DVec3) -> Option<Self> {
        Some(Self { axis: long_axis(gaussians, up)?, poses: poses.clone() })
    }

    /// Turns about its long axis by time, radians, as far as it goes across it; from zero at `reference`.
    pub(super) fn rolled(&self, up: DVec3, radius: f64, reference: usize) -> BTreeMap<usize, f64> {
        let mut angle = 0.0;
        let mut angles = BTreeMap::new();
        let mut last: Option<&Pose> = None;
        for (time, pose) in &self.poses {
            if let Some(last) = last {
                let turn = up.cross(pose.translation - last.translation) / radius;
                angle += turn.dot(pose.rotation * self.axis);
            }
            angles.insert(*time, angle);
            last = Some(pose);
        }
        let origin = angles.get(&reference).copied().unwrap_or(0.0);
        angles.values_mut().for_each(|angle| *angle -= origin);
        angles
    }

    /// Its poses, turned about its long axis.
    pub(super) fn turned(&self, turns: &BTreeMap<usize, f64>) -> BTreeMap<usize, Pose> {
        let pose = |(time, pose): (&usize, &Pose)| {
            let turn = DQuat::from_axis_angle(self.axis, *turns.get(time)?);
            Some((*time, Pose { rotation: pose.rotation * turn, ..*pose }))
        };
        self.poses.iter().filter_map(pose).collect()
    }
}

/// Long axis of Gaussians, as of a bar that lies in a plane.
fn long_axis(gaussians: &Gaussians, up: DVec3) -> Option<DVec3> {
    let weight = |row: usize| direct_sigmoid(f64::from(gaussians.opacity_logits[row]));
    let place = |row: usize| DVec3::from_array(gaussians.means[row].map(f64::from));
    let rows = || 0..gaussians.len();
    let total: f64 = rows().map(weight).sum();
    let middle = rows().map(|row| weight(row) * place(row)).sum::<DVec3>() / total.max(1e-9);
    let mut moments = Matrix3::zeros();
    for row in rows() {
        let d = Vector3::from((place(row) - middle).to_array());
        moments += weight(row) * d * d.transpose();
    }
    let eigen = moments.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let axis = eigen.eigenvectors.column(order[0]);
    let axis = DVec3::new(axis[0], axis[1], axis[2]);
    let is_long = eigen.eigenvalues[order[0]] > BAR.0 * BAR.0 * eigen.eigenvalues[order[1]];
    (is_long && axis.dot(up).abs() < BAR.1).then_some(axis)
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
    fn what_is_tall_slides_and_what_is_low_may_roll() {
        let along: BTreeMap<usize, DVec3> = (0..20).map(|k| (k, DVec3::X * (0.02 * k as f64))).collect();
        let rolls = |height: f64, radius: f64| {
            let outline = shaped((height, radius), 0.85, along.clone());
            let paths = Paths {
                along: along.clone(),
                place: DVec3::ZERO,
                outline: &outline,
                up: DVec3::Z,
                stands: true,
                reference: 0,
                followed: None,
                off: Vec::new(),
                pauses: None,
                textured: None,
            };
            paths.ways().iter().any(|way| matches!(way, Way::Roll(_)))
        };
        assert!(rolls(0.03, 0.1) && rolls(0.05, 0.04));
        assert!(!rolls(0.09, 0.03));
    }
}
