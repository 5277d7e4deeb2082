//! Renders a dynamic Gaussian field, forward and backward.
//!
//! | module | answers |
//! |---|---|
//! | [`blend`] | values per Gaussian in an image: features, logits, codes |
//! | [`constants`] | thresholds of the blending rule, each with its derivation |
//! | [`settings`] | what a render may vary |
//! | [`speed`] | peak throughput of a device or the processor |
//! | [`gradients`] | where gradients of all parameters are kept |
//! | [`image`] | what comes out per pixel |
//! | [`motion`] | how far a Gaussian moves on screen between two views |
//! | [`quality`] | renders that take shortcuts |
//! | [`reference`] | the readable oracle, generic over `f32` and `f64` |
//! | [`cpu`] | the fast path: tiles, SIMD, threads |
//! | `wgpu` | the GPU path, with the feature of that name |
//! | [`synthetic`] | small random scenes for tests and benchmarks |

pub mod blend;
pub mod constants;
pub mod cpu;
pub mod gradients;
pub mod image;
pub mod motion;
pub mod poses;
pub mod quality;
pub mod reference;
pub mod settings;
pub mod speed;
pub mod synthetic;
#[cfg(feature = "wgpu")]
pub mod wgpu;

pub use blend::{BlendRequest, BlendedImage, Blending};
pub use gradients::Gradients;
pub use image::{Channels, InstanceImage, InstanceRanks, RenderedImage, UNLABELLED};
pub use motion::screen_motion;
pub use poses::{GroupedGaussian, PoseGradient};
pub use settings::{GeometryPath, InstanceNormalisation, InstanceSettings, OccupancySource, RenderSettings};
pub use speed::Speed;
