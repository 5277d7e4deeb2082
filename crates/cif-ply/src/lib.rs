//! Scene graph to PLY files of Gaussian splats and back.
//!
//! | module | answers |
//! |---|---|
//! | [`pose`] | where the splats of a node stand in the world at a moment |
//! | `write` | the layout of the 3D Gaussian splatting reference implementation; which files |
//! | `read` | files of any property order, ASCII and binary |
//!
//! PLY knows neither objects nor time: what moves leaves as one moment, or as a numbered sequence of moments, and
//! objects leave as files of their own. Splats stand in the world as it was captured, or on request turned so that another
//! axis is up, which a comment states for readers.

pub mod error;
pub mod pose;

mod read;
#[cfg(test)]
mod tests;
mod write;

use std::path::Path;

use cif_scene::{About, Ending, FormatError, ReadOptions, SceneGraph};

pub use cif_scene::format::{ExportOptions, ExportSummary, SceneFormat};
pub use error::PlyError;
pub use read::read;
pub use write::{check_target, export};

/// Splats as PLY: `.ply`.
#[derive(Clone, Copy, Debug)]
pub struct Ply;

impl SceneFormat for Ply {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "PLY",
            key: "ply",
            endings: &[Ending::written("ply", "splats")],
            files: "The layout that splat viewers and editors read: the whole scene as it stands at one moment. With \
                    --ply-split or --ply-sequence a folder",
            most_expensive_motion: None,
            note_on_place: Some(
                "splats of PLY files, which are single precision, stay in that frame; the comments `world offset` \
                 and `world scale` tell it: a place in the world is that in the file / scale + offset",
            ),
            options: &["time_code", "turn_up"],
            is_read: true,
            holds_windows: false,
        };
        &ABOUT
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
}
