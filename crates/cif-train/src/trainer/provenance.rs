//! Record of the training run that produced a field, stored with the field.

use cif_field::{Drawing, FrameCodes, Record, Run};
use serde_json::{Map, Value, json};

use super::Trainer;
use crate::config::Ablation;
use crate::exposure::Exposures;
use crate::stage::Stage;

/// The members of a JSON object that are not null.
fn members(object: Value) -> Map<String, Value> {
    match object {
        Value::Object(members) => members.into_iter().filter(|(_, value)| !value.is_null()).collect(),
        _ => Map::new(),
    }
}

impl Trainer {
    /// The record: how to draw the field, settings, capture, steps, times, memory, versions.
    pub(super) fn provenance(&self) -> Record {
        let (dataset, config, progress) = (self.state.capture(), &self.state.config, &self.progress());
        let masks = dataset.frames.iter().find_map(|frame| frame.mask.as_ref()).and_then(|mask| {
            let folder = mask.strip_prefix(&dataset.root).ok().unwrap_or(mask).components().next()?;
            folder.as_os_str().to_str().map(str::to_owned)
        });
        let rollbacks = &progress.rollbacks;
        let rolled_back =
            (!rollbacks.is_empty()).then(|| json!({ "steps": rollbacks.total, "last": rollbacks.last }));
        let exposures = progress.exposures.as_ref();
        Record {
            drawing: Drawing {
                near: Some(self.state.near),
                antialiased: Some(config.antialiased),
                opacity_is_occupancy: config.ablates(Ablation::OpacityOccupancy) || self.labels_by_opacity(),
                exposures: exposures.map(Exposures::by_camera).unwrap_or_default(),
                exposures_in_time: exposures.map(Exposures::in_time).unwrap_or_default(),
            },
            frame: dataset.frame,
            // Those of the world of the capture.
            declared: None,
            frame_codes: dataset.window.filter(|of| of.first > 0).map(|of| FrameCodes::From(of.first as f64)),
            window: dataset.window.map(|of| of.window),
            capture: dataset.root.file_name().and_then(|name| name.to_str()).map(str::to_owned),
            unknown: dataset.unknown.clone(),
            run: Some(Run {
                complete: progress.stage == Stage::Done,
                preset: json!(config.preset).as_str().map(str::to_owned),
                seed: Some(config.seed),
                iterations: Some(progress.total_steps),
                wall_s: Some(progress.total().wall_s),
                wall_s_by_phase: progress.wall_s.clone(),
                cpu_s: Some(progress.total().cpu_s),
                peak_rss_mb: peak_rss_mb(),
                notes: members(json!({
                    "iterations_by_stage": progress.steps,
                    "seconds_by_stage": progress.stages_s,
                    "seconds_by_effect": (!progress.effects_s.is_empty()).then_some(&progress.effects_s),
                    "cpu_s_by_phase": progress.cpu_s,
                    "simd": self.simd_name(),
                    "gaussians": self.state.field.gaussians.len(),
                    "psnr_training_views": progress.psnr,
                    "work": (progress.work.views > 0).then_some(progress.work),
                    "rolled_back": rolled_back,
                    "effects": progress.effects,
                    "goals": self.goals_record(),
                    "from": progress.source,
                })),
            }),
            settings: Some(json!(config)),
            images: self.state.field.record.images.clone(),
            curve: (!progress.curve.points.is_empty()).then(|| json!(progress.curve)),
            // Of what training goes on with, nobody has looked at what it looks like now.
            embeddings: None,
            edits: Vec::new(),
            notes: members(json!({
                "generator": { "name": "cif", "version": env!("CARGO_PKG_VERSION") },
                "dataset": {
                    "layout": dataset.layout,
                    "frames": dataset.frames.len(),
                    "training_frames": self.state.frames.len(),
                    "times": dataset.times.len(),
                    "instances": dataset.instances.len(),
                    "masks": masks,
                },
            })),
        }
    }
}

/// Largest resident memory of this process so far, MB; `None` where the system does not report it.
pub(super) fn peak_rss_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kibibytes: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kibibytes * 1024.0 / 1e6)
}
