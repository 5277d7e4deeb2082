//! The capture and the phases that a run starts from.

use cif_dataset::Dataset;

use crate::phases::Phases;

/// A capture to train on, and the phases of the run, which may be watched and stopped from its preparation on. A capture
/// alone is enough where nobody does.
pub struct Start {
    /// Capture.
    pub dataset: Dataset,
    /// Phases, of which the caller may have been through some.
    pub phases: Phases,
}

impl From<Dataset> for Start {
    fn from(dataset: Dataset) -> Self {
        Self { dataset, phases: Phases::default() }
    }
}
