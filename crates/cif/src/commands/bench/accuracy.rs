//! `cif bench accuracy`: what accuracy costs, measured on a capture of one's own.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};

use cif_batch::Part;
use cif_bench::accuracy::ladders::{BASE, Base, NAMES, PAPER, Paper, QUICK_BASE};
use cif_bench::accuracy::measure::{self, Training};
use cif_bench::accuracy::record::Record;
use cif_bench::accuracy::report::{self, AccuracyReport, Measured, Subject};
use cif_bench::accuracy::time_limit::{QUICK_SECONDS, TimeLimit};
use cif_bench::accuracy::{Ladder, Rung, Work, ladders};
use cif_bench::records::{Kept, Records};
use cif_dataset::{Dataset, MadeFrom, Split};
use cif_field::Field;
use cif_geometry::PinholeCamera;
use cif_render::RenderedImage;
use cif_render::cpu::SimdLevel;
use cif_render::quality::{FINAL, Quality};
use cif_train::config::InstanceGeometry;
use cif_train::fit::stretched;
use cif_train::metrics::{FrameView, trained_settings};
use cif_train::{Preset, Stop, SystemClock, TrainConfig, Trainer};
use clap::Args;
use serde_json::json;

use crate::commands::shared::motion;
use crate::commands::shared::named::preset;
use crate::commands::shared::trajectories::Trajectories;
use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
use crate::lock::Lock;
use crate::pictures::{Picture, instance_picture, rgb_picture};
use crate::report::{JsonReport, Stored};
use crate::settings::Layers;
use crate::{interrupt, output, starting_points};

/// Measure accuracy against time and bytes, and write a report with plots
#[derive(Debug, Args)]
#[command(after_help = "\
Ladders change one thing each and keep the rest: presets, iterations, resolution, gaussians,
deformation, sh, instance, speedups train a scene per rung; precision, storage, render and export use
the scene that the base trains. Every rung is scored on the held-out frames. All train what their
settings have, as `cif train --effects all` does.

  cif bench accuracy captures/table -o report --quick
  cif bench accuracy captures/table -o report --ladders iterations,gaussians
  cif bench accuracy captures/table -o report --preset draft --set seed=3

The ladder `paper` trains the preset `paper` in addition to the base, as published for the layout of the capture. That takes
hours, so that it is measured only where it is named, with a quarter of its steps unless --paper-share says otherwise:
the steps of all stages and everything that counts in steps are shortened alike, while batch, planes, network, losses,
rates, Gaussians and images stay as published. --paper-set reduces other settings; the page lists
both next to the numbers. A step has two or four views and no limit on Gaussians that acts: limiting these saves most.

  cif bench accuracy captures/table -o paper --ladders paper --paper-set densify.max_gaussians=20000

The page also shows how the objects of the base move: a picture of their paths, and where the capture
has motion.json and tracks.npz, the scores of `cif eval` for every object.

DIR holds report.html (needs no network), report.json, rungs.csv, the plots as SVG, and the rungs:
finished ones are not measured again, and Ctrl-C keeps the current one, so that the same command
continues where it stopped. --quick trains small scenes on reduced images and ends within five minutes: it shows
how costs and scores change, not the best quality of a scene. Rungs that do not fit are listed; run the same command
again for them. Without --quick, a capture takes about thirty times a training run.

