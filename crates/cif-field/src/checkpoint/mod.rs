//! `.cif` files: one [safetensors](https://github.com/huggingface/safetensors) file per scene.
//!
//! The header's `__metadata__` holds strings:
//!
//! | key | holds |
//! |---|---|
//! | `cif.format` | up to [`FORMAT`], a decimal number: the oldest layout that holds the field |
//! | `cif.version` | version of the cif that wrote the file |
//! | `cif.field` | JSON of everything in a [`Field`] that is not a tensor |
//! | `cif.training` | JSON of the [`TrainingState`]; absent in a scene without one |
//! | `cif.head` | JSON of [`Checkpoint::head`], likewise |
//!
//! and the tensors are, little-endian, with N Gaussians and E identity entries:
//!
//! | tensor | type | shape |
//! |---|---|---|
//! | `gaussians.means`, `gaussians.log_scales` | F32 | `[N, 3]` |
//! | `gaussians.quaternions` | F32 | `[N, 4]`, w x y z |
//! | `gaussians.opacity_logits`, `gaussians.occupancy_logits` | F32 | `[N]` |
//! | `gaussians.sh_coefficients` | F32 | `[N, 16, 3]` |
//! | `deformation.planes`, `deformation.mlp` | F32 | `[floats]`; absent in a static scene |
//! | `deformation.still` | U8 | `[N]`, 1 where the deformation leaves a Gaussian as it is; absent where it moves all |
//! | `tracks.group_of` | U32 | `[N]`, 2^32 - 1 without a group; absent without recorded motion, as the next four |
//! | `tracks.poses` | F64 | `[poses, 8]`: time, translation x y z, quaternion w x y z; group after group |
//! | `tracks.means`, `tracks.log_scales` | F32 | `[rows, 3]`, dense samples, group after group |
//! | `tracks.quaternions` | F32 | `[rows, 4]`, w x y z |
//! | `tracks.opacities` | F32 | `[rows]`, in [0, 1], group after group; absent where none changes |
//! | `tracks.sh_coefficients` | F32 | `[rows, 48]`, group after group; absent where no colour changes |
//! | `identities.row_offsets` | U32 | `[N + 1]`; absent without identities, as the next two |
//! | `identities.labels` | U16 | `[E]` |
//! | `identities.log_estimates`, `identities.log_calibrations` | F32 | `[E]` |
//! | `identities.owners` | I32 | `[N]`: an instance, -1 for none, -2 where the identity row decides; absent where all do |
//! | `training.<name>`, `head.<name>` | F32, F64, U32 or U64 | `[length]` |
//!
//! Floats survive bit by bit, in tensors and in JSON; equal fields give equal bytes. A file is written next to
//! its destination and renamed, so a failed save leaves what was there. A reader trusts nothing: it allocates
//! no more than a small multiple of the file's length, and checks everything that later code relies on.

mod contents;
mod error;
mod format;
mod read;
mod write;

use std::io::{Read, Seek, Write};
use std::path::Path;

pub use contents::{Checkpoint, StateTensor, TrainingState};
pub use error::CheckpointError;
pub use format::FORMAT;

use self::contents::States;
use crate::Field;

impl Checkpoint {
    /// Writes the file, replacing an older one only once the new one is complete on disk.
    ///
    /// # Errors
    /// When the field is not valid (see [`Field::validate`]) or the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), CheckpointError> {
        write::save(path.as_ref(), &self.field, self.states())
    }

    fn states(&self) -> States<'_> {
        States { training: self.training.as_ref(), head: self.head.as_ref() }
    }

    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is not a whole `.cif` file, or holds values that no cif writes.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, CheckpointError> {
        read::load(path.as_ref(), true)
    }

    /// Reads a file whose values may be broken, to be looked at and repaired (see [`crate::health`]). Nothing else
    /// may be done with such a field.
    ///
    /// # Errors
    /// When it cannot be read or is not a whole `.cif` file.
    pub fn load_unchecked(path: impl AsRef<Path>) -> Result<Self, CheckpointError> {
        read::load_unchecked(path.as_ref(), true)
    }

    /// Writes the bytes of a `.cif` file to any sink; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Checkpoint::save`].
    pub fn write(&self, sink: &mut dyn Write, path: impl AsRef<Path>) -> Result<(), CheckpointError> {
        write::write(sink, path.as_ref(), &self.field, self.states())
    }

    /// Reads the bytes of a `.cif` file from any source; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn read(source: &mut (impl Read + Seek), path: impl AsRef<Path>) -> Result<Self, CheckpointError> {
        read::read(source, path.as_ref(), true)
    }
}

impl Field {
    /// Writes the scene alone as a `.cif` file (see [`crate::checkpoint`]).
    ///
    /// # Errors
    /// As [`Checkpoint::save`].
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), CheckpointError> {
        write::save(path.as_ref(), self, States::default())
    }

    /// [`Checkpoint::save`] without taking the field.
    ///
    /// # Errors
    /// As [`Checkpoint::save`].
    pub fn save_with_training(
        &self,
        training: &TrainingState,
        path: impl AsRef<Path>,
    ) -> Result<(), CheckpointError> {
        write::save(path.as_ref(), self, States { training: Some(training), head: None })
    }

    /// Reads the scene of a `.cif` file and leaves a training state in it unread.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self, CheckpointError> {
        Ok(read::load(path.as_ref(), false)?.field)
    }
}

#[cfg(test)]
mod tests;
