//! Losses and their gradients: of the colours of a view (methods reference 1.4), and of motion that is known.

mod color;
pub mod displacement;
pub(crate) mod held_out;
mod rows;
pub(crate) mod ssim;
#[cfg(test)]
mod tests;

pub use color::{ColorLoss, color_loss};
pub use ssim::SsimScratch;
