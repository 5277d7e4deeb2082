//! Masks from a video tracker: one sequence out of all views, and its ids back per view; what a detector found; masks of
//! other tools.
//!
//! Source: methods reference 10.1. The masks of every view, the held-out ones included, come from one tracker
//! pass: scores on them measure agreement with a consistent tracker, not with human truth.

mod folder;
mod found;
mod import;
mod split;
mod view_order;
mod writer;
mod zigzag;

pub use folder::NewFolder;
pub(crate) use found::files_of_frames;
pub use found::{flat_name, found_masks};
pub use import::{Drawn, Import, SourceKind};
pub use split::{KeptInstance, RemovedInstance, SplitReport, split_tracker_masks};
pub use view_order::{ViewOrder, ordered_views};
pub use writer::MaskWriter;
pub use zigzag::{INDEX_FILE, ZigzagEntry, ZigzagIndex, frame_of, position_of, write_zigzag, zigzag_order};

/// The ids of a mask, a PNG file, at its own size.
///
/// # Errors
/// When the file is missing, truncated or no mask.
pub fn read_ids(path: &std::path::Path) -> Result<cif_geometry::PixelGrid<u16>, crate::Error> {
    crate::files::mask::decode(path)
}

/// Labels of a file `instances.json` by id.
///
/// # Errors
/// When the file is missing or damaged.
pub fn read_labels(
    file: &std::path::Path,
) -> Result<std::collections::BTreeMap<u16, crate::InstanceLabel>, crate::Error> {
    crate::instances::read(file, &mut Vec::new())
}
