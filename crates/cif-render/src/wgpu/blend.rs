//! Values per Gaussian blended over a view on the device, and back: the stages of `cpu/blend.rs` and
//! `cpu/blend_backward.rs` as kernels, which take four channels at a time.

use super::buffers::{GpuVec, Uniform};
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::{Commands, Kernel, Module, Snippet, structures, workgroups};
use super::layout::Shared;
use super::rasterizer::{PosedInput, Rasterizer};
use super::stages::entries;
use super::view::{
    BLEND_CHANNELS, COLOR_PASS, CONSTANTS, INSTANCE_PASS, NUMBERS, OCCUPANCY_NONE, PARTIAL_SUMS, SPLAT,
    TILE_BACKWARD, TILE_FORWARD, TILE_STAGING, VIEW,
};
use crate::{BlendRequest, Blending, GeometryPath};

crate::shared_struct! {
    /// Channels of a request that a dispatch takes.
    pub struct BlendChunk {
        /// First of them.
        pub first: u32,
        /// Channels C of the request.
        pub channels: u32,
        /// Bit of the pass whose weights values are blended with.
        pub passes: u32,
        /// Share of the gradient through the weights that reaches scales and rotations: 0 or 1.
        pub full_geometry: f32,
        /// Share that reaches means.
        pub mean_geometry: f32,
        /// Pads to 16 bytes.
        pub unused: u32,
        /// As above.
        pub unused_too: [u32; 2],
    }
}

const BLEND_CHUNK: Snippet = Snippet { name: "blend_chunk", text: || structures(&[BlendChunk::layout()]) };
const BLEND_VALUES: Snippet =
    Snippet { name: "blend_values", text: || include_str!("shared/blend_values.wgsl").to_owned() };
/// Gradients of values alone; so many splats are summed at a time.
const VALUES_ONLY: Snippet = Snippet {
    name: "blend_variant",
    text: || {
        "const WITH_WEIGHTS: bool = false;\nconst SUMS: u32 = BLEND_CHANNELS;\nconst BATCH: u32 = 8u;\n"
            .to_owned()
    },
};
/// As above, also through the weights.
const WITH_WEIGHTS: Snippet = Snippet {
    name: "blend_variant",
    text: || {
        "const WITH_WEIGHTS: bool = true;\nconst SUMS: u32 = GRADIENT_SUMS;\nconst BATCH: u32 = 4u;\n"
            .to_owned()
    },
};

/// Blending of values.
pub const BLEND: Module = Module {
    name: "blend",
    text: include_str!("blend.wgsl"),
    imports: &[CONSTANTS, VIEW, SPLAT, BLEND_CHUNK, TILE_STAGING, TILE_FORWARD, BLEND_VALUES],
    entries: &["blend"],
};

/// Gradients of pairs by values.
pub const BLEND_BACKWARD: Module = Module {
    name: "blend_backward",
    text: include_str!("blend_backward.wgsl"),
    imports: &[
        CONSTANTS,
        VIEW,
        SPLAT,
        BLEND_CHUNK,
        TILE_STAGING,
        TILE_BACKWARD,
        BLEND_VALUES,
        PARTIAL_SUMS,
        VALUES_ONLY,
    ],
    entries: &["blend_backward"],
};

/// Gradients of pairs by values and weights.
pub const BLEND_BACKWARD_WEIGHTS: Module = Module {
    imports: &[
        CONSTANTS,
        VIEW,
        SPLAT,
        BLEND_CHUNK,
        TILE_STAGING,
        TILE_BACKWARD,
        BLEND_VALUES,
        PARTIAL_SUMS,
        WITH_WEIGHTS,
    ],
    ..BLEND_BACKWARD
};

