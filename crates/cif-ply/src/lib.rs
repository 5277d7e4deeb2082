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

use std::path::Path;

use cif_scene::{Ending, FormatError, MotionModel, ReadOptions, Relabelled, SceneGraph};

pub use cif_scene::format::{ExportOptions, ExportSummary, SceneFormat};
pub use error::PlyError;

/// Splats as PLY: `.ply`.
#[derive(Clone, Copy, Debug)]
pub struct Ply;

impl SceneFormat for Ply {
    fn name(&self) -> &'static str {
        "PLY"
    }

    fn key(&self) -> &'static str {
        "ply"
    }

    fn endings(&self) -> &'static [Ending] {
        const ENDINGS: [Ending; 1] = [Ending::written("ply", "splats")];
        &ENDINGS
    }

    fn about(&self) -> &'static str {
        "The layout that splat viewers and editors read: the whole scene as it stands at one moment. With --ply-split or \
         --ply-sequence a folder"
    }

    fn most_expensive_motion(&self) -> Option<MotionModel> {
        None
    }

    fn options(&self) -> &'static [&'static str] {
        &["time_code"]
    }

    fn note_on_place(&self) -> Option<&'static str> {
        Some(
            "splats of PLY files, which are single precision, stay in that frame; the comments `world offset` and \
             `world scale` tell it: a place in the world is that in the file / scale + offset",
        )
    }

    fn fills_folder(&self, options: &ExportOptions) -> bool {
        options.split || options.sequence
    }

    fn check_target(&self, path: &Path, options: &ExportOptions) -> Result<(), FormatError> {
        Ok(check_target(path, *options)?)
    }

    fn write(
        &self,
        graph: &SceneGraph,
        path: &Path,
        options: &ExportOptions,
    ) -> Result<ExportSummary, FormatError> {
        Ok(export(graph, path, *options)?)
    }

    fn read(&self, path: &Path, _: ReadOptions) -> Result<SceneGraph, FormatError> {
        Ok(read(path)?)
    }

    fn relabel(
        &self,
        path: &Path,
        _: &Path,
        _: &str,
        _: &str,
        _: Option<&str>,
    ) -> Result<Relabelled, FormatError> {
        let what = "PLY holds no labels; label the scene that it was exported from".to_owned();
        Err(PlyError::Invalid { path: path.to_owned(), what }.into())
    }
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
