//! Output folders that appear whole or not at all.

use std::path::{Path, PathBuf};

use cif_output::{Scratch, folder_of};

use crate::Error;

/// A folder being filled next to its final place.
pub struct NewFolder {
    scratch: Scratch,
    partial: PathBuf,
    place: PathBuf,
}

impl NewFolder {
    /// Starts a folder; nothing is at `place` until [`NewFolder::finish`].
    ///
    /// # Errors
    /// When `place` holds something already, or its parent cannot be written.
    pub fn create(place: &Path) -> Result<Self, Error> {
        check_free(place)?;
        let parent = folder_of(place);
        std::fs::create_dir_all(&parent).map_err(Error::write(&parent))?;
        let scratch = Scratch::inside(&parent).map_err(Error::write(&parent))?;
        let partial = scratch.folder().map_err(Error::write(&parent))?;
        Ok(Self { scratch, partial, place: place.to_owned() })
    }

    /// Where files are written for now.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.partial
    }

    /// Moves the folder to its place.
    ///
    /// # Errors
    /// When something came to `place` in the meantime, or the folder cannot be moved.
    pub fn finish(self) -> Result<(), Error> {
        let Self { scratch, partial, place } = self;
        check_free(&place)?;
        scratch.replace(&[(partial, place.clone())], &[]).map_err(Error::write(&place))
    }
}

/// Refuses a place that holds something already.
fn check_free(place: &Path) -> Result<(), Error> {
    let occupied = match std::fs::read_dir(place) {
        Ok(mut entries) => entries.next().is_some(),
        Err(_) => place.exists(),
    };
    if occupied {
        return Err(Error::invalid(
            place,
            "something is there already; give a new folder, or empty this one",
        ));
    }
    Ok(())
}
