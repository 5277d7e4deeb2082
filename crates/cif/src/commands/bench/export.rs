//! `cif bench export`: what accuracy of motion costs in samples, bytes and time.

use std::path::{Path, PathBuf};
use std::time::Instant;

use cif_bench::export::{Rung, measure};
use cif_scene::graph::ReportRow;
use cif_scene::{SceneFormat, SceneOptions, Tolerance};
use clap::Args;
use serde::Serialize;

use crate::commands::shared::model_options::ModelOptions;
use crate::commands::shared::{motion_table, scene};
use crate::error::Error;
use crate::formats::FORMATS;
use crate::messages::note;
use crate::output::Outputs;
use crate::report::{JsonReport, Report};

/// Show the cost of accurate motion
#[derive(Debug, Args)]
#[command(after_help = "\
The scene is built once per tolerance. Residuals are distances in world units: decisive is what the
tolerance is held against (worst time, without the outermost 5 % of an object's weight); both are of
motion that is fitted, and recorded poses, which leave as they are, have no residual. KB are the
sampled values; write times and file sizes come with every format that this build can write, into a
temporary folder. glTF holds few splats with paths of their own: what else is dense leaves as rigid parts there, and
the lines of glTF show the residuals of that (worst: largest decisive residual as a share of what is allowed).

  cif bench export table.cif
  cif bench export table.cif --tolerances 0.5%,2% --motion parts
  cif bench export table.cif --tolerances 0.001,0.01 --json ladder.json")]
pub(super) struct BenchExport {
    /// Trained scene
    #[arg(value_name = "SCENE.cif")]
    scene: PathBuf,
    /// Rungs of the ladder: percentages of an object's size, or world units
    #[arg(long, value_name = "TOLERANCE,...", value_delimiter = ',', default_value = "0.1%,0.3%,1%,3%,10%")]
    tolerances: Vec<Tolerance>,
    /// Measure the graph alone, write no file
    #[arg(long)]
    no_files: bool,
    #[command(flatten)]
    models: ModelOptions,
    #[command(flatten)]
    report: Report,
    /// Replace existing output
    #[arg(long)]
    force: bool,
}

/// Cost of the accuracy of motion.
#[derive(Serialize)]
struct ExportLadder<'a> {
    /// The scene.
    scene: &'a Path,
    /// Every tolerance.
    rungs: &'a [Rung],
}

impl JsonReport for ExportLadder<'_> {
    const COMMANDS: &'static [&'static str] = &["cif bench export"];
}

pub(super) fn run(command: &BenchExport) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.scene)?;
    command.report.check(&mut outputs)?;
    let field = scene::load(&command.scene)?;
    let folder = tempfile::tempdir()
        .map_err(|error| Error::plain(format!("cannot make a temporary folder: {error}")))?;
    // A format that does not work is reported once, and left out of all rungs.
    let moving = FORMATS.into_iter().filter(|format| {
        let about = format.about();
        about.is_read && about.most_expensive_motion.is_some()
    });
    let mut formats: Vec<&dyn SceneFormat> = if command.no_files { Vec::new() } else { moving.collect() };
    let mut rungs = Vec::new();
    for &tolerance in &command.tolerances {
        let options =
            command.models.apply(&field, None, SceneOptions { tolerance, ..SceneOptions::default() });
        let start = Instant::now();
        let graph = cif_scene::build(&field, &options).map_err(Error::plain)?;
        let mut rung = Rung::of(tolerance, start.elapsed().as_secs_f64(), &graph);
        formats.retain(|format| {
            // One file without text, which is what takes the least room.
            let ending = format.about().endings.iter().find(|ending| ending.kind != "text");
            let ending = ending.map_or_else(|| format.about().key, |ending| ending.name);
            let path = folder.path().join(format!("rung_{}.{ending}", rungs.len()));
            match measure(*format, &field, &graph, &options, &path) {
                Ok(file) => {
                    rung.files.push(file);
                    true
                }
                Err(reason) => {
                    note!("no {} files are measured: {reason}", format.about().name);
                    false
                }
            }
        });
        rungs.push(rung);
    }
    let report = || ExportLadder { scene: &command.scene, rungs: &rungs };
    command.report.give(report, || print_ladder(&rungs))
}

fn name_of(tolerance: Tolerance) -> String {
    match tolerance {
        Tolerance::Absolute(distance) => format!("{distance}"),
        Tolerance::Percent(percent) => format!("{percent}%"),
    }
}

fn print_ladder(rungs: &[Rung]) {
    let mut table = crate::commands::shared::table(
        ["tolerance", "format", "object"].into_iter().chain(motion_table::HEADINGS),
    );
    for rung in rungs {
        let others =
            rung.files.iter().filter_map(|file| Some((file.format, &file.simplified.as_ref()?.nodes)));
        // Lines of a format that holds another motion are shown of the objects whose motion differs.
        let differs = |row: &&ReportRow| {
            !rung.nodes.iter().any(|here| here.name == row.name && here.motion == row.motion)
        };
        let rows = rung.nodes.iter().map(|row| ("", row));
        let of_others =
            others.flat_map(|(format, rows)| rows.iter().filter(differs).map(move |row| (format, row)));
        for (format, row) in rows.chain(of_others) {
            let object = [name_of(rung.tolerance), format.to_owned(), row.name.clone()];
            table.add_row(object.into_iter().chain(motion_table::cells(row)));
        }
    }
    println!("{table}\n");
    let mut table = crate::commands::shared::table([
        "tolerance",
        "static",
        "rigid",
        "parts",
        "dense",
        "samples",
        "KB",
        "graph, s",
        "format",
        "file, KB",
        "write, s",
        "samples",
        "worst",
        "outside",
    ]);
    for rung in rungs {
        let count = |index: usize| rung.models[index].nodes.to_string();
        let mut row = vec![
            name_of(rung.tolerance),
            count(0),
            count(1),
            count(2),
            count(3),
            rung.samples.to_string(),
            format!("{:.1}", rung.motion_bytes as f64 / 1e3),
            format!("{:.2}", rung.graph_seconds),
        ];
        for file in &rung.files {
            let mut row = std::mem::replace(&mut row, vec![String::new(); 8]);
            row.extend([
                file.format.to_owned(),
                format!("{:.1}", file.bytes as f64 / 1e3),
                format!("{:.2}", file.seconds),
                file.samples.to_string(),
                format!("{:.2}", file.worst_share),
                file.nodes_outside.to_string(),
            ]);
            table.add_row(row);
        }
        if rung.files.is_empty() {
            table.add_row(row);
        }
    }
    println!("{table}");
}
