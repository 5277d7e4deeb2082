//! Motion of the Gaussians: hexplane features decoded by a small MLP. Source: methods reference 2.
//!
//! All parameters lie in two flat vectors (planes, MLP), so that optimisers, checkpoints and GPU uploads see
//! plain slices; [`PlaneLayout`] and [`MlpLayout`] say what is where.

mod apply;
pub mod evaluate;
pub mod initialize;
mod validate;

pub use crate::error::ConfigError;
pub use validate::{
    MAX_CHANNELS, MAX_LEVELS, MAX_MULTIPLIER, MAX_PLANE_FLOATS, MAX_SPATIAL_RESOLUTION, MAX_TIME_RESOLUTION,
    MAX_WIDTH,
};

use std::ops::Range;

use cif_geometry::Bounds;
use serde::{Deserialize, Serialize};

use crate::parameters::{self, Parameter};

/// Which MLP heads exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Heads {
    /// dx, 3 outputs, metres.
    pub position: bool,
    /// ds, 3 outputs, log domain.
    pub scale: bool,
    /// dr, 4 outputs, added to the raw quaternion.
    pub rotation: bool,
    /// do, 1 output, added to the opacity logit.
    pub opacity: bool,
    /// dSH, 48 outputs.
    pub sh: bool,
}

/// Which rows of the time planes are stored (methods reference 2.1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TimeEncoding {
    /// Only the rows that a time in [0, 1] can address.
    #[default]
    Compact,
    /// All rows, as the base code stores them.
    Compat,
}

/// Shape of a deformation field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeformationConfig {
    /// Nodes along x, y, z at multiplier 1.
    pub spatial_resolution: [u32; 3],
    /// Nodes along time over [-1, 1]; a time in [0, 1] addresses the upper half.
    pub time_resolution: u32,
    /// Spatial resolution factors, one level each; time is never multiplied.
    pub multipliers: Vec<u32>,
    /// Feature channels C per plane.
    pub channels: u32,
    /// MLP width W.
    pub width: u32,
    /// Heads that exist.
    pub heads: Heads,
    /// Storage of the time planes.
    pub time_encoding: TimeEncoding,
}

/// Number of planes per level.
pub const PLANES: usize = 6;

/// Axes (columns, rows) of the planes in storage order xy, xz, xt, yz, yt, zt; axis 3 is time.
pub const PLANE_AXES: [(usize, usize); PLANES] = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)];

/// True when the plane has time as its row axis.
#[must_use]
pub const fn is_time_plane(plane: usize) -> bool {
    PLANE_AXES[plane].1 == 3
}

/// Where one plane lies in [`Deformation::planes`]: `[rows, columns, channels]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlaneLayout {
    /// First float.
    pub offset: usize,
    /// Stored rows (second axis).
    pub rows: usize,
    /// Columns (first axis).
    pub columns: usize,
    /// Rows that the regulariser means count: all rows of the `compat` encoding.
    pub counted_rows: usize,
}

/// Weights and biases of one linear layer in [`Deformation::mlp`]; weights are `[outputs, inputs]` row-major.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinearLayout {
    /// Inputs.
    pub inputs: usize,
    /// Outputs.
    pub outputs: usize,
    /// Weight floats.
    pub weights: Range<usize>,
    /// Bias floats.
    pub biases: Range<usize>,
}

/// Parameter whose delta a head computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeadKind {
    /// dx.
    Position,
    /// ds.
    Scale,
    /// dr.
    Rotation,
    /// do.
    Opacity,
    /// dSH.
    Sh,
}

impl HeadKind {
    /// Every kind, in the order in which heads follow each other in the network.
    pub const ALL: [Self; 5] = [Self::Position, Self::Scale, Self::Rotation, Self::Opacity, Self::Sh];

    /// The parameter of a Gaussian that the head adds to.
    #[must_use]
    pub const fn parameter(self) -> Parameter {
        match self {
            Self::Position => parameters::MEANS,
            Self::Scale => parameters::LOG_SCALES,
            Self::Rotation => parameters::QUATERNIONS,
            Self::Opacity => parameters::OPACITY_LOGITS,
            Self::Sh => parameters::SH_COEFFICIENTS,
        }
    }

    /// Floats written per Gaussian.
    #[must_use]
    pub fn outputs(self) -> usize {
        self.parameter().width()
    }
}

/// One head: `W2 ReLU(W1 r + b1) + b2`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HeadLayout {
    /// Parameter whose delta it computes.
    pub kind: HeadKind,
    /// W1, b1: width to width.
    pub hidden: LinearLayout,
    /// W2, b2: width to outputs.
    pub output: LinearLayout,
}

/// Where the MLP's layers lie.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MlpLayout {
    /// z = W0 F + b0.
    pub trunk: LinearLayout,
    /// Heads in the order position, scale, rotation, opacity, SH; absent ones left out.
    pub heads: Vec<HeadLayout>,
    /// Total floats.
    pub len: usize,
}

