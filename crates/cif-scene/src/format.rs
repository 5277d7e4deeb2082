//! The interface of file formats. Every format is a crate with one implementation of [`SceneFormat`]; the
//! command keeps the list of them.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use cif_field::Field;
use serde::Deserialize;

use crate::{
    CodeRange, DENSITY, LabelMatch, LabelQuery, MotionModel, ObjectMatch, ObjectQuery, OptionError,
    QueryError, SceneError, SceneGraph, SceneOptions, UpAxis, build, query, search,
};

/// Why a format refuses; the message names the file and what to do.
pub type FormatError = Box<dyn std::error::Error + Send + Sync>;

/// A file format of scene graphs.
pub trait SceneFormat: Sync {
    /// Facts about the format.
    fn about(&self) -> &'static About;

    /// True when the name of a file says that it is of this format.
    fn recognises(&self, path: &Path) -> bool {
        ending_of(path, self.about().endings).is_some()
    }

    /// True when a file of this name can be written.
    fn writes(&self, path: &Path) -> bool {
        ending_of(path, self.about().endings).is_some_and(|ending| ending.written)
    }

    /// Options of graphs that the format can hold.
    fn held(&self, options: &SceneOptions) -> SceneOptions {
        let most = self.about().most_expensive_motion.unwrap_or(options.most_expensive_motion);
        SceneOptions { most_expensive_motion: options.most_expensive_motion.min(most), ..options.clone() }
    }

    /// The graph of a field as the format can hold it; `None` where that is the graph that was built already.
    ///
    /// # Errors
    /// As [`build`](fn@build).
    fn rebuilt(
        &self,
        field: &Field,
        graph: &SceneGraph,
        options: &SceneOptions,
    ) -> Result<Option<SceneGraph>, SceneError> {
        let too_much =
            |most| options.most_expensive_motion > most && graph.nodes.iter().any(|node| node.model() > most);
        if !self.about().most_expensive_motion.is_some_and(too_much) {
            return Ok(None);
        }
        build(field, &self.held(options)).map(Some)
    }

    /// True when the output is a folder of several files.
    fn fills_folder(&self, _: &ExportOptions) -> bool {
        false
    }

    /// Files that are written beside `path` and itself.
    fn files(&self, path: &Path) -> Vec<PathBuf> {
        vec![path.to_owned()]
    }

    /// Checks everything about an output that can be checked before the work starts.
    ///
    /// # Errors
    /// As [`SceneFormat::write`].
    fn check_target(&self, path: &Path, options: &ExportOptions) -> Result<(), FormatError>;

    /// Writes a graph: beside its place, and then moved there.
    ///
    /// # Errors
    /// A name that does not fit, a missing folder, a file there that is not ours (without [`ExportOptions::force`]),
    /// a graph that the format does not hold, disk full. Nothing existing is touched then.
    fn write(
        &self,
        graph: &SceneGraph,
        path: &Path,
        options: &ExportOptions,
    ) -> Result<ExportSummary, FormatError>;

    /// Reads a file as the graph that it holds.
    ///
    /// # Errors
    /// Missing, damaged or foreign files without splats.
    fn read(&self, path: &Path, options: ReadOptions) -> Result<SceneGraph, FormatError>;

    /// Range of the time codes of a file.
    ///
    /// # Errors
    /// As [`SceneFormat::read`].
    fn code_range(&self, path: &Path, options: ReadOptions) -> Result<CodeRange, FormatError> {
        Ok(self.read(path, options)?.time_codes.range())
    }

    /// Gives an object of a file another label, and another class where one is given. `object` is a mask value or
    /// what the file calls it. The result takes the place of `output`, which may be `path` itself.
    ///
    /// # Errors
    /// No such object or several, formats without labels, and as [`SceneFormat::read`]. Nothing existing is touched
    /// then.
    fn relabel(
        &self,
        path: &Path,
        output: &Path,
        object: &str,
        label: &str,
        category: Option<&str>,
    ) -> Result<Relabelled, FormatError> {
        let _ = (output, object, label, category);
        let (path, name) = (path.display(), self.about().name);
        Err(format!("{path}: {name} holds no labels; label the scene that it was exported from").into())
    }

    /// Objects of a file whose label, class or name matches.
    ///
    /// # Errors
    /// When nothing matches, and as [`SceneFormat::read`].
    fn query(
        &self,
        path: &Path,
        label_query: &LabelQuery,
        options: ReadOptions,
    ) -> Result<Vec<LabelMatch>, FormatError> {
        Ok(query(&self.read(path, options)?, label_query, &path.display().to_string())?)
    }

    /// Objects of a file that meet every condition.
    ///
    /// # Errors
    /// When no label matches, and as [`SceneFormat::read`].
    fn search(
        &self,
        path: &Path,
        query: &ObjectQuery,
        options: ReadOptions,
    ) -> Result<Vec<ObjectMatch>, FormatError> {
        let found: Result<_, QueryError> =
            search(&self.read(path, options)?, query, &path.display().to_string(), str::to_owned);
        Ok(found?)
    }
}

