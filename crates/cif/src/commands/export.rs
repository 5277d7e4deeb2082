//! `cif export`: a scene as USD, glTF and PLY.

use std::path::{Path, PathBuf};

use cif_field::Field;
use cif_scene::{FrameRange, SceneGraph, SceneOptions, Tolerance, UpAxis};
use clap::{ArgGroup, Args};
use serde_json::json;

use super::export_gltf::Gltf;
use super::export_ply::Ply;
use super::model_options::ModelOptions;
use super::{motion_table, scene};
use crate::error::Error;
use crate::ground_truth::{self, MotionError};
use crate::output::{self, Outputs};

/// Export a scene as USD, glTF or PLY, one prim or node per object
#[derive(Debug, Args)]
#[command(
    group = ArgGroup::new("result").required(true).multiple(true)
        .args(["usd", "gltf", "ply", "report", "report_json"]),
    after_help = "\
Every object gets the cheapest motion that stays inside the tolerance: static, rigid, parts (a few
rigid bodies), or dense (a path for every splat). Samples that interpolation reproduces inside the
tolerance are left out. The table tells which motion was chosen, and what it misses.

  cif export table.cif --usd table.usda
  cif export table.cif --usd table.usdz --tolerance 0.5%
  cif export table.cif --gltf table.glb --usd table.usdc
  cif export table.cif --ply table.ply --ply-time 0.5
  cif export table.cif --ply frames --ply-sequence
  cif export table.cif --report --ground-truth motion.json"
)]
pub(super) struct Export {
    /// Trained scene
    #[arg(value_name = "SCENE.cif")]
    scene: PathBuf,
    /// Stage to write; the ending decides: .usda (text), .usdc (binary), .usdz (package)
    #[arg(long, value_name = "OUT.usda|usdc|usdz")]
    usd: Option<PathBuf>,
    #[command(flatten)]
    gltf: Gltf,
    #[command(flatten)]
    ply: Ply,
    /// Largest error of a simplified motion: 0.2% of the object's size, or 0.002 in world units
    #[arg(long, default_value = "0.2%", value_name = "TOLERANCE")]
    tolerance: Tolerance,
    /// Largest RMS error of opacities and colours that change over time; 0 keeps them at every frame
    #[arg(long, default_value_t = 0.01, value_name = "ERROR")]
    appearance_tolerance: f64,
    /// Frames to export, e.g. 0:71 [default: all]
    #[arg(long, value_name = "FIRST:LAST")]
    frames: Option<FrameRange>,
    /// Sample every N-th frame
    #[arg(long, default_value_t = 1, value_name = "N")]
    frame_step: usize,
    /// Up axis to declare; the data is not turned
    #[arg(long, default_value = "z", value_name = "AXIS")]
    up_axis: UpAxis,
    /// Metres per world unit
    #[arg(long, default_value_t = 1.0, value_name = "METRES")]
    meters_per_unit: f64,
    /// Leave out splats below this opacity [default: 1/255]
    #[arg(long, value_name = "OPACITY")]
    min_opacity: Option<f32>,
    /// Splats with less instance mass are background too [default: 0, the share of labelled pixels decides]
    #[arg(long, value_name = "MASS")]
    background_threshold: Option<f32>,
    /// Put the arrays of every object into a file of its own in OUT.usdc.payloads, loaded on demand;
    /// .usda does so anyway
    #[arg(long, conflicts_with = "single_file")]
    payloads: bool,
    /// Keep everything in one file; .usdc and .usdz do so anyway
    #[arg(long)]
    single_file: bool,
    /// Leave out the variants with half and a quarter of the splats
    #[arg(long)]
    no_lod: bool,
    /// Most points of an object's stand-in; 0 for none
    #[arg(long, value_name = "N")]
    proxy_points: Option<usize>,
    /// Print the motion table even when nothing is written
    #[arg(long)]
    report: bool,
    /// Write the motion table and the comparison with known motion as JSON; - for stdout
    #[arg(long, value_name = "FILE")]
    report_json: Option<PathBuf>,
    /// Print tables as JSON
    #[arg(long)]
    json: bool,
    /// Compare with known motion
    #[arg(long, value_name = "motion.json")]
    ground_truth: Option<PathBuf>,
    /// Replace existing output
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    models: ModelOptions,
}

