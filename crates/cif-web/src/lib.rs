//! Scene graphs as pages that a browser plays: a splat renderer with a timeline, objects and cameras.
//!
//! | module | answers |
//! |---|---|
//! | [`document`] | a scene as the page reads it |
//! | [`describe`](mod@describe) | a scene graph, or the points of a capture, as such a document |
//! | `arrays` | how its numbers are packed |
//! | [`assets`] | the page itself, whose files are in `plugin/web`, and what a browser lets it do |
//! | [`write`](mod@write) | one file that works from disk |

pub mod assets;
pub mod describe;
pub mod document;
pub mod error;
pub mod write;

mod arrays;
#[cfg(test)]
mod tests;

use std::path::Path;

use cif_scene::{About, Ending, FormatError, ReadOptions, SceneGraph};

pub use cif_scene::format::{ExportOptions, ExportSummary, SceneFormat};
pub use describe::{InstanceColor, Page, describe};
pub use error::WebError;
pub use write::export;

/// A page of its own: `.html`.
#[derive(Clone, Copy, Debug)]
pub struct Html {
    /// Colours of instances.
    pub color: InstanceColor,
}

impl SceneFormat for Html {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "HTML",
            key: "html",
            endings: &[Ending::written("html", "page")],
            files: "One page that plays the scene in a browser, from disk and without a network; it is not read back",
            most_expensive_motion: Some(cif_scene::MotionModel::Dense),
            note_on_place: None,
            options: &[],
            is_read: false,
            holds_windows: false,
        };
        &ABOUT
    }

    fn check_target(&self, path: &Path, options: &ExportOptions) -> Result<(), FormatError> {
        Ok(write::check_target(path, *options)?)
    }

    fn write(
        &self,
        graph: &SceneGraph,
        path: &Path,
        options: &ExportOptions,
    ) -> Result<ExportSummary, FormatError> {
        Ok(export(graph, path, *options, self.color)?)
    }

    fn read(&self, path: &Path, _: ReadOptions) -> Result<SceneGraph, FormatError> {
        Err(WebError::NotRead { path: path.to_owned() }.into())
    }
}
