//! Masks of the frames of a capture, written as a folder that captures are read with.

use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;

use super::folder::NewFolder;
use crate::files::{json, mask};
use crate::{Error, InstanceLabel};

/// Folder of confidences inside a mask folder.
pub(crate) const CONFIDENCE_FOLDER: &str = "confidence";

/// A new folder of masks: `<frame>.png` with the ids of a frame, `confidence/<frame>.png` with the probability that each
/// is right in units of 1 / 255, and `instances.json`. It appears when it is finished, whole.
pub struct MaskWriter {
    folder: NewFolder,
    place: PathBuf,
}

impl MaskWriter {
    /// Starts a folder.
    ///
    /// # Errors
    /// When `place` holds something already, or its parent cannot be written.
    pub fn create(place: &Path) -> Result<Self, Error> {
        Ok(Self { folder: NewFolder::create(place)?, place: place.to_owned() })
    }

    /// Folder that is being filled, for other files that belong next to the masks.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Writes the ids of a frame, and their confidence where there is one.
    ///
    /// # Errors
    /// When the name leads out of the folder, or a file cannot be written.
    pub fn add(
        &self,
        frame: &str,
        ids: &PixelGrid<u16>,
        confidence: Option<&PixelGrid<u8>>,
    ) -> Result<(), Error> {
        let write = |folder: &Path, values: &PixelGrid<u16>| {
            let path = cif_output::inside(folder, frame, "png").map_err(Error::write(&self.place))?;
            if let Some(parent) = path.parent() {
                std::fs::create_dir_all(parent).map_err(Error::write(parent))?;
            }
            mask::write(&path, values)
        };
        write(self.folder.path(), ids)?;
        match confidence {
            Some(grid) => {
                write(&self.folder.path().join(CONFIDENCE_FOLDER), &grid.map(|value| u16::from(*value)))
            }
            None => Ok(()),
        }
    }

    /// Writes the labels and puts the folder in its place.
    ///
    /// # Errors
    /// When the file system refuses.
    pub fn finish(self, instances: &[InstanceLabel]) -> Result<(), Error> {
        json::write(&self.folder.path().join("instances.json"), &instances)?;
        self.folder.finish()
    }
}
