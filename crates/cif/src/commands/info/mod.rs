//! `cif info`: what is in a capture or a scene, and what GPUs there are.

#[cfg(feature = "wgpu")]
mod gpu;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use cif_dataset::{Dataset, PointSource, Split};
use cif_field::{Checkpoint, Field, Record};
use cif_geometry::Bounds;
use cif_scene::SceneOptions;
use cif_scene::from_field::assignment::members;
use cif_train::{Curve, Stage};
use clap::Args;
use glam::DVec3;
use serde::Deserialize;
use serde_json::{Value, json};

use super::shared::object_motion::ObjectMotion;
use super::shared::scene;
use crate::commands::shared::CaptureOptions;
use crate::error::Error;
use crate::formats;
use crate::report::OnlyReport;

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
        return Err(Error::usage("nothing to tell of", "name a capture or a scene"));
    };
    command.report.check([path.as_path()])?;
    let facts = if path.is_file() {
        let checkpoint = Checkpoint::load(path).map_err(Error::plain)?;
        scene_facts(&checkpoint)
    } else if formats::is_field(path) {
        return scene::load(path).map(drop);
    } else {
        capture_facts(&command.capture_options.open(path)?)?
    };
    command.report.give(|| Value::Object(facts.iter().cloned().collect()), || print(&facts))
}

/// Facts in the order they are told.
type Facts = Vec<(String, Value)>;

fn capture_facts(dataset: &Dataset) -> Result<Facts, Error> {
    let frames = &dataset.frames;
    let count = |split| frames.iter().filter(|frame| frame.split == split).count();
    let mut groups: BTreeMap<&str, usize> = BTreeMap::new();
    for group in frames.iter().filter_map(|frame| frame.group.as_deref()) {
        *groups.entry(group).or_default() += 1;
    }
    let cameras: BTreeSet<&str> = frames.iter().map(|frame| frame.camera_name.as_str()).collect();
    let sizes: BTreeSet<String> =
        frames.iter().map(|frame| format!("{} x {}", frame.camera.width, frame.camera.height)).collect();
    let focal: Vec<f64> = frames.iter().map(|frame| frame.camera.focal_px.x).collect();
    let masks = frames.iter().filter(|frame| frame.mask.is_some()).count();
    let lenses = frames.iter().filter(|frame| !frame.lens.is_identity()).count();
    let centres = Bounds::around(frames.iter().map(|frame| frame.camera.centre()));
    let points = Bounds::around(dataset.points.positions.iter().map(|p| DVec3::from(p.map(f64::from))));
    let source = match &dataset.points.source {
        PointSource::File(path) => path.display().to_string(),
        PointSource::Triangulated => "its own images".to_owned(),
        PointSource::Random => "random, in the box that the cameras see".to_owned(),
    };
    Ok(vec![
        ("capture".to_owned(), json!(dataset.root.display().to_string())),
        ("layout".to_owned(), json!(dataset.layout)),
        ("frames".to_owned(), json!(frames.len())),
        ("train".to_owned(), json!(count(Split::Train))),
        ("val".to_owned(), json!(count(Split::Val))),
        ("groups".to_owned(), json!(groups)),
        ("cameras".to_owned(), json!(cameras)),
        ("times".to_owned(), json!(dataset.times.len())),
        ("frames_per_second".to_owned(), json!(dataset.frames_per_second)),
        ("resolution".to_owned(), json!(sizes)),
        ("focal_px".to_owned(), json!(range(&focal))),
        ("frames_with_lens_distortion".to_owned(), json!(lenses)),
        ("alpha".to_owned(), json!(dataset.has_alpha)),
        ("frames_with_masks".to_owned(), json!(masks)),
        ("instances".to_owned(), json!(dataset.instances)),
        ("points".to_owned(), json!(dataset.points.positions.len())),
        ("points_from".to_owned(), json!(source)),
        ("points_box".to_owned(), corners(&points)),
        ("camera_box".to_owned(), corners(&centres)),
        ("frame".to_owned(), json!((!dataset.frame.is_identity()).then_some(dataset.frame))),
        ("notes".to_owned(), json!(dataset.notes)),
        ("warnings".to_owned(), json!(dataset.warnings)),
    ])
}

fn scene_facts(checkpoint: &Checkpoint) -> Facts {
    let field: &Field = &checkpoint.field;
    // Nobody reads their numbers.
    let embeddings = field.record.embeddings.as_ref();
    let embeddings = embeddings.map(|all| json!({ "model": all.model, "instances": all.of.len() }));
    let record = Record { embeddings: None, ..field.record.clone() };
    let means = Bounds::around(field.gaussians.means.iter().map(|p| DVec3::from(p.map(f64::from))));
    let owned = members(field, &SceneOptions::default());
    let instances: Vec<Value> = field
        .instances
        .iter()
        .zip(&owned)
        .map(|(instance, rows)| {
            json!({
                "id": instance.id,
                "label": instance.label,
                "category": instance.category,
                "taxonomies": instance.taxonomies,
                "gaussians": rows.len(),
                "motion": ObjectMotion::of(field, rows),
            })
        })
        .collect();
    let cameras: BTreeSet<&str> = field.cameras.iter().map(|camera| camera.name.as_str()).collect();
    vec![
        ("gaussians".to_owned(), json!(field.gaussians.len())),
        ("moving".to_owned(), json!(field.deformation.is_some())),
        ("sh_degree".to_owned(), json!(field.sh_degree)),
        ("times".to_owned(), json!(field.timeline.times.len())),
        ("frames_per_second".to_owned(), json!(field.timeline.frames_per_second)),
        ("cameras".to_owned(), json!(cameras)),
        ("box".to_owned(), corners(&means)),
        ("extent".to_owned(), json!(field.extent)),
        ("instances".to_owned(), json!(instances)),
        ("resumable".to_owned(), json!(checkpoint.training.is_some())),
        (
            "stages".to_owned(),
            json!(field.record.run.as_ref().and_then(|run| run.notes.get("seconds_by_stage"))),
        ),
        ("work".to_owned(), json!(field.record.run.as_ref().and_then(|run| run.notes.get("work")))),
        ("curve".to_owned(), json!(field.record.curve)),
        ("embeddings".to_owned(), json!(embeddings)),
        ("provenance".to_owned(), record.to_json()),
    ]
}

fn range(values: &[f64]) -> [f64; 2] {
    values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(*v), high.max(*v)])
}

fn corners(bounds: &Bounds) -> Value {
    if bounds.is_empty() {
        Value::Null
    } else {
        json!({ "from": bounds.low.to_array(), "to": bounds.high.to_array() })
    }
}

fn print(facts: &Facts) {
    for (name, value) in facts {
        let name = name.replace('_', " ");
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
