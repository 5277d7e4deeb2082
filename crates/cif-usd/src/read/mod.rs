//! Stages as scene graphs, and prims by label.

mod arrays;
mod cameras;
mod colors;
mod expansion;
mod frames;
mod joints;
pub(crate) mod labels;
mod layer_spec;
mod nesting;
mod nodes;
pub(crate) mod open;
mod owner;
pub(crate) mod query;
mod reading;
mod splats;
mod stage;
mod values;
mod windows;

pub(crate) use stage::scene;
