//! Cost of accuracy: one scene trained, stored, rendered and exported with many settings, and the report of it.
//!
//! | file | answers |
//! |---|---|
//! | `ladders` | which ladders there are, and what their rungs change |
//! | `measure` | how a rung is measured |
//! | `record` | what is kept of a rung, so that a report can be interrupted |
//! | `pareto` | which rungs nothing else beats, and what the next dB costs |
//! | `time_limit` | what still fits into a quick report |
//! | `report` | the page, the table and the JSON |

pub mod ladders;
pub mod measure;
mod pareto;
pub mod record;
pub mod report;
pub mod time_limit;

pub use ladders::{Ladder, Rung, Work, ladders};
pub use record::Record;
