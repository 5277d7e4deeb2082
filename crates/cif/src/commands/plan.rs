//! `cif plan`: which effects a capture calls for, and what a run with them takes.

use std::path::PathBuf;
use std::sync::Arc;

use cif_dataset::Dataset;
use cif_train::budget::BudgetClock;
use cif_train::config::DensifyRule;
use cif_train::fit::{Expected, Workload, calibrate};
use cif_train::{Clock, EffectChoice, EffectPlan, Stop, SystemClock, TrainConfig};
use clap::Args;
use serde::Serialize;

use crate::commands::shared::named::preset;
use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
use crate::progress::duration;
use crate::report::{JsonReport, OnlyReport};
use crate::{interrupt, starting_points};

/// Most seconds of measuring steps, once three are done.
const MEASURING_S: f64 = 2.0;

/// Show which effects a capture needs, and how long training would take
#[derive(Debug, Args)]
#[command(after_help = "\
`cif train` follows this plan (unless the preset is paper, or --effects says otherwise) and records it in the scene.
Points of a capture that has none are triangulated first, as in training, which takes some seconds.
The time comes from some steps that are measured here and now, beside whatever else the machine does; fits of
objects may take half or twice as long.
Each line names the flag of `cif train` that overrides it; settings on the command line or in a
--config file override the plan.

  cif plan captures/table
  cif train captures/table -o table.cif --effects auto,-instances")]
pub(super) struct Plan {
    /// Folder of the capture
    capture: PathBuf,
    #[command(flatten)]
    pub(super) report: OnlyReport,
    /// Named settings that the capture would be trained with: draft, standard, best or paper
    #[arg(long, value_name = "NAME", default_value = "standard")]
    preset: String,
    /// Effects: auto (as the capture calls for), all (as the preset says) or none, then single ones
    /// on or off, as in auto,+motion,-instances
    #[arg(long, value_name = "LIST", default_value = "auto", allow_hyphen_values = true)]
    effects: EffectChoice,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

/// Effects of a capture, and what a run with them is expected to take.
#[derive(Serialize)]
struct PlanReport {
    /// Effects.
    #[serde(flatten)]
    plan: EffectPlan,
    /// Time and memory of a run.
    expected: Expected,
    /// Threads that the time is for.
    threads: usize,
}

impl JsonReport for PlanReport {
    const COMMANDS: &'static [&'static str] = &["cif plan"];
}

pub(super) fn run(command: &Plan) -> Result<(), Error> {
    command.report.check([command.capture.as_path()])?;
    let preset = preset(&command.preset, "--preset")?;
    let mut dataset = command.capture_options.open(&command.capture)?;
    let config = TrainConfig::preset(preset, dataset.layout);
    // As in training: what points show of the light of cameras is evidence.
    if config.model.triangulate {
        starting_points::find(&mut dataset, &Stop::when(interrupt::requested).into())?;
    }
    print_warnings(&dataset);
    let plan = EffectPlan::new(&dataset, &config, &command.effects).map_err(Error::plain)?;
    let is_bound = config.densify.rule == DensifyRule::Gradient;
    let expected = expected(&dataset, config, &plan)?;
    let report = || PlanReport { plan: plan.clone(), expected, threads: rayon::current_num_threads() };
    command.report.give(report, || print(&plan, &expected, is_bound))
}

/// Time and memory of a run on this machine, by steps that are measured.
fn expected(dataset: &Dataset, mut config: TrainConfig, plan: &EffectPlan) -> Result<Expected, Error> {
    plan.apply(&mut config);
    let clock: Arc<dyn Clock> = Arc::new(SystemClock::start());
    let threads = rayon::current_num_threads();
    let calibration =
        calibrate(dataset, &config, &clock, BudgetClock::Wall, threads, MEASURING_S).map_err(Error::plain)?;
    let work = Workload::of(dataset, plan.travelling.len());
    Expected::of(dataset, &config, &calibration, work).map_err(Error::plain)
}

fn print(plan: &EffectPlan, expected: &Expected, is_bound: bool) {
    let mut table = crate::commands::shared::table(["effect", "decision", "evidence", "cost", "otherwise"]);
    for effect in &plan.effects {
        table.add_row([
            effect.effect.name(),
            &effect.decision.to_string(),
            &effect.evidence,
            &effect.cost,
            &effect.flag,
        ]);
    }
    println!("{table}");
    let fits = match plan.travelling.len() {
        _ if expected.fits_s <= 0.0 => String::new(),
        1 => format!(", {} of it fits of 1 object", duration(expected.fits_s)),
        objects => format!(", {} of it fits of {objects} objects", duration(expected.fits_s)),
    };
    let threads = match rayon::current_num_threads() {
        1 => "1 thread".to_owned(),
        threads => format!("{threads} threads"),
    };
    println!(
        "expected: {}{}{fits}, on {threads} of this machine ({} steps measured); up to {} Gaussians; {:.1} GB of memory",
        if is_bound { "at most " } else { "" },
        duration(expected.steps_s + expected.fits_s),
        expected.measured_steps,
        expected.gaussians,
        expected.memory_bytes as f64 / 1e9
    );
}
