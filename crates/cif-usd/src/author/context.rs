//! Context that all parts of the writer share.

use std::path::Path;

use cif_scene::{ExportOptions, SceneGraph};

use crate::layer::Variability;
use crate::pxr::Pxr;

/// `uniform` attributes read better by name.
pub(super) const UNIFORM: Variability = Variability::Uniform;

/// As [`UNIFORM`].
pub(super) const VARYING: Variability = Variability::Varying;

/// Storage of the arrays of instances: payloads or root layer, and levels of detail.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Storage<'a> {
    /// Folder for one layer per instance, and how the root layer calls it; `None` keeps all in the root layer.
    pub(crate) payloads: Option<(&'a Path, &'a str)>,
    /// True when coarser levels of detail are written too.
    pub(crate) levels: bool,
}

/// Context that all parts of the writer share.
pub(crate) struct Scene<'a, 'py> {
    pub(crate) pxr: &'a Pxr<'py>,
    pub(crate) graph: &'a SceneGraph,
    pub(crate) storage: Storage<'a>,
    pub(crate) options: &'a ExportOptions,
}

impl Scene<'_, '_> {
    /// True where arrays change from window to window, so that all windows have to store them in the same way.
    pub(super) fn has_windows(&self) -> bool {
        !self.graph.windows.is_empty()
    }
}
