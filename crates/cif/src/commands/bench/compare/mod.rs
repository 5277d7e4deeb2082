//! `cif bench compare`: the tables of the paper on captures of one's own.

mod answers;
mod capture;
mod describe;
mod options;
mod questions;
mod runs;
mod video;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_batch::Part;
use cif_bench::comparison::page::{self, Comparison};
use cif_bench::comparison::queries::Answer;
use cif_bench::comparison::record::Row;
use cif_bench::comparison::{ABLATIONS, Contender};
use cif_bench::records::Records;
use cif_dataset::{Dataset, Layout, Split};
use cif_train::{HeadName, TrainConfig};
use serde::Serialize;

use self::capture::Capture;
use self::describe::describe;
pub(super) use self::options::BenchCompare;
use self::runs::{Bench, Ended};
use crate::commands::shared::named::preset;
use crate::commands::shared::print_warnings;
use crate::error::Error;
use crate::report::{JsonReport, Stored};
use crate::settings::Layers;
use crate::{interrupt, output};

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
    if let Some(only) = &command.only {
        return part(command, &captures, &contenders, maps, only);
    }
    // Two at once would replace each other's records.
    let _lock = crate::lock::Lock::take(&command.output.join("report.json"))?;
    let runs = Records::inside(&command.output)?;
    interrupt::watch();
    let mut bench = Bench::new(runs, command.iterations, command.budget, maps);
    bench.compare_all(&captures, command.seeds, &contenders)?;
    let heads: Vec<HeadName> = contenders.iter().filter_map(Contender::whole).collect();
    let (folder, models) = (&*command.output, command.models.as_deref());
    let ask = |questions: &Vec<_>| answers::ask(&mut bench, &captures, questions, &heads, folder, models);
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
            message: format!("interrupted; {} holds the results so far", page.display()),
            help: Some("run the same command again to continue".to_owned()),
        });
    }
    let tables = ["panoptic", "queries"].into_iter().take(1 + usize::from(comparison.queries.is_some()));
    let mut text = String::new();
    for name in tables {
        let path = command.output.join(format!("{name}.md"));
        text += &std::fs::read_to_string(&path).map_err(Error::io("read", &path))?;
        text.push('\n');
    }
    let stored = |name: &str| command.output.join(format!("{name}.json"));
    let report = CompareReport {
        panoptic: Stored::read(&stored("panoptic"))?,
        queries: comparison.queries.as_ref().map(|_| Stored::read(&stored("queries"))).transpose()?,
    };
    command.report.give(|| report, || print!("{text}"))?;
    crate::messages::outcome!("wrote {}", page.display());
    if bench.ended == Some(Ended::OutOfTime) {
        let answers = match unanswered {
            0 => String::new(),
            scenes => format!(", and with the questions that {scenes} scenes have not answered"),
        };
        crate::messages::outcome!(
            "the budget is used up; run the same command again for the {left} runs that are missing{answers}"
        );
    }
    Ok(())
}

/// Does one part alone, while other processes do others.
fn part(
    command: &BenchCompare,
    captures: &[Capture],
    contenders: &[Contender],
    maps: BTreeMap<String, PathBuf>,
    only: &str,
) -> Result<(), Error> {
    let parts = |capture: &Capture| {
        parts_of(Path::new(&capture.name), capture.config.seed, command.seeds, contenders)
    };
    let names: Vec<String> = captures.iter().flat_map(parts).map(|part| part.name).collect();
    if !names.iter().any(|name| name == only) {
        let help = format!("the parts are {}", names.join(", "));
        return Err(Error::usage(format!("--only {only}: there is no such part"), help));
    }
    let runs = Records::inside(&command.output)?;
    let _lock = crate::lock::Lock::take(&runs.file(&format!("{only}.json")))?;
    interrupt::watch();
    let mut bench = Bench::new(runs, command.iterations, None, maps);
    bench.only = Some(only.to_owned());
    bench.compare_all(captures, command.seeds, contenders)?;
    match bench.ended {
        Some(_) => Err(Error::Interrupted { message: format!("interrupted in {only}"), help: None }),
        None => Ok(()),
    }
}

/// Parts of a capture that are jobs of their own: a reconstruction per seed, and what is trained on it.
fn parts_of(capture: &Path, seed: u64, seeds: u32, contenders: &[Contender]) -> Vec<Part> {
    let name = capture.file_name().unwrap_or_default().to_string_lossy();
    let mut parts: Vec<Part> = Vec::new();
    for seed in (seed..).take(seeds as usize) {
        let base = parts.len();
        let part = |part: &str, needs: &[usize]| Part {
            name: runs::id(&name, seed, part),
            needs: needs.to_vec(),
            capture: capture.to_owned(),
        };
        parts.push(part(BASE, &[]));
        parts.extend(contenders.iter().map(|contender| part(contender.name(), &[base])));
    }
    parts
}

/// Parts of a comparison of captures in a folder; they are not read.
///
/// # Errors
/// When a folder is no capture, or settings do not fit.
pub(in crate::commands) fn parts(command: &BenchCompare, folder: &Path) -> Result<Vec<Part>, Error> {
    if command.queries.is_some() {
        return Err(Error::usage(
            "questions are asked of all runs together, so that they are no parts of a plan",
            "leave --queries out of the plan, and run the same comparison with it when the batch is done",
        ));
    }
    let contenders = contenders(command, false)?;
    let mut all: Vec<Part> = Vec::new();
    for capture in &command.captures {
        let check = |layout| base_config(command, layout).map(drop);
        let layout = command.capture_options.layout_after(&folder.join(capture), check)?;
        let begin = all.len();
        let of_capture = parts_of(capture, base_config(command, layout)?.seed, command.seeds, &contenders);
        all.extend(
            of_capture
                .into_iter()
                .map(|part| Part { needs: part.needs.iter().map(|need| need + begin).collect(), ..part }),
        );
    }
    Ok(all)
}

/// Name of the reconstruction among parts.
const BASE: &str = "base";

/// Scores of every run, and its answers to questions.
#[derive(Serialize)]
struct CompareReport {
    /// Scores of every run.
    panoptic: Stored<Vec<Row>>,
    /// Every answer; absent without questions.
    #[serde(skip_serializing_if = "Option::is_none")]
    queries: Option<Stored<Vec<Answer>>>,
}

impl JsonReport for CompareReport {
    const COMMANDS: &'static [&'static str] = &["cif bench compare"];
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
    let is_included = |head: &HeadName| match command.heads.is_empty() {
        true => head.tells_labels() || has_maps,
        false => is_named(*head),
    };
    let mut contenders: Vec<Contender> =
        HeadName::ALL.iter().copied().filter(is_included).map(Contender::Head).collect();
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
    let preset = command.preset.as_deref().map(|name| preset(name, "--preset")).transpose()?;
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
