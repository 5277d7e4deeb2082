//! Time and memory of a run on this machine and this capture, and settings that fit a time budget.
//!
//! | file | answers |
//! |---|---|
//! | `calibrate` | what a step costs here |
//! | `expected` | how long a run takes, and how much memory |
//! | `choose` | which settings fit the budget, and what they give up |
//! | `growth` | how the cost of a step grows with Gaussians and pixels |

mod calibrate;
mod choose;
mod expected;
mod growth;

pub use calibrate::{Calibration, calibrate};
pub use choose::{Change, Choice, choose, share_of_fits, stretched};
pub use expected::{Expected, Workload};
pub use growth::{Grown, filled, grown};
