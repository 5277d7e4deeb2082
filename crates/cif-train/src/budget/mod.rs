//! Training inside a time budget: settings that fit it, and stages that end on time.
//!
//! | file | answers |
//! |---|---|
//! | `calibrate` | what a step costs on this machine and this capture |
//! | `choose` | which settings fit the budget, and what they give up |
//! | `pacer` | how long each stage goes on, by measured progress |

mod calibrate;
mod choose;
mod pacer;

use serde::{Deserialize, Serialize};

use crate::clock::Seconds;

pub use calibrate::{Calibration, calibrate};
pub(crate) use choose::weights;
pub use choose::{Change, Choice, Workload, choose};
pub use pacer::{Pacer, StageShare};

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

/// Target scores of a run on the frames of its curve; none by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Targets {
    /// PSNR, dB.
    pub psnr: Option<f64>,
    /// mIoU, percent.
    pub miou: Option<f64>,
}

impl Targets {
    /// True when there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.psnr.is_none() && self.miou.is_none()
    }

    /// True when measured values reach all targets.
    #[must_use]
    pub fn reached_by(&self, psnr: Option<f64>, miou: Option<f64>) -> bool {
        let reached = |target: Option<f64>, value: Option<f64>| {
            target.is_none_or(|target| value.is_some_and(|value| value >= target))
        };
        reached(self.psnr, psnr) && reached(self.miou, miou)
    }
}