/// Gradients of values.
pub const GATHER_VALUES: Module = Module {
    name: "gather_values",
    text: include_str!("gather_values.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW, SPLAT, BLEND_CHUNK, VALUES_ONLY],
    entries: &["gather_values"],
};

/// Gradients of values and splats.
pub const GATHER_VALUES_WEIGHTS: Module =
    Module { imports: &[CONSTANTS, NUMBERS, VIEW, SPLAT, BLEND_CHUNK, WITH_WEIGHTS], ..GATHER_VALUES };

/// Kernels of blending, and the chunks of channels that were blended so far.
#[derive(Debug)]
pub(super) struct BlendKernels {
    blend: Kernel,
    /// Without weights, and with.
    backward: [Kernel; 2],
    gather: [Kernel; 2],
    /// Never written again: several requests may go into one submission.
    chunks: Vec<(BlendChunk, Uniform<BlendChunk>)>,
}

impl BlendKernels {
    fn compile(gpu: &Gpu) -> Result<Self, GpuError> {
        let one = |module: &Module| entries(gpu, module).map(|[kernel]| kernel);
        Ok(Self {
            blend: one(&BLEND)?,
            backward: [one(&BLEND_BACKWARD)?, one(&BLEND_BACKWARD_WEIGHTS)?],
            gather: [one(&GATHER_VALUES)?, one(&GATHER_VALUES_WEIGHTS)?],
            chunks: Vec::new(),
        })
    }

    /// The chunks of a request, as places in `self.chunks`.
    fn chunks(
        &mut self,
        gpu: &Gpu,
        request: &BlendRequest<'_, GpuVec<f32>>,
        geometry: GeometryPath,
    ) -> Vec<usize> {
        let firsts = (0..request.channels).step_by(BLEND_CHANNELS);
        let of_request = firsts.map(|first| BlendChunk {
            first: first as u32,
            channels: request.channels as u32,
            passes: match request.blending {
                Blending::Color => COLOR_PASS,
                Blending::Own => INSTANCE_PASS,
            },
            full_geometry: f32::from(u8::from(geometry == GeometryPath::Full)),
            mean_geometry: f32::from(u8::from(geometry != GeometryPath::Off)),
            ..BlendChunk::default()
        });
        of_request
            .map(|chunk| {
                self.chunks.iter().position(|(known, _)| *known == chunk).unwrap_or_else(|| {
                    self.chunks.push((chunk, Uniform::new(gpu, "channels of a pass", &chunk)));
                    self.chunks.len() - 1
                })
            })
            .collect()
    }
}

/// Inputs of gradients through blending weights, beside those of the values.
#[derive(Clone, Copy, Debug)]
pub struct BlendWeightGradients<'a> {
    /// The Gaussians of the view.
    pub gaussians: PosedInput<'a>,
    /// The same request blended over the view.
    pub blended: &'a GpuVec<f32>,
    /// Geometry that they reach; the opacity logit, or that of the occupancy, they always do.
    pub geometry: GeometryPath,
}

impl Rasterizer {
    /// Records the blending of values over the view whose tiles were listed last, into `[height, width, C]`.
    ///
    /// # Errors
    /// When the image exceeds what the device binds, with the arithmetic; when the driver rejects the kernels.
    ///
    /// # Panics
    /// When there are not C values of every Gaussian, or for [`Blending::Own`] when the view has no instances.
    pub fn blend(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        request: &BlendRequest<'_, GpuVec<f32>>,
        blended: &mut GpuVec<f32>,
    ) -> Result<(), GpuError> {
        blended.resize(gpu, self.view.pixels() * request.channels)?;
        let (kernels, chunks) = self.blend_kernels(gpu, request, GeometryPath::Off)?;
        for chunk in chunks {
            let bound = self.cache.get(
                gpu,
                ("blend", chunk as u32),
                &kernels.blend,
                &[
                    self.uniform.buffer(),
                    self.arrays.splats.buffer(),
                    self.arrays.entries.buffer(),
                    self.arrays.tile_ranges.buffer(),
                    kernels.chunks[chunk].1.buffer(),
                    request.values.buffer(),
                    blended.buffer(),
                ],
            );
            let [columns, rows] = self.view.tiles;
            commands.stage("blend", |stage| stage.dispatch(&kernels.blend, &bound, [columns, rows, 1]));
        }
        self.blend = Some(kernels);
        Ok(())
    }

