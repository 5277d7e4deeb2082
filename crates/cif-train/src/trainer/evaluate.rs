//! Scores while training goes on: on held-out frames when asked, and the points of the run's curve.

use cif_dataset::{Dataset, FrameData, Split};
use cif_render::{Channels, RenderSettings};

use super::Trainer;
use crate::clock::Seconds;
use crate::config::TrainConfig;
use crate::curve::{CurveFrames, CurvePoint};
use crate::engine::Views;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::metrics::evaluate::mask_ids;
use crate::metrics::image::{psnr, ssim, unit_color};
use crate::metrics::panoptic::{panoptic_metrics, with_background};
use crate::metrics::{FrameConfusion, instance_metrics};
use crate::phase::Phase;
use crate::stage::Stage;

/// PSNR that equal images count as, dB.
const MAX_PSNR: f64 = 100.0;

/// Least training frames per withheld one.
const FRAMES_PER_WITHHELD: usize = 4;

/// Frames that the curve is measured on, decoded once.
#[derive(Default)]
pub(super) struct MeasuredFrames {
    /// Training frames that are not trained on, as indices of the capture.
    withheld: Vec<usize>,
    /// Index in the capture, and what was captured; none before the first point.
    decoded: Option<Vec<(usize, FrameData)>>,
}

/// Means over frames.
struct MeanScores {
    psnr: Option<f64>,
    ssim: Option<f64>,
    iou: Option<f64>,
    miou: Option<f64>,
    macc_pix: Option<f64>,
}

impl MeasuredFrames {
    /// Takes the frames to withhold out of the training split.
    pub(super) fn withhold(dataset: &mut Dataset, config: &TrainConfig) -> Self {
        let of_split = |dataset: &Dataset| -> Vec<usize> {
            let frames = dataset.frames.iter().enumerate();
            frames.filter(|(_, frame)| frame.split == Split::Train).map(|(index, _)| index).collect()
        };
        let training = of_split(dataset);
        let count = (config.report.withhold as usize).min(training.len() / FRAMES_PER_WITHHELD);
        // Frames with masks tell more; where they are few, all of them are needed for training.
        let masked: Vec<usize> =
            training.iter().copied().filter(|index| dataset.frames[*index].mask.is_some()).collect();
        let pool = if masked.len() >= FRAMES_PER_WITHHELD * count { &masked } else { &training };
        let withheld: Vec<usize> = (0..count).map(|k| pool[(2 * k + 1) * pool.len() / (2 * count)]).collect();
        for index in &withheld {
            dataset.frames[*index].split = Split::Val;
        }
        Self { withheld, decoded: None }
    }

    /// True when a frame belongs to the training split of the capture, though it is not trained on.
    pub(super) fn withholds(&self, index: usize) -> bool {
        self.withheld.contains(&index)
    }

    fn select(&self, dataset: &Dataset, count: usize) -> (CurveFrames, Vec<usize>) {
        let spread = |pool: Vec<usize>| -> Vec<usize> {
            let count = count.min(pool.len());
            (0..count).map(|k| pool[(2 * k + 1) * pool.len() / (2 * count)]).collect()
        };
        let of = |split| -> Vec<usize> {
            let frames = dataset.frames.iter().enumerate();
            frames.filter(|(_, frame)| frame.split == split).map(|(index, _)| index).collect()
        };
        if !self.withheld.is_empty() {
            return (CurveFrames::Withheld, self.withheld.clone());
        }
        match of(Split::Val) {
            held_out if !held_out.is_empty() => (CurveFrames::HeldOut, spread(held_out)),
            _ => (CurveFrames::Training, spread(of(Split::Train))),
        }
    }
}

impl Trainer {
    /// Scores evenly spread held-out frames.
    pub(super) fn evaluate(&mut self, stage: Stage) -> Result<TrainEvent, TrainError> {
        let held_out: Vec<usize> = (0..self.state.dataset.frames.len())
            .filter(|index| {
                self.state.dataset.frames[*index].split == Split::Val
                    && !self.measured_frames.withholds(*index)
            })
            .collect();
        let count = held_out.len().min(self.state.config.report.evaluate_frames as usize);
        let _phase = self.state.phases.enter(Phase::Evaluate, count);
        let frames = (0..count)
            .map(|k| {
                self.check_stop()?;
                let index = held_out[k * held_out.len() / count];
                Ok((index, self.state.capture().load_frame(index, self.state.config.background)?))
            })
            .collect::<Result<Vec<_>, TrainError>>()?;
        let scores = self.score(&frames)?;
        Ok(TrainEvent::Evaluated {
            stage,
            iteration: self.state.progress.iteration,
            frames: count,
            psnr: scores.psnr,
            ssim: scores.ssim,
            iou: scores.iou,
            miou: scores.miou,
            macc_pix: scores.macc_pix,
        })
    }

