//! A time budget of a run, and stages that end on time.

mod pacer;

use serde::{Deserialize, Serialize};

use crate::clock::Seconds;

pub use pacer::{COARSE, INSTANCE, OtherWork, Pacer, Part, StageShare, StepCosts};
pub(crate) use pacer::{
    FITS, MOVING, PIXELS_OF_FIT, REHEARSAL, STEPS_OF_IDENTITY_VIEW, TRIALS, fits_of_resting, weights,
};

/// Which time a budget counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BudgetClock {
    /// Time that passes.
    #[default]
    Wall,
    /// Processor time over threads: what would pass on a machine that does nothing else.
    Cpu,
}

/// Time that a run may take.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Budget {
    /// Seconds, from `start` on.
    pub seconds: f64,
    /// Which ones.
    pub clock: BudgetClock,
    /// Threads that processor time is divided by.
    pub threads: usize,
    /// Reading of the run's clock at which the budget began.
    pub start: Seconds,
}

impl Budget {
    /// Seconds used at a reading of the clock.
    #[must_use]
    pub fn used(&self, now: Seconds) -> f64 {
        let spent = now - self.start;
        match self.clock {
            BudgetClock::Wall => spent.wall_s,
            BudgetClock::Cpu => spent.cpu_s / self.threads.max(1) as f64,
        }
    }
}
