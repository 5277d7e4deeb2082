//! Where frames are over time.

use glam::{DAffine3, DQuat, DVec3};

use crate::PoseSample;
use crate::graph::pose_at;
use crate::motion::keys;

/// A frame that moves rigidly in another.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Where it is when nothing is sampled, or at the earliest time.
    pub rest: PoseSample,
    /// Samples, ascending time codes; empty where it stands still.
    pub samples: Vec<PoseSample>,
}

impl Track {
    /// A frame that stays in the other one.
    #[must_use]
    pub fn still() -> Self {
        let rest = PoseSample { time_code: 0.0, translation: DVec3::ZERO, rotation: DQuat::IDENTITY };
        Self { rest, samples: Vec::new() }
    }

    /// True when it stays in the other frame.
    #[must_use]
    pub fn is_identity(&self) -> bool {
        let PoseSample { translation, rotation, .. } = self.rest;
        self.samples.is_empty() && translation == DVec3::ZERO && rotation == DQuat::IDENTITY
    }

    /// The pose at a time code.
    #[must_use]
    pub fn at(&self, time_code: f64) -> PoseSample {
        match self.samples.is_empty() {
            true => self.rest,
            false => pose_at(&self.samples, self.rest.translation, time_code),
        }
    }

    /// The track of a graph: the samples; without any the pose itself where it is turned, or where `keeps_pose`.
    pub(super) fn poses(self, keeps_pose: bool) -> Vec<PoseSample> {
        match self.samples.is_empty() && (keeps_pose || self.rest.rotation != DQuat::IDENTITY) {
            true => vec![self.rest],
            false => self.samples,
        }
    }

    /// Pivot of a frame whose track is `poses`: as recorded, unless the frame stands elsewhere by more than rounding
    /// to the single precision of files.
    pub(super) fn pivot(&self, recorded: Option<DVec3>, poses: &[PoseSample]) -> DVec3 {
        let rest = self.rest.translation;
        let holds = |pivot: &DVec3| !poses.is_empty() || pivot.as_vec3() == rest.as_vec3();
        recorded.filter(holds).unwrap_or(rest)
    }
}

/// Successive rotations in one hemisphere, so that what is between them takes the shorter arc.
pub fn one_hemisphere(samples: &mut [PoseSample]) {
    keys::one_hemisphere(samples);
}

/// Transform from the frame of a piece to the frame of its object, over time.
#[derive(Clone, Debug)]
pub enum Placement {
    /// `object_from_piece = track * baked`.
    Rigid {
        /// The part that turns and moves.
        track: Track,
        /// The constant part; `None` for the identity.
        baked: Option<DAffine3>,
    },
    /// Anything else, at every time code.
    Sampled(Vec<(f64, DAffine3)>),
}

impl Placement {
    /// Standing still, below a map.
    #[must_use]
    pub fn still(baked: Option<DAffine3>) -> Self {
        Self::Rigid { track: Track::still(), baked }
    }

    /// `object_from_piece` at a time code.
    #[must_use]
    pub fn at(&self, time_code: f64) -> DAffine3 {
        match self {
            Self::Rigid { track, baked } => {
                let PoseSample { translation, rotation, .. } = track.at(time_code);
                DAffine3::from_rotation_translation(rotation, translation)
                    * baked.unwrap_or(DAffine3::IDENTITY)
            }
            Self::Sampled(samples) => {
                let nearest =
                    samples.iter().min_by(|a, b| (a.0 - time_code).abs().total_cmp(&(b.0 - time_code).abs()));
                nearest.map_or(DAffine3::IDENTITY, |(_, map)| *map)
            }
        }
    }

    /// Time codes at which it is sampled.
    #[must_use]
    pub fn codes(&self) -> Vec<f64> {
        match self {
            Self::Rigid { track, .. } => track.samples.iter().map(|sample| sample.time_code).collect(),
            Self::Sampled(samples) => samples.iter().map(|(code, _)| *code).collect(),
        }
    }
}
