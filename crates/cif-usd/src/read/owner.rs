//! Prims that become nodes.

use cif_scene::assemble::Identity;
use pyo3::prelude::*;

use super::labels::Recorded;
use super::splats::SplatPrim;

/// A prim that becomes a node.
pub(super) struct Owner<'py> {
    pub(super) prim: Bound<'py, PyAny>,
    pub(super) path: String,
    /// Properties of our schema on the prim.
    pub(super) recorded: Recorded,
    pub(super) splats: Vec<SplatPrim<'py>>,
}

impl Owner<'_> {
    /// Identity of the node; `original` where it is called as it was exported.
    pub(super) fn identity(&self, original: bool) -> Identity {
        match (self.recorded.background, self.recorded.id) {
            (true, _) => Identity::Background,
            (false, Some(id)) => Identity::Recorded { id, index: self.recorded.index, original },
            (false, None) => Identity::New,
        }
    }
}
