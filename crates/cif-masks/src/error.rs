//! Errors of propagation.

/// Masks could not be propagated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An image of the capture could not be read.
    #[error(transparent)]
    Capture(#[from] cif_dataset::Error),
    /// No frame has a painted object.
    #[error("no keyframe shows an object; paint the objects of at least one frame with their ids")]
    NoObject,
    /// There are too many ids, or frames between keyframes, for the memory that is free.
    #[error("{0}; paint fewer objects at a time, or more frames between")]
    Memory(#[from] cif_system::memory::TooLittle),
    /// The caller asked to stop.
    #[error("interrupted")]
    Stopped,
}
