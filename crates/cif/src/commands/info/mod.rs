//! `cif info`: what is in a capture or a scene, and what GPUs there are.

#[cfg(feature = "wgpu")]
mod gpu;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use cif_dataset::{Dataset, InstanceLabel, Layout, PointSource, Split, TimeWindow};
use cif_field::{Checkpoint, Field, Instance, Record};
use cif_geometry::{Bounds, CaptureFrame};
use cif_scene::SceneOptions;
use cif_scene::from_field::assignment::members;
use cif_train::{Curve, Stage};
use clap::Args;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::shared::object_motion::ObjectMotion;
use super::shared::scene;
use crate::commands::shared::CaptureOptions;
use crate::error::Error;
use crate::formats;
use crate::report::{JsonReport, OnlyReport, Stored};

/// Show what is in a capture or a trained scene, or what GPUs there are
#[derive(Debug, Args)]
pub(super) struct Info {
    /// Folder of a capture, or a .cif file
    #[arg(value_name = "CAPTURE|SCENE.cif")]
    #[cfg_attr(feature = "wgpu", arg(required_unless_present = "gpu"))]
    #[cfg_attr(not(feature = "wgpu"), arg(required = true))]
    path: Option<PathBuf>,
    /// Show which GPUs Vulkan, Metal and Direct3D 12 offer, their features and limits, and what of them is used.
    /// The first is taken; WGPU_ADAPTER_NAME=PART takes the first whose name contains PART
    #[cfg(feature = "wgpu")]
    #[arg(long, conflicts_with = "path")]
    gpu: bool,
    #[command(flatten)]
    pub(super) report: OnlyReport,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

pub(super) fn run(command: &Info) -> Result<(), Error> {
    #[cfg(feature = "wgpu")]
    if command.gpu {
        command.report.check([])?;
        return gpu::run(&command.report);
    }
    let Some(path) = &command.path else {
        return Err(Error::usage("no capture or scene is given", "name a capture or a scene"));
    };
    command.report.check([path.as_path()])?;
    if path.is_file() {
        let checkpoint = Checkpoint::load(path).map_err(Error::plain)?;
        give(&command.report, scene_facts(&checkpoint))
    } else if formats::is_field(path) {
        scene::load(path).map(drop)
    } else {
        give(&command.report, capture_facts(command.capture_options.open(path)?))
    }
}

fn give(report: &OnlyReport, facts: impl Facts) -> Result<(), Error> {
    let printed = facts.in_order();
    report.give(|| facts, || print(&printed))
}

/// A report whose fields are also printed, in their order.
trait Facts: JsonReport {
    /// Names and values of the fields.
    fn in_order(&self) -> Vec<(&'static str, Value)>;
}

/// Declares a report whose fields are also printed.
macro_rules! facts {
    (
        $(#[$of_report:meta])*
        struct $name:ident { $($(#[$of_field:meta])* $field:ident: $kind:ty,)+ }
    ) => {
        $(#[$of_report])*
        #[derive(Serialize)]
        struct $name { $($(#[$of_field])* $field: $kind,)+ }

        impl Facts for $name {
            fn in_order(&self) -> Vec<(&'static str, Value)> {
                vec![$((stringify!($field), json!(self.$field))),+]
            }
        }
    };
}

facts! {
    /// A capture.
    struct CaptureFacts {
        /// Its folder.
        capture: String,
        /// Layout of its files.
        layout: Layout,
        /// Frames.
        frames: usize,
        /// Frames that are trained on.
        train: usize,
        /// Frames that are held out.
        val: usize,
        /// Frames of every group, by its name.
        groups: BTreeMap<String, usize>,
        /// Names of the cameras.
        cameras: BTreeSet<String>,
        /// Different times.
        times: usize,
        /// Frames per second; null where that is not known.
        frames_per_second: Option<f64>,
        /// Sizes of the images as they are loaded, `WIDTH x HEIGHT` in pixels.
        resolution: BTreeSet<String>,
        /// Least and largest focal length, pixels.
        focal_px: [f64; 2],
        /// Frames whose lens distortion is removed.
        frames_with_lens_distortion: usize,
        /// True where images have an alpha channel.
        alpha: bool,
        /// Frames that have a mask.
        frames_with_masks: usize,
        /// Instances of the masks.
        instances: Vec<InstanceLabel>,
        /// Points that training starts from.
        points: usize,
        /// Origin of the points: their file, or in words.
        points_from: String,
        /// Box of the points, capture coordinates; null without points.
        points_box: Option<BoxReport>,
        /// Box of the cameras, capture coordinates.
        camera_box: Option<BoxReport>,
        /// Place of the coordinates in the world of the capture; null where they are the same.
        frame: Option<CaptureFrame>,
        /// Notes of reading it.
        notes: Vec<String>,
        /// Warnings of reading it.
        warnings: Vec<String>,
    }
}

impl JsonReport for CaptureFacts {
    const COMMANDS: &'static [&'static str] = &["cif info CAPTURE"];
}

facts! {
    /// A trained scene.
    struct SceneFacts {
        /// Gaussians.
        gaussians: usize,
        /// True where a deformation moves Gaussians.
        moving: bool,
        /// Degree of the spherical harmonics.
        sh_degree: u8,
        /// Captured times.
        times: usize,
        /// Window of time of the capture, as in 2/4 for the second of four; null where it is all of it.
        window: Option<TimeWindow>,
        /// Time codes of the first and the last time.
        time_codes: [f64; 2],
        /// Frames per second.
        frames_per_second: f64,
        /// Names of the cameras.
        cameras: BTreeSet<String>,
        /// Box of the centres of the Gaussians.
        r#box: Option<BoxReport>,
        /// Extent of the scene that learning rates are relative to, world units.
        extent: f32,
        /// Instances.
        instances: Vec<InstanceFacts>,
        /// True where training can be continued.
        resumable: bool,
        /// Seconds of every stage of the training, by name; null where they are not recorded.
        stages: Option<Value>,
        /// Counts of the work of the training, by name; null where they are not recorded.
        work: Option<Value>,
        /// Quality over training time; null where it was not measured.
        curve: Option<Stored<Curve>>,
        /// Embeddings of the instances; null without any.
        embeddings: Option<EmbeddingFacts>,
        /// Record of how the scene came about, without embeddings.
        provenance: Value,
    }
}

impl JsonReport for SceneFacts {
    const COMMANDS: &'static [&'static str] = &["cif info SCENE.cif"];
}

/// An axis-aligned box.
#[derive(Serialize)]
struct BoxReport {
    /// Corner of the least coordinates.
    from: [f64; 3],
    /// Corner of the largest coordinates.
    to: [f64; 3],
}

/// An instance of a scene.
#[derive(Serialize)]
struct InstanceFacts {
    /// Mask id.
    id: u16,
    /// Label.
    label: String,
    /// Class.
    category: String,
    /// Names in other taxonomies, by taxonomy.
    taxonomies: BTreeMap<String, String>,
    /// Gaussians.
    gaussians: usize,
    /// Motion.
    motion: ObjectMotion,
}

/// Embeddings of the instances of a scene.
#[derive(Serialize)]
struct EmbeddingFacts {
    /// Model that made them.
    model: String,
    /// Instances that have one.
    instances: usize,
}

fn capture_facts(dataset: Dataset) -> CaptureFacts {
    let frames = &dataset.frames;
    let count = |split| frames.iter().filter(|frame| frame.split == split).count();
    let mut groups: BTreeMap<String, usize> = BTreeMap::new();
    for group in frames.iter().filter_map(|frame| frame.group.as_ref()) {
        *groups.entry(group.clone()).or_default() += 1;
    }
    let focal: Vec<f64> = frames.iter().map(|frame| frame.camera.focal_px.x).collect();
    let centres = Bounds::around(frames.iter().map(|frame| frame.camera.centre()));
    let points = Bounds::around(dataset.points.positions.iter().map(|p| DVec3::from(p.map(f64::from))));
    CaptureFacts {
        capture: dataset.root.display().to_string(),
        layout: dataset.layout,
        frames: frames.len(),
        train: count(Split::Train),
        val: count(Split::Val),
        groups,
        cameras: frames.iter().map(|frame| frame.camera_name.clone()).collect(),
        times: dataset.times.len(),
        frames_per_second: dataset.frames_per_second,
        resolution: frames
            .iter()
            .map(|frame| format!("{} x {}", frame.camera.width, frame.camera.height))
            .collect(),
        focal_px: range(&focal),
        frames_with_lens_distortion: frames.iter().filter(|frame| !frame.lens.is_identity()).count(),
        alpha: dataset.has_alpha,
        frames_with_masks: frames.iter().filter(|frame| frame.mask.is_some()).count(),
        points: dataset.points.positions.len(),
        points_from: match &dataset.points.source {
            PointSource::File(path) => path.display().to_string(),
            PointSource::Triangulated => "its own images".to_owned(),
            PointSource::Random => "random, in the box that the cameras see".to_owned(),
        },
        points_box: corners(&points),
        camera_box: corners(&centres),
        frame: (!dataset.frame.is_identity()).then_some(dataset.frame),
        instances: dataset.instances,
        notes: dataset.notes,
        warnings: dataset.warnings,
    }
}

fn scene_facts(checkpoint: &Checkpoint) -> SceneFacts {
    let field: &Field = &checkpoint.field;
    let facts = |(instance, rows): (&Instance, &Vec<u32>)| InstanceFacts {
        id: instance.id,
        label: instance.label.clone(),
        category: instance.category.clone(),
        taxonomies: instance.taxonomies.clone(),
        gaussians: rows.len(),
        motion: ObjectMotion::of(field, rows),
    };
    let means = Bounds::around(field.gaussians.means.iter().map(|p| DVec3::from(p.map(f64::from))));
    // Nobody reads the numbers of embeddings.
    let embeddings = field.record.embeddings.as_ref();
    let record = Record { embeddings: None, ..field.record.clone() };
    SceneFacts {
        gaussians: field.gaussians.len(),
        moving: field.deformation.is_some(),
        sh_degree: field.sh_degree,
        times: field.timeline.times.len(),
        window: field.record.window,
        time_codes: range(&field.time_codes()),
        frames_per_second: field.timeline.frames_per_second,
        cameras: field.cameras.iter().map(|camera| camera.name.clone()).collect(),
        r#box: corners(&means),
        extent: field.extent,
        instances: field.instances.iter().zip(&members(field, &SceneOptions::default())).map(facts).collect(),
        resumable: checkpoint.training.is_some(),
        stages: field.record.run.as_ref().and_then(|run| run.notes.get("seconds_by_stage")).cloned(),
        work: field.record.run.as_ref().and_then(|run| run.notes.get("work")).cloned(),
        curve: field.record.curve.clone().map(Stored::from),
        embeddings: embeddings
            .map(|all| EmbeddingFacts { model: all.model.clone(), instances: all.of.len() }),
        provenance: record.to_json(),
    }
}

fn range(values: &[f64]) -> [f64; 2] {
    values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(*v), high.max(*v)])
}

fn corners(bounds: &Bounds) -> Option<BoxReport> {
    (!bounds.is_empty()).then(|| BoxReport { from: bounds.low.to_array(), to: bounds.high.to_array() })
}

fn print(facts: &[(&'static str, Value)]) {
    for (name, value) in facts {
        let name = name.trim_start_matches("r#").replace('_', " ");
        match value {
            Value::Array(items) if items.is_empty() => println!("{name:>28}  none"),
            Value::Array(items) if items.iter().all(Value::is_object) => {
                println!("{name:>28}  {}", items.len());
                for item in items {
                    println!("{:>28}  {}", "", named(item));
                }
            }
            Value::Array(items) if ["notes", "warnings"].contains(&name.as_str()) => {
                for item in items {
                    println!("{:>28}  {}", &name[..name.len() - 1], one_line(item));
                }
            }
            Value::Object(items) if items.is_empty() => println!("{name:>28}  none"),
            Value::Object(items) if name == "provenance" => {
                println!("{name:>28}  {}", items.keys().cloned().collect::<Vec<_>>().join(", "));
            }
            Value::Null if ["curve", "embeddings", "stages", "work"].contains(&name.as_str()) => {}
            Value::Object(items) if name == "stages" => println!("{name:>28}  {}", stage_times(items)),
            Value::Object(items) if name == "work" => print_work(items),
            value if name == "curve" => print_curve(value),
            value => println!("{name:>28}  {}", one_line(value)),
        }
    }
}

/// Times of stages in words, in the order of a run.
fn stage_times(times: &serde_json::Map<String, Value>) -> String {
    let mut stages: Vec<(Option<Stage>, String)> = Vec::new();
    for (name, seconds) in times {
        let stage = serde_json::from_value(json!(name)).ok();
        stages.push((stage, format!("{name} {:.1} s", seconds.as_f64().unwrap_or(0.0))));
    }
    stages.sort_by_key(|(stage, _)| *stage);
    stages.into_iter().map(|(_, words)| words).collect::<Vec<_>>().join(", ")
}

/// Prints the work counts of the run.
fn print_work(counts: &serde_json::Map<String, Value>) {
    for (row, (name, count)) in counts.iter().enumerate() {
        let heading = if row == 0 { "work of training" } else { "" };
        println!("{heading:>28}  {}  {}", count, name.replace('_', " "));
    }
}

/// Prints the curve of the run.
fn print_curve(curve: &Value) {
    let Ok(curve) = serde_json::from_value::<Curve>(curve.clone()) else {
        println!("{:>28}  not readable", "curve");
        return;
    };
    println!(
        "{:>28}  {} {}; measuring took {:.1} s; points count everything else, fits of objects too",
        "curve",
        curve.frame_names.len(),
        curve.frames.describe(),
        curve.measuring.wall_s
    );
    let mut table = crate::commands::shared::table([
        "stage",
        "step",
        "wall s",
        "CPU s",
        "Gaussians",
        "PSNR dB",
        "SSIM",
        "IoU %",
        "mIoU %",
    ]);
    let number = |value: Option<f64>, digits| value.map_or("n/a".to_owned(), |v| format!("{v:.digits$}"));
    for point in &curve.points {
        table.add_row([
            point.stage.to_string(),
            point.step.to_string(),
            format!("{:.1}", point.wall_s),
            format!("{:.1}", point.cpu_s),
            point.gaussians.to_string(),
            number(point.psnr, 2),
            number(point.ssim, 4),
            number(point.iou, 1),
            number(point.miou, 1),
        ]);
    }
    println!("{table}");
}

/// An instance in one line.
fn named(instance: &Value) -> String {
    let text = |key: &str| instance.get(key).map(one_line);
    let mut line = format!(
        "id {:>3}  {}  ({})",
        text("id").unwrap_or_default(),
        text("label").unwrap_or_default(),
        text("category").unwrap_or_default()
    );
    if let Some(Value::Object(taxonomies)) = instance.get("taxonomies") {
        for (taxonomy, name) in taxonomies {
            line += &format!("  {taxonomy} {}", one_line(name));
        }
    }
    if let Some(gaussians) = text("gaussians") {
        line += &format!("  {gaussians} Gaussians");
    }
    if let Some(motion) = instance.get("motion").and_then(|motion| ObjectMotion::deserialize(motion).ok()) {
        line += &format!("  {motion}");
    }
    line
}

fn one_line(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Null => "n/a".to_owned(),
        Value::Bool(value) => if *value { "yes" } else { "no" }.to_owned(),
        Value::Number(number) => match number.as_f64() {
            Some(float) if number.is_f64() => format!("{float:.4}"),
            _ => number.to_string(),
        },
        Value::Array(items) => items.iter().map(one_line).collect::<Vec<_>>().join(", "),
        Value::Object(items) => items
            .iter()
            .map(|(key, value)| format!("{key} {}", one_line(value)))
            .collect::<Vec<_>>()
            .join(", "),
    }
}
