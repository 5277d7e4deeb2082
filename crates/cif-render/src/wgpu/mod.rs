//! The GPU path: the stages of `cpu` as WGSL kernels through wgpu.
//!
//! | module | holds |
//! |---|---|
//! | [`device`] | which GPU, what it can do, what went wrong on it |
//! | [`kernel`] | kernels from WGSL files, recorded commands, times on the device |
//! | [`gaussians`] | Gaussians and their gradients on the device |
//! | [`deform`] | canonical Gaussians to the time of a view, and back |
//! | [`buffers`] | typed arrays that grow, uploads and read-backs |
//! | [`layout`] | structures that Rust and WGSL share |
//! | [`testing`] | the GPU that tests run on |
//! | [`validation`] | checks of WGSL files without a GPU |
//! | [`error`] | what can go wrong |
//!
//! Kernels need the core limits of WebGPU and no more: 8 storage buffers, 16 KiB of workgroup memory and 256
//! invocations per workgroup.

pub mod buffers;
pub mod deform;
pub mod device;
pub mod error;
pub mod gaussians;
pub mod kernel;
pub mod layout;
pub mod testing;
pub mod validation;

pub use buffers::{Arriving, GpuVec, Recorded, Uniform};
pub use deform::{DeformationGradients, GpuDeformation};
pub use device::{AdapterFacts, Gpu};
pub use error::GpuError;
pub use gaussians::GpuGaussians;
pub use kernel::{
    Access, Commands, Constant, Kernel, MAX_WORKGROUPS, Module, Snippet, Stage, Timestamps, constants,
    structures, workgroups,
};
pub use layout::{Layout, Member, Shared, WgslType};

/// Every WGSL file of this crate, for the test that validates them.
pub const MODULES: &[&Module] = &[];

/// Every structure that Rust and WGSL share.
pub const LAYOUTS: &[fn() -> Layout] = &[];
