//! Scores of a scene on the frames of a capture, as `cif eval` and Python report them.

use std::collections::BTreeMap;
use std::time::Instant;

use cif_dataset::{Dataset, MotionTruth};
use cif_field::Field;
use cif_scene::motion_scores::{MotionScores, motion_scores};
use cif_scene::{SceneError, SceneOptions};
use cif_train::metrics::{Evaluation, FrameScores, InstanceScore, Scores};
use serde::Serialize;

pub use crate::commands::shared::scene::load_with_head;
use crate::error::Error;
use crate::report::JsonReport;

/// Measured motion of a scene.
#[derive(Debug, Serialize)]
pub struct Motion {
    /// Scores.
    #[serde(flatten)]
    pub(crate) scores: MotionScores,
    /// Wall time of building the scene graph and measuring it, seconds.
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

/// Scores of a scene on the frames of a capture.
#[derive(Debug, Serialize)]
pub struct EvaluationReport<'a> {
    #[serde(flatten)]
    overall: GroupReport<'a>,
    /// Scores of every group of frames, by its name; empty where the capture has no groups.
    groups: BTreeMap<&'a str, GroupReport<'a>>,
    /// Scores of every frame.
    per_frame: &'a [FrameScores],
    /// Scores of motion against followed points; null where the capture has none, or nothing could be measured.
    motion: Option<&'a Motion>,
    /// Source of the labels of rendered pixels: `identity rows`, or the name of the head that decoded them.
    labels_by: &'static str,
    /// Gaussians of the scene.
    gaussians: usize,
    /// Frames that were compared with the exposure that training found for their camera; null where it found none.
    frames_with_exposure: Option<usize>,
    /// Mean wall time of rendering a frame, milliseconds.
    render_ms_per_frame: f64,
    /// The run that trained the scene.
    train: RunReport,
}

/// The run that trained a scene, as the scene records it; null where it does not.
#[derive(Debug, Serialize)]
struct RunReport {
    /// Wall time, interruptions not counted, seconds.
    wall_s: Option<f64>,
    /// Optimiser steps of all stages.
    iterations: Option<u64>,
    /// Preset of the settings.
    preset: Option<String>,
    /// Largest resident memory of the process, MB.
    peak_rss_mb: Option<f64>,
    /// Seed of all random numbers.
    seed: Option<u64>,
}

/// Scores of some frames.
#[derive(Debug, Serialize)]
struct GroupReport<'a> {
    /// Frames.
    frames: usize,
    /// Mean PSNR over images that are not equal to their truth, dB.
    psnr: Option<f64>,
    /// The same of the mean look, without the exposures of cameras; null where training learnt none.
    psnr_mean_look: Option<f64>,
    /// The same with the colours of each image fitted to its truth by an affine map.
    psnr_color_fitted: Option<f64>,
    /// The same over co-visible pixels, those that a training view shows; null where it was not asked for.
    psnr_covisible: Option<f64>,
    /// Co-visible pixels, mean percent of an image; null where it was not asked for.
    covisible: Option<f64>,
    /// Mean SSIM.
    ssim: Option<f64>,
    /// Panoptic quality.
    panoptic: PanopticReport,
    /// mAcc-pix: labelled pixels predicted right, mean over the frames, percent.
    macc_pix: Option<f64>,
    /// mAcc-inst: accuracy of an instance, mean over its frames, then over the instances, percent.
    macc_inst: Option<f64>,
    /// mIoU: intersection over union on labelled pixels, mean over pairs of an instance and a frame showing it,
    /// percent.
    miou: Option<f64>,
    /// The same scores by other rules.
    variants: Variants,
    /// Scores of every instance.
    instances: Vec<InstanceReport<'a>>,
}

/// Panoptic quality, percent. Source: Kirillov et al., Panoptic Segmentation (2019).
#[derive(Debug, Serialize)]
struct PanopticReport {
    /// Panoptic quality: `segmentation` times `recognition`.
    quality: Option<f64>,
    /// Mean intersection over union of the segments that match, over the whole image.
    segmentation: Option<f64>,
    /// Matches over the mean of the segments that there are and those that are predicted.
    recognition: Option<f64>,
    /// Mean over pairs of an instance and a frame showing it of the intersection over union, over the whole image.
    iou: Option<f64>,
}

