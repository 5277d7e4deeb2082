//! Label mass for the identity stage, counted on the device; its twin is `trainer/identity.rs`.

use cif_render::UNLABELLED;
use cif_render::cpu::IdentityCounts;
use cif_render::wgpu::{Commands, GpuIdentityCounts, ViewInput};

use super::super::Trainer;
use super::DeviceTraining;
use crate::error::TrainError;
use crate::wgpu::losses::GpuTarget;

impl Trainer {
    /// Counts of the training views with labels, and how many there were, where the device holds a table of them; the
    /// host's field is up to date.
    pub(in crate::trainer) fn count_on_device(
        &mut self,
    ) -> Result<Option<(IdentityCounts, usize)>, TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(None) };
        let counted = self.count_with(&mut device);
        self.device = Some(device);
        counted
    }

    fn count_with(
        &mut self,
        device: &mut DeviceTraining,
    ) -> Result<Option<(IdentityCounts, usize)>, TrainError> {
        let (n, instances) = (self.field.gaussians.len(), self.field.instances.len());
        if !GpuIdentityCounts::fits(&device.gpu, n, instances) {
            return Ok(None);
        }
        self.send(device)?;
        let settings = self.color_settings();
        let DeviceTraining { gpu, rasterizer, targets, resident, .. } = device;
        let Some(resident) = resident else { return Ok(None) };
        let mut counts = GpuIdentityCounts::zeros(gpu, n, instances)?;
        let mut frames = 0;
        for view in (0..self.frames.len()).step_by(self.config.identity.stride as usize) {
            let data = self.frames.get(&self.dataset, view)?;
            let Some(labels) = data.labels.as_ref().filter(|_| data.labelled > 0) else { continue };
            let mut present: Vec<u16> = labels.pixels.clone();
            present.sort_unstable();
            present.dedup();
            present.retain(|label| *label != UNLABELLED);
            let fresh;
            let target = match targets.get(&view) {
                Some(target) => target,
                None => {
                    fresh = GpuTarget::new(gpu, &data.image, Some(labels))?;
                    &fresh
                }
            };
            let frame = &self.dataset.frames[self.frames.index(view)];
            let mut commands = Commands::new(gpu, None);
            let posed = resident.pose(gpu, &mut commands, frame.time);
            let input = ViewInput { camera: &frame.camera, settings: &settings, labels: None };
            rasterizer.project(gpu, &mut commands, posed, None, &input)?;
            // Between steps the host may wait for the room that a view needs.
            rasterizer.measure(gpu, commands)?;
            let mut commands = Commands::new(gpu, None);
            rasterizer.rasterize(gpu, &mut commands, None, None)?;
            counts.add_view(gpu, &mut commands, rasterizer, &target.labels, &present)?;
            commands.submit();
            gpu.check()?;
            self.add_label_pixels(labels);
            frames += 1;
        }
        Ok(Some((counts.read(gpu)?, frames)))
    }
}
