//! Scene graph to PLY files of Gaussian splats and back.
//!
//! | module | answers |
//! |---|---|
//! | [`pose`] | where the splats of a node stand in the world at a moment |
//! | `write` | the layout of the 3D Gaussian splatting reference implementation; which files |
//! | `read` | files of any property order, ASCII and binary |
//!
//! PLY knows neither objects nor time: what moves leaves as one moment, or as a numbered sequence of moments, and
//! objects leave as files of their own. Splats stand in the world as it was captured; nothing swaps its axes.

pub mod error;
pub mod pose;

mod read;
#[cfg(test)]
mod tests;
mod write;

use std::path::{Path, PathBuf};

use cif_scene::SceneGraph;

pub use error::PlyError;

/// How a scene is written.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ExportOptions {
    /// Replace existing files even when they were not written by cif.
    pub force: bool,
    /// Moment that is written, as time code; `None` takes the first. A sequence does not need it.
    pub time_code: Option<f64>,
    /// A file per object, in a folder.
    pub split: bool,
    /// A file per sampled time code, numbered by it, in a folder; with `split`, in a folder per object.
    pub sequence: bool,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExportSummary {
    /// The files.
    pub files: Vec<PathBuf>,
    /// Their size together.
    pub bytes: u64,
    /// Splats over all files.
    pub splats: usize,
}

/// Writes a scene: to the file `path` (`.ply`), or with [`ExportOptions::split`] or [`ExportOptions::sequence`]
/// into the folder `path`, which is created. Each file is written beside its place and renamed.
///
/// # Errors
/// A name that does not fit, a missing folder, files that are not ours (without [`ExportOptions::force`]), nothing
/// visible at that time, disk full.
pub fn export(graph: &SceneGraph, path: &Path, options: ExportOptions) -> Result<ExportSummary, PlyError> {
    write::export(graph, path, &options)
}

/// Checks everything about an output that can be checked before the work starts.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), PlyError> {
    write::check_target(path, &options)
}

/// Reads splats: INRIA layout, ASCII or binary of either byte order, properties in any order, spherical harmonics
/// of degree 0 to 3. They become one still object that carries the file's name, occupied and certain of its
/// identity, in the axes of the file; `rows` count the splats of the file.
///
/// # Errors
/// No PLY, cut off, or without what a splat needs; the message says what is missing.
pub fn read(path: &Path) -> Result<SceneGraph, PlyError> {
    read::read(path)
}
