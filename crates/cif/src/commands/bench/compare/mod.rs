//! `cif bench compare`: the tables of the paper on captures of one's own.

mod answers;
mod describe;
mod questions;
mod runs;
mod video;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use cif_bench::comparison::page::{self, Comparison};
use cif_bench::comparison::run::Subject;
use cif_bench::comparison::{ABLATIONS, Contender};
use cif_bench::records::Records;
use cif_dataset::{Dataset, Layout, Split};
use cif_train::{HeadName, TrainConfig};
use clap::Args;

use self::describe::describe;
use self::runs::{Bench, Ended};
use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::commands::train::{self, HeadArgument};
use crate::error::Error;
use crate::settings::Layers;
use crate::{interrupt, output};

const HELP: &str = "\
Every capture is reconstructed once per seed; every head then trains on that reconstruction, sees the same masks and is
scored on the held-out frames as `cif eval` scores its scene. All train what their settings have, as `cif train
--effects all` does. What is trained on the masks of one folder may be scored on those of another:

  cif bench compare captures/table -o compare --masks masks_tracker --score-masks masks

  cif bench compare captures/table -o compare --preset draft
  cif bench compare captures/table captures/kitchen -o compare --heads cif,sa4d --seeds 1 --ablations

DIR holds compare.html (needs no network), panoptic and ablation each as .md, .csv, .json and .tex, and the runs with
their scenes: finished ones are not done again, and Ctrl-C keeps the one under way, so that the same command goes on
where it stopped. --budget 2h begins no new run after that long. With --video, the camera goes through the held-out
frames of one camera in the order of their times, and straight from one to the next.

--iterations published trains every head as long as its own publication does: Gaussian Grouping 30 000 steps, SA4D 5 000,
VLGS 15 000, Trace3D 29 000, 4D LangSplat 10 000, CIF 3 000; Dr. Splat trains nothing. VLGS is a re-implementation, because there is no
public code; the page says so beside its numbers. Published numbers stand in a column of their own: they were taken
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
pub(super) struct BenchCompare {
    /// Folders of the captures
    #[arg(required = true)]
    captures: Vec<PathBuf>,
    /// Folder to write into
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    output: PathBuf,
    #[command(flatten)]
    report: crate::report::Report,
    /// Heads to compare, comma separated [default: all]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    heads: Vec<HeadArgument>,
    /// Number of seeds, from that of the settings on
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    seeds: u32,
    /// Named settings: draft, standard or paper [default: standard]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Steps of the instance stage of every head: a number, or `published` for those of its publication
    #[arg(long, value_name = "N|published", default_value = "3000", value_parser = iterations)]
    iterations: Iterations,
    /// Compare the method without its parts too
    #[arg(long)]
    ablations: bool,
    /// Questions in words per capture with the instances that are their answers, in a file described below
    #[arg(long, value_name = "FILE")]
    queries: Option<PathBuf>,
    /// Folder of ONNX models with a models.toml, which answer the questions of --queries too
    #[arg(long, value_name = "DIR", requires = "queries")]
    models: Option<PathBuf>,
    /// Begin no new run after so long: 90s, 5m, "1h 30m". Runs under way are finished, the tables say what is missing,
    /// and the same command goes on
    #[arg(long, value_name = "DURATION", value_parser = humantime::parse_duration)]
    budget: Option<Duration>,
    /// Mask folder that scores are taken on: a name inside every capture, such as `masks` beside --masks masks_tracker
    /// [default: that of --masks]
    #[arg(long, value_name = "NAME")]
    score_masks: Option<PathBuf>,
    /// Write a video per capture, shown in the page: colours, then the labels of every run of the first seed, side by
    /// side, along the held-out frames. Needs ffmpeg with libx264
    #[arg(long)]
    video: bool,
    /// Any setting by its key in SCENE.train.toml, e.g. --set head.camera=cam16
    #[arg(long, value_name = "TABLE.KEY=VALUE")]
    set: Vec<String>,
    /// Write into a folder that holds other files already
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

/// Steps of the instance stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Iterations {
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
    fn of(self, head: HeadName) -> u32 {
        match self {
            Self::Published => head.published_steps(),
            Self::Steps(steps) => steps,
        }
    }
}

