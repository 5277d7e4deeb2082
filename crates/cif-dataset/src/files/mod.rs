//! Readers of single files, each bounded by the size of the file: a header cannot make them allocate more.

pub(crate) mod confidence;
pub(crate) mod exr;
pub(crate) mod image;
pub(crate) mod json;
pub(crate) mod listing;
pub(crate) mod mask;
pub(crate) mod npy;
pub(crate) mod ply;
pub(crate) mod points;
pub(crate) mod video;

/// No PNG holds more than this per byte, as DEFLATE cannot pack more: a header that claims more is not believed.
pub(crate) const MAX_DEFLATE_RATIO: u64 = 1032;
