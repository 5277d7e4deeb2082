//! Gradients of a rasterized view.

use super::Rasterizer;
use super::inputs::{LabelInput, PosedInput};
use crate::wgpu::buffers::GpuVec;
use crate::wgpu::device::Gpu;
use crate::wgpu::error::GpuError;
use crate::wgpu::identities::DeviceIdentities;
use crate::wgpu::kernel::{Commands, workgroups};

impl Rasterizer {
    /// Records the gradients of the rasterized view: `v_colors` is dL/dcolour per pixel (the fourth number is not
    /// read), and the instance loss counts as the view's labels said.
    ///
    /// # Errors
    /// When arrays exceed what the device binds, with the arithmetic.
    ///
    /// # Panics
    /// When `v_colors` and the view differ in size.
    pub fn backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        gaussians: PosedInput<'_>,
        identities: Option<&DeviceIdentities>,
        labels: Option<LabelInput<'_>>,
        v_colors: &GpuVec<[f32; 4]>,
    ) -> Result<(), GpuError> {
        assert_eq!(v_colors.len(), self.view.pixels(), "cotangent size");
        self.arrays.cotangents.resize(gpu, 2 * self.view.pixels())?;
        self.reserve_sums(gpu)?;
        self.reserve_gradients(gpu)?;
        if let Some(identities) = identities {
            self.gradients.calibrations.resize(gpu, identities.entries.len())?;
        }
        self.cotangents(gpu, commands, labels, v_colors);
        self.splats_backward(gpu, commands, identities);
        self.project_backward(gpu, commands, gaussians);
        if let Some(identities) = identities.filter(|_| self.view.label_slots != 0) {
            self.calibrations_backward(gpu, commands, identities);
        }
        Ok(())
    }

    /// Records what pixels carry to the splats: gradients of the losses by their colours and blended values.
    fn cotangents(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        labels: Option<LabelInput<'_>>,
        v_colors: &GpuVec<[f32; 4]>,
    ) {
        let (arrays, kernel) = (&self.arrays, &self.kernels.cotangents);
        let label_map = labels.map_or(&arrays.no_labels, |labels| labels.labels);
        let bindings = [
            self.uniform.buffer(),
            arrays.colors.buffer(),
            arrays.blended.buffer(),
            label_map.buffer(),
            v_colors.buffer(),
            arrays.cotangents.buffer(),
        ];
        let cotangents = self.cache.get(gpu, ("cotangents", 0), kernel, &bindings);
        let groups = workgroups(self.view.pixels(), 64);
        commands.stage("cotangents", |stage| stage.dispatch(kernel, &cotangents, groups));
    }

    /// Records the gradients of (tile, splat) pairs, and their sums by splat.
    fn splats_backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: Option<&DeviceIdentities>,
    ) {
        let (view, arrays, kernels) = (self.view, &self.arrays, &self.kernels);
        let (uniform, order) = (self.uniform.buffer(), &arrays.depth.values[self.depth_result]);
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let identity_entries = identities.map_or(&arrays.no_entries, |identities| &identities.entries);
        let (variant, kernel) = match view.label_slots {
            0 => (0, &kernels.rasterize_backward_color),
            _ => (1, &kernels.rasterize_backward),
        };
        let bindings = [
            uniform,
            arrays.splats.buffer(),
            arrays.entries.buffer(),
            arrays.tile_ranges.buffer(),
            rows.buffer(),
            identity_entries.buffer(),
            arrays.cotangents.buffer(),
            arrays.pair_sums.buffer(),
            arrays.label_mass.buffer(),
        ];
        let backward = self.cache.get(gpu, ("rasterize_backward", variant), kernel, &bindings);
        commands.stage("rasterize backward", |stage| {
            stage.dispatch(kernel, &backward, [view.tiles[0], view.tiles[1], 1]);
        });
        let bindings = [
            uniform,
            arrays.splats.buffer(),
            order.buffer(),
            arrays.pair_offsets.buffer(),
            arrays.pairs.buffer(),
            arrays.pair_sums.buffer(),
            arrays.work.buffer(),
            arrays.splat_gradients.buffer(),
        ];
        let gather = self.cache.get(gpu, ("gather_gradients", 0), &kernels.gather_gradients, &bindings);
        let groups = workgroups(view.gaussians as usize, 16);
        commands.stage("gather gradients", |stage| {
            stage.dispatch(&kernels.gather_gradients, &gather, groups);
        });
    }

    /// Records the gradients of the calibrations of identities, from the label mass of the splats.
    fn calibrations_backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: &DeviceIdentities,
    ) {
        let (arrays, kernel) = (&self.arrays, &self.kernels.identity_backward);
        let bindings = [
            self.uniform.buffer(),
            arrays.depth.values[self.depth_result].buffer(),
            arrays.slot_offsets.buffer(),
            identities.row_offsets.buffer(),
            identities.entries.buffer(),
            arrays.label_mass.buffer(),
            arrays.work.buffer(),
            self.gradients.calibrations.buffer(),
        ];
        let identity = self.cache.get(gpu, ("identity_backward", 0), kernel, &bindings);
        let groups = workgroups(self.view.gaussians as usize, 64);
        commands.stage("identity backward", |stage| stage.dispatch(kernel, &identity, groups));
    }

    /// Makes room for gradients of splats and Gaussians.
    pub(crate) fn reserve_gradients(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let n = self.view.gaussians as usize;
        self.arrays.splat_gradients.resize(gpu, 3 * n)?;
        self.gradients.gaussians.geometry.resize(gpu, n)?;
        self.gradients.gaussians.sh.resize(gpu, n)?;
        self.gradients.screen.resize(gpu, n)?;
        Ok(())
    }
}
