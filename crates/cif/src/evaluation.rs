//! Scores of a scene on the frames of a capture, as `cif eval` and Python report them.

use std::time::Instant;

use cif_dataset::{Dataset, MotionTruth};
use cif_field::Field;
use cif_scene::motion_scores::{MotionScores, motion_scores};
use cif_scene::{SceneError, SceneOptions};
use cif_train::metrics::{Evaluation, Scores};
use serde::Serialize;
use serde_json::{Value, json};

pub use crate::commands::shared::scene::load_with_head;
use crate::error::Error;

/// Measured motion of a scene.
#[derive(Debug, Serialize)]
pub struct Motion {
    #[serde(flatten)]
    pub(crate) scores: MotionScores,
    /// Wall-clock time of building the scene graph and measuring it.
    pub(crate) seconds: f64,
}

/// Builds the scene graph of a field, as `cif export` would write it, and measures its motion against followed points;
/// the inner error says why there is nothing to measure.
///
/// # Errors
/// When a mask cannot be decoded, or the field is inconsistent.
pub fn motion_of(
    field: &Field,
    dataset: &Dataset,
    truth: &MotionTruth,
) -> Result<Result<Motion, String>, Error> {
    let start = Instant::now();
    // Stand-ins and colliders are not measured.
    let options = SceneOptions { proxy_points: 0, hulls_per_instance: 0, ..SceneOptions::default() };
    let graph = match cif_scene::build(field, &options) {
        Ok(graph) => graph,
        Err(error @ SceneError::NoGaussians { .. }) => return Ok(Err(error.to_string())),
        Err(error) => return Err(Error::plain(error)),
    };
    let seen = truth.seen_steps(dataset).map_err(Error::plain)?;
    let scores = motion_scores(&graph, truth, &seen);
    if scores.moving.is_none() && scores.resting.is_none() {
        return Ok(Err("no instance with followed points is in the scene and seen at two times".to_owned()));
    }
    Ok(Ok(Motion { scores, seconds: start.elapsed().as_secs_f64() }))
}

/// All scores as JSON: those of `cif eval --json`. `head` names the head that decoded the labels of pixels, where the
/// identity rows did not.
#[must_use]
pub fn report_of(
    evaluation: &Evaluation,
    motion: Option<&Motion>,
    field: &Field,
    head: Option<&'static str>,
) -> Value {
    let mut report = scores_json(&evaluation.overall, field);
    let groups: serde_json::Map<String, Value> =
        evaluation.groups.iter().map(|(name, scores)| (name.clone(), scores_json(scores, field))).collect();
    let run = field.record.run.clone().unwrap_or_default();
    report["groups"] = Value::Object(groups);
    report["per_frame"] = json!(evaluation.frames);
    report["motion"] = json!(motion);
    report["labels_by"] = json!(head.unwrap_or("identity rows"));
    report["gaussians"] = json!(evaluation.gaussians);
    report["frames_with_exposure"] = json!(evaluation.exposed_frames);
    report["render_ms_per_frame"] = json!(evaluation.render_ms_per_frame);
    report["train"] = json!({
        "wall_s": run.wall_s,
        "iterations": run.iterations,
        "preset": run.preset,
        "peak_rss_mb": run.peak_rss_mb,
        "seed": run.seed,
    });
    report
}

fn scores_json(scores: &Scores, field: &Field) -> Value {
    let instance = &scores.instance;
    let instances: Vec<Value> = instance
        .instances
        .iter()
        .map(|score| {
            let mut value = json!(score);
            value["label"] = json!(label_of(field, score.id));
            value["panoptic_iou"] = json!(scores.panoptic.instances.get(&score.id));
            value
        })
        .collect();
    json!({
        "frames": scores.frames,
        "psnr": scores.psnr,
        "psnr_covisible": scores.psnr_covisible,
        "covisible": scores.covisible,
        "ssim": scores.ssim,
        "panoptic": {
            "quality": scores.panoptic.quality,
            "segmentation": scores.panoptic.segmentation,
            "recognition": scores.panoptic.recognition,
            "iou": scores.panoptic.iou,
        },
        "macc_pix": instance.macc_pix,
        "macc_inst": instance.macc_inst,
        "miou": instance.miou,
        "variants": {
            "psnr_infinite": scores.psnr_infinite,
            "macc_pix_pooled": instance.macc_pix_pooled,
            "macc_inst_pooled": instance.macc_inst_pooled,
            "miou_per_instance_first": instance.miou_per_instance_first,
            "miou_with_fp": instance.miou_with_fp,
            "miou_all_pixels": instance.miou_all_pixels,
            "tube_iou": instance.tube_iou,
            "id_switches_per_100": instance.id_switches_per_100,
            "association_quality": instance.association_quality,
        },
        "instances": instances,
    })
}

/// Label of a mask id as the scene has it.
pub(crate) fn label_of(field: &Field, id: u16) -> String {
    let known = field.instances.iter().find(|instance| instance.id == id);
    known.map_or_else(|| format!("instance_{id} (not trained)"), |instance| instance.label.clone())
}
