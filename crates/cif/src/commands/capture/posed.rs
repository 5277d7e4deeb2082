//! Poses of the images, and the decisions that they depend on.

use std::path::{Path, PathBuf};

use cif_capture::frames::{self, Shot};
use cif_capture::poses::Poses;
use cif_capture::structure::{Order, Verdict};

use super::options::{Capture, OrderName};

/// Photographs are matched each with each up to this number, unless something else is asked for.
const ANY_ORDER: usize = 120;

/// Poses of all images, and how they came about.
pub(super) struct Posed {
    pub(super) poses: Poses,
    pub(super) from: String,
    pub(super) verdict: Option<Verdict>,
    pub(super) metres_known: bool,
    pub(super) up_known: bool,
}

/// Results of a run without a capture, for those that continue it.
#[derive(Default)]
pub(super) struct Left {
    /// Poses that were found and not believed.
    pub(super) unbelieved: Option<Posed>,
    /// A camera was seen to stand still, which no other option changes than one that says that it moves.
    pub(super) stands_still: bool,
}

/// True where the cameras stand still, as the user says or the images show.
pub(super) fn is_fixed(command: &Capture, shots: &[Shot]) -> bool {
    command.fixed || (!command.moving && frames::is_fixed(shots))
}

/// How images that are solved follow each other.
pub(super) fn order(command: &Capture, solved: &[Shot], fixed: bool) -> Order {
    let is_video = solved.iter().any(|shot| shot.time.is_some()) && command.times.is_none();
    match command.order {
        OrderName::Sequence => Order::Sequence,
        OrderName::Any => Order::Any,
        OrderName::Auto if fixed || (!is_video && solved.len() <= ANY_ORDER) => Order::Any,
        OrderName::Auto => Order::Sequence,
    }
}

/// File in which a scene of this capture would be saved, for messages.
pub(super) fn scene_name(place: &Path) -> PathBuf {
    place.with_extension("cif")
}
