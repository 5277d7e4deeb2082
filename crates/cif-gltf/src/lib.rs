//! Scene graph to glTF 2.0 and back: Gaussian splats through `KHR_gaussian_splatting`.
//!
//! | module | answers |
//! |---|---|
//! | [`conventions`] | how axes, quaternions, times and cameras differ from ours |
//! | `extras` | what stands in `extras.cif`, because glTF has no place for it |
//! | `document` | the objects of glTF that are written |
//! | `loose` | bodies of splats that move one by one |
//! | `author` | which nodes, meshes, cameras and tracks a scene becomes |
//! | `rotation_keys` | keys between those of a track, for viewers that do not slerp |
//! | `arrays` | what the buffer holds |
//! | `write` | file kinds, atomic replacement, what may be replaced |
//! | `read` | files, ours and others', to scene graphs |
//!
//! Layout of a file: the node `World` brings our axes and units to those of glTF; below it stand one node per
//! instance, one for the background, and `Cameras`. A rigid instance is a mesh of one point primitive with
//! splats; one that moves in parts has a child node per part, and one of few splats with paths of their own a child node
//! per splat. One animation holds all motion. Splats carry the
//! attributes [`ROW`], [`OCCUPANCY`], [`IDENTITY`], [`INSTANCE_IDS`] and [`INSTANCE_SHARES`] besides those of the
//! extension, so that an edited file can be traced home.
//!
//! Proxies and colliders of the graph are not written: the points of the splats stand in where the extension is
//! not known.

pub mod conventions;
pub mod error;

mod arrays;
mod author;
mod document;
mod extras;
#[cfg(test)]
mod foreign_tests;
mod loose;
mod names;
mod read;
mod relabel;
mod rotation_keys;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
mod write;

use std::path::{Path, PathBuf};

use cif_scene::{About, Ending, FormatError, ReadOptions, SceneGraph};

pub use cif_scene::format::{ExportOptions, ExportSummary, Relabelled, SceneFormat};
pub use error::GltfError;
pub use names::{
    EXTENSION, IDENTITY, INSTANCE_IDS, INSTANCE_SHARES, MOST_EXPENSIVE_MOTION, OCCUPANCY, POINTER, ROW,
    VISIBILITY,
};
pub use read::read_scene;
pub use relabel::relabel;
pub use write::{check_target, export};

/// glTF 2.0: `.glb`, `.gltf`.
#[derive(Clone, Copy, Debug)]
pub struct Gltf;

impl SceneFormat for Gltf {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "glTF",
            key: "gltf",
            endings: &[Ending::written("glb", "one file"), Ending::written("gltf", "text next to a .bin")],
            files: "Objects that deform move as a few rigid parts; the table says what that misses",
            most_expensive_motion: Some(MOST_EXPENSIVE_MOTION),
            note_on_place: None,
            options: &[],
            is_read: true,
            holds_windows: false,
        };
        &ABOUT
    }

    fn files(&self, path: &Path) -> Vec<PathBuf> {
        write::files(path)
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
        Ok(read_scene(path)?)
    }

    fn relabel(
        &self,
        path: &Path,
        output: &Path,
        object: &str,
        label: &str,
        category: Option<&str>,
    ) -> Result<Relabelled, FormatError> {
        Ok(relabel(path, output, object, label, category)?)
    }
}