/// Scores by other rules than those that the method reports.
#[derive(Debug, Serialize)]
struct Variants {
    /// Images left out of the mean PSNR because they agree exactly.
    psnr_infinite: usize,
    /// mAcc-pix from summed counts, percent.
    macc_pix_pooled: Option<f64>,
    /// mAcc-inst, each instance's accuracy from summed counts, percent.
    macc_inst_pooled: Option<f64>,
    /// mIoU, mean over the frames of an instance first, then over the instances, percent.
    miou_per_instance_first: Option<f64>,
    /// mIoU where instances predicted on labelled pixels of a frame that does not show them count as 0, percent.
    miou_with_fp: Option<f64>,
    /// mIoU with unions over the whole image instead of labelled pixels, percent.
    miou_all_pixels: Option<f64>,
    /// Mean over instances of summed intersections over summed unions on labelled pixels, percent.
    tube_iou: Option<f64>,
    /// Changes of the majority prediction inside an instance of at least 100 pixels, per 100 pairs of consecutive
    /// frames of one view.
    id_switches_per_100: Option<f64>,
    /// Mean over instances of the association quality, predicted ids taken as tracks, percent.
    association_quality: Option<f64>,
}

/// Scores of an instance.
#[derive(Debug, Serialize)]
struct InstanceReport<'a> {
    #[serde(flatten)]
    score: &'a InstanceScore,
    /// Label, as the scene has it.
    label: String,
    /// Intersection over union over the whole image, percent; null where no frame shows the instance.
    panoptic_iou: Option<&'a f64>,
}

impl JsonReport for EvaluationReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif eval"];
}

/// All scores: those of `cif eval --json`. `head` names the head that decoded the labels of pixels, where the identity
/// rows did not.
#[must_use]
pub fn report_of<'a>(
    evaluation: &'a Evaluation,
    motion: Option<&'a Motion>,
    field: &Field,
    head: Option<&'static str>,
) -> EvaluationReport<'a> {
    let run = field.record.run.clone().unwrap_or_default();
    EvaluationReport {
        overall: group_report(&evaluation.overall, field),
        groups: evaluation
            .groups
            .iter()
            .map(|(name, scores)| (name.as_str(), group_report(scores, field)))
            .collect(),
        per_frame: &evaluation.frames,
        motion,
        labels_by: head.unwrap_or("identity rows"),
        gaussians: evaluation.gaussians,
        frames_with_exposure: evaluation.exposed_frames,
        render_ms_per_frame: evaluation.render_ms_per_frame,
        train: RunReport {
            wall_s: run.wall_s,
            iterations: run.iterations,
            preset: run.preset,
            peak_rss_mb: run.peak_rss_mb,
            seed: run.seed,
        },
    }
}

fn group_report<'a>(scores: &'a Scores, field: &Field) -> GroupReport<'a> {
    let (instance, panoptic) = (&scores.instance, &scores.panoptic);
    let report = |score: &'a InstanceScore| InstanceReport {
        score,
        label: label_of(field, score.id),
        panoptic_iou: panoptic.instances.get(&score.id),
    };
    GroupReport {
        frames: scores.frames,
        psnr: scores.psnr,
        psnr_mean_look: scores.psnr_mean_look,
        psnr_color_fitted: scores.psnr_color_fitted,
        psnr_covisible: scores.psnr_covisible,
        covisible: scores.covisible,
        ssim: scores.ssim,
        panoptic: PanopticReport {
            quality: panoptic.quality,
            segmentation: panoptic.segmentation,
            recognition: panoptic.recognition,
            iou: panoptic.iou,
        },
        macc_pix: instance.macc_pix,
        macc_inst: instance.macc_inst,
        miou: instance.miou,
        variants: Variants {
            psnr_infinite: scores.psnr_infinite,
            macc_pix_pooled: instance.macc_pix_pooled,
            macc_inst_pooled: instance.macc_inst_pooled,
            miou_per_instance_first: instance.miou_per_instance_first,
            miou_with_fp: instance.miou_with_fp,
            miou_all_pixels: instance.miou_all_pixels,
            tube_iou: instance.tube_iou,
            id_switches_per_100: instance.id_switches_per_100,
            association_quality: instance.association_quality,
        },
        instances: instance.instances.iter().map(report).collect(),
    }
}

/// Label of a mask id as the scene has it.
pub(crate) fn label_of(field: &Field, id: u16) -> String {
    let known = field.instances.iter().find(|instance| instance.id == id);
    known.map_or_else(|| format!("instance_{id} (not trained)"), |instance| instance.label.clone())
}
