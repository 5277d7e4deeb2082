//! Blending of a view: colour with labels, and instance images.

use super::Rasterizer;
use super::inputs::LabelInput;
use crate::wgpu::device::Gpu;
use crate::wgpu::error::GpuError;
use crate::wgpu::identities::DeviceIdentities;
use crate::wgpu::kernel::Commands;

impl Rasterizer {
    /// Records tile lists and blending of the projected view.
    ///
    /// # Errors
    /// As [`Self::list_tiles`].
    pub fn rasterize(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: Option<&DeviceIdentities>,
        labels: Option<LabelInput<'_>>,
    ) -> Result<(), GpuError> {
        self.list_tiles(gpu, commands, identities)?;
        let arrays = &self.arrays;
        let kernels = &self.kernels;
        let view = self.view;
        let uniform = self.uniform.buffer();
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let identity_entries = identities.map_or(&arrays.no_entries, |identities| &identities.entries);
        let label_map = labels.map_or(&arrays.no_labels, |labels| labels.labels);
        let (variant, kernel) = match view.label_pixels {
            0 => (0, &kernels.rasterize_color),
            _ => (1, &kernels.rasterize),
        };
        let rasterize = self.cache.get(
            gpu,
            ("rasterize", variant),
            kernel,
            &[
                uniform,
                arrays.splats.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
                label_map.buffer(),
                rows.buffer(),
                identity_entries.buffer(),
                arrays.colors.buffer(),
                arrays.blended.buffer(),
            ],
        );
        commands.stage("rasterize", |stage| {
            stage.dispatch(kernel, &rasterize, [view.tiles[0], view.tiles[1], 1]);
        });
        Ok(())
    }

    /// Records the instance images of the rasterized view.
    ///
    /// # Errors
    /// When they exceed what the device binds.
    pub fn render_instances(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: &DeviceIdentities,
    ) -> Result<(), GpuError> {
        let view = self.view;
        self.arrays.instance_images.resize(gpu, view.pixels())?;
        self.arrays.foregrounds.resize(gpu, view.pixels())?;
        let arrays = &self.arrays;
        let dense = self.cache.get(
            gpu,
            ("dense", 0),
            &self.kernels.dense,
            &[
                self.uniform.buffer(),
                arrays.splats.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
                identities.row_offsets.buffer(),
                identities.entries.buffer(),
                identities.labelled_shares.buffer(),
                arrays.instance_images.buffer(),
                arrays.foregrounds.buffer(),
            ],
        );
        commands.stage("dense", |stage| {
            stage.dispatch(&self.kernels.dense, &dense, [2 * view.tiles[0], 2 * view.tiles[1], 1]);
        });
        Ok(())
    }
}
