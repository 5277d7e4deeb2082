//! Fault bits, by which a step with values that no optimiser may take is held back until the host has answered.
//!
//! Kernels get an array of words. The first holds the bits of the step under way, the second is not 0 from a step
//! that must not be taken on: neither that step nor any recorded after it moves a parameter, until the host has
//! cleared both.

use cif_field::parameters::{MLP, Parameter, TABLE};

use super::gaussians::COLUMNS;
use super::kernel::{Constant, Snippet, constants};

/// Words of the array.
pub const WORDS: usize = 4;

/// The pairs of a view had no room.
pub const NO_ROOM: u32 = 1 << 31;
/// The colour loss.
pub const COLOR_LOSS: u32 = 1 << 30;
/// The instance loss.
pub const INSTANCE_LOSS: u32 = 1 << 29;
/// Gradient of exposures.
pub const EXPOSURES: u32 = 1 << 28;
/// Gradient of poses.
pub const POSES: u32 = 1 << 27;

/// Bit of the gradient of a parameter: its place in the table.
///
/// # Panics
/// When it is not in the table.
#[must_use]
pub fn bit(parameter: &Parameter) -> u32 {
    1 << TABLE.iter().position(|other| other == parameter).expect("a parameter of the table")
}

/// Largest gradient whose square is finite in single precision, with a margin: what is larger would make a moment
/// infinite for ever.
pub const MAX_GRADIENT: f32 = 1e18;

/// Names of the bits and of what they are found by, for WGSL.
pub const FAULTS: Snippet = Snippet {
    name: "faults",
    text: || {
        let names = constants(&[
            ("MLP_FAULT", Constant::Unsigned(bit(&MLP))),
            ("NO_ROOM_FAULT", Constant::Unsigned(NO_ROOM)),
            ("COLOR_LOSS_FAULT", Constant::Unsigned(COLOR_LOSS)),
            ("INSTANCE_LOSS_FAULT", Constant::Unsigned(INSTANCE_LOSS)),
            ("EXPOSURES_FAULT", Constant::Unsigned(EXPOSURES)),
            ("POSES_FAULT", Constant::Unsigned(POSES)),
            ("LARGEST_GRADIENT", Constant::Unsigned(MAX_GRADIENT.to_bits())),
        ]);
        let columns: String = COLUMNS
            .iter()
            .map(|(parameter, first)| {
                let end = first + parameter.width();
                format!("    if component < {end}u {{\n        return {}u;\n    }}\n", bit(parameter))
            })
            .collect();
        let of_geometry =
            format!("fn geometry_fault(component: u32) -> u32 {{\n{columns}    return 0u;\n}}\n");
        format!("{names}{}\n{of_geometry}", include_str!("shared/faults.wgsl"))
    },
};
