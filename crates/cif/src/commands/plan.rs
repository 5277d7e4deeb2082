//! `cif plan`: which effects a capture calls for.

use std::path::PathBuf;

use cif_train::{EffectChoice, EffectPlan, TrainConfig};
use clap::Args;
use serde_json::json;

use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
use crate::report::OnlyReport;

/// Show which effects a capture calls for, and what they cost
#[derive(Debug, Args)]
#[command(after_help = "\
`cif train` follows this plan (unless the preset is paper, or --effects says otherwise) and records it in the scene.
Each line tells the flag of `cif train` that decides otherwise; settings that are typed or in a
--config file win over the plan.

  cif plan captures/table
  cif train captures/table -o table.cif --effects auto,-instances")]
pub(super) struct Plan {
    /// Folder of the capture
    capture: PathBuf,
    #[command(flatten)]
    pub(super) report: OnlyReport,
    /// Named settings that the capture would be trained with: draft, standard or paper
    #[arg(long, value_name = "NAME", default_value = "standard")]
    preset: String,
    /// Effects: auto (as the capture calls for), all (as the preset says) or none, then single ones
    /// on or off, as in auto,+motion,-instances
    #[arg(long, value_name = "LIST", default_value = "auto", allow_hyphen_values = true)]
    effects: EffectChoice,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

pub(super) fn run(command: &Plan) -> Result<(), Error> {
    command.report.check([command.capture.as_path()])?;
    let preset = super::train::preset(&command.preset, "--preset")?;
    let dataset = command.capture_options.open(&command.capture)?;
    print_warnings(&dataset);
    let config = TrainConfig::preset(preset, dataset.layout);
    let plan = EffectPlan::new(&dataset, &config, &command.effects).map_err(Error::plain)?;
    command.report.give(|| json!(plan), || print(&plan))
}

fn print(plan: &EffectPlan) {
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
}
