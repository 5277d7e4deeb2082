//! Context that all parts of the reader share.

use std::cell::RefCell;
use std::path::Path;

use pyo3::PyErr;

use super::arrays::Arrays;
use super::frames::Frames;
use crate::UsdError;
use crate::pxr::{Pxr, reason};

/// A stage while it is read.
pub(super) struct Reading<'a, 'py> {
    pub(super) pxr: &'a Pxr<'py>,
    pub(super) path: &'a Path,
    pub(super) arrays: Arrays<'a, 'py>,
    pub(super) frames: Frames<'a, 'py>,
    /// First time code.
    pub(super) start: f64,
    /// First and last frame, for nodes that do not say theirs.
    pub(super) source_frames: (usize, usize),
    /// True where values of splats are those of a window of time, and what stands at no time those of the first one.
    pub(super) has_windows: bool,
    pub(super) warnings: RefCell<Vec<String>>,
}

impl Reading<'_, '_> {
    pub(super) fn python(&self, error: &PyErr) -> UsdError {
        UsdError::Unusable { path: self.path.to_owned(), reason: reason(self.pxr.py, error) }
    }

    pub(super) fn prim_error(&self, prim: &str, problem: String, fix: &'static str) -> UsdError {
        UsdError::Prim { path: self.path.to_owned(), prim: prim.to_owned(), problem, fix }
    }

    pub(super) fn warn(&self, warning: String) {
        let mut warnings = self.warnings.borrow_mut();
        // Samples over time say the same again.
        if !warnings.contains(&warning) {
            warnings.push(warning);
        }
    }
}
