//! Strings the stages together.
//!
//! | module | direction |
//! |---|---|
//! | `state` | the renderer, and what it keeps between stages and views |
//! | `forward` | forward |
//! | `backward` | gradients of the last forward pass |
//! | `images` | pixels of tiles as rows of pictures, instance images |
//! | `blend` | values per Gaussian, in both directions |
//! | `banded` | pictures of a view, whole or band by band within a budget of memory |
//! | `count` | label mass for identity estimation |
//! | `pose` | Gaussians at the time of the view |
//! | `displace` | motion without pictures |
//! | `inspect` | the first value that is not finite |

mod backward;
mod banded;
mod blend;
mod count;
mod displace;
mod forward;
mod images;
mod inspect;
mod pose;
mod state;

pub use self::banded::{BandRequest, RenderedBand};
pub use self::blend::BlendWeightGradients;
pub use self::forward::ForwardPass;
pub use self::inspect::NotFinite;
pub use self::state::{Renderer, ViewStatistics};
