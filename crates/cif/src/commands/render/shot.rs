//! What is rendered.

use crate::camera_file::View;

/// A view, and the camera that it belongs to.
pub(super) struct Shot {
    pub(super) view: View,
    /// Empty where it has no name.
    pub(super) camera: String,
}
