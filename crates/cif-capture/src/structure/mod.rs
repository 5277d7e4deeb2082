//! Where the cameras were: structure from motion through pycolmap, tried with one setting after the other
//! until two runs agree.

mod ladder;
mod pairs;
mod points;
mod python;
mod verdict;

pub use ladder::{Found, Lenses, Request, find};
pub use pairs::Order;
pub use points::{points_of_images, points_of_rig};
pub use python::{pythons, set_python};
pub use verdict::{Check, Verdict, judge};
