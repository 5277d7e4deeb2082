//! The WGSL files of rendering: their imports and entry points, and the kernels made of them.

use super::device::Gpu;
use super::error::GpuError;
use super::kernel::{Kernel, Module};
use super::view::{
    BATCH_SUMS, COEFFICIENTS, COLOR_ONLY, CONSTANTS, DIRECTIONS, FOOTPRINT, HARMONICS, IDENTITY, NUMBERS,
    PACKED_COEFFICIENTS, SCAN_PARAMETERS, SORT_PARAMETERS, SPLAT, SPLAT_GRADIENTS, TILE_STAGING, TILES,
    TORQUES, TURNED_DIRECTIONS, TURNS, VIEW, WITH_INSTANCES,
};

/// Projection.
pub const PROJECT: Module = Module {
    name: "project",
    text: include_str!("project.wgsl"),
    imports: &[CONSTANTS, NUMBERS, HARMONICS, VIEW, FOOTPRINT, COEFFICIENTS, DIRECTIONS],
    entries: &["project"],
};

/// Projection of Gaussians whose spherical harmonics are in 16-bit floats.
pub const PROJECT_PACKED: Module = Module {
    imports: &[CONSTANTS, NUMBERS, HARMONICS, VIEW, FOOTPRINT, PACKED_COEFFICIENTS, DIRECTIONS],
    ..PROJECT
};

/// Projection of Gaussians whose spherical harmonics are in frames of groups.
pub const PROJECT_TURNED: Module =
    Module { imports: &[CONSTANTS, NUMBERS, HARMONICS, VIEW, FOOTPRINT, COEFFICIENTS, TURNS], ..PROJECT };

/// Prefix sum.
pub const SCAN: Module = Module {
    name: "scan",
    text: include_str!("scan.wgsl"),
    imports: &[CONSTANTS, NUMBERS, SCAN_PARAMETERS],
    entries: &["reduce", "spine", "spread"],
};

/// A pass of the radix sort.
pub const SORT: Module = Module {
    name: "sort",
    text: include_str!("sort.wgsl"),
    imports: &[CONSTANTS, NUMBERS, SORT_PARAMETERS],
    entries: &["histogram", "scatter"],
};

