//! The fast path: tiles, SIMD, threads.
//!
//! | module | stage |
//! |---|---|
//! | `deform` | canonical Gaussians to the time of the view, and back |
//! | `posed` | the Gaussians at the time of the view, by row |
//! | `project`, `project_backward` | Gaussians to splats, and back |
//! | `gaussian_lanes`, `functions`, `rotation`, `harmonics` | what they compute with, sixteen Gaussians at a time |
//! | `bin` | depth order and tile lists |
//! | `bands` | which tiles are drawn at once |
//! | `tile` | how a splat falls on a tile's pixels and blends: the steps that all of these share: |
//! | `rasterize`, `rasterize_backward` | pixels, and back |
//! | `dense` | instance images |
//! | `blend`, `blend_backward` | other values per Gaussian, and back |
//! | `identity`, `counts` | label mass for identity estimation |
//! | `contributors` | label mass by the contributors of every pixel |
//! | `products` | matrix products for networks elsewhere |
//! | `renderer` | the stages in order, in both directions |
//!
//! Results do not depend on the number of threads: every sum over pixels, tiles or Gaussians runs in an
//! order fixed by the data.

mod bands;
mod bin;
mod blend;
mod blend_backward;
mod contributors;
mod counts;
mod deform;
mod dense;
mod functions;
mod gaussian_lanes;
mod groups;
mod harmonics;
mod identity;
mod labels;
mod level;
mod matrix;
mod pixels;
mod posed;
mod products;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod renderer;
mod rotation;
mod speed;
mod tile;
mod timing;

pub use contributors::{ContributorMass, ContributorRule};
pub use counts::IdentityCounts;
pub use level::SimdLevel;
pub use products::{Products, Side};
pub use renderer::{
    BandRequest, BlendWeightGradients, ForwardPass, NotFinite, RenderedBand, Renderer, ViewStatistics,
};
pub use timing::StageTimes;
