//! Joints that an object may have, by the box around it: flaps at its edges, drawers, halves and slabs that turn, scissors.

use std::collections::BTreeMap;

use cif_field::tracks::JointKind;
use glam::DVec3;

use super::super::plane::Plane;
use super::body::{Hinge, JointOfBody};

/// Thickness of flaps, drawers and slabs that turn, of the box.
const FLAPS: [f64; 3] = [0.15, 0.35, 0.55];
const DRAWERS: [f64; 3] = [0.15, 0.4, 0.75];
const PLATES: [f64; 2] = [0.15, 0.4];
const WHEELS: [f64; 3] = [0.15, 0.4, 0.7];

/// Places at which halves are cut apart, of the box.
const CUTS: [f64; 3] = [0.3, 0.5, 0.7];

/// Turns of the sides of the box that are tried, degrees apart.
const SIDES: i32 = 3;

/// Share of the Gaussians beyond each side of the box.
const BEYOND: f64 = 0.02;

/// A box around an object, in its frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sides {
    /// Unit directions; the last one away from the support, where there is one.
    pub(super) axes: [DVec3; 3],
    pub(super) low: [f64; 3],
    pub(super) high: [f64; 3],
}

/// A joint to be tried.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Guess {
    pub(super) hinge: Hinge,
    /// Region of the part.
    pub(super) cut: Cut,
    /// Values that are tried at each time.
    pub(super) values: JointValues,
}

/// A side of a plane: its normal, and its offset.
pub(super) type Side = (DVec3, f64);

/// Region of an object that is a part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Cut {
    /// Beyond a plane.
    Beyond(Side),
    /// Beyond both of two planes or of neither; all else is a second part, which turns the other way, as the blades of
    /// scissors.
    Crossed([Side; 2]),
}

/// Values of a joint that are tried.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct JointValues {
    /// Ascending and equally far apart; radians or metres.
    pub(super) values: Vec<f64>,
    /// True where the last value is followed by the first.
    pub(super) is_round: bool,
}

impl JointValues {
    /// Values of which the last is not followed by the first.
    pub(super) fn open(values: Vec<f64>) -> Self {
        Self { values, is_round: false }
    }
}

impl Guess {
    /// Its joints, two where there is a second part, at searched values.
    pub(super) fn joints(&self, values: &BTreeMap<usize, f64>) -> Vec<JointOfBody> {
        let of = |share: f64| {
            let values = values.iter().map(|(time, value)| (*time, share * value)).collect();
            JointOfBody::new(self.hinge, values, share)
        };
        if self.cut.other().is_some() { vec![of(1.0), of(-1.0)] } else { vec![of(1.0)] }
    }
}

impl Cut {
    /// True where a place belongs to the part, widened by a margin.
    pub(super) fn has(&self, place: DVec3, margin: f64) -> bool {
        let beyond = |(normal, offset): &Side| normal.dot(place) - offset;
        match self {
            Self::Beyond(side) => beyond(side) >= -margin,
            Self::Crossed(sides) => {
                let [a, b] = [0, 1].map(|k| beyond(&sides[k]));
                (a >= -margin && b >= -margin) || (a <= margin && b <= margin)
            }
        }
    }

    /// Region of the second part; `None` where there is none.
    pub(super) fn other(&self) -> Option<Self> {
        match self {
            Self::Beyond(_) => None,
            Self::Crossed([first, (normal, offset)]) => Some(Self::Crossed([*first, (-*normal, -offset)])),
        }
    }
}

fn range(places: &[DVec3], axis: DVec3) -> [f64; 2] {
    let mut along: Vec<f64> = places.iter().map(|place| axis.dot(*place)).collect();
    along.sort_by(f64::total_cmp);
    let last = along.len() - 1;
    let at = |share: f64| along[(last as f64 * share).round() as usize];
    [at(BEYOND), at(1.0 - BEYOND)]
}

impl Sides {
    /// The upright box of least area around places; `up` in the object's frame.
    pub(super) fn around(places: &[DVec3], up: DVec3) -> Self {
        let across = up.any_orthonormal_vector();
        let turned = |degrees: i32| {
            let (sine, cosine) = f64::from(degrees).to_radians().sin_cos();
            let first = cosine * across + sine * up.cross(across);
            [first, up.cross(first), up]
        };
        let area = |axes: &[DVec3; 3]| {
            let [a, b] = [0, 1].map(|k| range(places, axes[k])).map(|[low, high]| high - low);
            a * b
        };
        let mut best = turned(0);
        for degrees in (0..90).step_by(SIDES as usize) {
            let axes = turned(degrees);
            if area(&axes) < area(&best) {
                best = axes;
            }
        }
        Self::of(best, places)
    }

    /// The box around places with sides along unit directions.
    fn of(axes: [DVec3; 3], places: &[DVec3]) -> Self {
        let ranges = axes.map(|axis| range(places, axis));
        Self { axes, low: ranges.map(|[low, _]| low), high: ranges.map(|[_, high]| high) }
    }

    /// The box around places with its sides turned about its last axis.
    pub(super) fn turned(&self, angle: f64, places: &[DVec3]) -> Self {
        let [first, second, up] = self.axes;
        let (sine, cosine) = angle.sin_cos();
        Self::of([cosine * first + sine * second, cosine * second - sine * first, up], places)
    }

