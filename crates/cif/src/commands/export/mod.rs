//! `cif export`: a scene as USD, glTF, PLY and HTML.

mod check;
mod preset;
mod targets;
mod windows;

use std::collections::BTreeMap;
use std::path::PathBuf;

use cif_dataset::MotionTruth;
use cif_field::Field;
use cif_scene::graph::ReportRow;
use cif_scene::{
    FrameRange, MotionModel, Node, SceneFormat, SceneGraph, SceneOptions, Seam, Tolerance, UpAxis,
};
use clap::{ArgGroup, Args};
use serde::Serialize;

use super::shared::model_options::ModelOptions;
use super::shared::{motion_table, scene};
use crate::error::Error;
use crate::formats::{self, FORMATS};
use crate::ground_truth::{self, MotionError};
use crate::interrupt;
use crate::messages::note;
use crate::moment::Frames;
use crate::output::Outputs;
use crate::report::{JsonReport, Report};
use check::{Check, FileCheck, Finding};
use preset::{Preferred, Preset};
use targets::{FILES, Targets, Writing};

/// Export a scene as USD, glTF or PLY, one prim or node per object, or as a page
#[derive(Debug, Args)]
#[command(
    group = ArgGroup::new("result").required(true).multiple(true)
        .args(FORMATS.iter().map(|format| format.about().key).chain([FILES, "report", "json"])),
    after_help = "\
Poses that the scene records for an object, trained or imported, leave as they are, whatever the
tolerance. Every other object gets the cheapest motion that stays inside the tolerance: static, rigid,
parts (a few rigid bodies), or dense (a path for every splat), without the samples that interpolation
reproduces inside the tolerance. The table shows the chosen motion models and
their residuals.

  cif export table.cif table.usda
  cif export table.cif table.usdz --tolerance 0.5%
  cif export table.cif table.glb table.usdc             the endings decide the formats
  cif export table.cif table.ply --ply-time 36          or 1.5s, or 50%
  cif export table.cif --ply frames --ply-sequence      a folder has no ending: its flag says the format
  cif export table.cif --report --ground-truth motion.json
  cif export table.cif table.usda --for mujoco          or newton, isaac, blender, web: --help shows their flags

A long capture that was trained in windows of time (`cif train --window`, `cif batch` with train.windows)
becomes one stage, in which every object keeps one path and its splats change from window to window:

  cif export walk.1.cif walk.2.cif walk.3.cif walk.usda

--check reads every file back as `cif import` would and compares it with the scene, from cameras that
the scene recorded and, with --capture, from those of held-out images. PSNR of an object is over the
pixels where the scene shows it; IoU is against where the scene shows it, or against the masks of the
held-out images. A PLY is compared at its moment, and has no objects.

  cif export table.cif table.usda --check --capture captures/table"
)]
pub(super) struct Export {
    /// Trained scene
    #[arg(value_name = "SCENE.cif")]
    scene: PathBuf,
    #[command(flatten)]
    targets: Targets,
    /// Options for the program that opens the files; flags on the command line override it
    #[arg(long = "for", value_name = "PROGRAM")]
    preset: Option<Preset>,
    #[command(flatten)]
    writing: Writing,
    /// Largest error of a motion that is fitted, where no poses are recorded: 0.2% of the object's size, or 0.002 in
    /// world units
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
    /// Up axis to declare; the data is not turned [default: that of the imported file, else z]
    #[arg(long, value_name = "AXIS")]
    up_axis: Option<UpAxis>,
    /// Metres per world unit [default: that of the imported file, else 1]
    #[arg(long, value_name = "METRES")]
    meters_per_unit: Option<f64>,
    /// Leave out splats below this opacity [default: 1/255]
    #[arg(long, value_name = "OPACITY")]
    min_opacity: Option<f32>,
    /// Splats with less instance mass are background too [default: 0, the share of labelled pixels decides]
    #[arg(long, value_name = "MASS")]
    background_threshold: Option<f32>,
    /// Most points of an object's stand-in; 0 for none
    #[arg(long, value_name = "N")]
    proxy_points: Option<usize>,
    /// Widen splats by the filter of the renderer (0.3 px2) as the recorded cameras see them, for viewers without one,
    /// in which thin parts vanish; for viewers alone: cif and viewers with a filter would blur twice
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    bake_blur: Option<bool>,
    /// Print the motion table even if no file is written
    #[arg(long)]
    report: bool,
    #[command(flatten)]
    tables: Report,
    /// Compare with known motion
    #[arg(long, value_name = "motion.json")]
    ground_truth: Option<PathBuf>,
    /// Replace existing output
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    models: ModelOptions,
    #[command(flatten)]
    check: Check,
}

