//! Phases of a run: every second of it belongs to one of them.

use serde::{Deserialize, Serialize};

use crate::stage::Stage;

/// A part of a run that takes time, in the order in which runs come to them. Serialises as [`Self::name`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// The capture is opened.
    Open,
    /// Points are triangulated for a capture that has none.
    Points,
    /// The capture is examined for the effects that it calls for, see [`crate::plan`].
    Plan,
    /// Steps are measured, to choose settings for a budget.
    Calibrate,
    /// Training frames are decoded.
    Decode,
    /// Masks are checked against each other and against the images.
    Masks,
    /// Steps are tried on several engines, to take the fastest.
    Probe,
    /// Paths of objects, and what they stand on, are read out of their masks.
    Paths,
    /// Objects that no path shows to move are tried for motion.
    Search,
    /// Objects that rest are tried for parts on joints.
    Joints,
    /// Steps of the coarse stage.
    Coarse,
    /// Poses of objects that move as a whole are fitted.
    Objects,
    /// Objects are tried for being absent at times.
    Presence,
    /// The deformation network learns the paths of objects that have no poses, and how others deform.
    Rehearsal,
    /// Steps of the fine stage.
    Fine,
    /// Identity rows are estimated.
    Identity,
    /// Steps of the instance stage.
    Instance,
    /// A point of the curve is measured.
    Measure,
    /// Held-out frames are scored.
    Evaluate,
    /// A scene or a state is saved.
    Save,
    /// Everything between the others.
    Other,
}

impl Phase {
    /// Name, as in logs and records.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Points => "points",
            Self::Plan => "plan",
            Self::Calibrate => "calibrate",
            Self::Decode => "decode",
            Self::Masks => "masks",
            Self::Probe => "probe",
            Self::Paths => "paths",
            Self::Search => "search",
            Self::Joints => "joints",
            Self::Coarse => "coarse",
            Self::Objects => "objects",
            Self::Presence => "presence",
            Self::Rehearsal => "rehearsal",
            Self::Fine => "fine",
            Self::Identity => "identity",
            Self::Instance => "instance",
            Self::Measure => "measure",
            Self::Evaluate => "evaluate",
            Self::Save => "save",
            Self::Other => "other",
        }
    }

    /// The work in words.
    #[must_use]
    pub const fn describe(self) -> &'static str {
        match self {
            Self::Open => "opening the capture",
            Self::Points => "triangulating points by the poses of the capture",
            Self::Plan => "looking at the capture",
            Self::Calibrate => "measuring steps",
            Self::Decode => "decoding training frames",
            Self::Masks => "checking masks",
            Self::Probe => "trying steps on the processor and the GPU",
            Self::Paths => "reading paths of objects out of masks",
            Self::Search => "trying objects for motion in place",
            Self::Joints => "trying objects for parts on joints",
            Self::Coarse => "training without motion",
            Self::Objects => "fitting objects that move as a whole",
            Self::Presence => "looking for times at which objects are absent",
            Self::Rehearsal => "teaching paths to the network",
            Self::Fine => "training with motion",
            Self::Identity => "estimating identities",
            Self::Instance => "training instances",
            Self::Measure => "measuring the curve",
            Self::Evaluate => "scoring held-out frames",
            Self::Save => "saving",
            Self::Other => "everything else",
        }
    }

    /// Unit in which its progress is counted; empty where it has no count.
    #[must_use]
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Decode | Self::Masks | Self::Plan | Self::Paths | Self::Identity => "frames",
            Self::Measure | Self::Evaluate => "frames",
            Self::Search | Self::Joints | Self::Objects | Self::Presence => "objects",
            Self::Calibrate | Self::Coarse | Self::Fine | Self::Instance | Self::Rehearsal => "steps",
            Self::Open | Self::Points | Self::Probe | Self::Save | Self::Other => "",
        }
    }

    /// True of stages, whose progress is sent as [`TrainEvent::Step`](crate::TrainEvent::Step).
    #[must_use]
    pub const fn has_steps(self) -> bool {
        matches!(self, Self::Coarse | Self::Fine | Self::Instance)
    }
}

impl From<Stage> for Phase {
    fn from(stage: Stage) -> Self {
        match stage {
            Stage::Search => Self::Search,
            Stage::Coarse => Self::Coarse,
            Stage::Objects => Self::Objects,
            Stage::Fine => Self::Fine,
            Stage::Identity => Self::Identity,
            Stage::Instance => Self::Instance,
            Stage::Done => Self::Other,
        }
    }
}

impl std::fmt::Display for Phase {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
