//! Requests to stop, which everything in a run that takes time looks at.

use std::sync::Arc;

use cif_dataset::Dataset;

use crate::phases::Phases;

/// A question that a run asks again and again: shall it stop? Asked between steps, and between views and the like
/// wherever the work between two steps takes longer than a step.
#[derive(Clone, Default)]
pub struct Stop(Option<Arc<dyn Fn() -> bool + Send + Sync>>);

impl Stop {
    /// Stops as soon as `requested` returns true; it is called from the thread of the run and must return at once.
    #[must_use]
    pub fn when(requested: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(requested)))
    }

    /// True where a stop is requested; never with the default.
    #[must_use]
    pub fn requested(&self) -> bool {
        self.0.as_ref().is_some_and(|requested| requested())
    }
}

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
