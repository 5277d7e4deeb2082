//! `cif bench export`: what accuracy of motion costs in samples, bytes and time.

use std::path::{Path, PathBuf};
use std::time::Instant;

use cif_scene::{MotionModel, SceneGraph, SceneOptions, Tolerance};
use clap::Args;
use serde::Serialize;

use super::model_options::ModelOptions;
use super::scene;
use crate::error::Error;
use crate::output;

/// Tell what accuracy of motion costs
#[derive(Debug, Args)]
#[command(after_help = "\
The scene is built once per tolerance. Residuals are distances in world units: decisive is what the
tolerance is held against (worst time, without the outermost 5 % of an object's weight). KB are the
sampled values; write times and file sizes come with every format that this build can write, into a
temporary folder.

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
    /// Write the ladder as JSON; - for stdout
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Replace existing output
    #[arg(long)]
    force: bool,
}

/// One tolerance.
#[derive(Debug, Serialize)]
struct Rung {
    tolerance: Tolerance,
    /// Seconds for the scene graph.
    graph_seconds: f64,
    samples: usize,
    motion_bytes: usize,
    models: Vec<ModelCount>,
    nodes: Vec<cif_scene::report::ReportRow>,
    files: Vec<WrittenFile>,
}

/// Nodes of one model.
#[derive(Debug, Serialize)]
struct ModelCount {
    model: MotionModel,
    nodes: usize,
}

/// What one format made of a rung.
#[derive(Debug, Serialize)]
struct WrittenFile {
    format: &'static str,
    bytes: u64,
    seconds: f64,
}

/// A format: its name, the ending of its files, and what writes them.
struct Format {
    name: &'static str,
    ending: &'static str,
    /// Bytes written, payloads included.
    write: fn(&SceneGraph, &Path) -> Result<u64, String>,
}

/// Formats that hold every motion model.
const FORMATS: [Format; 1] = [Format { name: "USD", ending: "usdc", write: write_usd }];

fn write_usd(graph: &SceneGraph, path: &Path) -> Result<u64, String> {
    cif_usd::export(graph, path, cif_usd::ExportOptions::default())
        .map(|written| written.bytes)
        .map_err(|error| error.to_string())
}

pub(super) fn run(command: &BenchExport) -> Result<(), Error> {
    let to_stdout = command.json.as_deref() == Some(Path::new("-"));
    if let Some(path) = command.json.as_deref().filter(|_| !to_stdout) {
        output::check_file(path, command.force)?;
    }
    let field = scene::load(&command.scene)?;
    let folder = tempfile::tempdir()
        .map_err(|error| Error::plain(format!("cannot make a temporary folder: {error}")))?;
    // A format that does not work is told once, and left out of all rungs.
    let mut formats: Vec<&Format> = if command.no_files { Vec::new() } else { FORMATS.iter().collect() };
    let mut rungs = Vec::new();
    for &tolerance in &command.tolerances {
        let options = command.models.apply(SceneOptions { tolerance, ..SceneOptions::default() });
        let start = Instant::now();
        let graph = cif_scene::build(&field, &options).map_err(Error::plain)?;
        let mut rung = Rung::of(tolerance, start.elapsed().as_secs_f64(), &graph);
        formats.retain(|format| {
            let path = folder.path().join(format!("rung_{}.{}", rungs.len(), format.ending));
            let start = Instant::now();
            match (format.write)(&graph, &path) {
                Ok(bytes) => {
                    let seconds = start.elapsed().as_secs_f64();
                    rung.files.push(WrittenFile { format: format.name, bytes, seconds });
                    true
                }
                Err(reason) => {
                    eprintln!("note: no {} files are measured: {reason}", format.name);
                    false
                }
            }
        });
        rungs.push(rung);
    }
    let text = format!("{:#}\n", serde_json::json!({ "scene": command.scene, "rungs": rungs }));
    if to_stdout {
        print!("{text}");
        return Ok(());
    }
    print_ladder(&rungs);
    if let Some(path) = &command.json {
        output::write_file(path, text.as_bytes())?;
    }
    Ok(())
}

impl Rung {
    fn of(tolerance: Tolerance, graph_seconds: f64, graph: &SceneGraph) -> Self {
        let nodes = graph.motion_table();
        let count = |model| nodes.iter().filter(|row| row.motion.model == model).count();
        let models = [MotionModel::Static, MotionModel::Rigid, MotionModel::Parts, MotionModel::Dense];
        Self {
            tolerance,
            graph_seconds,
            samples: nodes.iter().map(|row| row.motion.samples).sum(),
            motion_bytes: nodes.iter().map(|row| row.motion.motion_bytes).sum(),
            models: models.map(|model| ModelCount { model, nodes: count(model) }).into(),
            nodes,
            files: Vec::new(),
        }
    }
}

fn name_of(tolerance: Tolerance) -> String {
    match tolerance {
        Tolerance::Absolute(distance) => format!("{distance}"),
        Tolerance::Percent(percent) => format!("{percent}%"),
    }
}

fn print_ladder(rungs: &[Rung]) {
    let mut table = super::table([
        "tolerance",
        "object",
        "motion",
        "parts",
        "allowed",
        "decisive",
        "error RMS",
        "max",
        "samples",
        "KB",
        "seconds",
    ]);
    for rung in rungs {
        for row in &rung.nodes {
            let motion = &row.motion;
            table.add_row([
                name_of(rung.tolerance),
                row.name.clone(),
                motion.model.to_string(),
                if motion.parts > 0 { motion.parts.to_string() } else { String::new() },
                format!("{:.5}", motion.tolerance),
                format!("{:.5}", motion.residual.decisive),
                format!("{:.5}", motion.residual.rms),
                format!("{:.5}", motion.residual.max),
                motion.samples.to_string(),
                format!("{:.1}", motion.motion_bytes as f64 / 1e3),
                format!("{:.3}", row.seconds),
            ]);
        }
    }
    println!("{table}\n");
    let mut table = super::table([
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
            ]);
            table.add_row(row);
        }
        if rung.files.is_empty() {
            table.add_row(row);
        }
    }
    println!("{table}");
}