    /// Records the gradients of values that were blended over the view whose tiles were listed last: `v_blended` is
    /// dL/dblended, `[height, width, C]`, and dL/dvalues is added to `v_values`, `[N, C]`. Gradients go through the
    /// blending weights only with `weights`, and cost nothing without; they replace [`Self::gradients`].
    ///
    /// # Errors
    /// When arrays exceed what the device binds, with the arithmetic; when the driver rejects the kernels.
    ///
    /// # Panics
    /// As [`Self::blend`], and when sizes differ from the view.
    pub fn blend_backward(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        request: &BlendRequest<'_, GpuVec<f32>>,
        v_blended: &GpuVec<f32>,
        v_values: &GpuVec<f32>,
        weights: Option<BlendWeightGradients<'_>>,
    ) -> Result<(), GpuError> {
        assert_eq!(v_blended.len(), self.view.pixels() * request.channels, "cotangent size");
        assert_eq!(v_values.len(), request.values.len(), "gradient size");
        self.reserve_sums(gpu)?;
        if let Some(weights) = &weights {
            assert_eq!(weights.blended.len(), v_blended.len(), "size of the blended image");
            self.reserve_gradients(gpu)?;
        }
        let variant = usize::from(weights.is_some());
        let geometry = weights.map_or(GeometryPath::Off, |weights| weights.geometry);
        let (kernels, chunks) = self.blend_kernels(gpu, request, geometry)?;
        let (backward, gather) = (&kernels.backward[variant], &kernels.gather[variant]);
        for chunk in chunks {
            let arrays = &self.arrays;
            let (view, constants) = (self.uniform.buffer(), kernels.chunks[chunk].1.buffer());
            let place = 2 * chunk as u32 + variant as u32;
            let of_tiles = self.cache.get(
                gpu,
                ("blend_backward", place),
                backward,
                &[
                    view,
                    arrays.splats.buffer(),
                    arrays.entries.buffer(),
                    arrays.tile_ranges.buffer(),
                    constants,
                    request.values.buffer(),
                    v_blended.buffer(),
                    weights.map_or(v_blended, |weights| weights.blended).buffer(),
                    arrays.pair_sums.buffer(),
                ],
            );
            let of_splats = self.cache.get(
                gpu,
                ("gather_values", place),
                gather,
                &[
                    view,
                    constants,
                    arrays.splats.buffer(),
                    arrays.depth.values[self.depth_result].buffer(),
                    arrays.pair_offsets.buffer(),
                    arrays.pairs.buffer(),
                    arrays.pair_sums.buffer(),
                    arrays.work.buffer(),
                    v_values.buffer(),
                    arrays.splat_gradients.buffer(),
                ],
            );
            let ([columns, rows], n) = (self.view.tiles, self.view.gaussians as usize);
            commands.stage("blend backward", |stage| {
                stage.dispatch(backward, &of_tiles, [columns, rows, 1]);
                stage.dispatch(gather, &of_splats, workgroups(n, 64));
            });
        }
        if let Some(weights) = weights {
            self.project_backward(gpu, commands, weights.gaussians);
        }
        self.blend = Some(kernels);
        Ok(())
    }

    /// The kernels, taken out until they are put back, and the chunks of a request.
    fn blend_kernels(
        &mut self,
        gpu: &Gpu,
        request: &BlendRequest<'_, GpuVec<f32>>,
        geometry: GeometryPath,
    ) -> Result<(BlendKernels, Vec<usize>), GpuError> {
        let n = self.view.gaussians as usize;
        assert!(request.channels > 0, "at least one channel");
        assert_eq!(request.values.len(), n * request.channels, "values of every Gaussian");
        assert!(
            request.blending == Blending::Color || self.view.occupancy != OCCUPANCY_NONE,
            "the view was projected with instances"
        );
        let mut kernels = match self.blend.take() {
            Some(kernels) => kernels,
            None => BlendKernels::compile(gpu)?,
        };
        let chunks = kernels.chunks(gpu, request, geometry);
        Ok((kernels, chunks))
    }
}
