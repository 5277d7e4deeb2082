//! Effects as they are planned: their kinds, and what is decided of each.

use serde::ser::{Serialize, Serializer};

/// An effect that a capture may or may not call for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EffectKind {
    /// The deformation network.
    Motion,
    /// Its outputs other than the centres: scales, rotations, opacities, colours.
    Shape,
    /// Nodes of the time planes.
    TimePlanes,
    /// Size of the images that are worked on.
    ImageSize,
    /// Spherical harmonics above degree 0.
    ViewDependence,
    /// Identities, occupancy, calibration, resampling.
    Instances,
    /// Instances that are not there all the time: opacities that change.
    Appearing,
    /// Paths of travelling objects from their masks.
    Guidance,
    /// Objects that move as a whole, or have a part on a joint: poses instead of the network.
    Objects,
    /// Exposure and white balance per camera.
    Exposure,
    /// Exposure and white balance per training image.
    ExposureInTime,
    /// Compensation of opacity for the low-pass filter.
    Antialiasing,
    /// Removal of lens distortion.
    Lens,
    /// Colour behind everything.
    Background,
    /// Hulls of instances for simulators, in exports.
    Physics,
}

impl EffectKind {
    /// Those that `--effects` switches.
    pub const SWITCHED: [Self; 11] = [
        Self::Motion,
        Self::Shape,
        Self::ViewDependence,
        Self::Instances,
        Self::Appearing,
        Self::Guidance,
        Self::Objects,
        Self::Exposure,
        Self::ExposureInTime,
        Self::Antialiasing,
        Self::Physics,
    ];

    /// Name, as in `--effects` and in JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Motion => "motion",
            Self::Shape => "shape",
            Self::TimePlanes => "time-planes",
            Self::ImageSize => "image-size",
            Self::ViewDependence => "view-dependence",
            Self::Instances => "instances",
            Self::Appearing => "appearing",
            Self::Guidance => "guidance",
            Self::Objects => "objects",
            Self::Exposure => "exposure",
            Self::ExposureInTime => "exposure-in-time",
            Self::Antialiasing => "antialiasing",
            Self::Lens => "lens",
            Self::Background => "background",
            Self::Physics => "physics",
        }
    }
}

impl Serialize for EffectKind {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// Decision on an effect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Throughout.
    On,
    /// Not at all.
    Off,
    /// As far as the words say.
    Value(String),
}

impl std::fmt::Display for Decision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::On => f.write_str("on"),
            Self::Off => f.write_str("off"),
            Self::Value(words) => f.write_str(words),
        }
    }
}

impl Serialize for Decision {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// An effect, and what is to be done about it.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Effect {
    /// Which.
    pub effect: EffectKind,
    /// Decision.
    pub decision: Decision,
    /// Why.
    pub evidence: String,
    /// Cost in time and memory where the effect is on throughout.
    pub cost: String,
    /// Flag that overrides the decision; empty where none can.
    pub flag: String,
}

/// Extent to which an effect is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extent {
    /// Not at all.
    Off,
    /// Only where it shows that it helps.
    Needed,
    /// Throughout, as the preset says.
    Full,
}