Processor time counts all threads together, so that other load on the machine changes it little.")]
pub(super) struct BenchAccuracy {
    /// Folder of the capture
    capture: PathBuf,
    /// Folder to write into
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    output: PathBuf,
    #[command(flatten)]
    report: crate::report::Report,
    /// Small scenes, reduced images and fewer rungs, in five minutes
    #[arg(long, conflicts_with = "preset")]
    quick: bool,
    /// Ladders to measure, comma separated [default: all but `paper` that say something of the capture]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',', value_parser = clap::builder::PossibleValuesParser::new(NAMES))]
    ladders: Vec<String>,
    /// Share of the steps of the preset `paper` in its ladder, above 0 and up to 1 for all [default: 0.25]
    #[arg(long, value_name = "SHARE", value_parser = share, conflicts_with = "quick")]
    paper_share: Option<f64>,
    /// Any setting of that preset by its key, e.g. --paper-set densify.max_gaussians=20000; may be repeated
    #[arg(long, value_name = "TABLE.KEY=VALUE", conflicts_with = "quick")]
    paper_set: Vec<String>,
    /// Named settings of the base: draft, standard, best or paper [default: standard]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Any setting of the base by its key in SCENE.train.toml, e.g. --set seed=3
    #[arg(long, value_name = "TABLE.KEY=VALUE")]
    set: Vec<String>,
    /// Measure this rung alone and write no report; for jobs of `cif batch`
    #[arg(long, value_name = "RUNG", conflicts_with = "quick")]
    only: Option<String>,
    /// Write into a folder that holds other files already
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

/// Share of the published steps that the preset `paper` is measured with, unless the user says otherwise.
const PAPER_SHARE: f64 = 0.25;

/// A number in (0, 1].
fn share(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|_| "expected a number".to_owned())?;
    if share > 0.0 && share <= 1.0 {
        Ok(share)
    } else {
        Err("expected a number above 0 and up to 1".to_owned())
    }
}

impl BenchAccuracy {
    /// The configuration of the paper, where its ladder is named.
    fn paper(&self) -> Result<Option<Paper>, Error> {
        if self.ladders.iter().any(|name| name == PAPER) {
            let share = self.paper_share.unwrap_or(PAPER_SHARE);
            return Ok(Some(Paper { share, settings: self.paper_set.clone() }));
        }
        if self.paper_share.is_some() || !self.paper_set.is_empty() {
            return Err(Error::usage(
                "--paper-share and --paper-set are of the ladder `paper`, which is not measured here",
                "add --ladders paper",
            ));
        }
        Ok(None)
    }
}

/// A capture with the ladders that it is measured on.
struct Prepared {
    options: CaptureOptions,
    dataset: Dataset,
    config: TrainConfig,
    ladders: Vec<Ladder>,
}

/// Opens the capture and lays the ladders.
fn prepare(command: &BenchAccuracy) -> Result<Prepared, Error> {
    let paper = command.paper()?;
    let check = |layout| {
        if let Some(Paper { share, settings }) = &paper {
            of_preset(PAPER, *share, settings, layout)?;
        }
        base_config(command, layout).map(drop)
    };
    let layout = command.capture_options.layout_after(&command.capture, check)?;
    let configured = base_config(command, layout)?.downscale;
    let mut options = command.capture_options.clone();
    options.downscale = options.downscale.or(configured);
    let mut dataset = options.open(&command.capture)?;
    if command.quick
        && options.downscale.is_none()
        && let Some(factor) = reduction(&dataset)
    {
        options.downscale = Some(factor);
        dataset = options.open(&command.capture)?;
    }
    if !dataset.frames.iter().any(|frame| frame.split == Split::Val) {
        return Err(Error::failed(
            format!("{}: no frame is held out, so nothing can be scored", command.capture.display()),
            "hold frames out in the split lists of the capture",
        ));
    }
    let mut config = base_config(command, dataset.layout)?;
    config.downscale = options.downscale;
    let base = base_of(command, &dataset, &config, paper);
    let mut all = ladders(&base);
    all.retain(|ladder| command.ladders.is_empty() || command.ladders.iter().any(|name| name == ladder.name));
    if all.is_empty() {
        return Err(Error::failed(
            "none of these ladders says anything of this capture",
            "it has a single time or no masks; leave --ladders away for those that fit",
        ));
    }
    Ok(Prepared { options, dataset, config, ladders: all })
}

