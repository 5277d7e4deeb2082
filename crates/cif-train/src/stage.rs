//! Stages of a run.

use serde::{Deserialize, Serialize};

/// Parts of a run, in order (methods reference 1.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// Objects are tried for motion, by their masks and by fits; without steps.
    Search,
    /// One static set of Gaussians fits all times.
    Coarse,
    /// Travelling objects are fitted, and join the field; without steps.
    Objects,
    /// Deformation and regularisers on; without deformation when the capture has one time.
    Fine,
    /// One pass over the training frames without gradients: who covers which mask.
    Identity,
    /// Occupancy, calibration and resampling; everything is trained.
    Instance,
    /// Nothing left to do.
    Done,
}

impl Stage {
    /// Name as in logs: `search`, `coarse`, `objects`, `fine`, `identity`, `instance`, `done`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Search => "search",
            Self::Coarse => "coarse",
            Self::Objects => "objects",
            Self::Fine => "fine",
            Self::Identity => "identity",
            Self::Instance => "instance",
            Self::Done => "done",
        }
    }

    /// True of stages that consist of optimiser steps.
    #[must_use]
    pub const fn has_steps(self) -> bool {
        matches!(self, Self::Coarse | Self::Fine | Self::Instance)
    }
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
