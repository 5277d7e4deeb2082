//! Choices with names.

use cif_render::{GeometryPath, InstanceNormalisation};
use serde::{Deserialize, Serialize};

/// A named set of settings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// A quick look: under a third of the iterations of `standard`, and half its Gaussians.
    Draft,
    /// Tuned for two processor cores and small images.
    #[default]
    Standard,
    /// As `standard`, with more of everything that still pays: three to four times its time.
    Best,
    /// The values of the method's publication and of the base code it builds on, per dataset type.
    Paper,
}

impl Preset {
    /// All of them, quick ones first.
    pub const ALL: [Self; 4] = [Self::Draft, Self::Standard, Self::Best, Self::Paper];
}

/// How Gaussians are added and removed while colours are learnt.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DensifyRule {
    /// Cloned and split where screen gradients are large, as in 3DGS.
    Gradient,
    /// Split where training views show the largest errors; those that show least make room.
    #[default]
    Error,
}

/// An ablation of the method (methods reference 8.7).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ablation {
    /// (i) Occupancy stays at its initial value.
    ConstantOccupancy,
    /// (ii) The colour opacity takes the place of occupancy.
    OpacityOccupancy,
    /// (iii) The identity estimate is never calibrated.
    NoCalibration,
    /// (iv) No instance-guided resampling.
    NoResampling,
}

/// Declares the heads in the order of tables, a row each: the name in settings, files and tables, and the steps of the
/// instance stage in its own publication or released configuration.
macro_rules! heads {
    ($($(#[$meta:meta])* $head:ident, $name:literal, $steps:expr;)*) => {
        /// A system whose head the instance stage trains (methods reference 8).
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
        pub enum HeadName {
            $($(#[$meta])* #[serde(rename = $name)] $head,)*
        }

        impl HeadName {
            /// Every head, in the order of tables.
            pub const ALL: &[Self] = &[$(Self::$head),*];

            /// As in settings, file names and tables.
            #[must_use]
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$head => $name,)*
                }
            }

            /// Steps of the instance stage in its own publication or released configuration.
            #[must_use]
            pub fn published_steps(self) -> u32 {
                match self {
                    $(Self::$head => $steps,)*
                }
            }
        }
    };
}

heads! {
    /// The paper's: occupancies and calibrated distributions over instances.
    #[default]
    Cif, "cif", 3_000;
    /// A code per Gaussian and a classifier.
    GaussianGrouping, "gaussian-grouping", 30_000;
    /// A network from place and time to codes, and a classifier.
    Sa4d, "sa4d", 5_000;
    /// Language channels fused with colour by attention, with an opacity of their own. A re-implementation: there is
    /// no public code.
    Vlgs, "vlgs", 15_000;
    /// Labels counted over the strongest contributors of every pixel; nothing is trained.
    DrSplat, "dr-splat", 0;
    /// Gaussians of several labels split or deleted, then codes learnt by contrast.
    // Splitting and deleting, then lifting.
    Trace3d, "trace3d", 9_000 + 20_000;
    /// Three language channels learnt of given feature maps. It distinguishes no instances, and answers questions alone.
    // Of the language channels, on Gaussians that move.
    LangSplat, "4d-langsplat", 10_000;
}

impl HeadName {
    /// True when it labels pixels; false when it only answers questions.
    #[must_use]
    pub fn tells_labels(self) -> bool {
        self != Self::LangSplat
    }
}

/// Motion that an object is declared to have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ObjectMotion {
    /// It moves as a whole, by a pose per time.
    Rigid,
    /// It moves by the deformation network.
    Free,
}

/// Which geometry the instance loss trains (A6; methods reference 4.5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InstanceGeometry {
    /// Means, scales and rotations.
    Full,
    /// Means only.
    MeansOnly,
    /// None: colours alone say where Gaussians are.
    #[default]
    Off,
}

impl From<InstanceGeometry> for GeometryPath {
    fn from(value: InstanceGeometry) -> Self {
        match value {
            InstanceGeometry::Full => Self::Full,
            InstanceGeometry::MeansOnly => Self::MeansOnly,
            InstanceGeometry::Off => Self::Off,
        }
    }
}

/// Division of rendered identities by coverage before the logarithm (A3; methods reference 4.3).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Normalisation {
    /// `-log M_y`: also drives coverage up.
    #[default]
    None,
    /// `-log (M_y / A)`: relative identity only.
    Coverage,
}

impl From<Normalisation> for InstanceNormalisation {
    fn from(value: Normalisation) -> Self {
        match value {
            Normalisation::None => Self::None,
            Normalisation::Coverage => Self::Coverage,
        }
    }
}

/// Source of the initial occupancy (A5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OccupancyStart {
    /// Every Gaussian at `instance.occupancy`.
    #[default]
    Constant,
    /// The opacity that the Gaussian has when the instance stage starts.
    CopyOpacity,
}

/// Candidates of a weak draw (A10; methods reference 6.1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WeakSet {
    /// Gaussians whose most probable instance is the one resampled.
    #[default]
    Members,
    /// All Gaussians: the literal reading, which mostly relocates members of other instances.
    Literal,
}

/// Strength of a weak candidate, by whose inverse weak draws are made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Weakness {
    /// Its occupancy x identity (methods reference 6.1), however much of the picture it draws.
    Occupancy,
    /// The larger of that and its opacity: what draws the surroundings of an instance stays where it is.
    #[default]
    Visibility,
}

/// Relocations that an instance has too few weak candidates for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Excess {
    /// They are left out: the event relocates fewer Gaussians than its rate says.
    #[default]
    Drop,
    /// They go to the instances that have candidates left, in proportion to the shares of these: the paper states the
    /// rate as one of all Gaussians.
    Share,
}

/// Correction of scales on relocation (A13; methods reference 6.4).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleCorrection {
    /// Replicas keep the scale of their source.
    #[default]
    Off,
    /// Scales shrink so that the integrated footprint is conserved too.
    Mcmc,
}

/// Shares of the instances in an event's pairs (A8).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelShares {
    /// Equal shares.
    #[default]
    Equal,
    /// In proportion to the summed occupancy x identity.
    Gamma,
    /// In proportion to labelled pixels.
    Pixels,
}
