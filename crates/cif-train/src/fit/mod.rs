//! Settings that fit a time budget on this machine and this capture.
//!
//! | file | answers |
//! |---|---|
//! | `calibrate` | what a step costs here |
//! | `choose` | which settings fit the budget, and what they give up |

mod calibrate;
mod choose;

pub use calibrate::{Calibration, calibrate};
pub use choose::{Change, Choice, Workload, choose, share_of_fits, stretched};
