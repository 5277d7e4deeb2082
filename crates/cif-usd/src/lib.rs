//! Scene graph to USD and back, through usd-core, called over PyO3.
//!
//! | module | answers |
//! |---|---|
//! | [`tokens`] | which names are written |
//! | [`conventions`] | how axes, quaternions and cameras differ from ours |
//! | `pxr` | the Python modules of usd-core, and arrays as buffers |
//! | `author` | what a stage is made of |
//! | `camera_prims` | cameras |
//! | `write` | file kinds, atomic replacement, what may be replaced |
//! | `read` | prims by label |
//!
//! The last five need the feature `python`. Without it every function returns [`UsdError::NotBuilt`].
//!
//! Layout of a stage: `/World` (assembly) holds one `Xform` (component) per instance and one for the background,
//! each with `translate` and `orient` and the siblings `Splats` (`ParticleField3DGaussianSplat`) and `Proxy`
//! (`Points`, purpose proxy), and the scope `Cameras`. Instances carry `SemanticsLabelsAPI` in the taxonomies
//! `class` (category and human label) and `instance` (unique name).

pub mod conventions;
pub mod error;
pub mod tokens;

#[cfg(feature = "python")]
mod author;
#[cfg(feature = "python")]
mod camera_prims;
#[cfg(feature = "python")]
mod pxr;
#[cfg(feature = "python")]
mod read;
#[cfg(feature = "python")]
mod write;

use std::path::{Path, PathBuf};

use cif_scene::{LabelMatch, LabelQuery, SceneGraph};

pub use error::UsdError;

/// How a stage is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExportOptions {
    /// Replace an existing file even when it was not written by cif.
    pub force: bool,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExportSummary {
    /// The file.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
    /// Instances and background.
    pub nodes: usize,
    /// Splats over all nodes.
    pub splats: usize,
    /// Time samples of the timeline.
    pub samples: usize,
    /// Version of usd-core that wrote it, e.g. `26.11`.
    pub usd_version: String,
}

/// Writes a scene to a `.usda`, `.usdc` or `.usdz` file: to a temporary file beside it, then renamed.
///
/// # Errors
/// Unknown extension, missing folder, a file there that is not ours (without [`ExportOptions::force`]),
/// usd-core missing or too old, disk full. Nothing existing is touched then.
pub fn export(graph: &SceneGraph, path: &Path, options: ExportOptions) -> Result<ExportSummary, UsdError> {
    #[cfg(feature = "python")]
    return write::export(graph, path, options);
    #[cfg(not(feature = "python"))]
    {
        let _ = (graph, path, options);
        Err(UsdError::NotBuilt)
    }
}

/// Checks everything about an output that can be checked before the work starts: extension, folder, what is
/// there already, usd-core.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), UsdError> {
    #[cfg(feature = "python")]
    return write::check_target(path, options);
    #[cfg(not(feature = "python"))]
    {
        let _ = (path, options);
        Err(UsdError::NotBuilt)
    }
}

/// Prims of a stage whose semantic labels match, in stage order. Labels, transforms and boxes are taken at
/// the query's time code, or at the default time.
///
/// # Errors
/// Missing or unreadable file, no usd-core, bad pattern, or a label that nothing carries (the error lists those
/// that are known).
pub fn query(path: &Path, query: &LabelQuery) -> Result<Vec<LabelMatch>, UsdError> {
    #[cfg(feature = "python")]
    return read::query(path, query);
    #[cfg(not(feature = "python"))]
    {
        let _ = (path, query);
        Err(UsdError::NotBuilt)
    }
}

/// [`export`] for callers that have asked already whether a file there may go: replaces it.
///
/// # Errors
/// As [`export`].
pub fn write_stage(graph: &SceneGraph, path: &Path) -> Result<(), UsdError> {
    export(graph, path, ExportOptions { force: true }).map(|_| ())
}

/// [`query`] by normalised time in [0, 1] instead of time code; a stage of ours knows when its samples are,
/// others are taken to run evenly from their first to their last time code.
///
/// # Errors
/// As [`query`].
pub fn query_stage(path: &Path, pattern: &str, time: Option<f64>) -> Result<Vec<LabelMatch>, UsdError> {
    let of = |time_code| LabelQuery { pattern: pattern.to_owned(), time_code };
    #[cfg(feature = "python")]
    return match time {
        Some(time) => query(path, &of(Some(read::time_code(path, time)?))),
        None => query(path, &of(None)),
    };
    #[cfg(not(feature = "python"))]
    {
        let _ = time;
        query(path, &of(None))
    }
}

/// Version of the usd-core in use, e.g. `26.11`.
///
/// # Errors
/// When there is none, or it is older than [`tokens::MINIMUM_USD`].
pub fn usd_version() -> Result<String, UsdError> {
    #[cfg(feature = "python")]
    return pxr::with(|pxr| Ok(pxr.version.clone()));
    #[cfg(not(feature = "python"))]
    Err(UsdError::NotBuilt)
}

#[cfg(all(test, not(feature = "python")))]
mod tests {
    use super::*;

    #[test]
    fn a_build_without_usd_says_how_to_get_it() {
        let query_of = LabelQuery { pattern: "*".into(), time_code: None };
        let error = query(Path::new("scene.usda"), &query_of).unwrap_err();
        assert!(error.to_string().contains("this build of cif has no USD"), "{error}");
        assert!(usd_version().is_err());
        assert!(check_target(Path::new("scene.usda"), ExportOptions::default()).is_err());
    }
}
