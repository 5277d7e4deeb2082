//! Scene graph to USD and back, through usd-core, called over PyO3.
//!
//! | module | answers |
//! |---|---|
//! | [`tokens`] | which names are written |
//! | [`conventions`] | how axes, quaternions and cameras differ from ours |
//! | `pxr` | the Python modules of usd-core, and arrays as buffers |
//! | `layer` | prims, properties and samples of one layer |
//! | `primvars` | values per point: repetitions, colours and their checksum |
//! | `author` | what a stage is made of |
//! | `write` | file kinds, payloads, atomic replacement, what may be replaced |
//! | `read` | stages as scene graphs, and prims by label |
//!
//! Those after `conventions` need the feature `python`. Without it every function returns [`UsdError::NotBuilt`].
//!
//! Layout of a stage: `/World` (assembly) holds one `Xform` (component) per instance and one for the background,
//! the scope `Cameras` and, where there are colliders, `PhysicsScene`. An instance has `translate` and `orient`,
//! `SemanticsLabelsAPI` in the taxonomies `class` (category and human label) and `instance` (unique name) and in those
//! of [`cif_scene::Node::taxonomies`], `CifInstanceAPI` (`schemas/cif`), and the children `NAME_splats` (`ParticleField3DGaussianSplat`), `Proxy` (`Points`
//! drawn by a `PointInstancer`, purpose proxy) and `Collider` (`Mesh`, purpose guide). Where it moves in parts, every
//! part is an `Xform` under it with such children of its own. The variant set `lod` chooses how many splats are
//! loaded, `physics` how simulators treat the instance. `Ground` is there where it was asked for. Arrays stand in the root layer or, by payload, in one layer
//! per instance.

pub mod conventions;
pub mod error;
pub mod tokens;

#[cfg(feature = "python")]
mod author;
#[cfg(feature = "python")]
mod find;
#[cfg(feature = "python")]
mod layer;
#[cfg(feature = "python")]
mod messages;
#[cfg(feature = "python")]
mod primvars;
#[cfg(feature = "python")]
mod pxr;
#[cfg(feature = "python")]
mod read;
#[cfg(feature = "python")]
mod relabel;
#[cfg(all(test, feature = "python"))]
mod tests;
#[cfg(feature = "python")]
mod write;

use std::path::Path;

use cif_scene::{
    About, CodeRange, Ending, FormatError, LabelMatch, LabelQuery, MotionModel, ObjectMatch, ObjectQuery,
    SceneGraph,
};

pub use cif_scene::format::{ExportOptions, ExportSummary, Payloads, ReadOptions, Relabelled, SceneFormat};
pub use error::UsdError;

/// Calls a function of the modules that need the feature `python`, where it is on.
macro_rules! with_usd {
    ($($function:ident)::+($($argument:ident),*)) => {{
        #[cfg(feature = "python")]
        return $($function)::+($($argument),*);
        #[cfg(not(feature = "python"))]
        {
            let _ = ($($argument),*);
            Err(UsdError::NotBuilt)
        }
    }};
}

/// Stages: `.usda`, `.usdc`, `.usdz`.
#[derive(Clone, Copy, Debug)]
pub struct Usd;

impl SceneFormat for Usd {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "USD",
            key: "usd",
            endings: &[
                Ending::written("usda", "text"),
                Ending::written("usdc", "binary"),
                Ending::written("usdz", "package"),
                Ending { name: "usd", kind: "text or binary", written: false },
            ],
            files: "One prim per object",
            most_expensive_motion: Some(MotionModel::Dense),
            note_on_place: None,
            options: &["payloads", "levels_of_detail", "ground", "density", "weld_kinematic"],
            is_read: true,
            holds_windows: true,
        };
        &ABOUT
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

    fn read(&self, path: &Path, options: ReadOptions) -> Result<SceneGraph, FormatError> {
        Ok(read_scene_with(path, options)?)
    }

    fn code_range(&self, path: &Path, options: ReadOptions) -> Result<CodeRange, FormatError> {
        Ok(code_range(path, options)?)
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

    fn query(
        &self,
        path: &Path,
        label_query: &LabelQuery,
        options: ReadOptions,
    ) -> Result<Vec<LabelMatch>, FormatError> {
        Ok(query(path, label_query, options)?)
    }

    fn search(
        &self,
        path: &Path,
        query: &ObjectQuery,
        options: ReadOptions,
    ) -> Result<Vec<ObjectMatch>, FormatError> {
        Ok(search(path, query, options)?)
    }
}

