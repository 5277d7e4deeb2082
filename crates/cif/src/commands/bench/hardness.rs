//! `cif bench hardness`: trains variants of a capture whose changes must not matter, or must not break a run.

use std::path::{Path, PathBuf};

use cif_bench::hard_captures::{HARD_CAPTURES, HardCapture, Unfit};
use cif_bench::hardness::{self, MAX_MIOU_LOSS, MAX_PSNR_LOSS, VariantScores, mean_of, number, signed};
use cif_dataset::{Dataset, Layout};
use cif_train::{Stop, TrainConfig};
use clap::Args;
use serde::Serialize;
use serde_json::json;

use crate::commands::shared::named::preset;
use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
use crate::report::{JsonReport, Report};
use crate::settings::Layers;
use crate::{interrupt, output};

/// Runs of the capture itself, with a seed each: one alone says little of changes of tenths.
const BASELINE_RUNS: u64 = 3;

/// Train hard variants of a capture and compare them with the capture itself
#[derive(Debug, Args)]
#[command(after_help = "\
Every variant is trained with the same settings and seed, with all effects, as by --effects all of
`cif train`, and scored on the same held-out frames. The capture itself is trained with three seeds;
changes are against their mean, and shown with the range between seeds.
Scaling and moving the capture must not change PSNR by 0.3 dB or mIoU by 1 point; every variant must
end with a finite scene. Exit code 1 when one does not.

  cif bench hardness captures/table -o hardness
  cif bench hardness captures/table -o hardness --quick --only moved,wrong-camera

The folder gets report.json and report.md. --quick trains half of the variants with a schedule of
480 steps; without it the preset draft is used, unless --preset names another.")]
pub(super) struct BenchHardness {
    /// Folder of the capture
    capture: PathBuf,
    /// Folder of the report
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    output: PathBuf,
    /// Write into a folder that is not empty, and replace an existing file of --json
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    report: Report,
    /// Fewer variants and a short schedule
    #[arg(long)]
    quick: bool,
    /// Only these variants
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    only: Vec<String>,
    /// Named settings: draft, standard, best or paper [default: draft]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Any setting by its key in SCENE.train.toml, e.g. --set stages.fine=500
    #[arg(long, value_name = "TABLE.KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

pub(super) fn run(command: &BenchHardness) -> Result<(), Error> {
    let names: Vec<&str> = HARD_CAPTURES.iter().map(|hard| hard.name).collect();
    if let Some(unknown) = command.only.iter().find(|name| !names.contains(&name.as_str())) {
        return Err(Error::usage(
            format!("--only {unknown}: there is no such variant"),
            format!("the variants are {}", names.join(", ")),
        ));
    }
    let check = |layout| resolve(command, layout).map(drop);
    command.capture_options.layout_after(&command.capture, check)?;
    let dataset = command.capture_options.open(&command.capture)?;
    print_warnings(&dataset);
    if dataset.val_frames().is_empty() {
        return Err(Error::failed(
            format!(
                "{}: no frame is held out, so that variants cannot be compared",
                command.capture.display()
            ),
            "give a capture with held-out frames",
        ));
    }
    command.report.check(&mut output::Outputs::new(command.force))?;
    output::check_folder(&command.output, command.force)?;
    let config = resolve(command, dataset.layout)?;
    let chosen: Vec<&HardCapture> = HARD_CAPTURES
        .iter()
        .filter(|hard| {
            if command.only.is_empty() {
                !command.quick || hard.quick
            } else {
                command.only.contains(&hard.name.to_owned())
            }
        })
        .collect();

    interrupt::watch();
    let mut runs = Vec::new();
    for seed in (0..BASELINE_RUNS).map(|run| config.seed.wrapping_add(run)) {
        let mut row = VariantScores {
            name: "as it is",
            what: "the capture itself",
            verdict: "ok",
            ..VariantScores::default()
        };
        measure(&mut row, &dataset, &TrainConfig { seed, ..config.clone() })?;
        if row.verdict == "failed" {
            return Err(Error::plain(format!("{}: {}", command.capture.display(), row.notes.join("; "))));
        }
        announce(&row);
        runs.push(row);
    }
    let baseline = mean_of(&runs);
    crate::messages::outcome!("{:>18}  {}", "their mean", baseline.notes.last().map_or("", String::as_str));
    let mut rows = vec![baseline.clone()];
    for hard in chosen {
        let folder = tempfile::tempdir()
            .map_err(|error| Error::plain(format!("cannot make a temporary folder: {error}")))?;
        let mut row =
            VariantScores { name: hard.name, what: hard.what, verdict: "ok", ..VariantScores::default() };
        match hard.of(&dataset, folder.path()) {
            Ok(changed) => {
                row.notes.extend(changed.warnings.iter().cloned());
                measure(&mut row, &changed, &config)?;
            }
            Err(Unfit::Lacks(what)) => {
                row.verdict = "skipped";
                row.notes.push(format!("the capture has no {what}").replace("no a ", "no "));
            }
            Err(Unfit::Failed(error)) => return Err(error.into()),
        }
        row.judge(&baseline, hard.demand);
        announce(&row);
        rows.push(row);
    }
    write_report(command, &config, &rows)?;
    let bad: Vec<&str> =
        rows.iter().filter(|row| ["failed", "differs"].contains(&row.verdict)).map(|row| row.name).collect();
    if bad.is_empty() {
        return Ok(());
    }
    Err(Error::failed(
        format!("{} of {} variants went wrong: {}", bad.len(), rows.len() - 1, bad.join(", ")),
        format!("{} says how", command.output.join("report.md").display()),
    ))
}

/// Settings of the preset, then what was typed.
fn resolve(command: &BenchHardness, layout: Layout) -> Result<TrainConfig, Error> {
    let name = command.preset.as_deref().unwrap_or("draft");
    let mut config = TrainConfig::preset(preset(name, "--preset")?, layout);
    if command.quick {
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 300, 120);
        config.model.sh_interval = 60;
        config.model.max_initial_points = 2_000;
        (config.densify.max_gaussians, config.densify.detail) = (2_500, 0.0);
        (config.densify.from, config.densify.every, config.densify.until) = (30, 30, 240);
        (config.resample.from, config.resample.every, config.resample.until) = (20, 20, 100);
    }
    let mut layers = Layers::new(config);
    for assignment in &command.set {
        layers.assignment(assignment)?;
    }
    layers.validated()
}

