//! Readers of single files, each bounded by the size of the file: a header cannot make them allocate more.

pub(crate) mod image;
pub(crate) mod json;
pub(crate) mod listing;
pub(crate) mod mask;
pub(crate) mod npy;
pub(crate) mod ply;
pub(crate) mod video;
