//! Optimiser of the poses of groups: one tangent vector of turn and translation per key. Source: methods reference of
//! motion, 2.1.

use std::collections::BTreeMap;
use std::ops::Range;

use cif_field::checkpoint::StateTensor;
use cif_field::{Gaussians, Tracks};
use cif_render::PoseGradient;
use glam::{DQuat, DVec3};

use crate::guard::Fault;

/// Decays of the moments: a pose is visited rarely, so they are short.
pub(crate) const DECAY: [f64; 2] = [0.9, 0.99];

/// Keeps steps finite where gradients vanish.
pub(crate) const EPSILON: f64 = 1e-15;

/// Rate of turns, radians, of that of translations, shares of the size: light, which stays where it is, turns objects
/// back from what their fits found.
pub(crate) const TURN_RATE: f64 = 0.25;

/// Values of a pose: turn, translation.
const WIDTH: usize = 6;

/// Steps of a pose after which the correction of its moments is that of so many.
pub(crate) const COUNTED_STEPS: u32 = 10_000;

/// Moments of all poses, in the order of the groups and their keys. Those of a pose advance only when a view of its
/// time is drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct PoseMoments {
    pub first: Vec<[f64; WIDTH]>,
    pub second: Vec<[f64; WIDTH]>,
    pub steps: Vec<u32>,
    /// Rates of the poses, of the common one.
    pub shares: Vec<f64>,
}

impl PoseMoments {
    /// Zero moments of the poses of some tracks.
    pub(crate) fn zeros(tracks: Option<&Tracks>) -> Self {
        let mut moments = Self::default();
        moments.extend(&vec![1.0; tracks.map_or(0, Tracks::poses)]);
        moments
    }

    /// Adds zero moments of poses that follow, with their shares of the common rate.
    pub(crate) fn extend(&mut self, shares: &[f64]) {
        let poses = self.shares.len() + shares.len();
        self.first.resize(poses, [0.0; WIDTH]);
        self.second.resize(poses, [0.0; WIDTH]);
        self.steps.resize(poses, 0);
        self.shares.extend(shares);
    }

    /// Keeps those at `trained` of poses at `places`, with so many that are not trained before and behind them.
    pub(crate) fn replace(
        &mut self,
        places: Range<usize>,
        trained: Range<usize>,
        [before, behind]: [usize; 2],
    ) {
        fn put<T: Copy>(
            values: &mut Vec<T>,
            places: &Range<usize>,
            kept: &Range<usize>,
            around: [usize; 2],
            new: T,
        ) {
            let kept = values[kept.clone()].to_vec();
            let [before, behind] = around.map(|count| vec![new; count]);
            values.splice(places.clone(), [before, kept, behind].concat());
        }
        let around = [before, behind];
        put(&mut self.first, &places, &trained, around, [0.0; WIDTH]);
        put(&mut self.second, &places, &trained, around, [0.0; WIDTH]);
        put(&mut self.steps, &places, &trained, around, 0);
        put(&mut self.shares, &places, &trained, around, 0.0);
    }

    /// Moves the poses that views were drawn of, each at its share of `rate`: translations at that of the `sizes` of the
    /// groups, metres, turns, where they are not assumed, at [`TURN_RATE`] of as many radians.
    pub(crate) fn step(
        &mut self,
        tracks: &mut Tracks,
        sizes: &[f64],
        gradients: &[PoseGradient],
        views: &[u32],
        rate: f64,
    ) {
        let mut index = 0;
        for (group, size) in tracks.groups.iter_mut().zip(sizes) {
            let turns = group.turns_are_trained();
            for pose in &mut group.poses {
                let place = index;
                index += 1;
                if views[place] == 0 {
                    continue;
                }
                self.steps[place] += 1;
                let steps = self.steps[place].min(COUNTED_STEPS) as i32;
                let bias = DECAY.map(|decay| 1.0 - decay.powi(steps));
                let PoseGradient { turn, translation } = gradients[place];
                let mut taken = [0.0; WIDTH];
                let values = turn.to_array().into_iter().chain(translation.to_array());
                for (k, g) in values.enumerate() {
                    let (first, second) = (&mut self.first[place][k], &mut self.second[place][k]);
                    *first = DECAY[0] * *first + (1.0 - DECAY[0]) * g;
                    *second = DECAY[1] * *second + (1.0 - DECAY[1]) * g * g;
                    taken[k] = (*first / bias[0]) / ((*second / bias[1]).sqrt() + EPSILON);
                }
                let rate = rate * self.shares[place];
                if turns {
                    let turn = -TURN_RATE * rate * DVec3::from_slice(&taken[..3]);
                    pose.rotation = (pose.rotation * DQuat::from_scaled_axis(turn)).normalize();
                }
                pose.translation -= rate * size * DVec3::from_slice(&taken[3..]);
            }
        }
    }

    /// Arrays of a saved run, by name; none without poses.
    pub(crate) fn saved(&self) -> Vec<(&'static str, StateTensor)> {
        if self.steps.is_empty() {
            return Vec::new();
        }
        vec![
            ("poses.first", StateTensor::F64(self.first.as_flattened().to_vec())),
            ("poses.second", StateTensor::F64(self.second.as_flattened().to_vec())),
            ("poses.steps", StateTensor::U32(self.steps.clone())),
            ("poses.shares", StateTensor::F64(self.shares.clone())),
        ]
    }

