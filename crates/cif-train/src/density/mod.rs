//! Changes of the set of Gaussians.
//!
//! | file | holds |
//! |---|---|
//! | `strategy` | the trait of densification rules, and a change as they yield it |
//! | `adaptive` | the rules of 3DGS: clone, split, prune, reset opacities |
//! | `statistics` | what steps count for them |
//! | `rearrangement` | a changed set as data, and how to make one |
//! | `relocate` | relocation of Gaussians to instances that need them |

pub mod adaptive;
mod rearrangement;
pub mod relocate;
mod statistics;
mod strategy;

pub(crate) use adaptive::FEWEST_OF_OBJECT;
pub use rearrangement::{Rearrangement, keep, with_copies};
pub use statistics::DensifyStatistics;
pub use strategy::{Change, Rows, Strategy};
