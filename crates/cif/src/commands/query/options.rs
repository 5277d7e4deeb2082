//! Options of `cif query`.

use std::path::PathBuf;

use clap::Args;

use super::mask_options::ByMasks;
use crate::moment::{Interval, Moment};
use crate::report::Report;

const HELP: &str = "\
Without conditions every object is listed; several conditions must all hold. Labels match the name,
class or unique name of an object; case does not matter, * stands for any characters and ? for one.
Boxes hold the splats to three standard deviations; volumes are those of the colliders, where there
are any, else of the boxes; speeds are world units per second. Stages of other programs need semantic
labels only.
Times are frames as captured, in a .cif as in what is exported of it: time codes of stages. With a suffix they are
seconds after the first frame or a share of the whole.

  cif query table.usda --label 'red mug' --time 36
  cif query table.cif --label 'red mug' --time 1.5s
  cif query table.usda --taxonomy class --label mug --interval 0:20
  cif query table.usda --label mug --interval 50%:100%
  cif query table.cif --taxonomy wikidata_qcode=Q81727
  cif query table.glb --box -0.2,-0.2,0,0.2,0.2,0.3
  cif query table.cif --label '*box' --json
  cif query table.cif --point 0.1,0.2,0.05 --time 50%

Paths: object, label and class; the frame (time code), the time from 0 to 1 and in seconds; the origin of
the object's frame (x, y, z; world units) and its rotation (quaternion qw, qx, qy, qz; from its own axes to
the world's, unturned at the first frame); visible, 0 while it is hidden. Objects in parts have the path of the largest part,
objects that bend that of the best rigid fit.

  cif query table.cif --label 'red mug' --trajectory mug.csv
  cif query table.usda --trajectory

By words: with --models, the objects whose embeddings (cif embed) are nearest to the text; those with a
* are nearer to it than to texts of anything. Else those that have most of the words in their names.

  cif query table.usda --text 'something to drink from' --models models
  cif query table.usda --text 'red mug'

By masks: DIR holds what a 2D detector found on frames of the capture, as PNG files (black = not
found) named FRAME.png, FRAME_*.png or FRAME/*.png. Instances are chosen that lie mostly inside the
masks of training frames; --eval renders them from held-out frames and compares with the masks there.

  cif query table.cif --masks found --capture captures/table --eval

By a prompt: Grounding DINO finds boxes (scores above 0.3) and SAM the masks in them, both ONNX models of
yours; --json lists the boxes, with the words that score above 0.45. Masks are kept in
CAPTURE/.cif-cache. Or a command of your own makes them.

  cif query table.cif --prompt 'steel jug' --capture captures/table --models models
  cif query table.cif --prompt 'steel jug' --capture captures/table --models models \\
      --protocol grouping --eval
  cif query table.cif --prompt 'steel jug' --capture captures/table \\
      --detector 'python detect.py --text {prompt} --in {frames} --out {masks}'

Models are run by ONNX Runtime (pip install 'cif4d[vision]', or ORT_DYLIB_PATH); nothing is downloaded.
Their folder has a file such as this, with the names of your exports:

";

fn help() -> String {
    format!("{HELP}{}", cif_vision::models::EXAMPLE)
}

/// Find objects by label, time, position or masks, or the objects at a point
#[derive(Debug, Args)]
#[command(after_help = help())]
pub(in crate::commands) struct Query {
    /// Trained scene (.cif), or a file of any format that cif export writes
    #[arg(value_name = "FILE")]
    pub(super) path: PathBuf,
    /// Label to look for
    #[arg(long, value_name = "PATTERN")]
    pub(super) label: Option<String>,
    /// Labels that count: class (classes and human labels), instance (unique names), or another taxonomy of the
    /// instances; NAME=PATTERN also gives the label to look for
    #[arg(long, value_name = "NAME[=PATTERN]")]
    pub(super) taxonomy: Option<String>,
    /// Point in the world: the objects there, with their probabilities in a .cif
    #[arg(
        long,
        alias = "at",
        value_name = "X,Y,Z",
        value_delimiter = ',',
        num_args = 1,
        allow_hyphen_values = true
    )]
    pub(super) point: Option<Vec<f64>>,
    /// Box in the world that objects touch, by two opposite corners
    #[arg(
        long = "box",
        value_name = "X,Y,Z,X,Y,Z",
        value_delimiter = ',',
        num_args = 1,
        allow_hyphen_values = true
    )]
    pub(super) region: Option<Vec<f64>>,
    /// Time: a frame (36), seconds (1.5s) or a share (50%) [default: the first frame]
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub(super) time: Option<Moment>,
    /// Interval of time: objects that are there at any time in it
    #[arg(long, value_name = "FROM:TO", conflicts_with = "time", allow_hyphen_values = true)]
    pub(super) interval: Option<Interval>,
    /// Words that describe what to look for: by embeddings, where the file has some (cif embed) and --models are
    /// given, else by the words of labels, classes and taxonomies
    #[arg(long, value_name = "TEXT", conflicts_with_all = ["label", "taxonomy", "masks"])]
    pub(super) text: Option<String>,
    /// Folder of ONNX models with a models.toml, which answer --prompt and --text
    #[arg(long, value_name = "DIR")]
    pub(super) models: Option<PathBuf>,
    /// Read layers that a stage brings in from outside its folder
    #[arg(long)]
    pub(super) follow_external: bool,
    /// Write the path of every object found, a row per captured frame, as CSV [default: to stdout]
    #[arg(
        long,
        value_name = "FILE.csv",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "-",
        conflicts_with_all = ["json", "time", "interval", "point", "region", "text", "masks", "prompt"]
    )]
    pub(super) trajectory: Option<PathBuf>,
    #[command(flatten)]
    pub(in crate::commands) report: Report,
    /// Replace an existing file of --json or --trajectory
    #[arg(long)]
    pub(super) force: bool,
    #[command(flatten)]
    pub(super) by_masks: ByMasks,
}

impl Query {
    /// True where paths go into a file.
    pub(in crate::commands) fn writes_trajectory(&self) -> bool {
        self.trajectory.as_deref().is_some_and(|file| !crate::output::is_stdout(file))
    }
}
