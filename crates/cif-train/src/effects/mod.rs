//! Effects: parts of the model that have to show, while a run trains, that they are worth what they cost.
//!
//! | file | effect |
//! |---|---|
//! | `harmonics` | view-dependent colour: degrees of spherical harmonics |
//! | `outputs` | optional outputs of the deformation network: rotations, scales, opacities, colours |
//! | `still` | which Gaussians stand still, and skip the network |
//! | `resting` | whole instances that do |
//! | `appearing` | objects with poses that are not there at times |
//! | `effect` | the trait, and when effects are judged |
//! | `bench` | what they are judged with: errors on held-out pixels |
//! | `motions` | what the network does to Gaussians |
//! | `changes` | where cameras that stay in place see the capture change |
//!
//! Which of them a capture calls for is planned before anything is trained, see [`crate::plan`].

pub(crate) mod appearing;
mod bench;
pub(crate) mod changes;
mod effect;
pub(crate) mod harmonics;
mod motions;
mod outputs;
mod resting;
mod still;

use std::sync::Arc;

pub use self::bench::Bench;
pub(crate) use self::bench::{Step, is_judged};
pub use self::effect::{Effect, Place, Standing};
pub(crate) use self::still::{copy_still, gather_still};

/// The effects of every run, in the order in which they are judged.
pub(crate) fn all() -> Vec<Arc<dyn Effect>> {
    vec![Arc::new(harmonics::Harmonics), Arc::new(outputs::Outputs), Arc::new(still::Still)]
}
