//! Motion models with their samples.

use cif_geometry::Bounds;
use serde::{Deserialize, Serialize};

use super::parts::PartsMotion;
use super::pose::PoseSample;

/// Bytes of a pose: three doubles and a quaternion of floats.
pub(crate) const POSE_BYTES: usize = 3 * 8 + 4 * 4;
/// Bytes of a splat at one dense sample: centre and orientation as floats.
pub(crate) const DENSE_BYTES: usize = 28;

/// Motion models, cheapest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionModel {
    /// Stands still.
    Static,
    /// Turns and moves as one body.
    Rigid,
    /// A few rigid bodies.
    Parts,
    /// Every Gaussian has its own path.
    Dense,
}

impl std::fmt::Display for MotionModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Static => "static",
            Self::Rigid => "rigid",
            Self::Parts => "parts",
            Self::Dense => "dense",
        })
    }
}

/// Motion of a node: its model, with samples.
#[derive(Clone, Debug, PartialEq)]
pub enum Motion {
    /// The local frame stays at the pivot.
    Static,
    /// The local frame moves; the splats are constant in it.
    Rigid(Vec<PoseSample>),
    /// The local frame moves, and a few rigid parts move in it.
    Parts(PartsMotion),
    /// The local frame moves and the splats deform in it.
    Dense(DenseMotion),
}

impl Motion {
    /// The motion model.
    #[must_use]
    pub fn model(&self) -> MotionModel {
        match self {
            Self::Static => MotionModel::Static,
            Self::Rigid(_) => MotionModel::Rigid,
            Self::Parts(_) => MotionModel::Parts,
            Self::Dense(_) => MotionModel::Dense,
        }
    }

    /// Number of samples: poses over all parts, or times of a dense motion.
    #[must_use]
    pub fn sample_count(&self) -> usize {
        match self {
            Self::Static => 0,
            Self::Rigid(track) => track.len(),
            Self::Parts(motion) => {
                motion.track.len() + motion.parts.iter().map(|part| part.track.len()).sum::<usize>()
            }
            Self::Dense(dense) => dense.samples.len(),
        }
    }

    /// Size of the sampled values, bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let Self::Dense(dense) = self else { return self.sample_count() * POSE_BYTES };
        let per_splat = |sample: &DenseSample| DENSE_BYTES + if sample.scales.is_some() { 12 } else { 0 };
        let shapes = dense.samples.iter().map(|sample| sample.means.len() * per_splat(sample));
        shapes.sum::<usize>() + dense.track.len() * POSE_BYTES
    }

    /// The parts; `None` for other motion.
    #[must_use]
    pub fn parts(&self) -> Option<&PartsMotion> {
        if let Self::Parts(motion) = self { Some(motion) } else { None }
    }

    /// Number of parts; 0 for other motion.
    #[must_use]
    pub fn part_count(&self) -> usize {
        self.parts().map_or(0, |motion| motion.parts.len())
    }
}

/// Per-sample splats.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseMotion {
    /// Best rigid fit, which carries the bulk of the motion; empty for the background, which stays put.
    pub track: Vec<PoseSample>,
    /// Splats in the local frame of their time, ascending time codes; where samples were left out, interpolation
    /// is inside the tolerance. First and last are those of the graph.
    pub samples: Vec<DenseSample>,
}

/// Splats of a node at one time code; between samples centres and scales are interpolated linearly; arrays parallel
/// to [`Node::splats`].
#[derive(Clone, Debug, PartialEq)]
pub struct DenseSample {
    /// Time code.
    pub time_code: f64,
    /// Centres, local frame of this time.
    pub means: Vec<[f32; 3]>,
    /// Unit quaternions (w, x, y, z), each in the hemisphere of the previous sample.
    pub orientations: Vec<[f32; 4]>,
    /// Standard deviations; `None` while they stay as in [`Node::splats`] over all samples.
    pub scales: Option<Vec<[f32; 3]>>,
    /// Box of the 3-sigma ellipsoids, local frame.
    pub extent: Bounds,
}
