//! Arrays of a view on the device, which grow with need.

use crate::wgpu::buffers::GpuVec;
use crate::wgpu::device::Gpu;
use crate::wgpu::error::GpuError;
use crate::wgpu::sort::SortArrays;
use crate::wgpu::view::{Splat, work};

/// Arrays of a view.
#[derive(Debug)]
pub(super) struct Arrays {
    pub(super) splats: GpuVec<Splat>,
    /// Keys are depths, values Gaussians.
    pub(super) depth: SortArrays,
    pub(super) tile_counts: GpuVec<u32>,
    pub(super) pair_offsets: GpuVec<u32>,
    pub(super) slot_offsets: GpuVec<u32>,
    pub(super) work: GpuVec<u32>,
    /// Keys are tiles, values pairs.
    pub(super) tiles: SortArrays,
    pub(super) pairs: GpuVec<[u32; 2]>,
    pub(super) entries: GpuVec<[u32; 4]>,
    pub(super) tile_ranges: GpuVec<[u32; 2]>,
    pub(super) colors: GpuVec<[f32; 4]>,
    pub(super) blended: GpuVec<[f32; 4]>,
    pub(super) instance_images: GpuVec<[f32; 4]>,
    pub(super) foregrounds: GpuVec<f32>,
    pub(super) cotangents: GpuVec<[f32; 4]>,
    pub(super) pair_sums: GpuVec<f32>,
    pub(super) label_mass: GpuVec<f32>,
    pub(super) splat_gradients: GpuVec<[f32; 4]>,
    /// Stand in where a view has no labels or no identities.
    pub(super) no_labels: GpuVec<u32>,
    pub(super) no_entries: GpuVec<[u32; 2]>,
}

impl Arrays {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            splats: GpuVec::zeros(gpu, "splats", 0)?,
            depth: SortArrays::new(gpu, "depth order")?,
            tile_counts: GpuVec::zeros(gpu, "tile counts", 0)?,
            pair_offsets: GpuVec::zeros(gpu, "pair offsets", 0)?,
            slot_offsets: GpuVec::zeros(gpu, "label slot offsets", 0)?,
            work: GpuVec::zeros(gpu, "work counts", work::LEN)?,
            tiles: SortArrays::new(gpu, "pairs of tiles and Gaussians")?,
            pairs: GpuVec::zeros(gpu, "pairs of tiles and Gaussians", 0)?,
            entries: GpuVec::zeros(gpu, "tile lists", 0)?,
            tile_ranges: GpuVec::zeros(gpu, "tile ranges", 0)?,
            colors: GpuVec::zeros(gpu, "colour image", 0)?,
            blended: GpuVec::zeros(gpu, "depth and label image", 0)?,
            instance_images: GpuVec::zeros(gpu, "instance image", 0)?,
            foregrounds: GpuVec::zeros(gpu, "foreground image", 0)?,
            cotangents: GpuVec::zeros(gpu, "pixel gradients", 0)?,
            pair_sums: GpuVec::zeros(gpu, "gradients of pairs", 0)?,
            label_mass: GpuVec::zeros(gpu, "label mass of pairs", 0)?,
            splat_gradients: GpuVec::zeros(gpu, "gradients of splats", 0)?,
            no_labels: GpuVec::zeros(gpu, "no labels", 2)?,
            no_entries: GpuVec::zeros(gpu, "no identities", 1)?,
        })
    }

    /// Buffers that `bin.wgsl` binds, for its passes before pairs have room and after.
    pub(super) fn bin_bindings<'a>(
        &'a self,
        uniform: &'a wgpu::Buffer,
        depth_result: usize,
        rows: &'a GpuVec<u32>,
    ) -> [&'a wgpu::Buffer; 8] {
        [
            uniform,
            self.splats.buffer(),
            self.depth.values[depth_result].buffer(),
            rows.buffer(),
            self.tile_counts.buffer(),
            self.pair_offsets.buffer(),
            self.slot_offsets.buffer(),
            self.work.buffer(),
        ]
    }
}

/// Arrays of a rasterized view.
pub(crate) struct CountingArrays<'a> {
    pub(crate) view: &'a wgpu::Buffer,
    pub(crate) splats: &'a wgpu::Buffer,
    pub(crate) depth_order: &'a wgpu::Buffer,
    pub(crate) pair_offsets: &'a wgpu::Buffer,
    pub(crate) pairs: &'a wgpu::Buffer,
    pub(crate) entries: &'a wgpu::Buffer,
    pub(crate) tile_ranges: &'a wgpu::Buffer,
    pub(crate) colors: &'a wgpu::Buffer,
    pub(crate) work: &'a wgpu::Buffer,
    pub(crate) pair_sums: &'a wgpu::Buffer,
}