    fn extent(&self, axis: usize) -> f64 {
        self.high[axis] - self.low[axis]
    }

    /// The point at these coordinates along the axes.
    fn point(&self, at: [f64; 3]) -> DVec3 {
        (0..3).map(|axis| at[axis] * self.axes[axis]).sum()
    }

    fn middle(&self) -> [f64; 3] {
        [0, 1, 2].map(|axis| 0.5 * (self.low[axis] + self.high[axis]))
    }
}

/// Equally spaced values.
fn spaced(from: f64, to: f64, count: usize) -> Vec<f64> {
    (0..count).map(|k| from + (to - from) * k as f64 / (count - 1) as f64).collect()
}

fn degrees(from: f64, to: f64, count: usize) -> Vec<f64> {
    spaced(from.to_radians(), to.to_radians(), count)
}

/// Joints worth a trial; nothing opens towards what the object stands on.
pub(super) fn guesses(sides: &Sides, stands: Option<&Plane>) -> Vec<Guess> {
    let mut all = Vec::new();
    let revolute = |axis, point| Hinge { kind: JointKind::Revolute, axis, point };
    let slide = |axis, point| Hinge { kind: JointKind::Prismatic, axis, point };
    for (face, sign) in (0..3).flat_map(|face| [(face, 1.0), (face, -1.0)]) {
        if face == 2 && sign < 0.0 && stands.is_some() {
            continue;
        }
        let normal = sign * sides.axes[face];
        let outer = if sign > 0.0 { sides.high[face] } else { -sides.low[face] };
        let extent = sides.extent(face);
        let beyond = |share: f64| outer - share * extent;
        let cut = |share: f64| Cut::Beyond((normal, beyond(share)));
        let others: Vec<usize> = (0..3).filter(|axis| *axis != face).collect();
        for share in FLAPS {
            for (side, towards) in others.iter().flat_map(|axis| [(*axis, 1.0), (*axis, -1.0)]) {
                let mut at = sides.middle();
                at[face] = sign * beyond(share);
                at[side] = if towards > 0.0 { sides.high[side] } else { sides.low[side] };
                let hinge = revolute(normal.cross(towards * sides.axes[side]), sides.point(at));
                let values = JointValues::open(degrees(-30.0, 150.0, 13));
                all.push(Guess { hinge, cut: cut(share), values });
            }
        }
        for share in DRAWERS {
            let hinge = slide(normal, sides.point(sides.middle()));
            let values = JointValues::open(spaced(-0.2 * extent, extent, 13));
            all.push(Guess { hinge, cut: cut(share), values });
        }
        for (share, side) in PLATES.iter().flat_map(|share| others.iter().map(move |side| (*share, *side))) {
            let reach = sides.extent(side);
            let hinge = slide(sides.axes[side], sides.point(sides.middle()));
            let values = JointValues::open(spaced(-0.9 * reach, 0.9 * reach, 13));
            all.push(Guess { hinge, cut: cut(share), values });
        }
        for share in WHEELS {
            let hinge = revolute(normal, sides.point(sides.middle()));
            let values = JointValues { values: degrees(-180.0, 150.0, 12), is_round: true };
            all.push(Guess { hinge, cut: cut(share), values });
        }
        if sign > 0.0 {
            for (share, axis) in CUTS.iter().flat_map(|share| others.iter().map(move |axis| (*share, *axis)))
            {
                let mut at = sides.middle();
                at[face] = sides.low[face] + share * extent;
                let hinge = revolute(sides.axes[axis], sides.point(at));
                let values = JointValues::open(degrees(-120.0, 120.0, 13));
                all.push(Guess { hinge, cut: Cut::Beyond((normal, at[face])), values });
                // Of scissors both blades turn, each by half of that.
                let across = 3 - face - axis;
                let crossed = Cut::Crossed([(normal, at[face]), (sides.axes[across], at[across])]);
                let values = JointValues::open(degrees(-60.0, 60.0, 13));
                all.push(Guess { hinge, cut: crossed, values });
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cut_through_both_planes_leaves_a_second_part_that_turns_the_other_way() {
        let sides = Sides { axes: [DVec3::X, DVec3::Y, DVec3::Z], low: [-1.0; 3], high: [1.0, 3.0, 1.0] };
        let all = guesses(&sides, None);
        let crossed = |guess: &&Guess| {
            let hinge = guess.hinge;
            guess.cut.other().is_some() && hinge.axis == DVec3::Z && hinge.point == DVec3::Y
        };
        let guess = all.iter().find(crossed).unwrap();
        let corners = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)];
        let has =
            |cut: &Cut, margin: f64| corners.map(|(x, y)| cut.has(DVec3::new(0.5 * x, 1.0 + y, 0.3), margin));
        let other = guess.cut.other().unwrap();
        assert_eq!(has(&guess.cut, 0.0), [true, false, false, true]);
        assert_eq!(has(&other, 0.0), [false, true, true, false]);
        assert_eq!(has(&guess.cut, 0.6), [true; 4], "widened");
        let joints = guess.joints(&BTreeMap::from([(3, 0.5)]));
        let values: Vec<f64> = joints.iter().map(|joint| joint.value_at(3)).collect();
        assert_eq!(values, [0.5, -0.5]);
        assert!(
            all.iter().any(|guess| guess.cut.other().is_none() && guess.joints(&BTreeMap::new()).len() == 1)
        );
    }
}