/// Writes a scene to a `.usda`, `.usdc` or `.usdz` file: to a temporary file next to it, then renamed.
///
/// # Errors
/// Unknown extension, missing folder, a file there that is not ours (without [`ExportOptions::force`]),
/// usd-core missing or too old, disk full. Nothing existing is touched then.
pub fn export(graph: &SceneGraph, path: &Path, options: ExportOptions) -> Result<ExportSummary, UsdError> {
    with_usd!(write::export(graph, path, options))
}

/// Checks everything about an output that can be checked before the work starts: extension, folder, what is
/// there already, usd-core.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), UsdError> {
    with_usd!(write::check_target(path, options))
}

/// Prims of a stage whose semantic labels match, in stage order. Labels, transforms and boxes are taken at
/// the query's time code, or at the default time.
///
/// # Errors
/// Missing or unreadable file, no usd-core, bad pattern, layers that are missing or lie outside the stage's folder,
/// more prims than can be composed, or a label that nothing carries (the error lists those that are known).
pub fn query(path: &Path, query: &LabelQuery, options: ReadOptions) -> Result<Vec<LabelMatch>, UsdError> {
    with_usd!(read::query::query(path, query, options))
}

/// Prims of any stage with semantic labels that meet every condition, in stage order; foreign stages need no splats.
/// Over an interval, labels count that hold at any time in it (`UsdSemantics.LabelsQuery`).
///
/// # Errors
/// As [`query`].
pub fn search(path: &Path, query: &ObjectQuery, options: ReadOptions) -> Result<Vec<ObjectMatch>, UsdError> {
    with_usd!(find::search(path, query, options))
}

/// Range of the time codes of any stage; without ends where its root layer does not say.
///
/// # Errors
/// As [`query`].
pub fn code_range(path: &Path, options: ReadOptions) -> Result<CodeRange, UsdError> {
    with_usd!(find::code_range(path, options))
}

/// Gives an object of a stage another label, and another class where one is given: as semantic labels, display name
/// and user property. `object` is a mask value, a unique name or a prim path. The root layer is edited in a copy
/// next to `output`, which then takes its place; `output` may be `path` itself.
///
/// # Errors
/// No usd-core, a file that is missing, unreadable or a package, no such object or several, an output in another
/// folder while the layer names files next to it. Nothing existing is touched then.
pub fn relabel(
    path: &Path,
    output: &Path,
    object: &str,
    label: &str,
    category: Option<&str>,
) -> Result<Relabelled, UsdError> {
    with_usd!(relabel::relabel(path, output, object, label, category))
}

/// Reads a stage as a scene graph: one of ours exactly, also when it was edited, and any stage with Gaussian splats.
///
/// A stage of ours comes back as it was exported, in the state of its selected variants: splats and samples exact,
/// rotations and camera lenses as single-precision numbers. Later edits are read as follows.
/// - *Deleted or deactivated* prims have no node.
/// - *Labels*: of `userProperties:label`, display name and class label, the first that is no longer what was
///   exported counts.
/// - *Recoloured*: display colours that differ from those that were written replace the DC coefficients; higher
///   degrees stay.
/// - *Moved*: any transform operations, also on ancestors. The part that is not rigid is baked into the splats.
/// - *Duplicated*: a copy keeps the id and the rows of its original, under its own name; with a warning. The
///   original is the one whose name is its `instance` label.
/// - *Hidden*: by `visibility` of the prim or an ancestor, also over time.
///
/// In stages of others, or what others added to ours, a node is made from the nearest prim at or above each splat
/// prim that has semantic labels, else that is a component model, else from the splat prim itself. A stage whose
/// only splat prim has neither becomes the background. Labels come from the taxonomy `class` or any other, display
/// name, or prim name. Without `primvars:cif:row` splats have [`cif_scene::Splats::NO_ROW`].
/// Up axis and unit are those of the stage; nothing is turned or scaled.
///
/// # Errors
/// Missing or unreadable file, no usd-core, no splats, values that make no sense (the error names the prim),
/// layers that are missing or lie outside the stage's folder, more prims than can be composed, another layout of
/// ours.
pub fn read_scene(path: &Path) -> Result<SceneGraph, UsdError> {
    read_scene_with(path, ReadOptions::default())
}

/// As [`read_scene`], with options.
///
/// # Errors
/// As [`read_scene`].
pub fn read_scene_with(path: &Path, options: ReadOptions) -> Result<SceneGraph, UsdError> {
    with_usd!(read::scene(path, options))
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
        let error = query(Path::new("scene.usda"), &query_of, ReadOptions::default()).unwrap_err();
        assert!(error.to_string().contains("this build of cif has no USD"), "{error}");
        assert!(usd_version().is_err());
        assert!(check_target(Path::new("scene.usda"), ExportOptions::default()).is_err());
    }
}
