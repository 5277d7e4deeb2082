//! The report of `cif train --json`: what was trained, at the end of the run.

use std::path::{Path, PathBuf};

use cif_field::Instance;
use cif_field::record::Run;
use cif_train::{Curve, Outcome};
use serde::Serialize;

use crate::commands::shared::scene;
use crate::error::Error;
use crate::report::{JsonReport, Report, Stored};

/// A run that ended and was saved.
#[derive(Serialize)]
struct TrainReport<'a> {
    /// The trained scene.
    scene: &'a Path,
    /// All settings of the run.
    settings: PathBuf,
    /// `finished`, or `stopped` where it can be continued with `--resume`.
    outcome: &'static str,
    /// Gaussians.
    gaussians: usize,
    /// Instances.
    instances: &'a [Instance],
    /// Captured times.
    times: usize,
    /// Record of the run, as the scene holds it.
    run: Option<&'a Run>,
    /// Quality over training time; null where it was not measured.
    curve: Option<Stored<Curve>>,
}

impl JsonReport for TrainReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif train"];
}

/// Gives the report of a run that ended and was saved, where one is asked for.
///
/// # Errors
/// When the scene cannot be read again, or the report cannot be written.
pub(super) fn give(report: &Report, path: &Path, outcome: Outcome) -> Result<(), Error> {
    if !report.is_asked() {
        return Ok(());
    }
    let field = scene::load(path)?;
    let whole = || TrainReport {
        scene: path,
        settings: path.with_extension("train.toml"),
        outcome: match outcome {
            Outcome::Finished => "finished",
            Outcome::Interrupted => "stopped",
        },
        gaussians: field.len(),
        instances: &field.instances,
        times: field.timeline.times.len(),
        run: field.record.run.as_ref(),
        curve: field.record.curve.clone().map(Stored::from),
    };
    report.give(whole, || ())
}
