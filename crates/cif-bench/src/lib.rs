//! Measurements behind `cif bench`: accuracy, time and size, and the reports of them.
//!
//! | module | answers |
//! |---|---|
//! | [`accuracy`] | what accuracy costs, as a report |
//! | [`comparison`] | how the method fares beside other systems and without its parts, as tables and a page |
//! | [`export`] | what accuracy of exported motion costs in bytes and seconds |
//! | [`hard_captures`] | captures changed in ways that must not matter or must not break a run |
//! | [`hardness`] | how runs on them end |
//! | [`records`] | what is measured already, when a bench goes on |
//! | `device` | stages of a step on a GPU beside the least that they could take, behind the feature `wgpu` |

pub mod accuracy;
pub mod comparison;
#[cfg(feature = "wgpu")]
pub mod device;
mod error;
pub mod export;
pub mod hard_captures;
pub mod hardness;
mod page;
mod plots;
pub mod records;
mod training;

pub use error::Error;