impl DeformationConfig {
    /// Input features of the MLP: levels x channels.
    #[must_use]
    pub fn features(&self) -> usize {
        self.multipliers.len() * self.channels as usize
    }

    /// First stored row of a time plane, in rows of the `compat` encoding.
    #[must_use]
    pub fn first_time_row(&self) -> usize {
        match self.time_encoding {
            TimeEncoding::Compact => (self.time_resolution as usize - 1) / 2,
            TimeEncoding::Compat => 0,
        }
    }

    /// Row coordinate, in stored rows, of a time in [0, 1].
    #[must_use]
    pub fn time_row(&self, time: f64) -> f64 {
        (time + 1.0) / 2.0 * f64::from(self.time_resolution - 1) - self.first_time_row() as f64
    }

    /// Nodes along a spatial axis at a level.
    #[must_use]
    pub fn nodes(&self, level: usize, axis: usize) -> usize {
        (self.spatial_resolution[axis] * self.multipliers[level]) as usize
    }

    /// Layout of all planes, `[levels][6]`, and the total number of floats.
    #[must_use]
    pub fn plane_layout(&self) -> (Vec<[PlaneLayout; PLANES]>, usize) {
        let mut offset = 0;
        let levels = (0..self.multipliers.len())
            .map(|level| {
                std::array::from_fn(|plane| {
                    let (column_axis, row_axis) = PLANE_AXES[plane];
                    let columns = self.nodes(level, column_axis);
                    let counted_rows = if row_axis == 3 {
                        self.time_resolution as usize
                    } else {
                        self.nodes(level, row_axis)
                    };
                    let rows =
                        if row_axis == 3 { counted_rows - self.first_time_row() } else { counted_rows };
                    let layout = PlaneLayout { offset, rows, columns, counted_rows };
                    offset += rows * columns * self.channels as usize;
                    layout
                })
            })
            .collect();
        (levels, offset)
    }

    /// Layout of the MLP.
    #[must_use]
    pub fn mlp_layout(&self) -> MlpLayout {
        let mut offset = 0;
        let mut linear = |inputs: usize, outputs: usize| {
            let weights = offset..offset + inputs * outputs;
            let biases = weights.end..weights.end + outputs;
            offset = biases.end;
            LinearLayout { inputs, outputs, weights, biases }
        };
        let width = self.width as usize;
        let trunk = linear(self.features(), width);
        let heads = [
            (self.heads.position, HeadKind::Position),
            (self.heads.scale, HeadKind::Scale),
            (self.heads.rotation, HeadKind::Rotation),
            (self.heads.opacity, HeadKind::Opacity),
            (self.heads.sh, HeadKind::Sh),
        ];
        let heads = heads
            .into_iter()
            .filter(|(on, _)| *on)
            .map(|(_, kind)| HeadLayout {
                kind,
                hidden: linear(width, width),
                output: linear(width, kind.outputs()),
            })
            .collect();
        MlpLayout { trunk, heads, len: offset }
    }
}

/// A deformation field.
#[derive(Clone, Debug, PartialEq)]
pub struct Deformation {
    /// Shape.
    pub config: DeformationConfig,
    /// Box that the spatial axes cover; positions outside are clamped to it in the lookup.
    pub bounds: Bounds,
    /// All planes, see [`DeformationConfig::plane_layout`].
    pub planes: Vec<f32>,
    /// All weights and biases, see [`DeformationConfig::mlp_layout`].
    pub mlp: Vec<f32>,
    /// Gaussians that stand still, `[N]`: the network moves every row but these, whose canonical parameters
    /// hold at all times. Rows beyond the list move; empty when all do.
    pub still: Vec<bool>,
}

impl Deformation {
    /// True when the network leaves a Gaussian where it is.
    #[must_use]
    pub fn is_still(&self, row: usize) -> bool {
        self.still.get(row).copied().unwrap_or(false)
    }

    /// The deformation of the Gaussians `sources[0], sources[1], ...`, which keep standing still.
    #[must_use]
    pub fn gather(&self, sources: &[u32]) -> Self {
        Self { still: self.gather_still(sources), ..self.clone() }
    }

    /// [`Self::still`] of the Gaussians `sources[0], sources[1], ...`.
    #[must_use]
    pub fn gather_still(&self, sources: &[u32]) -> Vec<bool> {
        if self.still.is_empty() {
            return Vec::new();
        }
        sources.iter().map(|row| self.is_still(*row as usize)).collect()
    }

    /// Rows among `0..n` that the network moves, ascending.
    pub fn moving_rows(&self, n: usize) -> impl Iterator<Item = u32> {
        (0..n as u32).filter(|row| !self.is_still(*row as usize))
    }
}

#[cfg(test)]
mod tests;
