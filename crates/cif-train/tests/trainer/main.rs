//! Runs of the trainer on a tiny capture.
//!
//! | module | holds |
//! |---|---|
//! | `support` | the capture: three shaded balls, ray-cast with exact masks; settings that train it in seconds. Unit tests compile it too |
//! | `training`, `effects`, `guidance` | whole runs: quality, resuming, threads, what is skipped, what masks show |
//! | `acceptance` | identities and their resampling keep what they promise |
//! | `from_scene` | instances on the reconstruction of another run |
//! | `density`, `added_effects` | densification rules, and an effect, declared by a test |
//! | `background` | what shows where no Gaussian is |
//! | `heads` | a head declared by a test, on every engine |
//! | `memory` | frames that do not fit into memory, read ahead |
//! | `curve`, `pacing`, `measure` | error curves, budgets of time, measured steps |
//! | `phases` | where the time of a run goes, stops and limits inside what is no step |
//! | `gpu` | runs on a GPU compared with the same runs on the processor (`CIF_TEST_GPU=off|auto|require`) |
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod acceptance;
mod added_effects;
mod background;
mod compared_heads;
mod curve;
mod density;
mod effects;
mod from_scene;
#[cfg(feature = "wgpu")]
mod gpu;
mod guidance;
mod heads;
mod measure;
mod memory;
mod pacing;
mod phases;
#[path = "../support/mod.rs"]
mod support;
mod training;
