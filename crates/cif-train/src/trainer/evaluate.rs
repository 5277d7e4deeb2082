//! Scores on held-out frames while training goes on.

use cif_dataset::Split;
use cif_render::{Channels, RenderSettings};

use super::Trainer;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::metrics::evaluate::mask_ids;
use crate::metrics::image::{psnr, ssim, unit_color};
use crate::metrics::{FrameConfusion, instance_metrics};

impl Trainer {
    /// Scores evenly spread held-out frames.
    pub(super) fn evaluate(&mut self, stage: Stage) -> Result<TrainEvent, TrainError> {
        let held_out: Vec<usize> = (0..self.dataset.frames.len())
            .filter(|index| self.dataset.frames[*index].split == Split::Val)
            .collect();
        let count = held_out.len().min(self.config.report.evaluate_frames as usize);
        let settings = RenderSettings {
            instances: self.field.identities.as_ref().map(|_| self.instance_settings()),
            ..self.color_settings()
        };
        let channels = Channels { depth: false, instances: settings.instances.is_some() };
        let (mut psnrs, mut ssims, mut confusions) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..count {
            let index = held_out[k * held_out.len() / count];
            let frame = &self.dataset.frames[index];
            let truth = self.dataset.load_frame(index, self.config.background)?;
            let rendered = self.renderer.render(&self.field, &frame.camera, frame.time, &settings, channels);
            let target = unit_color(&truth.image);
            psnrs.push(psnr(&rendered.color, &target));
            ssims.push(ssim(&rendered.color, &target));
            if let (Some(mask), Some(instances)) = (&truth.mask, &rendered.instances) {
                let predicted = mask_ids(&self.field, &instances.label);
                confusions.push(FrameConfusion::new(&frame.camera_name, frame.time_index, mask, &predicted));
            }
        }
        let mean =
            |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        let scores = instance_metrics(&confusions);
        Ok(TrainEvent::Evaluated {
            stage,
            iteration: self.progress.iteration,
            frames: count,
            psnr: mean(&psnrs),
            ssim: mean(&ssims),
            miou: scores.miou,
            macc_pix: scores.macc_pix,
        })
    }
}
