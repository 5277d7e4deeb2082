//! `cif plan`: which effects a capture calls for, and what a run with them takes.

use std::path::PathBuf;
use std::sync::Arc;

use cif_train::fit::Expected;
use cif_train::{Clock, EffectChoice, EffectPlan, Stop, SystemClock, TrainConfig};
use clap::Args;
use serde::Serialize;

use crate::commands::shared::expected::{expected, in_words};
use crate::commands::shared::named::preset;
use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
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
    let mut config = TrainConfig::preset(preset, dataset.layout);
    // As in training: what points show of the light of cameras is evidence.
    if config.model.triangulate {
        starting_points::find(&mut dataset, &Stop::when(interrupt::requested).into())?;
    }
    print_warnings(&dataset);
    let plan = EffectPlan::new(&dataset, &config, &command.effects).map_err(Error::plain)?;
    plan.apply(&mut config);
    let clock: Arc<dyn Clock> = Arc::new(SystemClock::start());
    let expected =
        expected(&dataset, &config, plan.travelling.len(), &clock, MEASURING_S).map_err(Error::plain)?;
    let report = || PlanReport { plan: plan.clone(), expected, threads: rayon::current_num_threads() };
    command.report.give(report, || print(&plan, &expected, &config))
}

fn print(plan: &EffectPlan, expected: &Expected, config: &TrainConfig) {
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
    println!("{}", in_words(expected, config, plan.travelling.len()));
}
