//! Solids and points around what a node shows.

pub(crate) mod body;
pub mod boxes;
pub mod colliders;
pub mod convex_hull;
pub mod extent;
pub(crate) mod flat;
pub mod ground;
pub mod level_of_detail;
pub mod mass;
pub mod proxy;
