//! Stages of a run.

use serde::{Deserialize, Serialize};

/// Parts of a run, in order (methods reference 1.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// One static set of Gaussians fits all times.
    Coarse,
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
    /// Name as in logs: `coarse`, `fine`, `identity`, `instance`, `done`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Coarse => "coarse",
            Self::Fine => "fine",
            Self::Identity => "identity",
            Self::Instance => "instance",
            Self::Done => "done",
        }
    }
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