/// Rungs as jobs of their own, of a capture in a folder: the base first, which those that train nothing use.
///
/// # Errors
/// When the capture cannot be read, or has nothing to be measured.
pub(in crate::commands) fn parts(command: BenchAccuracy, folder: &Path) -> Result<Vec<Part>, Error> {
    if command.quick {
        return Err(Error::usage(
            "--quick measures what fits into five minutes, so that its rungs are no jobs",
            "leave --quick out of the plan",
        ));
    }
    let capture = command.capture.clone();
    let part = |name: String, needs| Part { name, needs, capture: capture.clone() };
    let mut parts = vec![part(BASE.to_owned(), Vec::new())];
    let command = BenchAccuracy { capture: folder.join(&capture), ..command };
    for rung in prepare(&command)?.ladders.into_iter().flat_map(|ladder| ladder.rungs) {
        let trains = matches!(rung.work, Work::Train(_) | Work::Preset { .. });
        if parts.iter().all(|part| part.name != rung.id) {
            parts.push(part(rung.id, if trains { Vec::new() } else { vec![0] }));
        }
    }
    Ok(parts)
}

pub(super) fn run(command: &BenchAccuracy) -> Result<(), Error> {
    command.report.check(&mut crate::output::Outputs::new(command.force))?;
    let goes_on = command.output.join("rungs").is_dir();
    output::check_folder(&command.output, command.force || goes_on)?;
    let Prepared { options, mut dataset, config, ladders: all } = prepare(command)?;
    if config.model.triangulate {
        starting_points::find(&mut dataset, &Stop::when(interrupt::requested).into())?;
    }
    print_warnings(&dataset);
    let rungs = Records::inside(&command.output)?;
    // Two at once would replace each other's records.
    let _lock = Lock::take(&match &command.only {
        Some(only) => rungs.file(&format!("{only}.json")),
        None => command.output.join("report.json"),
    })?;
    measure::save_truth(&dataset, config.laid_over(), &rungs.file("truth.png"))?;
    let mut inputs = MadeFrom::new();
    inputs.value("version", env!("CARGO_PKG_VERSION")).capture(&dataset, rungs.known(BASE).as_ref());
    let mut bench = Bench {
        inputs,
        capture: options,
        dataset,
        config,
        rungs,
        base: None,
        exact: None,
        is_terminal: std::io::stderr().is_terminal(),
    };
    interrupt::watch();
    if let Some(only) = &command.only {
        return bench.part(&all, only);
    }
    report_all(command, bench, all)
}

/// Measures all rungs that are not kept, and writes the report.
fn report_all(command: &BenchAccuracy, mut bench: Bench, all: Vec<Ladder>) -> Result<(), Error> {
    let Rungs { records, left_out, stopped } = bench.measure_all(&all, command.quick)?;
    let measured: Measured = all
        .into_iter()
        .map(|ladder| {
            let of_ladder = ladder.rungs.iter().map(|rung| records.get(&rung.id).cloned()).collect();
            (ladder, of_ladder)
        })
        .collect();
    let missing = measured.iter().flat_map(|(_, records)| records).filter(|record| record.is_none()).count();
    let mut subject = bench.subject(command, missing);
    if records.contains_key(BASE) || bench.base.is_some() {
        subject.motion = bench.motion()?;
    }
    report::write(&command.output, &bench.rungs, &subject, &measured)?;
    let page = command.output.join("report.html");
    if stopped {
        return Err(Error::Interrupted {
            message: format!("interrupted; {} holds the results so far", page.display()),
            help: Some("run the same command again to continue".to_owned()),
        });
    }
    if !left_out.is_empty() {
        crate::messages::outcome!(
            "left out, because they do not fit into five minutes: {}; run the same command again for them",
            left_out.join("; ")
        );
    }
    crate::messages::outcome!("wrote {}", page.display());
    let report = Stored::<AccuracyReport<'static>>::read(&command.output.join("report.json"))?;
    command.report.give(|| report, || ())
}

