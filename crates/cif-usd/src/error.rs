//! Errors of writing and reading stages.

use std::path::PathBuf;

use cif_scene::files::FileError;

use crate::tokens;

/// Why a stage cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UsdError {
    /// Something with the file itself.
    #[error(transparent)]
    File(#[from] FileError),
    /// The crate was built without the feature `python`.
    #[error("this build of cif has no USD: install the Python wheel (`make build`, then .venv/bin/cif)")]
    NotBuilt,
    /// No interpreter runs in this process.
    #[error(
        "USD needs a running Python interpreter: start cif through its Python wheel (the `cif` script or `python -m cif`)"
    )]
    NoInterpreter,
    /// `pxr` cannot be imported.
    #[error("USD cannot be imported ({reason}): pip install 'cif4d[usd]'")]
    Missing {
        /// Message of Python.
        reason: String,
    },
    /// `pxr` is older than what is worked with.
    #[error(
        "USD {found} is too old, {year}.{month} is the oldest that will do: pip install --upgrade usd-core",
        year = tokens::MINIMUM_USD.0,
        month = tokens::MINIMUM_USD.1
    )]
    TooOld {
        /// Version found.
        found: String,
    },
    /// `pxr` is older than splats, and was in use before `import cif` could add them.
    #[error(
        "USD {found} has no Gaussian splats, and those that cif adds came too late: import pxr, then cif, then open stages; \
         or pip install --upgrade usd-core"
    )]
    SplatsUnknown {
        /// Version found.
        found: String,
    },
    /// Not a file name that USD knows.
    #[error(
        "{path}: the extension decides the kind of file; use .usda (text), .usdc (binary) or .usdz (package)"
    )]
    Extension {
        /// Given path.
        path: PathBuf,
    },
    /// A folder has the name of the file.
    #[error("{path} is a folder; give a file name")]
    IsFolder {
        /// The folder.
        path: PathBuf,
    },
    /// A package holds its arrays itself.
    #[error("{path}: a package has no payloads next to it; use .usda or .usdc, or leave out --payloads")]
    PayloadsInPackage {
        /// Given path.
        path: PathBuf,
    },
    /// Windows of time are files of their own.
    #[error(
        "{path}: a scene of several windows of time is a stage with a file for each; use .usda or .usdc, without --single-file"
    )]
    WindowsInOneFile {
        /// Given path.
        path: PathBuf,
    },
    /// The file to read is missing.
    #[error("{path}: no such file")]
    NotFound {
        /// Given path.
        path: PathBuf,
    },
    /// The file to read is no stage.
    #[error("{path} cannot be opened as a USD stage: {reason}")]
    Unreadable {
        /// Given path.
        path: PathBuf,
        /// Message of USD.
        reason: String,
    },
    /// A stage without splats.
    #[error("{path} holds no splats: no active ParticleField3DGaussianSplat prim with positions{found}")]
    NoSplats {
        /// The stage.
        path: PathBuf,
        /// Word on what it holds instead; may be empty.
        found: String,
    },
    /// Something about a prim makes no sense.
    #[error("{path}: {prim}: {problem}; {fix}")]
    Prim {
        /// The stage.
        path: PathBuf,
        /// Path of the prim.
        prim: String,
        /// The problem.
        problem: String,
        /// Remedy.
        fix: &'static str,
    },
    /// A layer that a stage is made of does not exist.
    #[error("{path}: {layer} needs {asset}, which does not exist; put it back, or take the arc out")]
    MissingAsset {
        /// The stage.
        path: PathBuf,
        /// Layer that asks for it.
        layer: String,
        /// Asset as written there.
        asset: String,
    },
    /// A layer that a stage is made of lies elsewhere.
    #[error(
        "{path}: {layer} needs {asset}, which lies outside the folder of the stage; move it there, or allow it with --follow-external"
    )]
    ExternalAsset {
        /// The stage.
        path: PathBuf,
        /// Layer that asks for it.
        layer: String,
        /// Asset as written there.
        asset: String,
    },
    /// A layer or stage whose prims usd-core cannot follow.
    #[error(
        "{path}: {layer}: {what}, and at most {limit} levels are read, since usd-core follows them by recursion; bring the \
         prims nearer to the root"
    )]
    TooDeep {
        /// The stage.
        path: PathBuf,
        /// Layer that it was met in.
        layer: String,
        /// Kind and depth of the nesting.
        what: String,
        /// Most levels.
        limit: u32,
    },
    /// References or instances that multiply beyond what can be composed.
    #[error(
        "{path}: references, payloads and instances make about {prims} prims of the {written} that its layers hold, and \
         at most {limit} are read; {largest} alone brings in {of_largest}. Take copies of copies out, or deactivate what \
         is not needed"
    )]
    TooManyPrims {
        /// The stage.
        path: PathBuf,
        /// Prims in its layers.
        written: u64,
        /// Prims once expanded.
        prims: u64,
        /// Path of the prim below the root that brings in most.
        largest: String,
        /// Prims that it brings in.
        of_largest: u64,
        /// Most prims.
        limit: u64,
    },
    /// A stage of ours in another layout.
    #[error(
        "{path} was written by {generator} in layout {found}, and this version reads layout {expected}: {}",
        if found < expected { "export it again" } else { "use a newer cif" }
    )]
    Layout {
        /// The stage.
        path: PathBuf,
        /// Program that wrote it.
        generator: String,
        /// Layout of the stage.
        found: i64,
        /// Layout that is read.
        expected: i64,
    },
    /// Writing failed.
    #[error("{path} could not be written: {reason}; nothing was changed")]
    Write {
        /// Output.
        path: PathBuf,
        /// Message of the operating system or of USD.
        reason: String,
    },
    /// An object could not be given another label.
    #[error("{path}: {problem}")]
    Relabel {
        /// The file.
        path: PathBuf,
        /// The problem and what would work.
        problem: String,
    },
    /// usd-core refuses what a stage holds.
    #[error("{path}: usd-core cannot use it: {reason}")]
    Unusable {
        /// The stage.
        path: PathBuf,
        /// Message of USD.
        reason: String,
    },
    /// usd-core did something unexpected.
    #[error("usd-core failed: {reason}")]
    Python {
        /// Message of Python.
        reason: String,
    },
    /// Bad pattern or unknown label.
    #[error(transparent)]
    Query(#[from] cif_scene::QueryError),
}
