//! Measurements behind `cif bench`: accuracy, time and size, and the reports of them.
//!
//! | module | answers |
//! |---|---|
//! | [`accuracy`] | what accuracy costs, as a report |
//! | [`export`] | what accuracy of exported motion costs in bytes and seconds |
//! | [`hard_captures`] | captures changed in ways that must not matter or must not break a run |
//! | [`hardness`] | how runs on them end |
//! | `device` | stages of a step on a GPU beside the least that they could take, behind the feature `wgpu` |

pub mod accuracy;
#[cfg(feature = "wgpu")]
pub mod device;
mod error;
pub mod export;
pub mod hard_captures;
pub mod hardness;

pub use error::Error;
