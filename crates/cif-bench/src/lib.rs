//! Measurements behind `cif bench`: accuracy, time and size, and the reports of them.
//!
//! | module | answers |
//! |---|---|
//! | [`accuracy`] | what accuracy costs, as a report |
//! | [`batch`] | all scenes of a batch, as a page and tables |
//! | [`comparison`] | the method compared with other systems and without its parts, as tables and a page |
//! | [`export`] | what accuracy of exported motion costs in bytes and seconds |
//! | [`hard_captures`] | variants of captures whose changes must not matter or must not break a run |
//! | [`hardness`] | how runs on them end |
//! | [`records`] | what is measured already, when a bench goes on |
//! | `device` | stages of a step on a GPU compared with their least possible time, behind the feature `wgpu` |

pub mod accuracy;
pub mod batch;
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