    /// Takes the arrays of [`Self::saved`] out of a saved run; `None` when they do not fit. A run that was saved
    /// without poses keeps zero moments.
    pub(crate) fn restore(&mut self, saved: &mut BTreeMap<String, StateTensor>) -> Option<()> {
        let Some(steps) = saved.remove("poses.steps") else { return Some(()) };
        let (first, second) = (saved.remove("poses.first")?, saved.remove("poses.second")?);
        let StateTensor::F64(shares) = saved.remove("poses.shares")? else { return None };
        let (StateTensor::F64(first), StateTensor::F64(second), StateTensor::U32(steps)) =
            (first, second, steps)
        else {
            return None;
        };
        let poses = self.steps.len();
        let fits =
            [first.len(), second.len()] == [WIDTH * poses; 2] && [steps.len(), shares.len()] == [poses; 2];
        let is_finite = first.iter().chain(&second).chain(&shares).all(|value| value.is_finite());
        (fits && is_finite).then(|| {
            self.first = first.as_chunks().0.to_vec();
            self.second = second.as_chunks().0.to_vec();
            (self.steps, self.shares) = (steps, shares);
        })
    }
}

/// Half of the largest extent of the Gaussians of every group, metres.
pub(crate) fn object_sizes(tracks: &Tracks, gaussians: &Gaussians) -> Vec<f64> {
    let mut bounds = vec![[[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]]; tracks.groups.len()];
    for (row, mean) in gaussians.means.iter().enumerate() {
        let Some(group) = tracks.group(row) else { continue };
        let [low, high] = &mut bounds[group];
        for axis in 0..3 {
            low[axis] = low[axis].min(mean[axis]);
            high[axis] = high[axis].max(mean[axis]);
        }
    }
    let half = |[low, high]: [[f32; 3]; 2]| {
        (0..3).map(|axis| 0.5 * f64::from(high[axis] - low[axis])).fold(0.0, f64::max)
    };
    bounds.into_iter().map(|bounds| half(bounds).max(0.0)).collect()
}

/// The first gradient of a pose that is not finite.
pub(crate) fn pose_fault(gradients: &[PoseGradient]) -> Option<Fault> {
    let is_bad = |pose: &PoseGradient| !(pose.turn.is_finite() && pose.translation.is_finite());
    let index = gradients.iter().position(is_bad)?;
    let PoseGradient { turn, translation } = gradients[index];
    Some(Fault {
        part: "gradients",
        tensor: "gradient of poses".to_owned(),
        index,
        value: format!("{turn} {translation}"),
    })
}

#[cfg(test)]
mod tests {
    use cif_field::RotationEvidence;
    use cif_field::tracks::{TrackGroup, TrackPose};

    use super::*;

    #[test]
    fn assumed_rotations_stay_and_observed_ones_turn() {
        let pose = TrackPose { time: 0.0, translation: DVec3::ZERO, rotation: DQuat::IDENTITY };
        let group = |rotation| TrackGroup {
            deformed: false,
            poses: vec![pose],
            rotation,
            ..TrackGroup::still("ball", DVec3::ZERO)
        };
        let kinds = [Some(RotationEvidence::Assumed), Some(RotationEvidence::Observed), None];
        let mut tracks = Tracks { groups: kinds.map(group).to_vec(), ..Tracks::default() };
        let gradients = [PoseGradient { turn: DVec3::X, translation: DVec3::Y }; 3];
        let mut moments = PoseMoments::zeros(Some(&tracks));
        moments.step(&mut tracks, &[0.1; 3], &gradients, &[1; 3], 0.01);
        let turned = tracks.groups.iter().map(|group| group.poses[0].rotation != DQuat::IDENTITY);
        assert_eq!(turned.collect::<Vec<_>>(), [false, true, true]);
        assert!(tracks.groups.iter().all(|group| group.poses[0].translation.y < 0.0));
    }

    #[test]
    fn poses_move_at_their_shares_of_the_rate_and_these_are_saved() {
        let pose = |time: f64| TrackPose { time, translation: DVec3::ZERO, rotation: DQuat::IDENTITY };
        let poses = vec![pose(0.0), pose(0.5), pose(1.0)];
        let group = TrackGroup { deformed: false, poses, ..TrackGroup::still("box", DVec3::ZERO) };
        let mut tracks = Tracks { groups: vec![group], ..Tracks::default() };
        let mut moments = PoseMoments::default();
        moments.extend(&[1.0]);
        moments.extend(&[0.1, 0.0]);
        let gradients = [PoseGradient { turn: DVec3::X, translation: DVec3::Y }; 3];
        moments.step(&mut tracks, &[0.1], &gradients, &[1; 3], 0.01);
        let moved: Vec<f64> = tracks.groups[0].poses.iter().map(|pose| -pose.translation.y / 0.001).collect();
        let turned: Vec<f64> =
            tracks.groups[0].poses.iter().map(|pose| -2.0 * pose.rotation.x / (TURN_RATE * 0.01)).collect();
        for found in [moved, turned] {
            assert!(found.iter().zip([1.0, 0.1, 0.0]).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        }
        let arrays = || moments.saved().into_iter().map(|(name, array)| (name.to_owned(), array));
        let mut restored = PoseMoments::zeros(Some(&tracks));
        assert!(restored.restore(&mut arrays().collect()).is_some());
        assert_eq!(restored, moments);
        let without = arrays().filter(|(name, _)| name != "poses.shares");
        assert!(restored.restore(&mut without.collect()).is_none());
    }
}
