//! Changes of the set of Gaussians.
//!
//! | file | holds |
//! |---|---|
//! | `strategy` | the trait of densification rules, and a change as they yield it |
//! | `error_guided` | split by the errors of views, within a set of fixed size |
//! | `growth` | how the set grows until it is full |
//! | `contributions` | what it looks at: blending weights of every Gaussian, and errors by them |
//! | `adaptive` | the rules of 3DGS: clone, split, prune, reset opacities |
//! | `statistics` | what steps count for them |
//! | `rearrangement` | a changed set as data, and how to make one |
//! | `relocate` | relocation of Gaussians to instances that need them |

pub mod adaptive;
pub(crate) mod contributions;
pub mod error_guided;
pub(crate) mod growth;
mod rearrangement;
pub mod relocate;
mod statistics;
mod strategy;

use std::sync::Arc;

pub(crate) use adaptive::FEWEST_OF_OBJECT;
pub use contributions::Contributions;
pub use rearrangement::{Rearrangement, keep, with_copies};
pub use statistics::DensifyStatistics;
pub use strategy::{Change, Rows, Strategy};

use crate::config::DensifyRule;

/// The strategy of a rule.
pub(crate) fn of(rule: DensifyRule) -> Arc<dyn Strategy> {
    match rule {
        DensifyRule::Gradient => Arc::new(adaptive::Adaptive),
        DensifyRule::Error => Arc::new(error_guided::ErrorGuided),
    }
}