pub(super) fn run(command: &Export) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.scene)?;
    command.ground_truth.as_deref().map_or(Ok(()), |truth| outputs.reads(truth))?;
    command.tables.check(&mut outputs)?;
    let preferred = command.preset.map_or_else(Preferred::default, Preset::preferred);
    command.targets.check(&command.writing, &preferred, command.force, &mut outputs)?;
    let bakes_blur = command.bake_blur.or(preferred.bake_blur).unwrap_or_default();
    command.check.refuse(&command.targets, &command.writing, &preferred, bakes_blur)?;
    windows::refuse(&command.targets, &command.writing, command.frames.is_some(), command.check.is_asked())?;
    command.targets.windows.iter().try_for_each(|window| outputs.reads(window))?;
    if let Some(preset) = command.preset {
        note!("--for {} is {}; flags on the command line override it", preset.name(), preset.flags());
    }
    let truth = command.ground_truth.as_deref().map(MotionTruth::read).transpose().map_err(Error::plain)?;
    let field = scene::load(&command.scene)?;
    let checker = command.check.open(&field, &mut outputs)?;
    let notes = command.targets.iter().filter_map(|target| target.format.about().note_on_place);
    scene::note_frame(&scene::frame(&field)?, notes);
    // The graph is as rich as the richest of the formats.
    let options_of = |field: &Field| {
        let asked = SceneOptions { bake_blur: bakes_blur, ..options(command, &preferred, field) };
        let held = command.targets.iter().map(|target| target.format.held(&asked));
        held.max_by_key(|held| held.most_expensive_motion).unwrap_or(asked)
    };
    let graph = cif_scene::build(&field, &options_of(&field)).map_err(Error::plain)?;
    let options = options_of(&field);
    let (graph, seams) = windows::with_further(&field, graph, &command.targets.windows, options_of)?;
    for warning in &graph.warnings {
        crate::messages::warning!("{warning}");
    }
    let place = command.scene.display().to_string();
    let frames = Frames::new(graph.time_codes.range(), &place);
    let writing = command.writing.options(&preferred, command.force, &frames)?;
    let mut rebuilt: Vec<(&dyn SceneFormat, SceneGraph)> = Vec::new();
    let mut findings: Vec<Finding> = Vec::new();
    if checker.is_some() {
        interrupt::watch();
    }
    for target in command.targets.iter() {
        let other = target.format.rebuilt(&field, &graph, &options).map_err(Error::plain)?;
        let held = other.as_ref().unwrap_or(&graph);
        let written = formats::write(target.format, held, &target.path, &writing)?;
        target.report(&written);
        if let Some(checker) = &checker {
            findings.push(checker.check(target, held, &writing)?);
        }
        rebuilt.extend(other.map(|graph| (target.format, graph)));
    }
    let errors = truth.map(|truth| ground_truth::compare(&graph, &truth));
    let masses = masses(&graph, writing.density);
    let simplifies = |most: MotionModel| most < MotionModel::Dense;
    let simplified = |format: &dyn SceneFormat| {
        let table = rebuilt.iter().find(|(other, _)| other.about().key == format.about().key);
        (format!("{}_motion", format.about().key), table.map(|(_, graph)| graph.motion_table()))
    };
    let tables = || ExportReport {
        motion: graph.motion_table(),
        ground_truth: errors.as_deref(),
        masses: &masses,
        simplified: FORMATS
            .into_iter()
            .filter(|format| format.about().most_expensive_motion.is_some_and(simplifies))
            .map(simplified)
            .collect(),
        check: checker.is_some().then(|| findings.iter().map(|finding| finding.report(&field)).collect()),
        seams: &seams,
    };
    let print = || {
        print_motion(&graph, &masses);
        for (format, graph) in &rebuilt {
            println!(
                "motion in the {}, which holds splats with paths of their own only where these are few:",
                format.about().name
            );
            print_motion(graph, &self::masses(graph, writing.density));
        }
        if let Some(errors) = &errors {
            print_errors(errors);
        }
        windows::print(&seams, graph.meters_per_unit);
        findings.iter().for_each(|finding| finding.print(&field));
    };
    command.tables.give(tables, print)
}

