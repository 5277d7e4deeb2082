//! Instance masks of all frames from a few painted ones.
//!
//! | module | answers |
//! |---|---|
//! | [`flow`] | dense optical flow between two images |
//! | `appearance` | which class of the keyframes a pixel looks like |
//! | [`propagate`](mod@propagate) | masks of all frames of a camera from its keyframes |
//! | [`rig`] | masks of cameras without keyframes, by points in the world |
//! | [`suggest`] | which frame to paint next |
//! | [`plane`] | single-precision images |
//!
//! Everything is deterministic, whatever the number of threads. Images are followed at most 640 pixels wide or high;
//! masks have the size of the images.

mod appearance;
mod error;
pub mod flow;
mod picture;
pub mod plane;
pub mod propagate;
pub mod rig;
pub mod suggest;

pub use error::Error;
pub use propagate::{Clip, Keyframe, Mask, propagate};
