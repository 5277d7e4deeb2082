//! Renders the held-out frames of a capture and scores them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Instant;

use cif_dataset::{Dataset, Frame, FrameData, Split};
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_geometry::stats::mean;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, OccupancySource, RenderSettings, RenderedImage};
use serde::Serialize;

use crate::config::TrainConfig;
use crate::heads::Decoder;

use super::color_fit::fitted;
use super::covisible::TrainingViews;
use super::image::{masked_psnr, psnr, ssim, unit_color};
use super::instance::{FrameConfusion, InstanceMetrics, instance_metrics};
use super::panoptic::{PanopticMetrics, panoptic_metrics, with_background};

/// Frames to score, and settings by which they are rendered.
#[derive(Clone, Copy)]
pub struct EvaluationOptions<'a> {
    /// Frames to score.
    pub split: Split,
    /// Render settings; typically [`trained_settings`].
    pub settings: RenderSettings,
    /// Vector instructions.
    pub simd: SimdLevel,
    /// Also render depth, for pictures.
    pub depth: bool,
    /// Also score over the pixels that training views show, see [`super::covisible`]; renders them first.
    pub covisible: bool,
    /// Head that labels pixels; `None` where the identity rows do.
    pub decoder: Option<&'a Decoder>,
}

impl EvaluationOptions<'_> {
    /// The held-out frames, rendered as the field says.
    #[must_use]
    pub fn held_out(field: &Field) -> Self {
        let settings = trained_settings(field);
        Self {
            split: Split::Val,
            settings,
            simd: SimdLevel::Auto,
            depth: false,
            covisible: false,
            decoder: None,
        }
    }
}

/// Errors of scoring a capture.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvaluationError {
    /// A frame could not be read.
    #[error(transparent)]
    Dataset(#[from] cif_dataset::Error),
    /// The split is empty.
    #[error("{}: the {split} split holds no frame, so there is nothing to score", root.display())]
    NoFrames {
        /// Capture.
        root: PathBuf,
        /// Name of the split.
        split: &'static str,
    },
}

/// One frame with its truth and render, for pictures.
#[derive(Clone, Copy, Debug)]
pub struct FrameView<'a> {
    /// Frame of the capture.
    pub frame: &'a Frame,
    /// Captured image and mask.
    pub truth: &'a FrameData,
    /// Render of the same view and time.
    pub rendered: &'a RenderedImage,
    /// Predicted mask ids, where the field has identities.
    pub predicted: Option<&'a PixelGrid<u16>>,
    /// Scores.
    pub scores: &'a FrameScores,
}

/// Scores of one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameScores {
    /// Frame of the capture.
    pub name: String,
    /// Named group inside the split.
    pub group: Option<String>,
    /// Normalised time.
    pub time: f64,
    /// dB; `None` when the pictures agree exactly.
    pub psnr: Option<f64>,
    /// The same of the mean look, without the exposure of the camera; `None` where no exposures were learnt, too.
    pub psnr_mean_look: Option<f64>,
    /// The same with the colours fitted to those of the image by an affine map.
    pub psnr_color_fitted: Option<f64>,
    /// The same over co-visible pixels; `None` when they agree exactly, there are none, or nobody asked.
    pub psnr_covisible: Option<f64>,
    /// Percent of the pixels that are co-visible; `None` when nobody asked.
    pub covisible: Option<f64>,
    /// Structural similarity.
    pub ssim: f64,
    /// Percent of labelled pixels predicted right; `None` without labelled pixels or identities.
    pub macc_pix: Option<f64>,
    /// Wall time of the render, milliseconds.
    pub render_ms: f64,
}

/// Scores of a set of frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scores {
    /// Frames in the set.
    pub frames: usize,
    /// Mean over images with a finite value, dB.
    pub psnr: Option<f64>,
    /// The same of the mean look, without the exposures of cameras; `None` where none were learnt.
    pub psnr_mean_look: Option<f64>,
    /// The same with the colours of each image fitted to its truth by an affine map.
    pub psnr_color_fitted: Option<f64>,
    /// The same over co-visible pixels.
    pub psnr_covisible: Option<f64>,
    /// Mean percent of the pixels that are co-visible.
    pub covisible: Option<f64>,
    /// Images left out of the mean because they agree exactly.
    pub psnr_infinite: usize,
    /// Mean over images.
    pub ssim: Option<f64>,
    /// Instance metrics over the frames that have a mask.
    #[serde(flatten)]
    pub instance: InstanceMetrics,
    /// The same with what is unlabelled as background.
    pub panoptic: PanopticMetrics,
}

/// Scores of a field on a capture.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// All frames of the split.
    pub overall: Scores,
    /// The same per named group (`interp`, `novel`), where the capture has groups.
    pub groups: BTreeMap<String, Scores>,
    /// Every frame, in capture order.
    pub frames: Vec<FrameScores>,
    /// Gaussians of the field.
    pub gaussians: usize,
    /// Mean wall time of a render, milliseconds.
    pub render_ms_per_frame: f64,
    /// Frames that were compared as their camera was learnt to expose; `None` where no exposures were learnt. The
    /// other frames are compared with what the average camera sees.
    pub exposed_frames: Option<usize>,
}