/// A capture to compare on.
struct Capture {
    name: String,
    dataset: Dataset,
    /// The capture with the masks that scores are taken on, where these are others.
    scored: Option<Dataset>,
    config: TrainConfig,
}

impl Capture {
    /// The capture with the masks that scores are taken on.
    fn scored(&self) -> &Dataset {
        self.scored.as_ref().unwrap_or(&self.dataset)
    }
}

pub(super) fn run(command: &BenchCompare) -> Result<(), Error> {
    let file = command.queries.as_deref().map(questions::File::read).transpose()?;
    if let Some(models) = &command.models {
        answers::check(models)?;
    }
    let goes_on = command.output.join("runs").is_dir();
    command.report.check(&mut output::Outputs::new(command.force))?;
    output::check_folder(&command.output, command.force || goes_on)?;
    let captures = command
        .captures
        .iter()
        .map(|path| open(command, path.as_path()))
        .collect::<Result<Vec<_>, Error>>()?;
    for (k, capture) in captures.iter().enumerate() {
        if captures[..k].iter().any(|other| other.name == capture.name) {
            return Err(Error::failed(
                format!("two captures are called {}", capture.name),
                "rename one of the folders: tables name captures by them",
            ));
        }
    }
    let questions = file.as_ref().map(|file| file.of(&captures)).transpose()?;
    let maps: BTreeMap<String, PathBuf> =
        questions.iter().flatten().filter_map(|of| Some((of.capture.clone(), of.maps.clone()?))).collect();
    let contenders = contenders(command, !maps.is_empty())?;
    for (name, maps) in &maps {
        if contenders.contains(&Contender::Head(HeadName::LangSplat))
            && let Some(capture) = captures.iter().find(|capture| capture.name == *name)
        {
            cif_dataset::feature_maps(&capture.dataset, maps)?;
        }
    }
    if command.video {
        video::check()?;
    }
    // Two at once would replace each other's records.
    let _lock = crate::lock::Lock::take(&command.output.join("report.json"))?;
    let runs = Records::inside(&command.output)?;
    interrupt::watch();
    let mut bench = Bench::new(runs, command.iterations, command.budget, maps);
    for capture in &captures {
        for seed in 0..u64::from(command.seeds) {
            let mut config = capture.config.clone();
            config.seed += seed;
            let subject = Subject {
                capture: &capture.name,
                dataset: &capture.dataset,
                scored: capture.scored(),
                config: &config,
            };
            bench.compare(&subject, &contenders)?;
        }
    }
    let heads: Vec<HeadName> = contenders.iter().filter_map(Contender::whole).collect();
    let of_run = (&*command.output, command.models.as_deref());
    let ask = |questions: &Vec<_>| answers::ask(&mut bench, &captures, questions, &heads, of_run);
    let queries = questions.as_ref().map(ask).transpose()?;
    let videos = match command.video && bench.ended != Some(Ended::Interrupted) {
        true => video::write_all(&command.output, &bench, &captures)?,
        false => Vec::new(),
    };
    let comparison = Comparison { queries, ..describe(command, &captures, &heads, &bench, videos) };
    page::write(&command.output, &bench.runs, &comparison, &bench.records)?;
    let page = command.output.join("compare.html");
    let unanswered = comparison.queries.as_ref().map_or(0, |queries| queries.missing.len());
    let left = bench.missing.len();
    if bench.ended == Some(Ended::Interrupted) {
        return Err(Error::Interrupted {
            message: format!("interrupted; {} holds what is compared so far", page.display()),
            help: Some("the same command goes on".to_owned()),
        });
    }
    let tables = ["panoptic", "queries"].into_iter().take(1 + usize::from(comparison.queries.is_some()));
    let (mut report, mut text) = (serde_json::Map::new(), String::new());
    for name in tables {
        report.insert(name.to_owned(), crate::report::read(&command.output.join(format!("{name}.json")))?);
        let path = command.output.join(format!("{name}.md"));
        text += &std::fs::read_to_string(&path).map_err(Error::io("read", &path))?;
        text.push('\n');
    }
    command.report.give(|| report.into(), || print!("{text}"))?;
    crate::messages::outcome!("wrote {}", page.display());
    if bench.ended == Some(Ended::OutOfTime) {
        let answers = match unanswered {
            0 => String::new(),
            scenes => format!(", and with the questions that {scenes} scenes have not answered"),
        };
        crate::messages::outcome!(
            "the budget is used up; the same command goes on with the {left} runs that are not done yet{answers}"
        );
    }
    Ok(())
}

