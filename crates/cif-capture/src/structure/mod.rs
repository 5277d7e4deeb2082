//! Where the cameras were: structure from motion through pycolmap, tried with one setting after the other
//! until one leaves no doubt, or two runs agree.

mod features;
mod kept;
mod ladder;
mod pairs;
mod points;
mod python;
mod request;
mod stage;
mod verdict;

pub use kept::{has_kept, kept_beside, remove_kept};
pub use ladder::{Found, find};
pub use pairs::Order;
pub use points::{points_of_capture, points_of_images, points_of_rig};
pub use python::{pythons, set_python};
pub use request::{Lenses, Request};
pub use verdict::{Check, Verdict};
