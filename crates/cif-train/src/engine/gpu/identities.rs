//! Label mass for the identity stage, counted on the device.

use cif_render::UNLABELLED;
use cif_render::cpu::IdentityCounts;
use cif_render::wgpu::{Commands, GpuIdentityCounts, ViewInput};

use super::gpu_engine::GpuEngine;
use crate::error::TrainError;
use crate::state::State;
use crate::wgpu::losses::GpuTarget;

impl GpuEngine {
    /// Counts of the training views with labels, and how many there were, where the device holds a table of them; the
    /// state is up to date.
    pub(super) fn count_on_device(
        &mut self,
        state: &mut State,
    ) -> Result<Option<(IdentityCounts, usize)>, TrainError> {
        let (n, instances) = (state.field.gaussians.len(), state.field.instances.len());
        if !GpuIdentityCounts::fits(&self.gpu, n, instances) {
            return Ok(None);
        }
        self.send(state)?;
        let settings = state.color_settings();
        let Self { gpu, rasterizer, targets, resident, .. } = self;
        let Some(resident) = resident else { return Ok(None) };
        let mut counts = GpuIdentityCounts::zeros(gpu, n, instances)?;
        let mut frames = 0;
        for view in state.views_of_identities() {
            let data = state.frame_of_identities(view)?;
            let Some(labels) = data.labels.as_ref().filter(|_| data.labelled > 0) else { continue };
            let mut present: Vec<u16> = labels.pixels.clone();
            present.sort_unstable();
            present.dedup();
            present.retain(|label| *label != UNLABELLED);
            let fresh;
            let target = match targets.get(&(state.frames.index(view), data.image.width)) {
                Some(target) => target,
                None => {
                    fresh = GpuTarget::new(gpu, &data.image, Some(labels))?;
                    &fresh
                }
            };
            let frame = &state.dataset.frames[state.frames.index(view)];
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
            state.add_label_pixels(labels);
            frames += 1;
        }
        Ok(Some((counts.read(gpu)?, frames)))
    }
}