/// Runs of every capture and seed, in the order of tables.
fn contenders(command: &BenchCompare, has_maps: bool) -> Result<Vec<Contender>, Error> {
    let is_named = |head: HeadName| command.heads.iter().any(|argument| argument.head() == head);
    if is_named(HeadName::LangSplat) && !has_maps {
        return Err(Error::usage(
            "4d-langsplat learns feature maps and answers questions, and no capture has maps",
            "name their folder in the file of --queries, see cif bench compare --help, or leave the head out",
        ));
    }
    let wanted = |head: &HeadName| match command.heads.is_empty() {
        true => head.tells_labels() || has_maps,
        false => is_named(*head),
    };
    let mut contenders: Vec<Contender> =
        HeadName::ALL.iter().copied().filter(wanted).map(Contender::Head).collect();
    if command.ablations {
        let whole = Contender::Head(HeadName::Cif);
        if !contenders.contains(&whole) {
            contenders.insert(0, whole);
        }
        contenders.extend(ABLATIONS.map(|(ablation, _)| Contender::Without(ablation)));
    }
    Ok(contenders)
}

/// Opens a capture, with the settings of its reconstruction.
fn open(command: &BenchCompare, path: &Path) -> Result<Capture, Error> {
    let check = |layout| base_config(command, layout).map(drop);
    let layout = command.capture_options.layout_after(path, check)?;
    let mut options = command.capture_options.clone();
    options.downscale = options.downscale.or(base_config(command, layout)?.downscale);
    let dataset = options.open(path)?;
    print_warnings(&dataset);
    let refused = |problem: &str, help: &str| {
        Err(Error::failed(format!("{}: {problem}", path.display()), help.to_owned()))
    };
    if !dataset.frames.iter().any(|frame| frame.split == Split::Val) {
        return refused(
            "no frame is held out, so nothing can be scored",
            "hold frames out in the split lists of the capture",
        );
    }
    let scored = command.score_masks.as_ref().map(|folder| dataset.with_masks(folder)).transpose()?;
    scored.iter().for_each(print_warnings);
    let is_masked = |dataset: &Dataset, split| {
        dataset.frames.iter().any(|frame| frame.split == split && frame.mask.is_some())
    };
    if !is_masked(&dataset, Split::Train) || !is_masked(scored.as_ref().unwrap_or(&dataset), Split::Val) {
        return refused(
            "heads are compared by masks, and its training or held-out frames have none",
            "give a capture with masks, or their folder with --masks",
        );
    }
    let mut config = base_config(command, dataset.layout)?;
    config.downscale = options.downscale;
    let name = dataset.root.file_name().map_or_else(|| "capture".into(), |name| name.to_string_lossy());
    Ok(Capture { name: name.into_owned(), config, scored, dataset })
}

/// Settings of the reconstruction: those of the run of the method itself.
fn base_config(command: &BenchCompare, layout: Layout) -> Result<TrainConfig, Error> {
    let preset = command.preset.as_deref().map(|name| train::preset(name, "--preset")).transpose()?;
    let mut config = TrainConfig::preset(preset.unwrap_or_default(), layout);
    let steps = command.iterations.of(HeadName::Cif);
    // Relocations end as far before the end of the stage as in the preset.
    let stage = u64::from(config.stages.instance.max(1));
    config.resample.until = (u64::from(config.resample.until) * u64::from(steps) / stage) as u32;
    config.stages.instance = steps;
    let mut layers = Layers::new(config);
    for assignment in &command.set {
        layers.assignment(assignment)?;
    }
    let mut config = layers.validated()?;
    config.head.name = HeadName::Cif;
    config.instance.ablate.clear();
    Ok(config)
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
