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
        let view = self.view;
        let n = view.gaussians as usize;
        assert_eq!(v_colors.len(), view.pixels(), "cotangent size");
        let arrays = &mut self.arrays;
        arrays.cotangents.resize(gpu, 2 * view.pixels())?;
        self.reserve_sums(gpu)?;
        self.reserve_gradients(gpu)?;
        if let Some(identities) = identities {
            self.gradients.calibrations.resize(gpu, identities.entries.len())?;
        }
        let arrays = &self.arrays;
        let kernels = &self.kernels;
        let uniform = self.uniform.buffer();
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let identity_entries = identities.map_or(&arrays.no_entries, |identities| &identities.entries);
        let label_map = labels.map_or(&arrays.no_labels, |labels| labels.labels);
        let order = &arrays.depth.values[self.depth_result];

        let cotangents = self.cache.get(
            gpu,
            ("cotangents", 0),
            &kernels.cotangents,
            &[
                uniform,
                arrays.colors.buffer(),
                arrays.blended.buffer(),
                label_map.buffer(),
                v_colors.buffer(),
                arrays.cotangents.buffer(),
            ],
        );
        commands.stage("cotangents", |stage| {
            stage.dispatch(&kernels.cotangents, &cotangents, workgroups(view.pixels(), 64));
        });
        let (variant, kernel) = match view.label_slots {
            0 => (0, &kernels.rasterize_backward_color),
            _ => (1, &kernels.rasterize_backward),
        };
        let backward = self.cache.get(
            gpu,
            ("rasterize_backward", variant),
            kernel,
            &[
                uniform,
                arrays.splats.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
                rows.buffer(),
                identity_entries.buffer(),
                arrays.cotangents.buffer(),
                arrays.pair_sums.buffer(),
                arrays.label_mass.buffer(),
            ],
        );
        commands.stage("rasterize backward", |stage| {
            stage.dispatch(kernel, &backward, [view.tiles[0], view.tiles[1], 1]);
        });
        let gather = self.cache.get(
            gpu,
            ("gather_gradients", 0),
            &kernels.gather_gradients,
            &[
                uniform,
                arrays.splats.buffer(),
                order.buffer(),
                arrays.pair_offsets.buffer(),
                arrays.pairs.buffer(),
                arrays.pair_sums.buffer(),
                arrays.work.buffer(),
                arrays.splat_gradients.buffer(),
            ],
        );
        commands.stage("gather gradients", |stage| {
            stage.dispatch(&kernels.gather_gradients, &gather, workgroups(n, 64));
        });
        self.project_backward(gpu, commands, gaussians);
        let (arrays, kernels, gradients) = (&self.arrays, &self.kernels, &self.gradients);
        let (uniform, order) = (self.uniform.buffer(), &arrays.depth.values[self.depth_result]);
        if let Some(identities) = identities.filter(|_| view.label_slots != 0) {
            let identity = self.cache.get(
                gpu,
                ("identity_backward", 0),
                &kernels.identity_backward,
                &[
                    uniform,
                    order.buffer(),
                    arrays.slot_offsets.buffer(),
                    identities.row_offsets.buffer(),
                    identities.entries.buffer(),
                    arrays.label_mass.buffer(),
                    arrays.work.buffer(),
                    gradients.calibrations.buffer(),
                ],
            );
            commands.stage("identity backward", |stage| {
                stage.dispatch(&kernels.identity_backward, &identity, workgroups(n, 64));
            });
        }
        Ok(())
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
