//! Scores while training goes on: on held-out frames when asked, and the points of the run's curve.

use cif_dataset::{FrameData, Split};
use cif_geometry::stats::mean;
use cif_render::{Channels, RenderSettings};

use super::Trainer;
use crate::clock::Seconds;
use crate::curve::CurvePoint;
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

/// Means over frames.
struct MeanScores {
    psnr: Option<f64>,
    ssim: Option<f64>,
    iou: Option<f64>,
    miou: Option<f64>,
    macc_pix: Option<f64>,
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
                Ok((index, self.state.capture().load_frame(index, self.state.field.background)?))
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
                    Ok((index, self.state.capture().load_frame(index, self.state.field.background)?))
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
