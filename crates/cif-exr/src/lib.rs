//! Rendered frames to multi-layer EXR files that compositors take apart again.
//!
//! | module | answers |
//! |---|---|
//! | [`color`] | which colours a file holds |
//! | [`cryptomatte`] | which objects cover a pixel, and how much |
//! | [`layers`] | which channels a file has, and in which units |
//! | [`write`] | how a file is written |
//!
//! A file has one part of scan lines, ZIP-compressed without loss, all channels 32-bit floats except ids:
//!
//! | channels | content |
//! |---|---|
//! | `R`, `G`, `B`, `A` | colour of the splats, multiplied by alpha, without the background colour |
//! | `Z` | expected depth along the viewing axis, world units; 1e10 where nothing is |
//! | `forward.u`, `forward.v` | motion to the next frame, pixels, u to the right, v up |
//! | `instance.id` | mask value of the instance that the pixel shows, 0 = none (32-bit integer) |
//! | `coverage.V`, `foreground.V`, `probability.V`, `entropy.V` | instance layers as `cif render` has them |
//! | `uCryptoObject00` ... `uCryptoObject02` | `.R .G .B .A`: id and coverage of the six foremost objects |
//!
//! No layer has more than four channels, because Blender takes such layers only. The header says what the units are
//! in its `cif/...` attributes.

pub mod color;
pub mod cryptomatte;
mod error;
pub mod layers;
mod object;
pub mod write;

pub use color::ColorEncoding;
pub use error::ExrError;
pub use layers::{Frame, Rows};
pub use object::Object;
pub use write::{FrameWriter, write};

#[cfg(test)]
mod tests;