/// Tile counts and the plan of work.
pub const BIN: Module = Module {
    name: "bin",
    text: include_str!("bin.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW, SPLAT, TILES],
    entries: &["count", "gather", "plan"],
};

/// Pairs.
pub const EMIT: Module = Module {
    name: "emit",
    text: include_str!("emit.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW, SPLAT, TILES],
    entries: &["emit"],
};

/// Tile ranges.
pub const RANGES: Module = Module {
    name: "ranges",
    text: include_str!("ranges.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW],
    entries: &["ranges"],
};

/// Blending.
pub const RASTERIZE: Module = Module {
    name: "rasterize",
    text: include_str!("rasterize.wgsl"),
    imports: &[CONSTANTS, WITH_INSTANCES, VIEW, SPLAT, TILE_STAGING, IDENTITY],
    entries: &["rasterize"],
};

/// Blending of colour alone.
pub const RASTERIZE_COLOR: Module =
    Module { imports: &[CONSTANTS, COLOR_ONLY, VIEW, SPLAT, TILE_STAGING, IDENTITY], ..RASTERIZE };

/// Instance images.
pub const DENSE: Module = Module {
    name: "dense",
    text: include_str!("dense.wgsl"),
    imports: &[CONSTANTS, VIEW, SPLAT],
    entries: &["dense"],
};

/// Gradients of pixels.
pub const COTANGENTS: Module = Module {
    name: "cotangents",
    text: include_str!("cotangents.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW],
    entries: &["cotangents_of_pixels"],
};

/// Gradients of pairs.
pub const RASTERIZE_BACKWARD: Module = Module {
    name: "rasterize_backward",
    text: include_str!("rasterize_backward.wgsl"),
    imports: &[CONSTANTS, WITH_INSTANCES, VIEW, SPLAT, TILE_STAGING, BATCH_SUMS, IDENTITY],
    entries: &["rasterize_backward"],
};

/// Gradients of pairs from colour alone.
pub const RASTERIZE_BACKWARD_COLOR: Module = Module {
    imports: &[CONSTANTS, COLOR_ONLY, VIEW, SPLAT, TILE_STAGING, BATCH_SUMS, IDENTITY],
    ..RASTERIZE_BACKWARD
};

/// Gradients of splats.
pub const GATHER_GRADIENTS: Module = Module {
    name: "gather_gradients",
    text: include_str!("gather_gradients.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW, SPLAT],
    entries: &["gather_gradients"],
};

/// Gradients of calibrations.
pub const IDENTITY_BACKWARD: Module = Module {
    name: "identity_backward",
    text: include_str!("identity_backward.wgsl"),
    imports: &[CONSTANTS, NUMBERS, VIEW],
    entries: &["identity_backward"],
};

/// Gradients of Gaussians.
pub const PROJECT_BACKWARD: Module = Module {
    name: "project_backward",
    text: include_str!("project_backward.wgsl"),
    imports: &[CONSTANTS, NUMBERS, HARMONICS, VIEW, FOOTPRINT, SPLAT_GRADIENTS, DIRECTIONS],
    entries: &["project_backward"],
};

/// Gradients of Gaussians whose spherical harmonics are in frames of groups.
pub const PROJECT_BACKWARD_TURNED: Module = Module {
    imports: &[CONSTANTS, NUMBERS, HARMONICS, VIEW, FOOTPRINT, TORQUES, TURNED_DIRECTIONS],
    ..PROJECT_BACKWARD
};

/// Kernels of rendering.
#[derive(Debug)]
pub(crate) struct Kernels {
    pub(crate) project: Kernel,
    /// Compiled when the first of them is drawn.
    pub(crate) project_packed: Option<Kernel>,
    /// With its backward pass; likewise.
    pub(crate) turned: Option<[Kernel; 2]>,
    pub(crate) count: Kernel,
    pub(crate) gather: Kernel,
    pub(crate) plan: Kernel,
    pub(crate) emit: Kernel,
    pub(crate) ranges: Kernel,
    pub(crate) rasterize: Kernel,
    pub(crate) rasterize_color: Kernel,
    pub(crate) dense: Kernel,
    pub(crate) cotangents: Kernel,
    pub(crate) rasterize_backward: Kernel,
    pub(crate) rasterize_backward_color: Kernel,
    pub(crate) gather_gradients: Kernel,
    pub(crate) identity_backward: Kernel,
    pub(crate) project_backward: Kernel,
}

impl Kernels {
    pub(crate) fn compile(gpu: &Gpu) -> Result<Self, GpuError> {
        let [count, gather, plan] = entries(gpu, &BIN)?;
        let one = |module: &Module| entries(gpu, module).map(|[kernel]| kernel);
        Ok(Self {
            project: one(&PROJECT)?,
            project_packed: None,
            turned: None,
            count,
            gather,
            plan,
            emit: one(&EMIT)?,
            ranges: one(&RANGES)?,
            rasterize: one(&RASTERIZE)?,
            rasterize_color: one(&RASTERIZE_COLOR)?,
            dense: one(&DENSE)?,
            cotangents: one(&COTANGENTS)?,
            rasterize_backward: one(&RASTERIZE_BACKWARD)?,
            rasterize_backward_color: one(&RASTERIZE_BACKWARD_COLOR)?,
            gather_gradients: one(&GATHER_GRADIENTS)?,
            identity_backward: one(&IDENTITY_BACKWARD)?,
            project_backward: one(&PROJECT_BACKWARD)?,
        })
    }
}

/// The kernels of a module, as many as it has entry points.
pub(crate) fn entries<const N: usize>(gpu: &Gpu, module: &Module) -> Result<[Kernel; N], GpuError> {
    let kernels = Kernel::compile(gpu, module)?;
    Ok(<[Kernel; N]>::try_from(kernels).expect("as many kernels as entry points, and the module lists those"))
}
