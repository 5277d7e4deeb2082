//! Captures that systems are compared on.

use cif_dataset::Dataset;
use cif_train::TrainConfig;

/// A capture to compare on.
pub(super) struct Capture {
    pub(super) name: String,
    pub(super) dataset: Dataset,
    /// The capture with the masks that scores are taken on, where these are others.
    pub(super) scored: Option<Dataset>,
    pub(super) config: TrainConfig,
}

impl Capture {
    /// The capture with the masks that scores are taken on.
    pub(super) fn scored(&self) -> &Dataset {
        self.scored.as_ref().unwrap_or(&self.dataset)
    }
}