/// Settings of the base that rungs multiply.
fn base_of(command: &BenchAccuracy, dataset: &Dataset, config: &TrainConfig, paper: Option<Paper>) -> Base {
    Base {
        quick: command.quick,
        steps: [config.stages.coarse, config.fine_iterations(), config.stages.instance],
        until: [config.densify.until, config.resample.until],
        gaussians: config.densify.max_gaussians,
        points: config.model.max_initial_points,
        nodes: config.model.spatial_resolution[0],
        width: config.model.width,
        sh_degree: config.model.sh_degree,
        downscale: config.downscale.unwrap_or(1),
        is_dynamic: dataset.times.len() > 1,
        has_instances: dataset.frames.iter().any(|frame| frame.mask.is_some()),
        instances_move_geometry: config.instance.geometry != InstanceGeometry::Off,
        paper,
    }
}

impl JsonReport for Stored<AccuracyReport<'static>> {
    const COMMANDS: &'static [&'static str] = &["cif bench accuracy"];
}

/// Pixels that training images of a quick report have at the most.
const QUICK_PIXELS: u64 = 160 * 120;

/// Reduction of the images of a capture for a quick report; none where they are small already.
fn reduction(dataset: &Dataset) -> Option<u32> {
    let pixels = |factor: u32| {
        let size =
            |camera: &PinholeCamera| u64::from(camera.width / factor) * u64::from(camera.height / factor);
        dataset.frames.iter().map(|frame| size(&frame.camera)).max().unwrap_or(0)
    };
    let factor = (0..5).map(|power| 1 << power).find(|factor| pixels(*factor) <= QUICK_PIXELS).unwrap_or(32);
    (factor > 1).then_some(factor)
}

/// Settings that all ladders start from.
fn base_config(command: &BenchAccuracy, layout: cif_dataset::Layout) -> Result<TrainConfig, Error> {
    let preset = match &command.preset {
        Some(name) => preset(name, "--preset")?,
        None if command.quick => Preset::Draft,
        None => Preset::Standard,
    };
    let mut layers = Layers::new(TrainConfig::preset(preset, layout));
    if command.quick {
        for setting in QUICK_BASE {
            layers.assignment(setting)?;
        }
    }
    for assignment in &command.set {
        layers.assignment(assignment)?;
    }
    layers.validated()
}

/// Settings of a preset with a share of its steps, and others over them.
fn of_preset(
    name: &str,
    share: f64,
    settings: &[String],
    layout: cif_dataset::Layout,
) -> Result<TrainConfig, Error> {
    let config = TrainConfig::preset(preset(name, "ladders")?, layout);
    let mut layers = Layers::new(if share < 1.0 { stretched(&config, share) } else { config });
    for assignment in settings {
        layers.assignment(assignment)?;
    }
    layers.validated()
}

/// Rungs that were measured.
struct Rungs {
    /// By id.
    records: BTreeMap<String, Record>,
    /// Names of those that there was no time for.
    left_out: Vec<String>,
    /// True where the user stopped it.
    stopped: bool,
}

/// An unfinished report.
struct Bench {
    capture: CaptureOptions,
    /// Inputs that all rungs are made from.
    inputs: MadeFrom,
    /// Capture that everything is scored on.
    dataset: Dataset,
    config: TrainConfig,
    rungs: Records<Record>,
    /// The scene of the base, once it is needed.
    base: Option<Field>,
    /// The shown frame in 64 bits, once it is needed.
    exact: Option<RenderedImage>,
    is_terminal: bool,
}

