//! Output folders that appear whole or not at all.

use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::Error;

/// A folder being filled beside its final place.
pub(super) struct NewFolder {
    partial: TempDir,
    place: PathBuf,
}

impl NewFolder {
    /// Starts a folder; nothing is at `place` until [`NewFolder::finish`].
    ///
    /// # Errors
    /// When `place` holds something already, or its parent cannot be written.
    pub(super) fn create(place: &Path) -> Result<Self, Error> {
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
        let parent = match place.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        std::fs::create_dir_all(parent).map_err(Error::write(parent))?;
        let partial =
            tempfile::Builder::new().prefix(".partial").tempdir_in(parent).map_err(Error::write(parent))?;
        Ok(Self { partial, place: place.to_owned() })
    }

    /// Where files are written for now.
    pub(super) fn path(&self) -> &Path {
        self.partial.path()
    }

    /// Moves the folder to its place.
    ///
    /// # Errors
    /// When it cannot be moved.
    pub(super) fn finish(self) -> Result<(), Error> {
        if self.place.is_dir() {
            std::fs::remove_dir(&self.place).map_err(Error::write(&self.place))?;
        }
        #[cfg(unix)]
        {
            // A temporary folder is private; what is kept should be readable as any other.
            use std::os::unix::fs::PermissionsExt;
            let permissions = std::fs::Permissions::from_mode(0o755);
            std::fs::set_permissions(self.partial.path(), permissions).map_err(Error::write(&self.place))?;
        }
        std::fs::rename(self.partial.path(), &self.place).map_err(Error::write(&self.place))?;
        let _ = self.partial.keep();
        Ok(())
    }
}
