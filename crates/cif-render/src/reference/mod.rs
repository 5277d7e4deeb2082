//! The readable renderer: the specification of every faster path.
//!
//! Generic over the scalar (`f32`, `f64`), single-threaded, without tiles: each pixel walks all visible
//! Gaussians in depth order. One stage per file, forward and backward side by side:
//!
//! | module | answers |
//! |---|---|
//! | [`scene`] | parameters and gradients as plain scalars, addressed by parameter and index |
//! | [`deform`] | where a Gaussian is at a time |
//! | [`tracks`] | where recorded motion carries it |
//! | [`project`] | what it looks like in a view: [`Splat2d`] |
//! | [`sort`] | in which order splats are blended |
//! | [`rasterize`] | colour, depth and the label's rendered identity per pixel |
//! | [`blend`] | other values per Gaussian, blended into an image |
//! | [`cross_entropy`] | the instance loss |
//! | [`dense`] | rendered identities of all instances: images, soft labels, oracle of the K-free form |
//! | [`identity_rows`] | identity distributions, their calibration gradient |
//! | [`pixel`] | a pixel after the forward pass, and its label |
//! | [`identity`] | label mass per Gaussian |
//! | [`render`] | the whole chain |
//!
//! Source: methods reference 2 to 5.1; notation as there: `v_x` is the gradient of the loss by x.

pub mod blend;
pub mod cross_entropy;
pub mod deform;
pub mod dense;
pub mod identity;
pub mod identity_rows;
mod matrix;
pub mod pixel;
pub mod project;
pub mod rasterize;
pub mod render;
pub mod scene;
pub mod sort;
pub mod tracks;

pub use blend::BlendGradients;
pub use deform::Deformed;
pub use identity_rows::IdentityProbabilities;
pub use pixel::{InstanceTarget, PixelState};
pub use project::{Splat2d, SplatGradient, View};
pub use rasterize::RasterGradients;
pub use render::{Forward, SceneGradients, backward, count_identities, forward, render, splats_backward};
pub use scene::{Gaussian, Parameters, Scene};

/// A constant of [`crate::constants`] in the scalar of the evaluation: its `f32` value exactly, so that all
/// precisions share the same thresholds.
fn constant<R: cif_geometry::Real>(value: f32) -> R {
    R::of(f64::from(value))
}