impl Bench {
    /// Record of a rung, measured where none is kept yet; none when interrupted.
    fn record(&mut self, rung: &Rung, heading: &str) -> Result<Option<Record>, Error> {
        if interrupt::requested() {
            return Ok(None);
        }
        match self.find(rung) {
            Kept::Good(record) => {
                crate::messages::outcome!("{heading}: kept, {}", summary(&record));
                return Ok(Some(record));
            }
            Kept::Void(why) => crate::messages::outcome!("{heading}: measured again: {why}"),
            Kept::Missing => {}
        }
        let Some(mut record) = self.measure(rung, heading)? else { return Ok(None) };
        record.fingerprint = self.fingerprint(rung);
        self.rungs.keep(&rung.id, &record)?;
        self.show(&format!("{heading}: {}", summary(&record)), true);
        Ok(Some(record))
    }

    fn show(&self, text: &str, ends: bool) {
        // Overwritten on terminals; elsewhere only what is finished.
        if self.is_terminal {
            eprint!("\r\x1b[K{text}{}", if ends { "\n" } else { "" });
            let _ = std::io::stderr().flush();
        } else if ends {
            crate::messages::outcome!("{text}");
        }
    }

    fn base_file(&self) -> PathBuf {
        self.rungs.file("base.cif")
    }

    /// Everything that a record depends on.
    fn fingerprint(&self, rung: &Rung) -> MadeFrom {
        let training = match &rung.work {
            Work::Train(_) | Work::Preset { .. } => {
                self.settings(rung).map(|config| json!(config)).unwrap_or_default()
            }
            _ => json!(self.config),
        };
        let mut made_from = self.inputs.clone();
        made_from.value("work", format!("{:?}", rung.work)).value("settings", training);
        made_from
    }

    /// Record of a rung that an earlier run kept; of the base, also the scene must be there.
    fn find(&self, rung: &Rung) -> Kept<Record> {
        if rung.id == BASE && !self.base_file().is_file() {
            return Kept::Missing;
        }
        self.rungs.find(&rung.id, &self.fingerprint(rung))
    }

    /// Steps that a rung trains; none where it uses the scene of the base.
    fn expected_steps(&self, rung: &Rung) -> u64 {
        let trains = matches!(rung.work, Work::Train(_) | Work::Preset { .. });
        let config = self.settings(rung).ok().filter(|_| trains);
        config.map_or(0, |config| {
            let stages = [config.stages.coarse, config.fine_iterations(), config.stages.instance];
            stages.into_iter().map(u64::from).sum()
        })
    }

    /// Settings that a rung trains with.
    fn settings(&self, rung: &Rung) -> Result<TrainConfig, Error> {
        let config = match &rung.work {
            Work::Preset { name, share, settings } => {
                let mut config = of_preset(name, *share, settings, self.dataset.layout)?;
                config.seed = self.config.seed;
                config.downscale = config.downscale.or(self.config.downscale);
                config
            }
            Work::Train(settings) => {
                let mut layers = Layers::new(self.config.clone());
                for setting in settings {
                    layers.assignment(setting)?;
                }
                layers.validated()?
            }
            _ => self.config.clone(),
        };
        config.validate().map_err(Error::plain)?;
        Ok(config)
    }

