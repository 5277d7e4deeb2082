//! Appearance of pixels: features of colour and texture, and which class the pixels of keyframes give to them.
//!
//! | module | answers |
//! |---|---|
//! | [`features`] | the numbers per pixel |
//! | [`forest`] | which class has most of the similar pixels of keyframes |

mod features;
mod forest;

pub(crate) use features::Features;
pub(crate) use forest::{Forest, Samples};
