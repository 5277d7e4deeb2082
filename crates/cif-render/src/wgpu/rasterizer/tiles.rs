//! Room for the pairs of a view, and the list of every tile.

use super::Rasterizer;
use crate::wgpu::device::Gpu;
use crate::wgpu::error::GpuError;
use crate::wgpu::identities::DeviceIdentities;
use crate::wgpu::kernel::Commands;
use crate::wgpu::sort::Count;
use crate::wgpu::view::{PAIR_SUMS, work};

impl Rasterizer {
    /// Submits what was recorded by [`Self::project`], waits for it, and makes room for the pairs of the view.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic; when the device is lost.
    pub fn measure(&mut self, gpu: &Gpu, commands: Commands<'_>) -> Result<(), GpuError> {
        commands.submit();
        let n = self.view.gaussians as usize;
        let pairs = self.arrays.pair_offsets.read_range(gpu, n, 1)?[0];
        let slots = self.arrays.slot_offsets.read_range(gpu, n, 1)?[0];
        if pairs == u32::MAX || slots == u32::MAX {
            // The sums on the device stop at 2^32 - 1: count again here, in 64 bits.
            let counts = self.arrays.tile_counts.read(gpu)?;
            let total: u64 = counts.iter().map(|count| u64::from(*count)).sum();
            let per_pair = (PAIR_SUMS * size_of::<f32>()) as u64;
            return Err(too_many_pairs(total, per_pair, gpu.largest_binding()));
        }
        self.reserve(gpu, pairs as usize, slots as usize)
    }

    /// Most pairs of a view that the device holds.
    #[must_use]
    pub fn most_pairs(gpu: &Gpu) -> usize {
        (gpu.largest_binding() / (PAIR_SUMS * size_of::<f32>()) as u64) as usize
    }

    /// Makes room for pairs and label slots; more room than asked stays.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic.
    pub fn reserve(&mut self, gpu: &Gpu, pairs: usize, slots: usize) -> Result<(), GpuError> {
        let arrays = &mut self.arrays;
        if pairs > arrays.entries.len() {
            // Half as much room on top, where the device allows, so that the next views fit too.
            let largest = Self::most_pairs(gpu);
            if pairs > largest {
                let per_pair = (PAIR_SUMS * size_of::<f32>()) as u64;
                return Err(too_many_pairs(pairs as u64, per_pair, gpu.largest_binding()));
            }
            let roomy = (pairs + pairs / 2).min(largest).max(pairs);
            arrays.entries.resize(gpu, roomy)?;
            arrays.pairs.resize(gpu, roomy)?;
            arrays.tiles.resize(gpu, roomy)?;
        }
        if slots > arrays.label_mass.len() {
            arrays.label_mass.resize(gpu, slots + slots / 2)?;
        }
        let changed = self.view.pair_capacity as usize != arrays.entries.len()
            || self.view.slot_capacity as usize != arrays.label_mass.len();
        if changed {
            self.view.pair_capacity = arrays.entries.len() as u32;
            self.view.slot_capacity = arrays.label_mass.len() as u32;
            self.uniform.write(gpu, &self.view);
        }
        Ok(())
    }

    /// Records tile lists of the projected view, without drawing colour: all that [`Self::blend`] and
    /// [`Self::blend_backward`] need, for losses that do not look at colour.
    ///
    /// # Errors
    /// When scratch memory exceeds what the device binds.
    pub fn list_tiles(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        identities: Option<&DeviceIdentities>,
    ) -> Result<(), GpuError> {
        let arrays = &self.arrays;
        let kernels = &self.kernels;
        let view = self.view;
        let uniform = self.uniform.buffer();
        let rows = identities.map_or(&arrays.no_labels, |identities| &identities.row_offsets);
        let order = &arrays.depth.values[self.depth_result];
        commands.clear(&arrays.tile_ranges);
        let bin = self.cache.get(
            gpu,
            ("bin", 0),
            &kernels.count,
            &arrays.bin_bindings(uniform, self.depth_result, rows),
        );
        let emit = self.cache.get(
            gpu,
            ("emit", 0),
            &kernels.emit,
            &[
                uniform,
                arrays.splats.buffer(),
                order.buffer(),
                arrays.pair_offsets.buffer(),
                arrays.slot_offsets.buffer(),
                arrays.tiles.keys[0].buffer(),
                arrays.tiles.values[0].buffer(),
                arrays.pairs.buffer(),
            ],
        );
        // One more than there are tiles: pairs of no tile go last.
        let bits = (u32::BITS - (view.tile_count() as u32).leading_zeros()).max(1);
        let mut sorted = Ok(0);
        commands.stage("emit", |stage| {
            stage.dispatch(&kernels.plan, &bin, [1, 1, 1]);
            stage.dispatch_indirect(&kernels.emit, &emit, &arrays.work, work::BY_RANK);
        });
        commands.stage("sort by tile", |stage| {
            sorted = self.sort.record(
                gpu,
                &mut self.cache,
                stage,
                &mut self.scan,
                "tiles",
                &arrays.tiles,
                Count::Pairs,
                bits,
                &arrays.work,
            );
        });
        let sorted = sorted?;
        let ranges = self.cache.get(
            gpu,
            ("ranges", 0),
            &kernels.ranges,
            &[
                uniform,
                arrays.work.buffer(),
                arrays.tiles.keys[sorted].buffer(),
                arrays.tiles.values[sorted].buffer(),
                arrays.pairs.buffer(),
                arrays.entries.buffer(),
                arrays.tile_ranges.buffer(),
            ],
        );
        commands.stage("ranges", |stage| {
            stage.dispatch_indirect(&kernels.ranges, &ranges, &arrays.work, work::BY_PAIR);
        });
        Ok(())
    }
}

/// The refusal of more pairs than the device can hold.
fn too_many_pairs(count: u64, item_bytes: u64, limit: u64) -> GpuError {
    GpuError::TooLarge {
        what: "pairs of tiles and Gaussians of one view".to_owned(),
        count,
        item_bytes,
        bytes: u128::from(count) * u128::from(item_bytes),
        limit,
        advice: "a smaller image or fewer, smaller Gaussians".to_owned(),
    }
}
