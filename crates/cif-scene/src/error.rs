//! Errors of building a scene.

use crate::graph::OptionError;

/// Why a field cannot become a scene.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// Nothing to export.
    #[error(
        "the field holds no Gaussian that can be seen (of {total}: {invisible} below opacity {min_opacity}, {invalid} not finite); train longer or lower the opacity cut"
    )]
    NoGaussians {
        /// Gaussians in the field.
        total: usize,
        /// Below the opacity or occupancy cut.
        invisible: usize,
        /// With a value that is not finite or a scale of zero.
        invalid: usize,
        /// The cut.
        min_opacity: f32,
    },
    /// The field's arrays do not fit together.
    #[error("the field is inconsistent: {what}; the file was not written by cif or is damaged")]
    Inconsistent {
        /// Which arrays.
        what: String,
    },
    /// No captured time in the range.
    #[error("frames {first} to {last} hold no captured time; the field has frames 0 to {newest}")]
    EmptyFrameRange {
        /// First frame asked for.
        first: usize,
        /// Last frame asked for.
        last: usize,
        /// Last frame of the field.
        newest: usize,
    },
    /// An object of a file that cannot become Gaussians.
    #[error("{object} cannot be imported: {what}; mend it where the file was made")]
    Import {
        /// Name of the node, or the file.
        object: String,
        /// The problem.
        what: String,
    },
    /// A file that does not say which field it came from.
    #[error(
        "{file} does not say that cif exported it, so its edits cannot be told; import it without a base to get a \
         scene of its own"
    )]
    NotExported {
        /// The file.
        file: String,
    },
    /// Edits of another field.
    #[error(
        "{file} was exported from another scene than this base (fingerprint {exported}, the base has {base}); give \
         the scene it was exported from, or force it if this one has the same Gaussians in the same order"
    )]
    OtherBase {
        /// The file.
        file: String,
        /// Fingerprint in the file.
        exported: String,
        /// Fingerprint of the base.
        base: String,
    },
    /// Scenes that are no windows of one capture.
    #[error("the scenes are no windows of one capture: {what}")]
    Windows {
        /// The misfit and its remedy.
        what: String,
    },
    /// An option outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
}