    /// Measures a point of the curve, where one is due or the stage `ends`.
    pub(super) fn measure_curve(
        &mut self,
        stage: Stage,
        ends: bool,
    ) -> Result<Option<TrainEvent>, TrainError> {
        let count = self.state.config.report.curve_frames.max(self.measured_frames.withheld.len() as u32);
        let (iteration, step) = (self.state.progress.iteration, self.state.progress.total_steps);
        let curve = &self.state.progress.curve;
        let due = curve.is_due(stage, iteration, !self.state.progress.goals.targets.is_empty()) || ends;
        if count == 0 || !due || curve.holds(stage, step) {
            return Ok(None);
        }
        self.fetch()?;
        let before = self.state.phases.spent(Phase::Measure);
        let phase = self.state.phases.enter(Phase::Measure, count as usize);
        let frames = match self.measured_frames.decoded.take() {
            Some(frames) => frames,
            None => {
                let (kind, indices) = self.measured_frames.select(&self.state.dataset, count as usize);
                let name = |index: &usize| self.state.dataset.frames[*index].name.clone();
                self.state.progress.curve.frames = kind;
                self.state.progress.curve.frame_names = indices.iter().map(name).collect();
                let load = |index| {
                    self.check_stop()?;
                    Ok((index, self.state.capture().load_frame(index, self.state.config.background)?))
                };
                indices.into_iter().map(load).collect::<Result<_, TrainError>>()?
            }
        };
        let scores = self.score(&frames)?;
        let Seconds { wall_s, cpu_s } = self.time_of_training();
        let point = CurvePoint {
            stage,
            iteration,
            step,
            wall_s,
            cpu_s,
            gaussians: self.state.field.gaussians.len(),
            psnr: scores.psnr,
            ssim: scores.ssim,
            iou: scores.iou,
            miou: scores.miou,
        };
        let count = frames.len();
        self.measured_frames.decoded = Some(frames);
        self.state.progress.curve.points.push(point.clone());
        drop(phase);
        self.state.progress.curve.measuring += self.state.phases.spent(Phase::Measure) - before;
        let measuring_s = self.state.progress.curve.measuring.wall_s;
        Ok(Some(TrainEvent::Measured { point, frames: count, measuring_s }))
    }

    /// Renders frames of the capture and compares them.
    fn score(&mut self, frames: &[(usize, FrameData)]) -> Result<MeanScores, TrainError> {
        let settings = RenderSettings {
            instances: self.state.field.identities.as_ref().and_then(|_| self.state.instance_settings()),
            ..self.state.color_settings()
        };
        let channels = Channels {
            depth: false,
            instances: settings.instances.is_some() || self.state.started_head().is_some(),
        };
        let (mut psnrs, mut ssims, mut labels) = (Vec::new(), Vec::new(), Vec::new());
        let indices: Vec<usize> = frames.iter().map(|(index, _)| *index).collect();
        let views = Views { frames: &indices, whole: true, settings: &settings, channels };
        let mut truths = frames.iter();
        let phases = self.state.phases.clone();
        self.draw(None, views, &mut |rendered| {
            let Some((_, truth)) = truths.next() else { return };
            phases.advance();
            let target = unit_color(&truth.image);
            psnrs.push(psnr(&rendered.color, &target).min(MAX_PSNR));
            ssims.push(ssim(&rendered.color, &target));
            labels.push(rendered.instances.map(|instances| (instances.label, instances.foreground)));
        })?;
        let (mut confusions, mut with_backgrounds) = (Vec::new(), Vec::new());
        for ((index, truth), labels) in frames.iter().zip(labels) {
            if let (Some(mask), Some((labels, foreground))) = (&truth.mask, labels) {
                let frame = &self.state.dataset.frames[*index];
                let predicted = mask_ids(&self.state.field, &labels);
                let of = |ids| FrameConfusion::new(&frame.camera_name, frame.time_index, mask, ids);
                confusions.push(of(&predicted));
                with_backgrounds.push(of(&with_background(&predicted, &foreground)));
            }
        }
        let mean =
            |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        let scores = instance_metrics(&confusions);
        Ok(MeanScores {
            psnr: mean(&psnrs),
            ssim: mean(&ssims),
            iou: panoptic_metrics(&with_backgrounds).iou,
            miou: scores.miou,
            macc_pix: scores.macc_pix,
        })
    }
}
