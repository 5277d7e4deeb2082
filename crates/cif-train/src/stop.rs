//! Requests to stop, which everything in a run that takes time looks at.

use std::sync::Arc;

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
