//! Views rendered on the device between steps; its twin is `trainer/draw.rs`.

use cif_field::Field;
use cif_render::RenderedImage;
use cif_render::wgpu::{
    Commands, DeviceIdentities, Gpu, GpuDeformation, GpuError, GpuGaussians, PosedInput, ViewInput,
};

use super::super::Trainer;
use super::super::draw::Views;
use super::DeviceTraining;
use super::resident::ResidentDeformation;
use crate::error::TrainError;

impl Trainer {
    /// What [`Trainer::draw`] does, on the device.
    pub(in crate::trainer) fn draw_on_device(
        &mut self,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(()) };
        let drawn = self.draw_with(&mut device, trial, views, each);
        self.device = Some(device);
        drawn.map_err(|error| self.device_failed(error))
    }

    fn draw_with(
        &mut self,
        device: &mut DeviceTraining,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        self.send(device)?;
        let DeviceTraining { gpu, rasterizer, resident, stale, .. } = device;
        let Some(resident) = resident else { return Ok(()) };
        let stand_in = match trial {
            Some(trial) => {
                // What the network leaves alone is put right before the next step.
                stale.gaussians = true;
                Some(StandIn::new(gpu, trial, resident.deformation.as_mut())?)
            }
            None => None,
        };
        let field = trial.unwrap_or(&self.field);
        let identities = match &field.identities {
            Some(rows) if views.channels.instances => {
                Some(DeviceIdentities::from_identities(gpu, rows, field.instances.len())?)
            }
            _ => None,
        };
        let settings = cif_render::RenderSettings {
            instances: views.settings.instances.filter(|_| identities.is_some()),
            ..*views.settings
        };
        for index in views.frames {
            let frame = &self.dataset.frames[*index];
            let input = ViewInput { camera: &frame.camera, settings: &settings, labels: None };
            let mut commands = Commands::new(gpu, None);
            let posed = match &stand_in {
                Some(stand_in) => {
                    let of_field = resident.deformation.as_ref().map(|resident| &resident.parameters);
                    stand_in.pose(gpu, &mut commands, frame.time, of_field)
                }
                None => resident.pose(gpu, &mut commands, frame.time),
            };
            let drawn =
                rasterizer.draw(gpu, commands, posed, identities.as_ref(), &input, views.channels.depth)?;
            gpu.check()?;
            each(self.recorded(*index, drawn));
        }
        Ok(())
    }
}

/// Gaussians of a trial. The field's own planes and network move them where the trial has those, too.
struct StandIn {
    canonical: GpuGaussians,
    posed: GpuGaussians,
    deformation: Option<GpuDeformation>,
    moves: bool,
}

impl StandIn {
    fn new(gpu: &Gpu, trial: &Field, of_field: Option<&mut ResidentDeformation>) -> Result<Self, GpuError> {
        let n = trial.len();
        let mut posed = GpuGaussians::zeros(gpu, 0)?;
        let mut own = None;
        if let Some(deformation) = &trial.deformation {
            posed.geometry.resize(gpu, n)?;
            posed.sh.resize(gpu, if deformation.config.heads.sh { n } else { 0 })?;
            match of_field.filter(|resident| *resident.parameters.config() == deformation.config) {
                Some(resident) => resident.parameters.set_still(gpu, &deformation.still)?,
                None => own = Some(GpuDeformation::new(gpu, deformation)?),
            }
        }
        Ok(Self {
            canonical: GpuGaussians::upload(gpu, &trial.gaussians)?,
            posed,
            deformation: own,
            moves: trial.deformation.is_some(),
        })
    }

