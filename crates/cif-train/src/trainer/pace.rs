//! A budget that the stages of a run keep to.

use crate::budget::Pacer;

/// Lengths that follow the steps of a stage, as shares of them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shares {
    /// Last densification, of the fine stage.
    pub densify: f64,
    /// Instance stage, of the fine stage.
    pub instance: f64,
    /// Schedule of learning rates, of the fine stage; 0 where it follows the stages anyway.
    pub schedule: f64,
    /// Last resampling, of the instance stage.
    pub resample: f64,
}

/// A budget under way.
pub(super) struct Pacing {
    pub pacer: Pacer,
    pub shares: Shares,
}
