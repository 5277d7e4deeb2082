//! What a run is expected to take on this machine, from steps that are measured here and now.

use std::sync::Arc;

use cif_dataset::Dataset;
use cif_train::budget::BudgetClock;
use cif_train::config::DensifyRule;
use cif_train::fit::{Expected, Workload, calibrate};
use cif_train::{Clock, TrainConfig, TrainError};

use crate::progress::duration;

/// Time and memory of a run in which so many objects travel, with steps measured for about `limit_s` seconds.
///
/// # Errors
/// When a frame cannot be read, or a setting cannot work.
pub(in crate::commands) fn expected(
    dataset: &Dataset,
    config: &TrainConfig,
    travelling: usize,
    clock: &Arc<dyn Clock>,
    limit_s: f64,
) -> Result<Expected, TrainError> {
    let threads = rayon::current_num_threads();
    let calibration = calibrate(dataset, config, clock, BudgetClock::Wall, threads, limit_s)?;
    Expected::of(dataset, config, &calibration, Workload::of(dataset, travelling))
}

/// The same in a line.
pub(in crate::commands) fn in_words(expected: &Expected, config: &TrainConfig, travelling: usize) -> String {
    let fits = match travelling {
        _ if expected.fits_s <= 0.0 => String::new(),
        1 => format!(", {} of it fits of 1 object", duration(expected.fits_s)),
        objects => format!(", {} of it fits of {objects} objects", duration(expected.fits_s)),
    };
    let threads = match rayon::current_num_threads() {
        1 => "1 thread".to_owned(),
        threads => format!("{threads} threads"),
    };
    // By gradients, nobody knows how many Gaussians there will be.
    let is_bound = config.densify.rule == DensifyRule::Gradient;
    format!(
        "expected: {}{}{fits}, on {threads} of this machine ({} steps measured); up to {} Gaussians; {:.1} GB of memory",
        if is_bound { "at most " } else { "" },
        duration(expected.steps_s + expected.fits_s),
        expected.measured_steps,
        expected.gaussians,
        expected.memory_bytes as f64 / 1e9
    )
}