    fn pose<'a>(
        &'a self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        time: f64,
        of_field: Option<&GpuDeformation>,
    ) -> PosedInput<'a> {
        match self.deformation.as_ref().or(of_field) {
            Some(deformation) if self.moves => {
                deformation.pose(gpu, commands, time, &self.canonical, &self.posed)
            }
            _ => (&self.canonical).into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use cif_render::{Channels, RenderSettings};

    use super::super::tests::{step, trainer};
    use super::*;
    use crate::events::{Stage, TrainEvent};
    use cif_render::wgpu::testing;

    fn drawn(trainer: &mut Trainer, trial: Option<&Field>) -> Vec<RenderedImage> {
        let settings = RenderSettings {
            instances: trainer.field.identities.as_ref().map(|_| trainer.instance_settings()),
            ..trainer.color_settings()
        };
        let views = Views {
            frames: &[0, 1, 3, 4],
            settings: &settings,
            channels: Channels { depth: true, instances: settings.instances.is_some() },
        };
        let mut images = Vec::new();
        trainer.draw(trial, views, &mut |image| images.push(image)).unwrap();
        images
    }

    /// The same on the processor, which has what was fetched last.
    fn on_processor<T>(trainer: &mut Trainer, work: impl FnOnce(&mut Trainer) -> T) -> T {
        let device = trainer.device.take();
        let result = work(trainer);
        trainer.device = device;
        result
    }

    fn assert_alike(found: &[RenderedImage], expected: &[RenderedImage], what: &str) {
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            let (a, b) = (found.color.pixels.as_flattened(), expected.color.pixels.as_flattened());
            let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum();
            assert!(sum / (a.len() as f64) < 1e-5, "{what}: colours differ by {sum} in all");
            assert_eq!(found.instances.is_some(), expected.instances.is_some());
            if let (Some(a), Some(b)) = (&found.instances, &expected.instances) {
                let differ = a.label.pixels.iter().zip(&b.label.pixels).filter(|(a, b)| a != b).count();
                assert!(differ < 5, "{what}: {differ} labels differ");
            }
        }
    }

    #[test]
    fn views_between_steps_are_those_of_the_processor() {
        let Some(gpu) = testing::gpu() else { return };
        let (mut trainer, _folder) = trainer(Some(&gpu));
        // A fine stage with a little motion.
        while trainer.stage() != Stage::Fine || trainer.iteration() < 4 {
            if trainer.iteration() == 6 {
                trainer.fetch_from_device().unwrap();
                trainer.enter(Stage::Fine).unwrap();
            }
            step(&mut trainer).0.unwrap();
        }
        trainer.fetch_from_device().unwrap();
        let of_field = drawn(&mut trainer, None);
        let expected = on_processor(&mut trainer, |trainer| drawn(trainer, None));
        assert_alike(&of_field, &expected, "the field");

        let mut still = trainer.field.clone();
        let n = still.len();
        let deformation = still.deformation.as_mut().unwrap();
        deformation.still = (0..n).map(|row| row % 3 != 0).collect();
        let mut headless = trainer.field.clone();
        let deformation = headless.deformation.as_mut().unwrap();
        let layout = deformation.config.mlp_layout();
        let last = layout.heads.last().unwrap();
        assert_eq!(last.output.biases.end, deformation.mlp.len());
        deformation.mlp.truncate(last.hidden.weights.start);
        deformation.config.heads.rotation = false;
        headless.validate().unwrap();
        let mut shrunk = trainer.field.clone();
        shrunk.deformation = None;
        for scales in &mut shrunk.gaussians.log_scales {
            scales[0] -= 1.0;
        }
        for (what, trial) in [("still", &still), ("without a head", &headless), ("without motion", &shrunk)] {
            let found = drawn(&mut trainer, Some(trial));
            let expected = on_processor(&mut trainer, |trainer| drawn(trainer, Some(trial)));
            assert_alike(&found, &expected, what);
            // The field is as it was, and so are the steps after it.
            assert!(drawn(&mut trainer, None) == of_field, "{what} leaves a trace");
        }
        trainer.estimate_identities(true).unwrap();
        trainer.begin(Stage::Instance);
        step(&mut trainer).0.unwrap();
        trainer.fetch_from_device().unwrap();
        let found = drawn(&mut trainer, None);
        assert!(found[0].instances.is_some() && found[0].depth.is_some());
        let expected = on_processor(&mut trainer, |trainer| drawn(trainer, None));
        assert_alike(&found, &expected, "with instances");
        let scores = [false, true].map(|processor| {
            let score = |trainer: &mut Trainer| match trainer.evaluate(Stage::Instance).unwrap() {
                TrainEvent::Evaluated { frames, psnr, ssim, miou, .. } => (frames, psnr, ssim, miou),
                other => panic!("{other:?}"),
            };
            if processor { on_processor(&mut trainer, score) } else { score(&mut trainer) }
        });
        let [(frames, psnr, ssim, miou), (_, other_psnr, other_ssim, other_miou)] = scores;
        let close = |a: Option<f64>, b: Option<f64>| (a.unwrap() - b.unwrap()).abs() < 1e-2;
        assert!(frames > 0 && close(psnr, other_psnr) && close(ssim, other_ssim), "{scores:?}");
        assert!((miou.unwrap() - other_miou.unwrap()).abs() < 1.0, "{scores:?}");
    }
}
