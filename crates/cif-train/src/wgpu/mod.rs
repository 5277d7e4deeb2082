//! Training on the GPU: losses and optimiser as kernels; rendering and the deformation are those of
//! `cif_render::wgpu`.
//!
//! | file | stage |
//! |---|---|
//! | `losses.wgsl`, `ssim.wgsl` | colour loss with its gradient, value of the instance loss |
//! | `leave_out.wgsl` | pixels that train nothing |
//! | `exposure.wgsl` | what cameras make of colours, and its gradient |
//! | `judge.wgsl` | whether a step may move anything |
//! | `rearrange.wgsl` | rows after a change of the set of Gaussians |
//! | `identity.wgsl` | probabilities of the identity rows |
//! | `accumulate.wgsl` | sums over the views of a step, statistics of densification |
//! | `adam_gaussians.wgsl`, `adam_planes.wgsl`, `adam_network.wgsl`, `adam_exposures.wgsl`, `adam_poses.wgsl` | the optimiser |
//! | `displacement.wgsl` | holds travelling objects to their paths, everything else to its place |
//! | `kernels` | the files, and what they share with Rust |
//! | `losses`, `exposure`, `judge`, `motion`, `optimiser`, `poses`, `rearrange` | recording them |

pub(crate) mod exposure;
pub mod judge;
pub mod kernels;
pub mod losses;
pub mod motion;
pub mod optimiser;
pub(crate) mod poses;
pub mod rearrange;

#[cfg(test)]
mod tests;