/// As [`hardness::measure`], until Ctrl-C.
fn measure(row: &mut VariantScores, dataset: &Dataset, config: &TrainConfig) -> Result<(), Error> {
    hardness::measure(row, dataset, config, &Stop::when(interrupt::requested));
    if interrupt::requested() {
        return Err(Error::Interrupted {
            message: "interrupted; no report was written".to_owned(),
            help: None,
        });
    }
    Ok(())
}

fn announce(row: &VariantScores) {
    crate::messages::outcome!(
        "{:>18}  {:<8} PSNR {} {}  mIoU {} {}  {:.0} s",
        row.name,
        row.verdict,
        number(row.psnr),
        signed(row.psnr_change),
        number(row.miou),
        signed(row.miou_change),
        row.seconds
    );
}

fn write_report(command: &BenchHardness, config: &TrainConfig, rows: &[VariantScores]) -> Result<(), Error> {
    let mut table = crate::commands::shared::table([
        "variant",
        "verdict",
        "PSNR",
        "change",
        "mIoU",
        "change",
        "Gaussians",
        "rolled back",
        "seconds",
    ]);
    let mut text = String::from(
        "| variant | what | verdict | PSNR, dB | change | mIoU, % | change | Gaussians | rolled back |\n\
         |---|---|---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let (psnr, psnr_change) = (number(row.psnr), signed(row.psnr_change));
        let (miou, miou_change) = (number(row.miou), signed(row.miou_change));
        text += &format!(
            "| {} | {} | {} | {psnr} | {psnr_change} | {miou} | {miou_change} | {} | {} |\n",
            row.name, row.what, row.verdict, row.gaussians, row.rolled_back
        );
        table.add_row([
            row.name,
            row.verdict,
            &psnr,
            &psnr_change,
            &miou,
            &miou_change,
            &row.gaussians.to_string(),
            &row.rolled_back.to_string(),
            &format!("{:.0}", row.seconds),
        ]);
    }
    let notes =
        rows.iter().flat_map(|row| row.notes.iter().map(move |note| format!("- {}: {note}\n", row.name)));
    text += "\n";
    text.extend(notes);
    let report = HardnessReport {
        capture: &command.capture,
        limits: Limits { psnr_db: MAX_PSNR_LOSS, miou_percent: MAX_MIOU_LOSS },
        config,
        variants: rows,
    };
    write(&command.output.join("report.json"), &format!("{:#}\n", json!(report)))?;
    write(&command.output.join("report.md"), &text)?;
    command.report.give(|| report, || println!("{table}"))
}

/// Variants of a capture, trained and scored.
#[derive(Serialize)]
struct HardnessReport<'a> {
    /// The capture.
    capture: &'a Path,
    /// Largest changes that a variant may make which must not matter.
    limits: Limits,
    /// Settings of all runs, see [settings](settings.md).
    config: &'a TrainConfig,
    /// The capture itself, then every variant.
    variants: &'a [VariantScores],
}

/// Largest changes.
#[derive(Serialize)]
struct Limits {
    /// Change of PSNR, dB.
    psnr_db: f64,
    /// Change of mIoU, percentage points.
    miou_percent: f64,
}

impl JsonReport for HardnessReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif bench hardness"];
}

fn write(path: &Path, text: &str) -> Result<(), Error> {
    output::write_file(path, text.as_bytes())
}
