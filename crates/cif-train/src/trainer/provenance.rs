//! How a field came about, as recorded in it.

use serde_json::{Value, json};

use super::Trainer;
use crate::events::Stage;

impl Trainer {
    /// The record: settings, capture, steps, times, memory, versions.
    pub(super) fn provenance(&self) -> Value {
        let dataset = &self.dataset;
        let masks = dataset.frames.iter().find_map(|frame| frame.mask.as_ref()).and_then(|mask| {
            let folder = mask.strip_prefix(&dataset.root).ok().unwrap_or(mask).components().next()?;
            folder.as_os_str().to_str().map(str::to_owned)
        });
        let mut record = json!({
            "generator": { "name": "cif", "version": env!("CARGO_PKG_VERSION") },
            "dataset": {
                "name": dataset.root.file_name().and_then(|name| name.to_str()),
                "layout": dataset.layout,
                "frames": dataset.frames.len(),
                "training_frames": self.frames.len(),
                "times": dataset.times.len(),
                "instances": dataset.instances.len(),
                "masks": masks,
            },
            "train": {
                "complete": self.progress.stage == Stage::Done,
                "preset": self.config.preset,
                "seed": self.config.seed,
                "iterations": self.progress.total_steps,
                "iterations_by_stage": self.progress.steps,
                "wall_s": self.progress.total_wall_s(),
                "wall_s_by_stage": self.progress.wall_s,
                "cpu_s": self.progress.total_cpu_s(),
                "cpu_s_by_stage": self.progress.cpu_s,
                "peak_rss_mb": peak_rss_mb(),
                "simd": self.simd_name(),
                "gaussians": self.field.gaussians.len(),
                "psnr_training_views": self.progress.psnr,
                "work": (self.progress.work.views > 0).then_some(self.progress.work),
            },
            "config": self.config,
        });
        if !dataset.frame.is_identity() {
            record["dataset"]["frame"] = json!(dataset.frame);
        }
        if !self.progress.rollbacks.is_empty() {
            let rollbacks = &self.progress.rollbacks;
            record["train"]["rolled_back"] = json!({ "steps": rollbacks.total, "last": rollbacks.last });
        }
        if let Some(effects) = &self.progress.effects {
            record["train"]["effects"] = effects.clone();
        }
        if let Some(exposures) = &self.progress.exposures {
            record["train"]["exposures"] = json!(exposures.by_camera());
        }
        if !self.progress.curve.points.is_empty() {
            record["curve"] = json!(self.progress.curve);
        }
        let goals = self.goals_record();
        if !goals.is_null() {
            record["train"]["goals"] = goals;
        }
        if let Some(source) = &self.progress.source {
            record["train"]["from"] = json!(source);
        }
        record
    }
}

/// Largest resident memory of this process so far, MB; `None` where the system does not tell.
pub(super) fn peak_rss_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kibibytes: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kibibytes * 1024.0 / 1e6)
}
