//! Scene graph to glTF 2.0 and back: Gaussian splats through `KHR_gaussian_splatting`.
//!
//! | module | answers |
//! |---|---|
//! | [`conventions`] | how axes, quaternions, times and cameras differ from ours |
//! | `extras` | what stands in `extras.cif`, because glTF has no place for it |
//! | `document` | the objects of glTF that are written |
//! | `author` | which nodes, meshes, cameras and tracks a scene becomes |
//! | `rotation_keys` | keys between those of a track, for viewers that do not slerp |
//! | `arrays` | what the buffer holds |
//! | `write` | file kinds, atomic replacement, what may be replaced |
//! | `read` | files, ours and others', to scene graphs |
//!
//! Layout of a file: the node `World` brings our axes and units to those of glTF; below it stand one node per
//! instance, one for the background, and `Cameras`. A rigid instance is a mesh of one point primitive with
//! splats; one that moves in parts has a child node per part. One animation holds all motion. Splats carry the
//! attributes [`ROW`], [`OCCUPANCY`], [`IDENTITY`], [`INSTANCE_IDS`] and [`INSTANCE_SHARES`] besides those of the extension, so that an edited file can
//! be traced home.
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
mod read;
mod relabel;
mod rotation_keys;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
mod write;

use std::path::{Path, PathBuf};

use cif_scene::{Ending, FormatError, MotionModel, ReadOptions, SceneGraph};

pub use cif_scene::format::{ExportOptions, ExportSummary, Relabelled, SceneFormat};
pub use error::GltfError;
pub use relabel::relabel;

/// The extension that holds the splats.
pub const EXTENSION: &str = "KHR_gaussian_splatting";
/// Most expensive motion that a file can hold: build graphs for glTF with no more than this.
pub const MOST_EXPENSIVE_MOTION: MotionModel = MotionModel::Parts;
/// Attribute with the row of every splat in the field: two unsigned shorts, the low one first.
pub const ROW: &str = "_CIF_ROW";
/// Attribute with the occupancy of every splat.
pub const OCCUPANCY: &str = "_CIF_OCCUPANCY";
/// Attribute with the probability of the most probable instance of every splat.
pub const IDENTITY: &str = "_CIF_IDENTITY";
/// Attribute of the instances that every splat may belong to, as ids, most probable first; 0 for an unused place.
pub const INSTANCE_IDS: &str = "_CIF_INSTANCE_IDS";
/// Attribute beside [`INSTANCE_IDS`]: probability of each instance times the share of the splat's image that was
/// labelled.
pub const INSTANCE_SHARES: &str = "_CIF_INSTANCE_SHARES";

const GENERATOR: &str = concat!("cif ", env!("CARGO_PKG_VERSION"));
const GENERATOR_PREFIX: &str = "cif ";

/// glTF 2.0: `.glb`, `.gltf`.
#[derive(Clone, Copy, Debug)]
pub struct Gltf;

impl SceneFormat for Gltf {
    fn name(&self) -> &'static str {
        "glTF"
    }

    fn key(&self) -> &'static str {
        "gltf"
    }

    fn endings(&self) -> &'static [Ending] {
        const ENDINGS: [Ending; 2] =
            [Ending::written("glb", "one file"), Ending::written("gltf", "text beside a .bin")];
        &ENDINGS
    }

    fn about(&self) -> &'static str {
        "Objects that deform move as a few rigid parts; the table says what that misses"
    }

    fn most_expensive_motion(&self) -> Option<MotionModel> {
        Some(MOST_EXPENSIVE_MOTION)
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

/// Writes a scene to a `.glb`, or to a `.gltf` with a `.bin` beside it: to temporary files in the same folder,
/// then renamed.
///
/// # Errors
/// Unknown ending, missing folder, a file there that is not ours (without [`ExportOptions::force`]), a node with
/// dense motion, values that are not finite, disk full. Nothing existing is touched then.
pub fn export(graph: &SceneGraph, path: &Path, options: ExportOptions) -> Result<ExportSummary, GltfError> {
    write::export(graph, path, options)
}

/// Checks everything about an output that can be checked before the work starts.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), GltfError> {
    write::check_target(path, options)
}

/// Reads a `.glb` or `.gltf` with `KHR_gaussian_splatting` as a scene.
///
/// Our own files come back as the graph that was written, with the edits that were made to them: float exact,
/// without proxies and colliders. Of other files every node with splats becomes an instance that is labelled by
/// the node's name, occupied and certain of its identity; a node that is turned but does not move gets a rigid
/// track of one sample; scales that are not 1 are worked into the splats. The world then has glTF's axes and
/// units (+y up, metres), 24 time codes per second, and [`cif_scene::Origin`] is empty. Rows count the splats of
/// such a file; in files of ours, splats that were added have [`cif_scene::Splats::NO_ROW`]. Whatever could not
/// be taken over is said in [`SceneGraph::warnings`].
///
/// # Errors
/// Missing, truncated or inconsistent files, buffers outside the file's folder, extensions that must be known,
/// values that are not finite; each names the object of the file.
pub fn read_scene(path: &Path) -> Result<SceneGraph, GltfError> {
    read::read_scene(path)
}