    fn measure(&mut self, rung: &Rung, heading: &str) -> Result<Option<Record>, Error> {
        if let Work::Train(settings) = &rung.work {
            return self.train(rung, settings.clone(), heading);
        }
        if let Work::Preset { name, share, settings } = &rung.work {
            let mut all = vec![format!("preset={name}")];
            if *share < 1.0 {
                all.push(format!("{share} of its steps"));
            }
            all.extend(settings.iter().cloned());
            return self.train(rung, all, heading);
        }
        if self.base.is_none() {
            let base =
                Rung { id: BASE.to_owned(), label: "the base".to_owned(), work: Work::Train(Vec::new()) };
            if self.record(&base, "first the base")?.is_none() {
                return Ok(None);
            }
            self.base = Some(Field::load(self.base_file()).map_err(Error::plain)?);
        }
        let Some(field) = &self.base else { return Ok(None) };
        let mut record = Record { gaussians: Some(field.len()), ..Record::default() };
        match rung.work {
            Work::Store { planes, splats, centres } => {
                let (stored, bytes) = measure::store(field, planes, splats, centres);
                let settings = trained_settings(field);
                measure::score(&stored, &settings, &self.dataset, &rung.id, &self.rungs, &draw, &mut record)?;
                record.bytes = Some(bytes);
            }
            Work::Render { reduction: 1, sh_degree: None, min_opacity }
                if min_opacity <= 0.0 && rung.id.starts_with("precision") =>
            {
                let exact = exact(&mut self.exact, field, &self.dataset);
                if let (Some(exact), Some((image, spent))) =
                    (exact, measure::fast(field, &self.dataset, FINAL))
                {
                    (record.cpu_s, record.wall_s) = (spent.cpu_s, spent.wall_s);
                    measure::against_exact(&image, exact, &self.dataset, &mut record)?;
                }
            }
            Work::Render { reduction, sh_degree, min_opacity } => {
                let quality = Quality { reduction, sh_degree, min_opacity };
                measure::render(field, &self.dataset, quality, &mut record)?;
            }
            Work::Reference { double } => {
                let rendered = measure::with_reference(field, &self.dataset, double);
                let exact = exact(&mut self.exact, field, &self.dataset);
                if let (Some(exact), Some((image, spent))) = (exact, rendered) {
                    (record.cpu_s, record.wall_s) = (spent.cpu_s, spent.wall_s);
                    measure::against_exact(&image, exact, &self.dataset, &mut record)?;
                }
            }
            Work::Export(tolerance) => measure::export(field, tolerance, &mut record)?,
            Work::Train(_) | Work::Preset { .. } => unreachable!("handled above"),
        }
        Ok(Some(record))
    }

    fn train(&mut self, rung: &Rung, settings: Vec<String>, heading: &str) -> Result<Option<Record>, Error> {
        let config = self.settings(rung)?;
        let dataset = if config.downscale == self.config.downscale {
            self.dataset.clone()
        } else {
            let options = CaptureOptions { downscale: config.downscale, ..self.capture.clone() };
            Dataset { points: self.dataset.points.clone(), ..options.open(&self.dataset.root)? }
        };
        let training = Training { id: &rung.id, dataset, config };
        let mut last = 0;
        let trained =
            measure::train(&self.rungs, training, &Stop::when(interrupt::requested), &mut |done, whole| {
                let percent = 100 * done / whole.max(1);
                if percent > last {
                    last = percent;
                    self.show(&format!("{heading}: {percent} %"), false);
                }
            })?;
        let Some((field, mut record)) = trained else { return Ok(None) };
        let scored = trained_settings(&field);
        measure::score(&field, &scored, &self.dataset, &rung.id, &self.rungs, &draw, &mut record)?;
        record.settings = settings;
        if rung.id == BASE {
            field.save(self.base_file()).map_err(Error::plain)?;
            (self.base, self.exact) = (Some(field), None);
        }
        Ok(Some(record))
    }

    /// Measures a rung alone, while other processes measure others.
    fn part(&mut self, all: &[Ladder], only: &str) -> Result<(), Error> {
        let base = Rung { id: BASE.to_owned(), label: "the base".to_owned(), work: Work::Train(Vec::new()) };
        let mut rungs = all.iter().flat_map(|ladder| &ladder.rungs).chain([&base]);
        let Some(rung) = rungs.find(|rung| rung.id == only) else {
            let mut names: Vec<&str> =
                all.iter().flat_map(|ladder| &ladder.rungs).map(|rung| rung.id.as_str()).collect();
            names.dedup();
            let help = format!("the rungs are {}", names.join(", "));
            return Err(Error::usage(format!("--only {only}: there is no such rung"), help));
        };
        match self.record(rung, only)? {
            Some(_) => Ok(()),
            None => Err(Error::Interrupted { message: format!("interrupted in {only}"), help: None }),
        }
    }