/// Confusion counts of one frame.
#[derive(Clone)]
struct Confusions {
    /// Of the most likely instances, for scores on labelled pixels.
    labelled: FrameConfusion,
    /// Of the same where they are more likely than the background.
    panoptic: FrameConfusion,
}

/// Renders and scores every frame of a split; `observe` sees each one.
///
/// # Errors
/// When the split is empty, a frame cannot be read, or `observe` fails.
pub fn evaluate<E: From<EvaluationError>>(
    field: &Field,
    dataset: &Dataset,
    options: &EvaluationOptions<'_>,
    mut observe: impl FnMut(FrameView<'_>) -> Result<(), E>,
) -> Result<Evaluation, E> {
    let mut renderer = Renderer::new(options.simd);
    let drawing = &field.record.drawing;
    let mut exposed_frames = 0;
    let by_rows = options.settings.instances.is_some() && options.decoder.is_none();
    let channels = Channels { depth: options.depth || options.covisible, instances: by_rows };
    let training_views =
        options.covisible.then(|| TrainingViews::of(field, dataset, &options.settings, &mut renderer));
    let mut frames: Vec<FrameScores> = Vec::new();
    let mut confusions: Vec<Option<Confusions>> = Vec::new();
    for (index, frame) in dataset.frames.iter().enumerate().filter(|(_, f)| f.split == options.split) {
        let truth =
            dataset.load_frame(index, options.settings.background).map_err(EvaluationError::Dataset)?;
        let start = Instant::now();
        let mut rendered = renderer.render(field, &frame.camera, frame.time, &options.settings, channels);
        if let Some(decoder) = options.decoder.filter(|decoder| decoder.tells_labels()) {
            let view = (&frame.camera, frame.time);
            let decoded = decoder.instances(&mut renderer, field, view, &options.settings, &rendered);
            rendered.instances = Some(decoded);
        }
        let render_ms = start.elapsed().as_secs_f64() * 1e3;
        let target = unit_color(&truth.image);
        let is_finite = |value: &f64| *value != f64::INFINITY;
        let mean_look = drawing.has_exposures().then(|| psnr(&rendered.color, &target));
        if let Some(exposure) = drawing.exposure(&frame.camera_name, frame.time) {
            exposure.apply(&mut rendered.color);
            exposed_frames += 1;
        }
        let predicted = rendered.instances.as_ref().map(|instances| mask_ids(field, &instances.label));
        let confusion = confusions_of(frame, &truth, &rendered, predicted.as_ref());
        let shown = training_views.as_ref().map(|views| views.show(&frame.camera, &rendered));
        if !options.depth {
            rendered.depth = None;
        }
        let covisible = shown.as_ref().map(|shown| {
            let count = shown.pixels.iter().filter(|shown| **shown).count();
            100.0 * count as f64 / shown.pixels.len() as f64
        });
        let psnr_covisible = shown.and_then(|shown| masked_psnr(&rendered.color, &target, &shown));
        let scores = FrameScores {
            name: frame.name.clone(),
            group: frame.group.clone(),
            time: frame.time,
            psnr: Some(psnr(&rendered.color, &target)).filter(is_finite),
            psnr_mean_look: mean_look.filter(is_finite),
            psnr_color_fitted: Some(psnr(&fitted(&rendered.color, &target), &target)).filter(is_finite),
            psnr_covisible: psnr_covisible.filter(is_finite),
            covisible,
            ssim: ssim(&rendered.color, &target),
            macc_pix: confusion.as_ref().and_then(|c| c.labelled.pixel_accuracy()).map(|v| v * 100.0),
            render_ms,
        };
        observe(FrameView {
            frame,
            truth: &truth,
            rendered: &rendered,
            predicted: predicted.as_ref(),
            scores: &scores,
        })?;
        frames.push(scores);
        confusions.push(confusion);
    }
    if frames.is_empty() {
        let split = match options.split {
            Split::Train => "train",
            Split::Val => "val",
        };
        return Err(EvaluationError::NoFrames { root: dataset.root.clone(), split }.into());
    }
    let (overall, groups) = summed_up(&frames, &confusions);
    let render_ms_per_frame = frames.iter().map(|f| f.render_ms).sum::<f64>() / frames.len() as f64;
    Ok(Evaluation {
        overall,
        groups,
        gaussians: field.gaussians.len(),
        render_ms_per_frame,
        frames,
        exposed_frames: drawing.has_exposures().then_some(exposed_frames),
    })
}

/// Confusions of a frame; `None` without a mask, or without predicted ids.
fn confusions_of(
    frame: &Frame,
    truth: &FrameData,
    rendered: &RenderedImage,
    predicted: Option<&PixelGrid<u16>>,
) -> Option<Confusions> {
    let (mask, predicted) = truth.mask.as_ref().zip(predicted)?;
    let layers = rendered.instances.as_ref()?;
    let of = |predicted: &PixelGrid<u16>| {
        FrameConfusion::new(&frame.camera_name, frame.time_index, mask, predicted)
    };
    Some(Confusions {
        labelled: of(predicted),
        panoptic: of(&with_background(predicted, &layers.foreground)),
    })
}

/// Scores of all frames, and of each group of them.
fn summed_up(
    frames: &[FrameScores],
    confusions: &[Option<Confusions>],
) -> (Scores, BTreeMap<String, Scores>) {
    let select = |group: Option<&str>| {
        let chosen = |scores: &FrameScores| group.is_none() || scores.group.as_deref() == group;
        let confusions: Vec<Confusions> = frames
            .iter()
            .zip(confusions)
            .filter(|(scores, _)| chosen(scores))
            .filter_map(|(_, confusion)| confusion.clone())
            .collect();
        scores_of(frames.iter().filter(|scores| chosen(scores)), &confusions)
    };
    let names: BTreeSet<&str> = frames.iter().filter_map(|f| f.group.as_deref()).collect();
    let groups = names.into_iter().map(|name| (name.to_owned(), select(Some(name)))).collect();
    (select(None), groups)
}

/// The settings that a field was trained with; `None` for a field of other origin.
#[must_use]
pub fn training_config(field: &Field) -> Option<TrainConfig> {
    TrainConfig::recorded(field.record.settings.clone()?).ok()
}

/// Render settings that repeat those of the training run, as the record of the field has them.
#[must_use]
pub fn trained_settings(field: &Field) -> RenderSettings {
    let mut settings = RenderSettings::of_field(field);
    let drawing = &field.record.drawing;
    settings.near = drawing.near.unwrap_or(settings.near);
    settings.antialiased = drawing.antialiased.unwrap_or(settings.antialiased);
    if let (Some(instances), true) = (&mut settings.instances, drawing.opacity_is_occupancy) {
        instances.occupancy = OccupancySource::Opacity;
    }
    settings
}

/// Mask ids of a label map (dense index + 1, 0 = unlabelled).
#[must_use]
pub fn mask_ids(field: &Field, labels: &PixelGrid<u16>) -> PixelGrid<u16> {
    labels.map(|&label| match label {
        cif_render::UNLABELLED => 0,
        label => field.instances[usize::from(label) - 1].id,
    })
}

fn scores_of<'a>(frames: impl Iterator<Item = &'a FrameScores>, confusions: &[Confusions]) -> Scores {
    let frames: Vec<&FrameScores> = frames.collect();
    let of = |pick: fn(&Confusions) -> &FrameConfusion| -> Vec<FrameConfusion> {
        confusions.iter().map(pick).cloned().collect()
    };
    let mean_of = |pick: fn(&FrameScores) -> Option<f64>| {
        mean(&frames.iter().filter_map(|scores| pick(scores)).collect::<Vec<_>>())
    };
    let finite: Vec<f64> = frames.iter().filter_map(|f| f.psnr).collect();
    Scores {
        frames: frames.len(),
        psnr: mean(&finite),
        psnr_mean_look: mean_of(|scores| scores.psnr_mean_look),
        psnr_color_fitted: mean_of(|scores| scores.psnr_color_fitted),
        psnr_covisible: mean_of(|scores| scores.psnr_covisible),
        covisible: mean_of(|scores| scores.covisible),
        psnr_infinite: frames.len() - finite.len(),
        ssim: mean(&frames.iter().map(|f| f.ssim).collect::<Vec<_>>()),
        instance: instance_metrics(&of(|confusions| &confusions.labelled)),
        panoptic: panoptic_metrics(&of(|confusions| &confusions.panoptic)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(psnr: Option<f64>, ssim: f64) -> FrameScores {
        FrameScores {
            name: "f".into(),
            group: None,
            time: 0.0,
            psnr,
            psnr_mean_look: psnr.map(|value| value - 1.0),
            psnr_color_fitted: psnr.map(|value| value + 2.0),
            psnr_covisible: psnr.map(|value| value + 1.0),
            covisible: Some(50.0),
            ssim,
            macc_pix: None,
            render_ms: 1.0,
        }
    }

    #[test]
    fn exact_pictures_are_counted_and_left_out_of_the_mean() {
        let frames = [frame(Some(20.0), 0.5), frame(None, 1.0), frame(Some(30.0), 0.9)];
        let scores = scores_of(frames.iter(), &[]);
        assert_eq!((scores.psnr, scores.psnr_infinite, scores.frames), (Some(25.0), 1, 3));
        assert_eq!((scores.psnr_covisible, scores.covisible), (Some(26.0), Some(50.0)));
        assert_eq!((scores.psnr_mean_look, scores.psnr_color_fitted), (Some(24.0), Some(27.0)));
        assert!((scores.ssim.unwrap() - 0.8).abs() < 1e-12);
        assert_eq!(scores.instance, InstanceMetrics::default());
    }

    #[test]
    fn only_exact_pictures_leave_no_mean() {
        assert_eq!(scores_of([frame(None, 1.0)].iter(), &[]).psnr, None);
    }
}
