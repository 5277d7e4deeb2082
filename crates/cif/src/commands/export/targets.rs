//! The part of `cif export` that knows of formats: files by their endings, a flag for each, and what is written where.

use std::path::{Path, PathBuf};

use cif_scene::{DENSITY, ExportOptions, ExportSummary, Ground, Payloads, SceneFormat, UpAxis};
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches, value_parser};

use super::preset::Preferred;
use crate::endings;
use crate::error::Error;
use crate::formats::{self, FORMATS};
use crate::messages::{note, outcome};
use crate::moment::{Frames, Moment, note_fraction};
use crate::output::{self, Outputs};

/// Files to write: `OUT` by its ending, `--usd OUT`, `--gltf OUT` and so on; and further scenes among them.
#[derive(Debug, Default)]
pub(super) struct Targets {
    files: Vec<Target>,
    /// Scenes of other windows of time of the same capture.
    pub(super) windows: Vec<PathBuf>,
}

/// Files that are given without a flag.
pub(super) const FILES: &str = "files";

/// A file to write.
pub(super) struct Target {
    pub(super) format: &'static dyn SceneFormat,
    pub(super) path: PathBuf,
}

impl std::fmt::Debug for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "--{} {}", self.format.about().key, self.path.display())
    }
}

/// Endings that are written, e.g. `.usda (text)`.
fn written(format: &dyn SceneFormat) -> Vec<String> {
    let endings = format.about().endings.iter().filter(|ending| ending.written);
    endings.map(|ending| format!(".{} ({})", ending.name, ending.kind)).collect()
}

