//! Cases that need several crates, and the command as it is run: one binary, so that it is linked once and its tests
//! share the processors.
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod accuracy;
mod batch;
mod bench;
mod check;
mod command_line;
mod compare;
mod conventions;
mod demo;
mod dependency_direction;
mod determinism;
mod edits;
mod folders;
mod gpu;
mod hard_captures;
mod hard_cases;
mod module_tangles;
mod objects;
mod outputs;
mod recorded_look;
mod recorded_motion;
mod reference;
mod render_memory;
mod unfinished_capture;
mod view;
mod vision;
mod where_is_it;
mod whole_path;