    fn subject(&self, command: &BenchAccuracy, missing: usize) -> Subject {
        let dataset = &self.dataset;
        let name = dataset.root.file_name().map_or_else(|| "capture".into(), |name| name.to_string_lossy());
        let count = |split| dataset.frames.iter().filter(|frame| frame.split == split).count();
        let size = dataset.frames.first().map_or([0; 2], |frame| [frame.camera.width, frame.camera.height]);
        let stages = &self.config.stages;
        let description = format!(
            "{} training frames and {} held-out ones of {} x {} pixels at {} times, {} instances. The base of all \
             ladders: {} steps without motion, {} with it, {} with instances, up to {} Gaussians.",
            count(Split::Train),
            count(Split::Val),
            size[0],
            size[1],
            dataset.times.len(),
            dataset.instances.len(),
            stages.coarse,
            self.config.fine_iterations(),
            stages.instance,
            self.config.densify.max_gaussians
        );
        let folder = |path: &Path| {
            path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
        };
        let mut line =
            format!("cif bench accuracy {} -o {}", folder(&command.capture), folder(&command.output));
        if command.quick {
            line += " --quick";
        }
        if !command.ladders.is_empty() {
            line += &format!(" --ladders {}", command.ladders.join(","));
        }
        if let Some(share) = command.paper_share {
            line += &format!(" --paper-share {share}");
        }
        for assignment in &command.paper_set {
            line += &format!(" --paper-set {assignment}");
        }
        if let Some(preset) = &command.preset {
            line += &format!(" --preset {preset}");
        }
        for assignment in &command.set {
            line += &format!(" --set {assignment}");
        }
        let simd = Trainer::vector_instructions();
        Subject {
            capture: name.into_owned(),
            description,
            command: line,
            threads: rayon::current_num_threads(),
            simd,
            missing,
            motion: None,
        }
    }

    /// Measures the rungs of all ladders, each once; in a quick report those that five minutes are enough for.
    fn measure_all(&mut self, all: &[Ladder], quick: bool) -> Result<Rungs, Error> {
        let mut seen = BTreeSet::new();
        let mut order: Vec<(&str, &Rung)> = all
            .iter()
            .flat_map(|ladder| ladder.rungs.iter().map(|rung| (ladder.name, rung)))
            .filter(|(_, rung)| seen.insert(&rung.id))
            .collect();
        if quick {
            // What costs least comes first, so that the time suffices for as many as can be.
            order.sort_by_key(|(_, rung)| (rung.id != BASE, self.expected_steps(rung)));
        }
        let mut limit = quick.then(|| TimeLimit::start(SystemClock::start(), QUICK_SECONDS));
        let mut records: BTreeMap<String, Record> = BTreeMap::new();
        let mut left_out = Vec::new();
        let mut stopped = false;
        for (number, (ladder, rung)) in order.iter().enumerate() {
            let steps = self.expected_steps(rung);
            if self.find(rung).good().is_none()
                && limit.as_ref().is_some_and(|limit| !limit.has_time_for(steps))
            {
                left_out.push(format!("{ladder}: {}", rung.label));
                continue;
            }
            let begin_s = limit.as_ref().map_or(0.0, TimeLimit::elapsed_s);
            let heading = format!("[{}/{}] {ladder}: {}", number + 1, order.len(), rung.label);
            let Some(record) = self.record(rung, &heading)? else {
                stopped = true;
                break;
            };
            if let Some(limit) = &mut limit {
                limit.learn(steps, begin_s);
            }
            records.insert(rung.id.clone(), record);
        }
        Ok(Rungs { records, left_out, stopped })
    }