/// Motion, masses and losses of an exported scene.
#[derive(Debug, Serialize)]
struct ExportReport<'a> {
    /// Motion of every node.
    motion: Vec<ReportRow>,
    /// Errors of objects with known motion; null without `--ground-truth`.
    ground_truth: Option<&'a [MotionError]>,
    /// Masses, in the order of the nodes.
    masses: &'a [Mass],
    /// `gltf_motion`: motion of every node in the file, where the format holds simpler motion than the scene has; null
    /// where it does not have to, or no such file was written.
    #[serde(flatten)]
    simplified: BTreeMap<String, Option<Vec<ReportRow>>>,
    /// Every file that was read back and compared with the scene; absent without `--check`.
    #[serde(skip_serializing_if = "Option::is_none")]
    check: Option<Vec<FileCheck<'a>>>,
    /// Where windows of time meet, how far they differ in where objects are; absent for one scene.
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    seams: &'a [Seam],
}

impl JsonReport for ExportReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif export"];
}

/// Mass of an object.
#[derive(Debug, Serialize)]
struct Mass {
    /// Name of the node.
    name: String,
    /// Kilograms; null without a collider.
    kilograms: Option<f64>,
}

fn masses(graph: &SceneGraph, density: f64) -> Vec<Mass> {
    let mass = |node: &Node| Mass {
        name: node.name.clone(),
        kilograms: (!node.colliders.is_empty()).then(|| cif_scene::masses(graph, node, density).iter().sum()),
    };
    graph.nodes.iter().map(mass).collect()
}

fn options(command: &Export, preferred: &Preferred, field: &Field) -> SceneOptions {
    let defaults = SceneOptions::default();
    command.models.apply(
        field,
        preferred.hulls,
        SceneOptions {
            tolerance: command.tolerance,
            appearance_tolerance: command.appearance_tolerance,
            frames: command.frames,
            frame_step: command.frame_step,
            up_axis: command.up_axis,
            meters_per_unit: command.meters_per_unit,
            min_opacity: command.min_opacity.unwrap_or(defaults.min_opacity),
            background_threshold: command.background_threshold.unwrap_or(defaults.background_threshold),
            proxy_points: command.proxy_points.or(preferred.proxy_points).unwrap_or(defaults.proxy_points),
            ..defaults
        },
    )
}

fn print_motion(graph: &SceneGraph, masses: &[Mass]) {
    let mut table = crate::commands::shared::table(
        ["object", "label", "splats", "kg"].into_iter().chain(motion_table::HEADINGS),
    );
    for (row, mass) in graph.motion_table().iter().zip(masses) {
        let kilograms = mass.kilograms.map_or_else(String::new, |mass| format!("{mass:.3}"));
        let object = [row.name.clone(), row.label.clone(), row.motion.gaussians.to_string(), kilograms];
        table.add_row(object.into_iter().chain(motion_table::cells(row)));
    }
    println!("{table}");
}

fn print_errors(errors: &[MotionError]) {
    if errors.is_empty() {
        println!("no static or rigid object of the known motion is in the scene");
        return;
    }
    let mut table = crate::commands::shared::table([
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
