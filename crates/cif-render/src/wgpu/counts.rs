//! Label mass of Gaussians on the device: the stage of `cpu/renderer/count.rs` as kernels.
//!
//! A view is projected and rasterized without instances first. The labels of its mask are then taken
//! [`LABELS_PER_PASS`] at a time: `count_labels.wgsl` sums every pair's mass on the pixels of each, and
//! `gather_counts.wgsl` adds the pairs of every Gaussian, in their order, to its row. Nothing is added in an order
//! that depends on chance, so counts are the same on every run.

use super::buffers::{GpuVec, Uniform};
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::{Commands, Kernel, Module, Snippet, structures, workgroups};
use super::layout::Shared;
use super::rasterizer::Rasterizer;
use super::stages::entries;
use super::view::{CONSTANTS, NUMBERS, PAIR_SUMS, SPLAT, VIEW};
use crate::cpu::IdentityCounts;

/// Labels that a pass over a view takes; the last sum of a pair is its mass on all pixels.
pub const LABELS_PER_PASS: usize = PAIR_SUMS - 1;

crate::shared_struct! {
    /// Labels that a pass takes.
    pub struct LabelChunk {
        /// Dense instance index + 1, ascending; behind them 0.
        pub labels: [[u32; 4]; 3],
        /// Number of labels in the pass.
        pub count: u32,
        /// Instances K: a row has one number more, the mass on all pixels.
        pub instances: u32,
        /// 1 when this pass adds the mass on all pixels.
        pub adds_total: u32,
        /// Pads to 16 bytes.
        pub unused: u32,
    }
}

const LABEL_CHUNK: Snippet = Snippet { name: "label_chunk", text: || structures(&[LabelChunk::layout()]) };

/// Mass of pairs.
pub const COUNT_LABELS: Module = Module {
    name: "count_labels",
    text: include_str!("count_labels.wgsl"),
    imports: &[CONSTANTS, VIEW, SPLAT, LABEL_CHUNK],
    entries: &["count_labels"],
};

/// Mass of Gaussians.
pub const GATHER_COUNTS: Module = Module {
    name: "gather_counts",
    text: include_str!("gather_counts.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW, SPLAT, LABEL_CHUNK],
    entries: &["gather_counts"],
};

/// Counts of N Gaussians and K instances on the device.
#[derive(Debug)]
pub struct GpuIdentityCounts {
    gaussians: usize,
    instances: usize,
    /// `[N, K + 1]`, the mass on all pixels last.
    counts: GpuVec<f32>,
    count: Kernel,
    gather: Kernel,
}

impl GpuIdentityCounts {
    /// True when the device holds the counts of so many Gaussians and instances: their table has no gaps, so that of
    /// a scene with very many instances does not fit, and is counted by the processor.
    #[must_use]
    pub fn fits(gpu: &Gpu, gaussians: usize, instances: usize) -> bool {
        let bytes = 4 * (gaussians as u128) * (instances as u128 + 1);
        bytes <= u128::from(gpu.largest_binding())
    }

    /// No mass yet.
    ///
    /// # Errors
    /// When they do not fit, with the arithmetic; when the driver rejects a kernel.
    pub fn zeros(gpu: &Gpu, gaussians: usize, instances: usize) -> Result<Self, GpuError> {
        let [count] = entries(gpu, &COUNT_LABELS)?;
        let [gather] = entries(gpu, &GATHER_COUNTS)?;
        let len = gaussians.saturating_mul(instances + 1);
        let counts = GpuVec::zeros(gpu, "label mass of Gaussians", len)?;
        Ok(Self { gaussians, instances, counts, count, gather })
    }

    /// Records the mass of a view that was rasterized with colour. `labels` hold dense index + 1 per pixel, 0 =
    /// unlabelled; `present` are those of them that are counted, ascending.
    ///
    /// # Errors
    /// When the sums of its pairs exceed what the device binds.
    ///
    /// # Panics
    /// When the labels are of another size than the view, or the view of other Gaussians.
    pub fn add_view(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        rasterizer: &mut Rasterizer,
        labels: &GpuVec<u32>,
        present: &[u16],
    ) -> Result<(), GpuError> {
        let view = *rasterizer.view();
        assert_eq!(labels.len(), view.pixels(), "label map size");
        assert_eq!(view.gaussians as usize, self.gaussians, "counts of other Gaussians");
        rasterizer.reserve_sums(gpu)?;
        let arrays = rasterizer.for_counting();
        let known: Vec<u32> = present
            .iter()
            .map(|label| u32::from(*label))
            .filter(|label| (1..=self.instances as u32).contains(label))
            .collect();
        let chunks = known.len().div_ceil(LABELS_PER_PASS).max(1);
        for pass in 0..chunks {
            let taken = &known[(pass * LABELS_PER_PASS).min(known.len())..];
            let taken = &taken[..taken.len().min(LABELS_PER_PASS)];
            let mut chunk = LabelChunk {
                count: taken.len() as u32,
                instances: self.instances as u32,
                adds_total: u32::from(pass == 0),
                ..LabelChunk::default()
            };
            for (k, label) in taken.iter().enumerate() {
                chunk.labels[k / 4][k % 4] = *label;
            }
            // Several passes go into one submission, each with a block of its own.
            let block = Uniform::new(gpu, "labels of a pass", &chunk);
            let bind = |kernel: &Kernel, rest: &[&wgpu::Buffer]| {
                let resources: Vec<_> = [arrays.view, block.buffer()]
                    .iter()
                    .chain(rest)
                    .map(|buffer| buffer.as_entire_binding())
                    .collect();
                kernel.bind(gpu, &resources)
            };
            let count = bind(
                &self.count,
                &[
                    arrays.splats,
                    arrays.entries,
                    arrays.tile_ranges,
                    labels.buffer(),
                    arrays.colors,
                    arrays.pair_sums,
                ],
            );
            let gather = bind(
                &self.gather,
                &[
                    arrays.depth_order,
                    arrays.pair_offsets,
                    arrays.pairs,
                    arrays.pair_sums,
                    arrays.work,
                    self.counts.buffer(),
                ],
            );
            commands.stage("count labels", |stage| {
                stage.dispatch(&self.count, &count, [view.tiles[0], view.tiles[1], 1]);
                stage.dispatch(&self.gather, &gather, workgroups(self.gaussians, 64));
            });
        }
        Ok(())
    }

    /// Reads the counts of all views, waiting for the device.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn read(&self, gpu: &Gpu) -> Result<IdentityCounts, GpuError> {
        let table = self.counts.read(gpu)?;
        let mut counts = IdentityCounts::zeros(self.gaussians, self.instances);
        for (row, masses) in table.chunks_exact(self.instances + 1).enumerate() {
            for (label, mass) in masses[..self.instances].iter().enumerate() {
                if *mass != 0.0 {
                    counts.add_label_mass(row, label as u16, f64::from(*mass));
                }
            }
            counts.add_total_mass(row, f64::from(masses[self.instances]));
        }
        Ok(counts)
    }
}
