//! What no optimiser may take: bits of a word that kernels set, and whether steps wait for the host.
//!
//! Kernels get an array of words. The first holds the bits of the step under way, the second is not 0 from a step
//! that must not be taken on: neither that step nor any recorded after it moves a parameter, until the host has
//! cleared both.

use super::kernel::{Constant, Snippet, constants};

/// Words of the array.
pub const WORDS: usize = 4;

/// Gradient of the planes is not finite, or beyond what fixed point holds.
pub const PLANES: u32 = 1;
/// Gradient of centres.
pub const MEANS: u32 = 2;
/// Gradient of log-scales.
pub const LOG_SCALES: u32 = 4;
/// Gradient of quaternions.
pub const QUATERNIONS: u32 = 8;
/// Gradient of opacity logits.
pub const OPACITY: u32 = 16;
/// Gradient of occupancy logits.
pub const OCCUPANCY: u32 = 32;
/// Gradient of spherical harmonics.
pub const SH: u32 = 64;
/// Gradient of calibrations.
pub const CALIBRATIONS: u32 = 128;
/// Gradient of the network.
pub const MLP: u32 = 256;
/// The pairs of a view had no room.
pub const NO_ROOM: u32 = 512;
/// The colour loss.
pub const COLOR_LOSS: u32 = 1024;
/// The instance loss.
pub const INSTANCE_LOSS: u32 = 2048;
/// Gradient of exposures.
pub const EXPOSURES: u32 = 4096;

/// Largest gradient whose square is finite in single precision, with a margin: what is larger would make a moment
/// infinite for ever.
pub const MAX_GRADIENT: f32 = 1e18;

/// Names of the bits and of what they are found by, for WGSL.
pub const FAULTS: Snippet = Snippet {
    name: "faults",
    text: || {
        let names = constants(&[
            ("MEANS_FAULT", Constant::Unsigned(MEANS)),
            ("LOG_SCALES_FAULT", Constant::Unsigned(LOG_SCALES)),
            ("QUATERNIONS_FAULT", Constant::Unsigned(QUATERNIONS)),
            ("OPACITY_FAULT", Constant::Unsigned(OPACITY)),
            ("OCCUPANCY_FAULT", Constant::Unsigned(OCCUPANCY)),
            ("MLP_FAULT", Constant::Unsigned(MLP)),
            ("NO_ROOM_FAULT", Constant::Unsigned(NO_ROOM)),
            ("COLOR_LOSS_FAULT", Constant::Unsigned(COLOR_LOSS)),
            ("INSTANCE_LOSS_FAULT", Constant::Unsigned(INSTANCE_LOSS)),
            ("EXPOSURES_FAULT", Constant::Unsigned(EXPOSURES)),
            ("LARGEST_GRADIENT", Constant::Unsigned(MAX_GRADIENT.to_bits())),
        ]);
        format!("{names}{}", include_str!("shared/faults.wgsl"))
    },
};
