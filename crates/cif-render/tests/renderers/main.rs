//! Views through every renderer: the reference in both precisions, the fast path at every level of vector
//! instructions that this processor has, and the GPU where there is one (`CIF_TEST_GPU=off|auto|require`).
//!
//! | module | holds |
//! |---|---|
//! | `support` | random cotangents, scenes clear of discontinuities, comparison of numbers, finite differences |
//! | `renderers` | a training view through every renderer, in one form |
//! | `views` | a training view through every renderer against the reference in double precision: tests that each has |
//! | `agreement` | pictures, counts and single properties of renderers against the reference |
//! | `hard_cases` | numerically hard cases, the table of `tests/README.md` |
//! | `gradients` | the reference against finite differences |
//! | `instances` | the instance pass of the reference, worked out by hand |
//! | `metamorphic` | changes to a scene that must not change its image |
//! | `blend` | values per Gaussian, blended and differentiated |
//! | `deformation` | gradients of the deformation alone |
//! | `bands`, `tracks` | views drawn in bands, recorded motion |
//! | `gpu`, `gpu_counts` | stages on the GPU with the reference's own inputs, and what only a GPU does |
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod agreement;
mod bands;
mod blend;
mod deformation;
#[cfg(feature = "wgpu")]
mod gpu;
#[cfg(feature = "wgpu")]
mod gpu_counts;
mod gradients;
mod hard_cases;
mod instances;
mod metamorphic;
#[cfg(feature = "wgpu")]
mod on_gpu;
mod renderers;
mod support;
mod tracks;
mod views;
