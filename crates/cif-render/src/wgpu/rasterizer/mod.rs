//! Strings the stages together, forward and backward, on one device.
//!
//! A view goes through [`Rasterizer::project`] and [`Rasterizer::rasterize`], then
//! [`Rasterizer::render_instances`] or [`Rasterizer::backward`]; other values per Gaussian through
//! [`Rasterizer::list_tiles`], which rasterizing begins with, [`Rasterizer::blend`] and
//! [`Rasterizer::blend_backward`]. Each records commands; nothing waits but [`Rasterizer::measure`], which makes room
//! for the pairs of a view. A trainer does not wait: it reads [`Rasterizer::counts`] when they arrive, and draws a
//! view again whose pairs did not fit, for it drew nothing.
//!
//! Memory grows with need: per Gaussian 64 + 4 x 9 bytes for a view and 48 + 48 + 192 + 16 for gradients, per pair 40
//! and 48, per label slot 4, per pixel 32 and 48.
//!
//! | file | stages |
//! |---|---|
//! | `project` | projection, depth order, tile counts; gradients of Gaussians |
//! | `tiles` | room for pairs, tile lists |
//! | `rasterize` | colour with labels, instance images |
//! | `backward` | gradients of pixels, pairs, splats and calibrations |
//! | `blend` | other values per Gaussian, in both directions |
//! | `inputs`, `arrays` | inputs and results, arrays of a view |

mod arrays;
mod backward;
mod blend;
mod inputs;
mod project;
mod rasterize;
mod tiles;

use self::arrays::{Arrays, CountingArrays};
pub use self::blend::BlendWeightGradients;
pub(super) use self::inputs::{Coefficients, PosedGaussians};
pub use self::inputs::{GpuStatistics, LabelInput, PosedGradients, PosedInput, ViewInput};
use super::blend::BlendKernels;
use super::buffers::{GpuVec, Recorded, Uniform};
use super::cache::BindCache;
use super::device::Gpu;
use super::error::GpuError;
use super::gaussians::GpuGaussians;
use super::kernel::Commands;
use super::sort::{RadixSort, Scan};
use super::stages::Kernels;
use super::view::{PAIR_SUMS, Splat, View, work};

/// Renders posed Gaussians on a device; keeps memory between views.
#[derive(Debug)]
pub struct Rasterizer {
    kernels: Kernels,
    scan: Scan,
    sort: RadixSort,
    cache: BindCache,
    uniform: Uniform<View>,
    view: View,
    /// Which of the two depth arrays and pair arrays holds the sorted ones.
    depth_result: usize,
    arrays: Arrays,
    /// Compiled when values are blended first.
    blend: Option<BlendKernels>,
    gradients: PosedGradients,
}

impl Rasterizer {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// When the driver rejects them.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            kernels: Kernels::compile(gpu)?,
            scan: Scan::new(gpu)?,
            sort: RadixSort::new(gpu)?,
            cache: BindCache::default(),
            uniform: Uniform::new(gpu, "view", &View::default()),
            view: View::default(),
            depth_result: 0,
            arrays: Arrays::new(gpu)?,
            blend: None,
            gradients: PosedGradients {
                gaussians: GpuGaussians::zeros(gpu, 0)?,
                screen: GpuVec::zeros(gpu, "screen gradients", 0)?,
                calibrations: GpuVec::zeros(gpu, "gradients of calibrations", 0)?,
            },
        })
    }

    /// Records a read-back of the counts of the view, for [`GpuStatistics::of`].
    pub fn read_statistics(&self, gpu: &Gpu, commands: &mut Commands<'_>) -> Recorded<u32> {
        self.arrays.work.read_later(gpu, commands.encoder(), 0, work::LEN)
    }

    /// Counts of the view, for [`GpuStatistics::of`].
    #[must_use]
    pub fn counts(&self) -> &GpuVec<u32> {
        &self.arrays.work
    }

    /// Constants of the view, its splats, tile lists and pairs, as [`super::GpuIdentityCounts`] reads them.
    pub(crate) fn for_counting(&self) -> CountingArrays<'_> {
        let arrays = &self.arrays;
        CountingArrays {
            view: self.uniform.buffer(),
            splats: arrays.splats.buffer(),
            depth_order: arrays.depth.values[self.depth_result].buffer(),
            pair_offsets: arrays.pair_offsets.buffer(),
            pairs: arrays.pairs.buffer(),
            entries: arrays.entries.buffer(),
            tile_ranges: arrays.tile_ranges.buffer(),
            colors: arrays.colors.buffer(),
            work: arrays.work.buffer(),
            pair_sums: arrays.pair_sums.buffer(),
        }
    }

    /// Makes room for the sums of pairs.
    pub(crate) fn reserve_sums(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.arrays.pair_sums.resize(gpu, PAIR_SUMS * self.arrays.entries.len())?;
        Ok(())
    }

    /// Constants of the view.
    #[must_use]
    pub fn view(&self) -> &View {
        &self.view
    }

    /// Splats of the view, by Gaussian.
    #[must_use]
    pub fn splats(&self) -> &GpuVec<Splat> {
        &self.arrays.splats
    }

    /// Per pixel: colour composited on the background, and final transmittance.
    #[must_use]
    pub fn colors(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.colors
    }

    /// Per pixel: blended depth D, probability M_y of the pixel's label, final instance transmittance, and the
    /// position in the list of the tile after the last splat that supports the label.
    #[must_use]
    pub fn blended(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.blended
    }

    /// Per pixel: most probable label (dense index + 1, 0 = none), its probability, coverage, entropy in nats.
    #[must_use]
    pub fn instance_images(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.instance_images
    }

    /// Per pixel: labelled shares, blended like colour.
    #[must_use]
    pub fn foregrounds(&self) -> &GpuVec<f32> {
        &self.arrays.foregrounds
    }

    /// Gradients of the splats, three rows each; of Gaussians whose harmonics are in turned frames, the first of them
    /// holds the gradient by the turn that comes through the colour, once the backward pass is done.
    pub(super) fn splat_gradients(&self) -> &GpuVec<[f32; 4]> {
        &self.arrays.splat_gradients
    }

    /// Gradients of the last backward pass.
    #[must_use]
    pub fn gradients(&self) -> &PosedGradients {
        &self.gradients
    }

    /// Order of Gaussians, nearest first, those that draw nothing last.
    #[must_use]
    pub fn depth_order(&self) -> &GpuVec<u32> {
        &self.arrays.depth.values[self.depth_result]
    }

    /// Range of every tile in [`Self::entries`].
    #[must_use]
    pub fn tile_ranges(&self) -> &GpuVec<[u32; 2]> {
        &self.arrays.tile_ranges
    }

    /// Pairs by tile and depth: pair, splat with passes in the two highest bits, first label slot, 0.
    #[must_use]
    pub fn entries(&self) -> &GpuVec<[u32; 4]> {
        &self.arrays.entries
    }
}
