//! Where Gaussians are over time.

pub mod frames;
pub mod source;

pub use source::{FieldMotion, MotionSource};
