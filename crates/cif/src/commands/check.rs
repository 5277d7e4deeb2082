//! `cif check`: whether a scene is numerically sound, and a repaired copy of one that is not.

use std::path::{Path, PathBuf};

use cif_field::health::{self, Finding, Repair, Severity};
use cif_field::{Checkpoint, Field, StateTensor};
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::UNLABELLED;
use cif_render::cpu::{IdentityCounts, Renderer, SimdLevel};
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use super::shared::scene;
use crate::endings;
use crate::error::Error;
use crate::output::Outputs;
use crate::report::{JsonReport, Report};

/// Blended weight over all recorded views, in pixels, below which a Gaussian was never seen.
const MIN_MASS: f64 = 1e-3;

/// Report whether a scene is numerically sound, and repair it
#[derive(Debug, Args)]
#[command(after_help = "\
Broken scenes cannot be loaded, drawn or trained: values that are not finite, quaternions of norm 0,
log-scales beyond what the renderer clamps. Odd scenes are drawn as they are, and may hold a mistake:
saturated opacity or occupancy, needles, copies, Gaussians that no recorded view shows, centres
outside the box of the deformation or far from the cameras.

  cif check table.cif
  cif check table.cif --json | jq '.findings[] | {check, array, count}'
  cif check broken.cif --fix repaired.cif

--fix writes a copy without the broken values and leaves odd ones: views stay the same, so that
Gaussians that cannot be drawn are removed, and values beyond the clamps are set to them.
Exit code: 0 sound (or repaired), 1 broken.")]
pub(super) struct Check {
    /// Trained scene
    #[arg(value_name = "SCENE.cif")]
    scene: PathBuf,
    /// Write a repaired copy
    #[arg(long, value_name = "OUT.cif", value_parser = endings::scene())]
    pub(super) fix: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    pub(super) report: Report,
}

pub(super) fn run(command: &Check) -> Result<(), Error> {
    if command.force && command.fix.is_none() && !command.report.is_asked() {
        return Err(Error::usage(
            "--force replaces the files of --fix and --json, of which none is given",
            "leave it out, or add --fix OUT.cif",
        ));
    }
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.scene)?;
    command.fix.as_deref().map_or(Ok(()), |target| outputs.file(target))?;
    command.report.check(&mut outputs)?;
    if command.scene.is_dir() {
        // Reports a capture in place of a scene as other commands do.
        scene::load(&command.scene)?;
    }
    let mut checkpoint = Checkpoint::load_unchecked(&command.scene).map_err(Error::plain)?;
    let gaussians = checkpoint.field.len();
    let never_seen = checkpoint.field.validate().is_ok().then(|| never_seen(&checkpoint.field)).flatten();
    let mut findings = health::check(&checkpoint.field, never_seen.as_deref());
    findings.extend(state_findings(&checkpoint));
    let broken = findings.iter().filter(|finding| finding.severity == Severity::Broken).count();

    let mut repairs = Vec::new();
    if let Some(target) = &command.fix {
        let _lock = crate::lock::Lock::wait(target)?;
        repairs = repair(&mut checkpoint).map_err(|reason| {
            Error::failed(
                format!("{}: {reason}", command.scene.display()),
                "nothing was written; train the scene again",
            )
        })?;
        checkpoint.save(target).map_err(Error::plain)?;
    }
    let report = || CheckReport {
        scene: &command.scene,
        gaussians,
        broken,
        odd: findings.len() - broken,
        views_checked: never_seen.is_some(),
        findings: &findings,
        repaired: command.fix.as_deref(),
        repairs: &repairs,
    };
    let views = never_seen.is_some();
    command.report.give(report, || print(command, gaussians, &findings, &repairs, views))?;
    if broken == 0 || command.fix.is_some() {
        return Ok(());
    }
    Err(Error::failed(
        format!(
            "{}: {broken} of {} findings mean that the scene is broken",
            command.scene.display(),
            findings.len()
        ),
        format!(
            "repair it into a new file: {}",
            crate::commands::shared::command_line(&[
                "check",
                &command.scene.to_string_lossy(),
                "--fix",
                "repaired.cif"
            ])
        ),
    ))
}

/// Findings on a scene.
#[derive(Serialize)]
struct CheckReport<'a> {
    /// The scene.
    scene: &'a Path,
    /// Gaussians.
    gaussians: usize,
    /// Findings that mean that the scene is broken.
    broken: usize,
    /// Findings that may have a reason.
    odd: usize,
    /// True where the views of the scene were searched for Gaussians that none shows.
    views_checked: bool,
    /// Every finding.
    findings: &'a [Finding],
    /// The repaired copy; null without `--fix`.
    repaired: Option<&'a Path>,
    /// Changes of the copy.
    repairs: &'a [Repair],
}

