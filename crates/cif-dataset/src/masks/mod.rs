//! Masks from a video tracker: one sequence out of all views, and its ids back per view; what a detector found; masks of
//! other tools.
//!
//! Source: methods reference 10.1. The masks of every view, the held-out ones included, come from one tracker
//! pass: scores on them measure agreement with a consistent tracker, not with human truth.

mod folder;
mod found;
mod import;
mod numbered;
mod split;
mod view_order;
mod writer;
mod zigzag;

pub use folder::NewFolder;
pub(crate) use found::files_of_frames;
pub use found::{flat_name, found_masks};
pub use import::{Drawn, Import, SourceKind};
pub(crate) use numbered::number_of;
pub use numbered::{files_of_video, first_number, numbered_files};
pub use split::{KeptInstance, RemovedInstance, SplitReport, split_tracker_masks};
pub use view_order::{ViewOrder, ordered_views};
pub(crate) use writer::CONFIDENCE_FOLDER;
pub use writer::MaskWriter;
pub use zigzag::{INDEX_FILE, ZigzagEntry, ZigzagIndex, frame_of, position_of, write_zigzag, zigzag_order};

/// The ids of a mask, a PNG file, at its own size.
///
/// # Errors
/// When the file is missing, truncated or no mask.
pub fn read_ids(path: &std::path::Path) -> Result<cif_geometry::PixelGrid<u16>, crate::Error> {
    crate::files::mask::decode(path)
}

/// The ids of a mask, a PNG file, at the size of an image: of any other size of that aspect by nearest neighbour. Masks of
/// the pixels as the file of the image stores them turn as it did.
///
/// # Errors
/// When the file is missing, truncated, no mask, or of another aspect.
pub fn read_ids_at(
    path: &std::path::Path,
    image: &std::path::Path,
    size: (u32, u32),
    turn: crate::Turn,
) -> Result<cif_geometry::PixelGrid<u16>, crate::Error> {
    let ids = turn.seen(crate::files::mask::decode(path)?, size);
    if !crate::sizes::same_aspect((ids.width, ids.height), size) {
        return Err(crate::Error::MaskSize {
            mask: path.to_owned(),
            mask_size: (ids.width, ids.height),
            image: image.to_owned(),
            image_size: size,
        });
    }
    Ok(crate::files::mask::nearest_resize(&ids, size.0, size.1))
}

/// Writes ids, or confidences, as a grey PNG file.
///
/// # Errors
/// When the file cannot be written.
pub fn write_ids(path: &std::path::Path, ids: &cif_geometry::PixelGrid<u16>) -> Result<(), crate::Error> {
    crate::files::mask::write(path, ids)
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
