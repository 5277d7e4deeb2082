//! Values per Gaussian blended over a view on the device, and back: the stages of `cpu/blend.rs` and
//! `cpu/blend_backward.rs` as kernels, which take four channels at a time.

use super::buffers::{GpuVec, Uniform};
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::{Kernel, Module, Snippet, structures};
use super::layout::Shared;
use super::stages::entries;
use super::view::{
    BATCH_SUMS, BLEND_CHANNELS, COLOR_PASS, CONSTANTS, INSTANCE_PASS, NUMBERS, SPLAT, TILE_STAGING, VIEW,
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
    imports: &[CONSTANTS, VIEW, SPLAT, BLEND_CHUNK, TILE_STAGING, BLEND_VALUES],
    entries: &["blend"],
};

/// Gradients of pairs by values.
pub const BLEND_BACKWARD: Module = Module {
    name: "blend_backward",
    text: include_str!("blend_backward.wgsl"),
    imports: &[CONSTANTS, VIEW, SPLAT, BLEND_CHUNK, TILE_STAGING, BATCH_SUMS, BLEND_VALUES, VALUES_ONLY],
    entries: &["blend_backward"],
};

/// Gradients of pairs by values and weights.
pub const BLEND_BACKWARD_WEIGHTS: Module = Module {
    imports: &[CONSTANTS, VIEW, SPLAT, BLEND_CHUNK, TILE_STAGING, BATCH_SUMS, BLEND_VALUES, WITH_WEIGHTS],
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
    pub(super) blend: Kernel,
    /// Without weights, and with.
    pub(super) backward: [Kernel; 2],
    pub(super) gather: [Kernel; 2],
    /// Never written again: several requests may go into one submission.
    pub(super) chunks: Vec<(BlendChunk, Uniform<BlendChunk>)>,
}

impl BlendKernels {
    pub(super) fn compile(gpu: &Gpu) -> Result<Self, GpuError> {
        let one = |module: &Module| entries(gpu, module).map(|[kernel]| kernel);
        Ok(Self {
            blend: one(&BLEND)?,
            backward: [one(&BLEND_BACKWARD)?, one(&BLEND_BACKWARD_WEIGHTS)?],
            gather: [one(&GATHER_VALUES)?, one(&GATHER_VALUES_WEIGHTS)?],
            chunks: Vec::new(),
        })
    }

    /// The chunks of a request, as places in `self.chunks`.
    pub(super) fn chunks(
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