impl JsonReport for CheckReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif check"];
}

/// Most pixels of a view in which Gaussians are looked for: 4096 x 4096, which take about 1 GiB. Larger views are
/// looked at in this size, in which Gaussians appear no less.
const MAX_CHECKED_PIXELS: f64 = 16_777_216.0;

/// The view, at a size at which Gaussians are looked for.
fn within_memory(camera: &PinholeCamera) -> PinholeCamera {
    let factor = (MAX_CHECKED_PIXELS / (f64::from(camera.width) * f64::from(camera.height))).sqrt();
    if factor >= 1.0 {
        return *camera;
    }
    let reduced = |side: u32| ((f64::from(side) * factor).floor() as u32).max(1);
    camera.resized(reduced(camera.width), reduced(camera.height))
}

/// Gaussians that none of the views it was trained on shows; `None` where no view is recorded.
fn never_seen(field: &Field) -> Option<Vec<bool>> {
    let trained = field.cameras.iter().any(|record| record.trained);
    let settings = scene::render_settings(field);
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let mut counts = IdentityCounts::zeros(field.len(), 0);
    for record in field.cameras.iter().filter(|record| record.trained || !trained) {
        let camera = &within_memory(&record.camera);
        let labels = PixelGrid::filled(camera.width, camera.height, UNLABELLED);
        let time = field.timeline.times.get(record.time_index).copied().unwrap_or_default();
        renderer.count_identities(field, camera, time, &settings, &labels, &mut counts);
    }
    let unseen = || (0..field.len()).map(|row| counts.total_mass(row) < MIN_MASS).collect();
    (!field.cameras.is_empty()).then(unseen)
}

/// Moments of the optimiser that are not finite.
fn state_findings(checkpoint: &Checkpoint) -> Vec<Finding> {
    let tensors = checkpoint.training.iter().flat_map(|state| &state.tensors);
    tensors
        .filter_map(|(name, tensor)| {
            let StateTensor::F32(values) = tensor else { return None };
            let bad: Vec<usize> = (0..values.len()).filter(|at| !values[*at].is_finite()).collect();
            (!bad.is_empty()).then(|| Finding {
                check: "not finite",
                severity: Severity::Broken,
                array: "training state",
                count: bad.len(),
                first: bad.into_iter().take(5).collect(),
                meaning: format!("{name}: the run cannot go on from them"),
            })
        })
        .collect()
}

/// Repairs the field, and keeps the state of its training where it still fits.
fn repair(checkpoint: &mut Checkpoint) -> Result<Vec<Repair>, health::HealthError> {
    let before = (checkpoint.field.len(), checkpoint.field.identities.is_some());
    let mut repairs = health::repair(&mut checkpoint.field)?;
    let fits = before == (checkpoint.field.len(), checkpoint.field.identities.is_some());
    let mut zeroed = 0;
    if !fits && checkpoint.training.take().is_some() {
        repairs.push(Repair {
            what: "the training state was left out, since it belongs to other Gaussians; cif train --from continues"
                .to_owned(),
            count: 1,
        });
    }
    for tensor in checkpoint.training.iter_mut().flat_map(|state| state.tensors.values_mut()) {
        if let StateTensor::F32(values) = tensor {
            for value in values.iter_mut().filter(|value| !value.is_finite()) {
                (*value, zeroed) = (0.0, zeroed + 1);
            }
        }
    }
    if zeroed > 0 {
        repairs.push(Repair {
            what: "moments of the training state that were not finite are 0".to_owned(),
            count: zeroed,
        });
    }
    Ok(repairs)
}

fn print(command: &Check, gaussians: usize, findings: &[Finding], repairs: &[Repair], views: bool) {
    if findings.is_empty() {
        println!("{}: {gaussians} Gaussians, nothing broken and nothing odd", command.scene.display());
    } else {
        println!("{}: {gaussians} Gaussians", command.scene.display());
        let mut table = crate::commands::shared::table(["", "check", "array", "count", "first", "meaning"]);
        for finding in findings {
            let first: Vec<String> = finding.first.iter().map(usize::to_string).collect();
            let severity = serde_json::to_value(finding.severity).unwrap_or(Value::Null);
            table.add_row([
                severity.as_str().unwrap_or_default(),
                finding.check,
                finding.array,
                &finding.count.to_string(),
                &first.join(" "),
                &finding.meaning,
            ]);
        }
        println!("{table}");
    }
    if !views {
        println!("not checked: Gaussians that no view shows, since the scene is broken or records no views");
    }
    for Repair { what, count } in repairs {
        println!("repaired: {count} x {what}");
    }
    if let Some(target) = &command.fix {
        println!("saved {}", target.display());
    }
}
