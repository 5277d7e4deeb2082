//! The report of `cif train --json`: what was trained, at the end of the run.

use std::path::Path;

use cif_train::Outcome;
use serde_json::json;

use crate::commands::shared::scene;
use crate::error::Error;
use crate::report::Report;

/// Gives the report of a run that ended and was saved, where one is asked for.
///
/// # Errors
/// When the scene cannot be read again, or the report cannot be written.
pub(super) fn give(report: &Report, path: &Path, outcome: Outcome) -> Result<(), Error> {
    if !report.is_asked() {
        return Ok(());
    }
    let field = scene::load(path)?;
    let scores = field.record.curve.as_ref();
    let whole = || {
        json!({
            "scene": path,
            "settings": path.with_extension("train.toml"),
            "outcome": match outcome {
                Outcome::Finished => "finished",
                Outcome::Interrupted => "stopped",
            },
            "gaussians": field.len(),
            "instances": field.instances,
            "times": field.timeline.times.len(),
            "run": field.record.run,
            "curve": scores,
        })
    };
    report.give(whole, || ())
}