/// Facts about a format.
#[derive(Clone, Copy, Debug)]
pub struct About {
    /// Name of the format, e.g. `glTF`.
    pub name: &'static str,
    /// The name as flags, keys and Python have it, e.g. `gltf`.
    pub key: &'static str,
    /// Endings of its files; the first is taken where nobody says.
    pub endings: &'static [Ending],
    /// Description of the files, in one or two sentences for the help of the command.
    pub files: &'static str,
    /// The most expensive motion that a file holds: graphs are built with no more than this. `None` for formats that
    /// hold one moment, to which any motion leads.
    pub most_expensive_motion: Option<MotionModel>,
    /// Advice on a scene that lies elsewhere in the world of its capture, where files do not place it.
    pub note_on_place: Option<&'static str>,
    /// Keys of [`ExportOptions`], in addition to `force`, that a single file of this format knows.
    pub options: &'static [&'static str],
    /// False for files that are made to be looked at, and not read back.
    pub is_read: bool,
    /// True when files hold splats that change from window to window ([`SceneGraph::windows`]).
    pub holds_windows: bool,
}

/// An ending of file names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ending {
    /// Without the dot, in lower case.
    pub name: &'static str,
    /// Kind of file, e.g. `text`.
    pub kind: &'static str,
    /// False when such files are only read.
    pub written: bool,
}

impl Ending {
    /// An ending of files that are read and written.
    #[must_use]
    pub const fn written(name: &'static str, kind: &'static str) -> Self {
        Self { name, kind, written: true }
    }
}

/// The ending that a name has, of those given.
#[must_use]
pub fn ending_of<'a>(path: &Path, endings: &'a [Ending]) -> Option<&'a Ending> {
    let own = path.extension()?;
    endings.iter().find(|ending| own.eq_ignore_ascii_case(ending.name))
}

/// Where the arrays of instances go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Payloads {
    /// Beside files of text, so that they stay readable; inside others.
    #[default]
    ByKind,
    /// One file per instance in a folder beside the output: `out.payloads` for `out.usda`, `out.usdc.payloads` for
    /// `out.usdc`.
    Separate,
    /// All in the output itself.
    SingleFile,
}

/// Plane on which simulators let things fall.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ground {
    /// None.
    #[default]
    None,
    /// Where the objects stand: see [`crate::ground_height`].
    Auto,
    /// At a height along the up axis, world units.
    At(f64),
}

impl FromStr for Ground {
    type Err = OptionError;

    /// `none`, `auto`, or a height such as `-0.02`.
    fn from_str(text: &str) -> Result<Self, OptionError> {
        match (text, text.parse::<f64>()) {
            ("none", _) => Ok(Self::None),
            ("auto", _) => Ok(Self::Auto),
            (_, Ok(height)) if height.is_finite() => Ok(Self::At(height)),
            _ => Err(OptionError {
                option: "ground",
                value: text.to_owned(),
                expected: "none, auto or a height in world units",
            }),
        }
    }
}

/// Options for writing a graph. A format ignores those that it does not know.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ExportOptions {
    /// Replace existing files even when they were not written by cif.
    pub force: bool,
    /// USD: where the arrays of instances go.
    pub payloads: Payloads,
    /// USD: write the variants `half` and `quarter` of the set `lod` in addition to `full`.
    pub levels_of_detail: bool,
    /// USD: a plane that simulators let things fall on. Default none.
    pub ground: Ground,
    /// USD: density of bodies over the volume that they fill (see [`crate::masses`]), kg/m^3. Default
    /// [`crate::DENSITY`].
    pub density: f64,
    /// USD: fix bodies on recorded tracks to the world by joints, for simulators that let them fall (MuJoCo). Default
    /// false.
    pub weld_kinematic: bool,
    /// Formats of one moment: the time code that is written; `None` takes the first.
    pub time_code: Option<f64>,
    /// Formats of one moment: a file per object, in a folder.
    pub split: bool,
    /// Formats of one moment: a file per sampled time code, numbered by it, in a folder; with `split`, in a folder
    /// per object.
    pub sequence: bool,
    /// Formats of one moment: turn the scene so that this axis is up; `None` leaves it as captured.
    pub turn_up: Option<UpAxis>,
}

impl Default for ExportOptions {
    fn default() -> Self {
        Self {
            force: false,
            payloads: Payloads::default(),
            levels_of_detail: true,
            ground: Ground::default(),
            density: DENSITY,
            weld_kinematic: false,
            time_code: None,
            split: false,
            sequence: false,
            turn_up: None,
        }
    }
}

/// Options for reading a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// USD: follow sublayers, references and payloads that lie outside the folder of the stage.
    pub follow_external: bool,
}

/// Summary of an export.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ExportSummary {
    /// The file or folder.
    pub path: PathBuf,
    /// All files that can be named: `path` and those beside or in it.
    pub files: Vec<PathBuf>,
    /// Size of everything together.
    pub bytes: u64,
    /// Instances and background.
    pub nodes: usize,
    /// Splats over all files.
    pub splats: usize,
    /// Time samples of the timeline, or moments that were written.
    pub samples: usize,
    /// Losses of the format, object by object.
    pub not_held: Vec<String>,
    /// Library that wrote it, with its version, e.g. `usd-core 26.11`; `None` for cif itself.
    pub library: Option<String>,
    /// Files of others in a folder of the output, which stay there.
    pub kept: Vec<PathBuf>,
}

/// Changes by a new label.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Relabelled {
    /// The object as the file calls it: path of the prim, or name of the node.
    pub object: String,
    /// The label before.
    pub before: String,
    /// The label now.
    pub label: String,
    /// The class now.
    pub category: String,
}
