//! Options of `cif bench compare`.

use std::path::PathBuf;
use std::time::Duration;

use cif_train::HeadName;
use clap::Args;

use super::questions;
use crate::commands::shared::CaptureOptions;
use crate::commands::shared::named::HeadArgument;

const HELP: &str = "\
Every capture is reconstructed once per seed; every head then trains on that reconstruction, sees the same masks and is
scored on the held-out frames as `cif eval` scores its scene. All train what their settings have, as `cif train
--effects all` does. What is trained on the masks of one folder may be scored on those of another:

  cif bench compare captures/table -o compare --masks masks_tracker --score-masks masks

  cif bench compare captures/table -o compare --preset draft
  cif bench compare captures/table captures/kitchen -o compare --heads cif,sa4d --seeds 1 --ablations

DIR holds compare.html (needs no network), panoptic and ablation each as .md, .csv, .json and .tex, and the runs with
their scenes: finished ones are not repeated, and Ctrl-C keeps the current one, so that the same command continues
where it stopped. --budget 2h starts no new run after that time. With --video, the camera goes through the held-out
frames of one camera in the order of their times, and straight from one to the next.

--iterations published trains every head as long as its own publication does: Gaussian Grouping 30 000 steps, SA4D 5 000,
VLGS 15 000, Trace3D 29 000, 4D LangSplat 10 000, CIF 3 000; Dr. Splat trains nothing. VLGS is a re-implementation, because there is no
public code; the page says so next to its numbers. Published numbers are in a column of their own: they were measured
against other masks.

Questions in words: --queries FILE has the scene of every head answer questions, and compares the answers with the masks
of the instances that FILE names, in held-out frames: queries.md, .csv, .json and .tex, and a table in the page. They are
answered by the words of labels and classes, as by cif query --text, and with --models by the masks that Grounding DINO
and SAM make of them, as by cif query --prompt with --protocol reproject and grouping; cif query --help describes the
folder of models.

  cif bench compare captures/table -o compare --queries questions.toml --models models

The head 4d-langsplat takes part in questions alone. It learns feature maps of yours, three floats per pixel of every
training frame (0 or NaN where a pixel has none), and answers by how near its pixels are to the code that your encoder
makes of a question; maps and codes stand in FILE.

FILE is TOML, or JSON of the same names where its name ends in .json:

";

fn help() -> String {
    format!("{HELP}{}", questions::EXAMPLE)
}

/// Compare the method with other systems and without its parts, on one reconstruction per capture and seed
#[derive(Debug, Args)]
#[command(after_help = help())]
pub(in crate::commands::bench) struct BenchCompare {
    /// Folders of the captures
    #[arg(required = true)]
    pub(super) captures: Vec<PathBuf>,
    /// Folder to write into
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) report: crate::report::Report,
    /// Heads to compare, comma separated [default: all]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    pub(super) heads: Vec<HeadArgument>,
    /// Number of seeds, from that of the settings on
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) seeds: u32,
    /// Named settings: draft, standard, best or paper [default: standard]
    #[arg(long, value_name = "NAME")]
    pub(super) preset: Option<String>,
    /// Steps of the instance stage of every head: a number, or `published` for those of its publication
    #[arg(long, value_name = "N|published", default_value = "3000", value_parser = iterations)]
    pub(super) iterations: Iterations,
    /// Compare the method without its parts too
    #[arg(long)]
    pub(super) ablations: bool,
    /// Questions in words per capture with the instances that are their answers, in a file described below
    #[arg(long, value_name = "FILE")]
    pub(super) queries: Option<PathBuf>,
    /// Folder of ONNX models with a models.toml, which answer the questions of --queries too
    #[arg(long, value_name = "DIR", requires = "queries")]
    pub(super) models: Option<PathBuf>,
    /// Start no new run after this time: 90s, 5m, "1h 30m". Runs that have started are finished, the
    /// tables list the missing ones, and the same command continues
    #[arg(long, value_name = "DURATION", value_parser = humantime::parse_duration)]
    pub(super) budget: Option<Duration>,
    /// Mask folder that scores are taken on: a name inside every capture, such as `masks` with --masks masks_tracker
    /// [default: that of --masks]
    #[arg(long, value_name = "NAME")]
    pub(super) score_masks: Option<PathBuf>,
    /// Write a video per capture, shown in the page: colours, then the labels of every run of the first seed, side by
    /// side, along the held-out frames. Needs ffmpeg with libx264
    #[arg(long)]
    pub(super) video: bool,
    /// Any setting by its key in SCENE.train.toml, e.g. --set head.camera=cam16
    #[arg(long, value_name = "TABLE.KEY=VALUE")]
    pub(super) set: Vec<String>,
    /// Do this part alone and write no page, as in --only table.seed0.cif; for jobs of `cif batch`
    #[arg(long, value_name = "CAPTURE.seedN.HEAD", conflicts_with_all = ["queries", "video", "budget"])]
    pub(super) only: Option<String>,
    /// Write into a folder that holds other files already
    #[arg(long)]
    pub(super) force: bool,
    #[command(flatten)]
    pub(super) capture_options: CaptureOptions,
}

/// Steps of the instance stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Iterations {
    Published,
    Steps(u32),
}

fn iterations(text: &str) -> Result<Iterations, String> {
    match text {
        "published" => Ok(Iterations::Published),
        number => match number.parse() {
            Ok(steps) if (1..=1_000_000).contains(&steps) => Ok(Iterations::Steps(steps)),
            _ => Err("expected a number of steps from 1 to 1000000, or `published`".to_owned()),
        },
    }
}

impl Iterations {
    pub(super) fn of(self, head: HeadName) -> u32 {
        match self {
            Self::Published => head.published_steps(),
            Self::Steps(steps) => steps,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_a_number_or_published() {
        assert_eq!(iterations("3000"), Ok(Iterations::Steps(3_000)));
        assert_eq!(iterations("published").unwrap().of(HeadName::Sa4d), 5_000);
        assert!(iterations("0").is_err() && iterations("many").is_err());
    }
}
