//! Training on the GPU: losses and optimiser as kernels; rendering and the deformation are those of
//! `cif_render::wgpu`.
//!
//! | file | stage |
//! |---|---|
//! | `losses.wgsl`, `ssim.wgsl` | colour loss with its gradient, value of the instance loss |
//! | `identity.wgsl` | probabilities of the identity rows |
//! | `accumulate.wgsl` | sums over the views of a step, statistics of densification |
//! | `adam_gaussians.wgsl`, `adam_planes.wgsl`, `adam_network.wgsl` | the optimiser |
//! | `displacement.wgsl` | holds travelling objects to their paths, everything else to its place |
//! | `kernels` | the files, and what they share with Rust |
//! | `losses`, `motion`, `optimiser` | recording them |

pub mod kernels;
pub mod losses;
pub mod motion;
pub mod optimiser;

#[cfg(test)]
mod tests;