    /// Motion of the objects of the base: scores where the capture knows it, and their paths in the shown frame.
    fn motion(&mut self) -> Result<Option<report::Motion>, Error> {
        let field = match self.base.take() {
            Some(field) => field,
            None => Field::load(self.base_file()).map_err(Error::plain)?,
        };
        let mut motion = report::Motion::default();
        if let Some(truth) = self.dataset.motion_truth().map_err(Error::plain)?
            && let Some(measured) = motion::measure(&field, &self.dataset, &truth)?
        {
            motion.scores = json!(measured);
            motion.headings = motion::HEADINGS.to_vec();
            motion.rows = measured.rows();
        }
        if let (Some(shown), Some((image, _))) =
            (measure::shown_frame(&self.dataset), measure::fast(&field, &self.dataset, FINAL))
        {
            let frame = &self.dataset.frames[shown];
            let lines = Trajectories::new(&field, SimdLevel::Auto).lines(&frame.camera, frame.time);
            if !lines.is_empty() {
                let mut picture = rgb_picture(&image.color);
                lines.iter().for_each(|line| line.draw(&mut picture, 0));
                let path = self.rungs.file("paths.png");
                measure::save(&path, &picture)?;
                motion.picture = Some(path);
            }
        }
        self.base = Some(field);
        Ok((!motion.rows.is_empty() || motion.picture.is_some()).then_some(motion))
    }
}

/// The shown frame in 64 bits, rendered once.
fn exact<'a>(
    known: &'a mut Option<RenderedImage>,
    field: &Field,
    dataset: &Dataset,
) -> Option<&'a RenderedImage> {
    if known.is_none() {
        *known = measure::with_reference(field, dataset, true).map(|(image, _)| image);
    }
    known.as_ref()
}

/// Pictures of a view for the report.
fn draw(view: &FrameView<'_>) -> Vec<(&'static str, Picture)> {
    let mut pictures = vec![("", rgb_picture(&view.rendered.color))];
    if let (Some(ids), Some(layers)) = (view.predicted, &view.rendered.instances) {
        pictures.push((".instances", instance_picture(ids, &layers.foreground)));
    }
    pictures
}

/// A record in a line.
fn summary(record: &Record) -> String {
    let mut parts = Vec::new();
    parts.push(if record.cpu_s >= 1.0 {
        format!("{:.1} s", record.cpu_s)
    } else {
        format!("{:.2} ms", 1e3 * record.cpu_s)
    });
    let mut add = |value: Option<f64>, text: &dyn Fn(f64) -> String| parts.extend(value.map(text));
    add(record.psnr, &|value| format!("{value:.2} dB"));
    add(record.iou, &|value| format!("IoU {value:.1} %"));
    add(record.miou, &|value| format!("mIoU {value:.1} %"));
    add(record.bytes.map(|bytes| bytes as f64 / 1e6), &|value| format!("{value:.2} MB"));
    if record.curve.is_none() {
        add(record.residual, &|value| format!("residual {value:.2e}"));
    }
    parts.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_of_rungs_exist_and_can_work() {
        let base = Base {
            quick: false,
            steps: [300, 7_000, 1_500],
            until: [4_000, 1_250],
            gaussians: 12_000,
            points: 20_000,
            nodes: 64,
            width: 64,
            sh_degree: 3,
            downscale: 1,
            is_dynamic: true,
            has_instances: true,
            instances_move_geometry: false,
            paper: None,
        };
        let mut trained = 0;
        for rung in ladders(&base).into_iter().flat_map(|ladder| ladder.rungs) {
            let Work::Train(settings) = rung.work else { continue };
            let mut layers = Layers::new(TrainConfig::default());
            for setting in settings.iter().filter(|setting| !setting.starts_with("downscale")) {
                layers.assignment(setting).unwrap();
            }
            layers.finish().validate().unwrap();
            trained += 1;
        }
        assert!(trained > 20);
        let mut layers = Layers::new(TrainConfig::default());
        QUICK_BASE.iter().for_each(|setting| layers.assignment(setting).unwrap());
        layers.finish().validate().unwrap();
    }
}