impl Args for Targets {
    fn augment_args(command: Command) -> Command {
        let help = format!(
            "Files to write; the endings decide the formats: {}. Further .cif are other windows of time of the same \
             capture, which become one stage",
            FORMATS.into_iter().flat_map(written).collect::<Vec<_>>().join(", ")
        );
        let files = Arg::new(FILES)
            .value_name("OUT")
            .num_args(0..)
            .action(ArgAction::Append)
            .value_parser(endings::exchanged_or_scene())
            .help(help);
        let command = command.arg(files);
        FORMATS.into_iter().fold(command, |command, format| {
            let help = format!(
                "{} to write; the ending decides: {}. {}",
                format.about().name,
                written(format).join(", "),
                format.about().files
            );
            let arg = Arg::new(format.about().key)
                .long(format.about().key)
                .value_name("OUT")
                .value_parser(value_parser!(PathBuf))
                .help(help);
            command.arg(arg)
        })
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Targets {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let given = FORMATS.into_iter().filter_map(|format| {
            let path = matches.get_one::<PathBuf>(format.about().key)?.clone();
            Some(Target { format, path })
        });
        let by_ending = matches.get_many::<PathBuf>(FILES).into_iter().flatten().filter_map(|path| {
            let format = FORMATS.into_iter().find(|format| format.writes(path))?;
            Some(Target { format, path: path.clone() })
        });
        let windows = matches.get_many::<PathBuf>(FILES).into_iter().flatten();
        let windows = windows.filter(|path| formats::is_field(path)).cloned().collect();
        Ok(Self { files: by_ending.chain(given).collect(), windows })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// Options for writing the files.
#[derive(Debug, Args)]
pub(super) struct Writing {
    /// Put the arrays of every object into a file of its own in OUT.usdc.payloads, loaded on demand;
    /// .usda does so anyway
    #[arg(long, conflicts_with = "single_file")]
    payloads: bool,
    /// Keep everything in one file; .usdc and .usdz do so anyway
    #[arg(long)]
    single_file: bool,
    /// Leave out the variants with half and a quarter of the splats
    #[arg(long)]
    no_lod: bool,
    /// A ground plane for simulators: auto (where the objects stand), none, or its height in world units
    /// [default: none]
    #[arg(long, value_name = "WHERE", allow_hyphen_values = true)]
    ground: Option<Ground>,
    /// Density of objects, kg/m3, over the volume that their splats fill: what lies between splats is full, the rest a
    /// sheet as thick as its splats, and no more than the colliders. Masses are in the report
    #[arg(long, value_name = "KG_PER_M3", default_value_t = DENSITY, value_parser = density)]
    density: f64,
    /// Fix objects on recorded tracks to the world by joints, for simulators that would let them fall (MuJoCo)
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    weld_kinematic: Option<bool>,
    /// Turn a PLY so that this axis is up, for viewers that expect it; it is read back as captured [default: as
    /// captured]
    #[arg(long, value_name = "AXIS")]
    ply_up: Option<UpAxis>,
    /// Moment of a PLY: a frame (36), seconds (1.5s) or a share (50%) [default: the first frame]
    #[arg(long, value_name = "TIME", conflicts_with = "ply_sequence", allow_hyphen_values = true)]
    ply_time: Option<Moment>,
    /// A file per object: --ply FOLDER makes FOLDER/red_mug_001.ply
    #[arg(long)]
    ply_split: bool,
    /// A file per sampled frame: --ply FOLDER makes FOLDER/0000.ply; with --ply-split FOLDER/red_mug_001/0000.ply
    #[arg(long)]
    ply_sequence: bool,
}

fn density(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(density) if density.is_finite() && density > 0.0 => Ok(density),
        _ => Err("a number of kg per cubic metre above 0 is expected".to_owned()),
    }
}

impl Writing {
    /// True with --single-file.
    pub(super) fn is_single_file(&self) -> bool {
        self.single_file
    }

    /// Options, with the moment of formats that hold one.
    ///
    /// # Errors
    /// When the scene has no such moment.
    pub(super) fn options(
        &self,
        preferred: &Preferred,
        force: bool,
        frames: &Frames<'_>,
    ) -> Result<ExportOptions, Error> {
        let code = |moment| {
            note_fraction("--ply-time", moment);
            frames.code("--ply-time", moment)
        };
        let time_code = self.ply_time.map(code).transpose()?;
        Ok(ExportOptions { time_code, ..self.without_moment(preferred, force) })
    }

    /// Options by which names and places are checked, which do not depend on the moment.
    pub(super) fn without_moment(&self, preferred: &Preferred, force: bool) -> ExportOptions {
        let payloads = match (self.payloads, self.single_file) {
            (true, _) => Payloads::Separate,
            (_, true) => Payloads::SingleFile,
            _ => Payloads::ByKind,
        };
        ExportOptions {
            force,
            payloads,
            levels_of_detail: !self.no_lod,
            ground: self.ground.or(preferred.ground).unwrap_or_default(),
            density: self.density,
            weld_kinematic: self.weld_kinematic.or(preferred.weld_kinematic).unwrap_or_default(),
            turn_up: self.ply_up.or(preferred.ply_up),
            time_code: None,
            split: self.ply_split,
            sequence: self.ply_sequence,
        }
    }
}

impl Targets {
    pub(super) fn iter(&self) -> std::slice::Iter<'_, Target> {
        self.files.iter()
    }

    /// Checks names and places before the work starts.
    pub(super) fn check(
        &self,
        writing: &Writing,
        preferred: &Preferred,
        force: bool,
        outputs: &mut Outputs,
    ) -> Result<(), Error> {
        let of_ply = [
            ("--ply-time", writing.ply_time.is_some()),
            ("--ply-split", writing.ply_split),
            ("--ply-sequence", writing.ply_sequence),
            ("--ply-up", writing.ply_up.is_some()),
        ];
        let has_ply = self.files.iter().any(|target| target.format.about().most_expensive_motion.is_none());
        if let Some((flag, _)) = of_ply.into_iter().find(|(_, is_given)| *is_given && !has_ply) {
            return Err(Error::usage(
                format!("{flag} is about a PLY, and none is written"),
                "add OUT.ply, or --ply OUT",
            ));
        }
        let options = writing.without_moment(preferred, force);
        self.files.iter().try_for_each(|target| target.check(&options, outputs))
    }
}

impl Target {
    fn check(&self, options: &ExportOptions, outputs: &mut Outputs) -> Result<(), Error> {
        let (format, path): (_, &Path) = (self.format, &self.path);
        let folder = format.fills_folder(options);
        if folder && format.recognises(path) {
            return Err(Error::usage(
                format!("{self:?}: several files go into a folder"),
                "name a folder, for example splats",
            ));
        }
        if !folder && !format.writes(path) {
            let or_folder = match format.about().most_expensive_motion {
                Some(_) => "",
                None => ", or write into a folder with --ply-split or --ply-sequence",
            };
            return Err(Error::usage(
                format!("{self:?}: the ending decides the format"),
                format!("end the name in {}{or_folder}", written(format).join(", ")),
            ));
        }
        if folder {
            format.check_target(path, options).map_err(Error::plain)?;
            return output::check_folder(path, options.force);
        }
        format.files(path).iter().try_for_each(|file| outputs.file(file))?;
        format.check_target(path, options).map_err(Error::plain)
    }

    /// Tells what was written.
    pub(super) fn report(&self, summary: &ExportSummary) {
        for lost in &summary.not_held {
            crate::messages::warning!("{} does not hold everything of {lost}", self.format.about().name);
        }
        for kept in &summary.kept {
            note!("{} is not of cif and was kept", kept.display());
        }
        let files = match summary.files.len() {
            0 | 1 => String::new(),
            count => format!("{count} files, "),
        };
        let library = summary.library.as_ref().map_or_else(String::new, |library| format!(" ({library})"));
        outcome!(
            "wrote {}: {files}{} objects, {} splats, {} time samples, {:.1} MB{library}",
            summary.path.display(),
            summary.nodes,
            summary.splats,
            summary.samples,
            summary.bytes as f64 / 1e6,
        );
    }
}
