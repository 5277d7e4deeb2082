//! The likeliest of the motions in which an object was followed from several starts.

use std::collections::BTreeMap;

use super::follow::nearest;
use super::shape::Pose;

/// Cost of what was followed from another start, of the likeliest, up to which it is as likely.
const AS_LIKELY: f64 = 1.02;

/// Cost of a jump by half a turn, of the loss. Three objects that one camera sees carried, in random captures and the same
/// mirrored and backwards, are turned rightly with 0.18 to 0.56.
const JUMPS: f64 = 0.3;

/// Evidence for the motion of an object that was followed from a start.
#[derive(Clone, Copy, Debug)]
pub(super) struct Explained {
    /// Loss of Gaussians that are made anew from its poses.
    pub(super) loss: f64,
    /// Turn by which it jumps where it was followed to from two rests, degrees; `None` where it was followed from one.
    pub(super) jump: Option<f64>,
}

impl Explained {
    /// Loss and jump in one number.
    fn cost(&self) -> f64 {
        self.loss * (1.0 + JUMPS * self.jump.unwrap_or(0.0) / 180.0)
    }

    /// True of what is as likely as what is kept: from one rest nothing jumps, and losses alone are compared.
    pub(super) fn rivals(&self, kept: &Self) -> bool {
        match self.jump.zip(kept.jump) {
            Some(_) => self.cost() <= AS_LIKELY * kept.cost(),
            None => self.loss <= AS_LIKELY * kept.loss,
        }
    }
}

/// Place of the likeliest motion: the one that explains most and, followed from two rests, jumps little between. Turned so
/// that each rest shows other sides of it an object is explained as well as it can be, and only the way from one to the other
/// tells otherwise.
pub(super) fn likeliest(tried: &[Explained]) -> Option<usize> {
    let best = (0..tried.len()).min_by(|a, b| tried[*a].loss.total_cmp(&tried[*b].loss))?;
    if tried[best].jump.is_none() {
        return Some(best);
    }
    let jumping = (0..tried.len()).filter(|place| tried[*place].jump.is_some());
    jumping.min_by(|a, b| tried[*a].cost().total_cmp(&tried[*b].cost()))
}

/// Largest turn from a time to which poses were followed from a start before it to the next time, to which they were followed
/// from one behind it, degrees; `None` where they were followed from one side.
pub(super) fn jump(poses: &BTreeMap<usize, Pose>, starts: &BTreeMap<usize, Pose>) -> Option<f64> {
    let meet = |a: usize, b: usize| {
        let [from, to] = [a, b].map(|time| nearest(starts.keys().copied(), time));
        from != to
            && from <= Some(a)
            && to >= Some(b)
            && !(starts.contains_key(&a) && starts.contains_key(&b))
    };
    let jumps = poses.iter().zip(poses.iter().skip(1)).filter(|((a, _), (b, _))| meet(**a, **b));
    let turns = jumps.map(|((_, a), (_, b))| a.rotation.angle_between(b.rotation).to_degrees());
    turns.max_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    #[test]
    fn turns_between_rests_are_told_by_what_they_explain_and_by_jumps_between() {
        let explained = |loss: f64, jump: Option<f64>| Explained { loss, jump };
        // A bottle that is carried before one camera, turned by 174, 64 and 95 degrees, and followed from one rest alone; and
        // the same backwards.
        let bottle = [
            explained(0.0426, Some(146.0)),
            explained(0.0430, Some(5.0)),
            explained(0.0475, Some(127.0)),
            explained(0.0433, None),
        ];
        assert_eq!(likeliest(&bottle), Some(1));
        assert!(!bottle[0].rivals(&bottle[1]) && bottle[3].rivals(&bottle[1]));
        assert_eq!(likeliest(&[explained(0.0415, Some(146.0)), explained(0.0454, Some(46.0))]), Some(1));
        // Mugs that are mistaken on their way explain more than any other, though they jump.
        assert_eq!(likeliest(&[explained(0.0314, Some(73.0)), explained(0.0364, Some(19.0))]), Some(0));
        assert_eq!(likeliest(&[explained(0.0312, Some(69.0)), explained(0.0404, Some(6.0))]), Some(0));
        assert_eq!(
            likeliest(&[explained(0.0420, Some(13.0)), explained(0.0426, None)]),
            Some(0),
            "one rest knows of no jump"
        );
        assert_eq!(likeliest(&[explained(0.0426, Some(0.0)), explained(0.0420, None)]), Some(1));
        assert_eq!(likeliest(&[]), None);
    }

    #[test]
    fn poses_jump_where_they_were_followed_to_from_both_rests() {
        let pose = |degrees: f64| Pose {
            rotation: DQuat::from_rotation_z(degrees.to_radians()),
            translation: DVec3::ZERO,
        };
        let turns = [(0, 0.0), (1, 10.0), (2, 20.0), (4, 120.0), (5, 130.0), (6, 140.0)];
        let poses: BTreeMap<usize, Pose> = turns.iter().map(|(time, turn)| (*time, pose(*turn))).collect();
        let starts = |times: &[usize]| times.iter().map(|time| (*time, poses[time])).collect();
        assert!((jump(&poses, &starts(&[0, 1, 6])).unwrap() - 100.0).abs() < 1e-6);
        assert_eq!(jump(&poses, &starts(&[0, 1])), None);
        assert_eq!(jump(&poses, &starts(&[2, 4])), None, "starts are not followed");
    }
}
