//! The fast path: tiles, SIMD, threads.
//!
//! | module | stage |
//! |---|---|
//! | `deform` | canonical Gaussians to the time of the view, and back |
//! | `project` | Gaussians to splats, and back |
//! | `bin` | depth order and tile lists |
//! | `rasterize`, `rasterize_backward` | pixels, and back |
//! | `dense` | instance images |
//! | `identity` | label mass for identity estimation |
//!
//! Results do not depend on the number of threads: every sum over pixels, tiles or Gaussians runs in an
//! order fixed by the data.

mod bin;
mod channels;
mod deform;
mod dense;
mod identity;
mod matrix;
mod project;
mod rasterize;
mod rasterize_backward;
mod renderer;
mod timing;
mod vector;

pub use renderer::{ForwardPass, IdentityCounts, Renderer, SimdLevel, ViewStatistics};
pub use timing::StageTimes;