pub(super) fn run(command: &Export) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.scene)?;
    command.ground_truth.as_deref().map_or(Ok(()), |truth| outputs.reads(truth))?;
    if let Some(path) = &command.usd {
        check_stage_name(path)?;
        outputs.file(path)?;
        cif_usd::check_target(path, writing(command)).map_err(Error::plain)?;
    }
    let report_to_stdout = command.report_json.as_deref().is_some_and(output::is_stdout);
    if let Some(path) = command.report_json.as_deref().filter(|_| !report_to_stdout) {
        outputs.text(path)?;
    }
    command.gltf.check(command.force, &mut outputs)?;
    command.ply.check(command.force, &mut outputs)?;
    let truth = command.ground_truth.as_deref().map(ground_truth::read).transpose()?;
    let field = scene::load(&command.scene)?;
    scene::note_frame(&scene::frame(&field)?, command.ply.ply.is_some());
    let options = options(command, &field);
    let only_gltf = command.gltf.gltf.is_some() && command.usd.is_none() && command.ply.ply.is_none();
    let options = if only_gltf { Gltf::options(&options) } else { options };
    let graph = cif_scene::build(&field, &options).map_err(Error::plain)?;
    for warning in &graph.warnings {
        eprintln!("warning: {warning}");
    }
    let written = match &command.usd {
        Some(path) => Some(cif_usd::export(&graph, path, writing(command)).map_err(Error::plain)?),
        None => None,
    };
    command.ply.write(&graph, command.force)?;
    let of_gltf = command.gltf.write(&field, &graph, &options, command.force)?;
    let errors = truth.map(|truth| ground_truth::compare(&graph, &truth));
    let of_gltf_table = of_gltf.as_ref().map(SceneGraph::motion_table);
    let tables =
        json!({ "motion": graph.motion_table(), "gltf_motion": of_gltf_table, "ground_truth": errors });
    if let Some(path) = command.report_json.as_deref().filter(|_| !report_to_stdout) {
        output::write_file(path, format!("{tables:#}\n").as_bytes())?;
    }
    if command.json || report_to_stdout {
        println!("{tables:#}");
    } else {
        print_motion(&graph);
        if let Some(of_gltf) = &of_gltf {
            println!("motion in the glTF, which holds no motion splat by splat:");
            print_motion(of_gltf);
        }
        if let Some(errors) = &errors {
            print_errors(errors);
        }
    }
    if let Some(written) = written {
        eprintln!(
            "wrote {}: {} prims, {} splats, {} time samples, {:.1} MB (usd-core {})",
            written.path.display(),
            written.nodes,
            written.splats,
            written.samples,
            written.bytes as f64 / 1e6,
            written.usd_version
        );
    }
    Ok(())
}

fn writing(command: &Export) -> cif_usd::ExportOptions {
    let payloads = match (command.payloads, command.single_file) {
        (true, _) => cif_usd::Payloads::Separate,
        (_, true) => cif_usd::Payloads::SingleFile,
        _ => cif_usd::Payloads::ByKind,
    };
    cif_usd::ExportOptions { force: command.force, payloads, levels_of_detail: !command.no_lod }
}

fn options(command: &Export, field: &Field) -> SceneOptions {
    let defaults = SceneOptions::default();
    command.models.apply(
        field,
        SceneOptions {
            tolerance: command.tolerance,
            appearance_tolerance: command.appearance_tolerance,
            frames: command.frames,
            frame_step: command.frame_step,
            up_axis: command.up_axis,
            meters_per_unit: command.meters_per_unit,
            min_opacity: command.min_opacity.unwrap_or(defaults.min_opacity),
            background_threshold: command.background_threshold.unwrap_or(defaults.background_threshold),
            proxy_points: command.proxy_points.unwrap_or(defaults.proxy_points),
            ..defaults
        },
    )
}

fn check_stage_name(path: &Path) -> Result<(), Error> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    if ["usda", "usdc", "usdz"].contains(&extension.as_str()) {
        return Ok(());
    }
    Err(Error::usage(
        format!("--usd {}: the ending decides the format", path.display()),
        "end the name in .usda (text), .usdc (binary) or .usdz (package)",
    ))
}

fn print_motion(graph: &SceneGraph) {
    let mut table = super::table(["object", "label", "splats"].into_iter().chain(motion_table::HEADINGS));
    for row in graph.motion_table() {
        let object = [row.name.clone(), row.label.clone(), row.motion.gaussians.to_string()];
        table.add_row(object.into_iter().chain(motion_table::cells(&row)));
    }
    println!("{table}");
}

fn print_errors(errors: &[MotionError]) {
    if errors.is_empty() {
        println!("no static or rigid object of the known motion is in the scene");
        return;
    }
    let mut table = super::table([
        "id",
        "label",
        "truth",
        "exported",
        "times",
        "translation RMS, mm",
        "max",
        "rotation RMS, deg",
        "max",
    ]);
    for error in errors {
        table.add_row([
            error.id.to_string(),
            error.label.clone(),
            error.truth.clone(),
            error.model.to_string(),
            error.samples.to_string(),
            format!("{:.2}", error.translation_rms_mm),
            format!("{:.2}", error.translation_max_mm),
            format!("{:.2}", error.rotation_rms_deg),
            format!("{:.2}", error.rotation_max_deg),
        ]);
    }
    println!("{table}");
}
