//! The GPU path: the stages of `cpu` as WGSL kernels through wgpu.
//!
//! | module | holds |
//! |---|---|
//! | [`device`] | which GPU, what it can do, what went wrong on it |
//! | [`features`] | optional features, and holding them back |
//! | [`form`] | what invocations do together, through workgroup memory or by subgroups |
//! | [`workgroup`] | the check of subgroups, by which devices are opened |
//! | [`snippet`] | text that WGSL files import |
//! | [`kernel`] | kernels from WGSL files, recorded commands, times on the device |
//! | [`reflection`] | bindings and entry points of WGSL, as naga finds them |
//! | [`gaussians`], [`identities`] | Gaussians and their gradients, and identities, on the device |
//! | [`faults`] | what no optimiser may take |
//! | [`counts`] | label mass of Gaussians |
//! | [`blend`] | other values per Gaussian, and back |
//! | [`deform`] | canonical Gaussians to the time of a view, and back |
//! | [`poses`] | groups of Gaussians that move as a whole |
//! | [`buffers`] | typed arrays that grow, uploads and read-backs |
//! | [`layout`] | structures that Rust and WGSL share |
//! | [`testing`] | the GPU that tests run on |
//! | [`validation`] | checks of WGSL files without a GPU |
//! | [`error`] | what can go wrong |
//! | [`view`] | the view, splats, constants: what all stages share |
//! | [`table`] | the stages, a row each, with their versions and tests |
//! | [`stages`] | the WGSL files of rendering |
//! | [`sort`] | prefix sums and radix sorts |
//! | [`rasterizer`] | the stages in order, in both directions |
//! | [`renderer`] | pictures of fields |
//! | [`speed`] | what a device can do at most |
//!
//! Kernels need the core limits of WebGPU and no more: 8 storage buffers, 16 KiB of workgroup memory and 256
//! invocations per workgroup. Subgroups are used where they are there.

pub mod blend;
pub mod buffers;
pub mod cache;
pub mod counts;
pub mod deform;
pub mod device;
pub mod error;
pub mod faults;
pub mod features;
pub mod form;
pub mod gaussians;
pub mod identities;
pub mod kernel;
pub mod layout;
pub mod poses;
pub mod rasterizer;
pub mod reflection;
pub mod renderer;
pub mod snippet;
pub mod sort;
pub mod speed;
pub mod stages;
pub mod table;
pub mod testing;
pub mod validation;
pub mod view;
pub mod workgroup;

pub use ::wgpu::{BindGroup, SubmissionIndex as Submission};
pub use buffers::{Arriving, GpuVec, PendingWords, Readback, Recorded, Uniform};
pub use cache::{BindCache, Place, UniformCache};
pub use counts::GpuIdentityCounts;
pub use deform::{DeformationGradients, GpuDeformation};
pub use device::{AdapterFacts, Gpu};
pub use error::GpuError;
pub use features::GpuFeatures;
pub use form::{Form, SubgroupUse};
pub use gaussians::GpuGaussians;
pub use identities::{DeviceIdentities, packed_entries};
pub use kernel::{
    Commands, Constant, Kernel, MAX_WORKGROUPS, Module, Snippet, Stage, Timestamps, constants, structures,
    workgroups,
};
pub use layout::{Layout, Member, Shared, WgslType};
pub use poses::GpuPoses;
pub use rasterizer::{
    BlendWeightGradients, GpuStatistics, LabelInput, PosedGradients, PosedInput, Rasterizer, ViewInput,
};
pub use reflection::{Access, Reflection};
pub use renderer::GpuRenderer;
pub use sort::{Count, RadixSort, Scan, SortArrays};
pub use view::{Splat, View};

/// Every structure that Rust and WGSL share.
pub const LAYOUTS: &[fn() -> Layout] = &[
    View::layout,
    Splat::layout,
    view::ScanParameters::layout,
    view::SortParameters::layout,
    blend::BlendChunk::layout,
    counts::LabelChunk::layout,
    poses::GroupSizes::layout,
    poses::GroupView::layout,
    poses::Pose::layout,
    poses::GroupFrame::layout,
    poses::PoseSum::layout,
];
