//! `cif train`: from a capture to a scene.

mod budget;
mod report;
mod watch;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cif_dataset::{Dataset, Layout};
use cif_field::Checkpoint;
use cif_train::metrics::training_config;
use cif_train::plan::Basis;
use cif_train::{
    Control, EffectChoice, EffectPlan, Outcome, Phase, Phases, Preset, Start, Stop, TrainConfig, TrainError,
    TrainEvent, Trainer,
};
use clap::{Args, ValueEnum};

use super::shared::expected::{expected, in_words};
use super::shared::named::{HeadArgument, preset};
use super::shared::simd::Simd;
use crate::commands::shared::{CaptureOptions, command_line, print_warnings};
use crate::destination::{Destination, Existing};
use crate::error::Error;
use crate::output::Outputs;
use crate::progress::Progress;
use crate::settings::Layers;
use crate::{endings, interrupt, starting_points, training};
use budget::{Goals, Timing};
use watch::{Opening, Watch};

/// Most seconds of measuring steps, once three are done, and the steps of a run from which they are.
const MEASURING_S: f64 = 1.0;
const LONG: u32 = 1_000;

/// Train a scene on a capture
#[derive(Debug, Args)]
#[command(after_help = "\
Settings come from the preset, then from --effects, then the --config file, then the command line; the result is
written next to the scene as SCENE.train.toml, which --config accepts again.

  cif train captures/table -o table.cif --preset draft
  cif train captures/table -o table.cif --masks masks_tracker --iterations-fine 8000 --seed 3
  cif train captures/table -o table.cif --config mine.toml --set densify.max_gaussians=30000

Measured: draft on examples/tabletop-mini (60 frames of 128 x 96) takes 41 s on two cores and reaches
29.2 dB PSNR and 97 % mIoU on held-out frames (make demo);
standard on a capture of 256 x 192 took four minutes on one core and reached 32.6 dB and 99 %, best twelve
and 33.0 dB; paper is not measured. `cif bench accuracy` measures this on your capture and machine.

Other masks or variants on one reconstruction, without training it again (settings that are not given
are those of the scene it comes from):

  cif train captures/table -o table.cif --no-masks
  cif train captures/table -o exact.cif --from table.cif
  cif train captures/table -o fixed.cif --from table.cif --ablate no-resampling

The head of a system that the method is compared with, on the same reconstruction (`cif bench compare`
runs all of them; each is described in crates/cif-train/src/heads):

  cif train captures/table -o codes.cif --from table.cif --head gaussian-grouping

The best result in a minute and a half, or training until a target is reached:

  cif train captures/table -o table.cif --budget 90s
  cif train captures/table -o table.cif --target-psnr 28 --target-miou 85 --budget 10m

With --resume, a budget is for the rest. SCENE.train.toml then holds the resulting settings. A budget counts
everything from the start of the command on; fits of objects that do not fit into it are left out, with a note.

Ctrl-C and SIGTERM save and stop, inside fits of objects too, which keep the objects that are done; the same command
with --resume continues with the same result. It also does so
after a power cut, from the last saved state: one is saved every five minutes and at the end of each stage
(--checkpoint-seconds). During a run its scene is locked: a second run that writes the same file is refused.")]
pub(super) struct Train {
    /// Folder of the capture
    capture: PathBuf,
    /// Scene to write
    #[arg(short, long, value_name = "SCENE.cif", value_parser = endings::scene())]
    output: PathBuf,
    /// Replace an existing scene
    #[arg(long)]
    force: bool,
    /// Continue the interrupted run of SCENE.cif, with its settings
    #[arg(long, conflicts_with_all = ["force", "preset", "config", "set"], conflicts_with = "settings",
        group = "goes_on")]
    resume: bool,
    /// As --resume where SCENE.cif holds an interrupted run, begun with the same command; for jobs of `cif batch`
    #[arg(long, hide = true, conflicts_with_all = ["resume", "from"])]
    resume_if_begun: bool,
    /// Continue although images, masks, cameras, points or labels of the capture have changed since the run began; with
    /// --from, although its images have
    #[arg(long, requires = "goes_on")]
    accept_changes: bool,
    /// Begin with the Gaussians and the motion of a trained scene of this capture: only identities and
    /// instances are trained
    #[arg(long, value_name = "SCENE.cif", conflicts_with_all = ["resume", "no_masks", "iterations_coarse",
        "iterations_fine"], group = "goes_on")]
    from: Option<PathBuf>,
    /// Stop after N steps of this command (at the next report, see report.step_every), saving so that
    /// --resume goes on
    #[arg(long, value_name = "N")]
    stop_after: Option<u64>,
    /// Log of the run: every event as a line of JSON, as it happens; --json is the report at the end
    #[arg(long, value_name = "FILE.jsonl", value_parser = endings::log())]
    log: Option<PathBuf>,
    /// Show the scene in a browser while it is trained, with the curve of its quality and a button that stops and saves;
    /// --view=address prints the address only. At most 3% of the time go there, and none while nobody looks
    #[arg(long, value_name = "HOW", num_args = 0..=1, require_equals = true, default_missing_value = "open")]
    view: Option<Opening>,
    #[command(flatten)]
    report: crate::report::Report,
    /// Look at every array of every step, and name the part, the tensor and the index of the first value that
    /// is not finite. Slower; the scene is the same. Without it such steps are rolled back and counted, too
    #[arg(long)]
    debug_validation: bool,
    #[arg(from_global)]
    quiet: bool,
    /// Named settings: draft, standard, best or paper [default: standard]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Settings file; it may hold only the settings that differ
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Effects: auto (as the capture calls for, see `cif plan`), all (as the preset says) or none, then single
    /// ones on or off, as in auto,+motion,-instances; settings on the command line or in
    /// a file override them [default: auto, and all with the preset paper]
    #[arg(long, value_name = "LIST", allow_hyphen_values = true, conflicts_with_all = ["resume", "from"])]
    effects: Option<EffectChoice>,
    /// Motion of an object that need not be found, as in --motion-of 'red mug=rigid': rigid (a pose per time) or
    /// free (by the deformation network); may be repeated
    #[arg(long, value_name = "LABEL=MOTION", conflicts_with_all = ["resume", "from"])]
    motion_of: Vec<String>,
    /// Any setting by its key in SCENE.train.toml, e.g. --set rates.opacity=0.02
    #[arg(long, value_name = "TABLE.KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    capture_options: CaptureOptions,
    /// Vector instructions: `auto` takes the widest that the processor has; results differ by
    /// rounding
    #[arg(long, value_name = "LEVEL", default_value = "auto", value_parser = Simd::parser())]
    simd: Simd,
    /// Backend that runs the steps; results of the processor and of a GPU differ by rounding, and --resume goes on
    /// with either
    #[cfg(feature = "wgpu")]
    #[arg(long, value_name = "BACKEND", default_value = "cpu")]
    backend: super::backend::Backend,
    #[command(flatten)]
    goals: Goals,
    #[command(flatten)]
    settings: Settings,
}

/// Settings with a flag of their own.
#[derive(Debug, Args)]
#[group(id = "settings", multiple = true)]
#[command(next_help_heading = "Settings")]
struct Settings {
    /// Seed of every random choice; same seed, same scene
    #[arg(long, value_name = "N")]
    seed: Option<u32>,
    /// Steps without motion
    #[arg(long, value_name = "N")]
    iterations_coarse: Option<u32>,
    /// Steps with motion
    #[arg(long, value_name = "N")]
    iterations_fine: Option<u32>,
    /// Steps with instances
    #[arg(long, value_name = "N")]
    iterations_instance: Option<u32>,
    /// Views per step
    #[arg(long, value_name = "N")]
    batch: Option<u32>,
    /// Most Gaussians
    #[arg(long, value_name = "N")]
    max_gaussians: Option<u32>,
    /// Highest spherical-harmonics degree, 0 to 3
    #[arg(long, value_name = "DEGREE")]
    sh_degree: Option<u8>,
    /// Weight of the instance loss
    #[arg(long, value_name = "WEIGHT")]
    lambda_instance: Option<f64>,
    /// Share of structural dissimilarity in the colour loss, 0 to 1
    #[arg(long, value_name = "SHARE")]
    lambda_dssim: Option<f64>,
    /// Fraction of Gaussians relocated per resampling event
    #[arg(long, value_name = "FRACTION")]
    resampling_rate: Option<f64>,
    /// Head that the instance stage trains: the paper's, or that of a system it is compared with; 4d-langsplat learns
    /// the feature maps of --set head.maps=DIR, and has no labels of instances
    #[arg(long, value_name = "NAME")]
    head: Option<HeadArgument>,
    /// Switch a part of the method off; may be repeated
    #[arg(long, value_name = "PART")]
    ablate: Vec<AblationName>,
    /// Compensate opacity for the low-pass filter
    #[arg(long)]
    antialiased: bool,
    /// Steps between evaluations on held-out frames; 0 for never
    #[arg(long, value_name = "N")]
    evaluate_every: Option<u32>,
    /// Steps between saved states during training; 0 for never [default: 0]
    #[arg(long, value_name = "N")]
    checkpoint_every: Option<u32>,
    /// Seconds between saved states during training; one is saved at the end of each stage as well; 0 for
    /// neither [default: 300]
    #[arg(long, value_name = "SECONDS")]
    checkpoint_seconds: Option<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
enum AblationName {
    ConstantOccupancy,
    OpacityOccupancy,
    NoCalibration,
    NoResampling,
}

pub(super) fn run(command: &Train) -> Result<(), Error> {
    let mut timing = Timing::start();
    interrupt::set_last_words("interrupted; nothing was saved");
    // Everything that can be refused is refused before the first image is read.
    check_outputs(command)?;
    let resumes =
        command.resume || (command.resume_if_begun && crate::destination::is_unfinished(&command.output));
    let existing = if command.force || resumes { Existing::Replace } else { Existing::Keep };
    let mut destination = Destination::open(&command.output, existing)?;
    let mut state = resumes.then(|| load_state(&command.output)).transpose()?;
    if command.accept_changes {
        state.iter_mut().for_each(cif_train::accept_changes);
    }
    if resumes {
        interrupt::set_last_words("interrupted; the saved state is as it was");
    }
    let progress = Arc::new(Mutex::new(Progress::new(command.quiet)));
    let watch = command.view.map(|opening| Watch::start(&command.output, opening)).transpose()?;
    let phases = phases(&timing, &progress, watch.as_ref());
    let _run = phases.enter(Phase::Other, 0);
    let mut source = command.from.as_deref().map(load_source).transpose()?;
    if command.accept_changes {
        source.iter_mut().for_each(cif_train::accept_changes);
    }
    let origin = match (state, source) {
        (Some(state), _) => Origin::State(state),
        (None, Some(scene)) => Origin::Scene(scene),
        (None, None) => Origin::Capture,
    };
    let base = origin.settings();
    let layout = command.capture_options.layout_after(&command.capture, |layout| match origin {
        Origin::State(_) => Ok(()),
        _ => resolve(command, base.as_ref(), layout, None).map(drop),
    })?;

    #[cfg(feature = "wgpu")]
    let gpu = command.backend.open()?;

    let (dataset, has_points) = open_capture(command, &origin, layout, &phases)?;
    let mut trainer = match origin {
        Origin::State(state) => Trainer::resume(Start { dataset, phases: phases.clone() }, state)
            .map_err(|error| error.of_scene(&command.output))
            .map_err(|error| not_started(command, error))
            .inspect(|trainer| destination.resumes(trainer.config())),
        origin => {
            let start = Start { dataset, phases: phases.clone() };
            begin(command, origin, start, has_points, &mut timing, &mut destination)
        }
    }?;
    trainer.set_simd(command.simd.into());
    trainer.set_debug_validation(command.debug_validation);
    command.goals.apply(&timing, &mut trainer)?;
    #[cfg(feature = "wgpu")]
    {
        let _phase = gpu.as_ref().map(|_| phases.enter(Phase::Probe, 0));
        command.backend.apply(gpu.as_ref(), &mut trainer)?;
    }

    shown(&progress).log_to(command.log.as_deref(), resumes)?;
    train(command, &timing, trainer, &mut destination, &progress, watch.as_deref())
}

/// State that a run starts from.
enum Origin {
    /// An unfinished run, which goes on.
    State(Checkpoint),
    /// Another scene: its Gaussians, and its settings where no others are given.
    Scene(Checkpoint),
    /// The points of the capture.
    Capture,
}

impl Origin {
    /// Settings of the scene.
    fn settings(&self) -> Option<TrainConfig> {
        match self {
            Self::Scene(scene) => training_config(&scene.field),
            Self::State(_) | Self::Capture => None,
        }
    }
}

/// Phases of a command, which end when the user asks for it, and are shown as they go.
fn phases(timing: &Timing, progress: &Arc<Mutex<Progress>>, watch: Option<&Arc<Watch>>) -> Phases {
    let stop = Stop::when({
        let watch = watch.cloned();
        move || interrupt::requested() || watch.as_ref().is_some_and(|watch| watch.is_stopped())
    });
    let (progress, watch) = (Arc::clone(progress), watch.cloned());
    timing.phases(stop).reported_to(move |event| {
        shown(&progress).event(event);
        if let Some(watch) = &watch {
            watch.phase(event);
        }
        Control::Continue
    })
}

/// Opens the capture as its scene was trained, and triangulates points where they are needed; the second is false where
/// none were found.
fn open_capture(
    command: &Train,
    origin: &Origin,
    layout: Layout,
    phases: &Phases,
) -> Result<(Dataset, bool), Error> {
    let mut capture = match origin {
        Origin::State(begun) | Origin::Scene(begun) => command.capture_options.as_trained(&begun.field),
        Origin::Capture => command.capture_options.clone(),
    };
    if !matches!(origin, Origin::State(_)) {
        let configured = resolve(command, origin.settings().as_ref(), layout, None)?.downscale;
        capture.downscale = command.capture_options.downscale.or(configured);
    }
    let phase = phases.enter(Phase::Open, 0);
    let mut dataset = capture.open(&command.capture)?;
    drop(phase);
    // A scene that is begun with has its Gaussians; a run that goes on has the points that it began with.
    let is_needed = match origin {
        Origin::State(state) => training_config(&state.field),
        Origin::Scene(_) => None,
        Origin::Capture => Some(resolve(command, None, layout, None)?),
    }
    .is_some_and(|config| config.model.triangulate);
    let has_points = !is_needed || starting_points::find(&mut dataset, phases)?;
    print_warnings(&dataset);
    Ok((dataset, has_points))
}

/// True where it is said before the first step how long a run takes: not of a few steps, nor of one that a budget ends, and
/// steps of a GPU take another time than those that are measured here.
fn expects_time(command: &Train, config: &TrainConfig) -> bool {
    #[cfg(feature = "wgpu")]
    let is_measured = command.backend == super::backend::Backend::Cpu;
    #[cfg(not(feature = "wgpu"))]
    let is_measured = true;
    let stages = &config.stages;
    let steps = config.fine_iterations() + stages.coarse + stages.instance;
    is_measured && !command.quiet && !command.goals.changes_steps() && steps >= LONG
}

/// A trainer at its first step; `has_points` is false where points were needed and could not be triangulated.
fn begin(
    command: &Train,
    origin: Origin,
    start: Start,
    has_points: bool,
    timing: &mut Timing,
    destination: &mut Destination,
) -> Result<Trainer, Error> {
    let Start { mut dataset, phases } = start;
    let is_afresh = matches!(origin, Origin::Capture);
    let plan = is_afresh.then(|| plan(command, &dataset, &phases)).transpose()?;
    let mut config = resolve(command, origin.settings().as_ref(), dataset.layout, plan.as_ref())?;
    command.goals.prepare(&mut config);
    config.model.triangulate &= has_points;
    if is_afresh {
        let preset = TrainConfig::preset(config.preset, dataset.layout);
        let (goals, options) = (&command.goals, &command.capture_options);
        dataset = goals.fit(timing, &mut config, &preset, dataset, options, &phases, command.quiet)?;
    }
    if let Some(plan) = plan.as_ref().filter(|_| expects_time(command, &config)) {
        let phase = phases.enter(Phase::Calibrate, 0);
        let objects = plan.travelling.len();
        let expected = expected(&dataset, &config, objects, &timing.clock, MEASURING_S);
        drop(phase);
        eprintln!("{}", in_words(&expected.map_err(|error| not_started(command, error))?, &config, objects));
    }
    destination.check_settings(&config)?;
    let start = Start { dataset, phases };
    let trainer = match (origin, &command.from) {
        (Origin::Scene(scene), Some(path)) => {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            Trainer::from_scene(start, config, scene, &name).map_err(|error| error.of_scene(path))
        }
        _ => Trainer::new(start, config),
    };
    let mut trainer = trainer.map_err(|error| not_started(command, error))?;
    if let Some(plan) = &plan {
        trainer.record_effects(serde_json::json!(plan));
    }
    Ok(trainer)
}

/// Runs a trainer to its end, or until it is stopped, and reports the result.
fn train(
    command: &Train,
    timing: &Timing,
    mut trainer: Trainer,
    destination: &mut Destination,
    progress: &Mutex<Progress>,
    watch: Option<&Watch>,
) -> Result<(), Error> {
    interrupt::watch_and_save();
    let mut steps_done = StepCount::default();
    let outcome = training::run(&mut trainer, Some(destination), &mut |event, view| {
        shown(progress).event(event);
        if let Some((watch, view)) = watch.zip(view) {
            watch.event(event, view);
        }
        let stops = watch.is_some_and(Watch::is_stopped);
        let enough = command.stop_after.is_some_and(|limit| steps_done.after(event) >= limit);
        if enough || stops { Control::Stop } else { Control::Continue }
    });
    let logged = shown(progress).finish(trainer.steps_done(), &trainer.wall_s_by_phase());
    if let Some(watch) = watch {
        watch.end(outcome.is_ok(), &trainer);
    }
    let outcome = outcome?;
    if command.goals.changes_steps() && !command.quiet {
        command.goals.report(timing, &trainer);
    }
    announce(command, &trainer, outcome)?;
    report::give(&command.report, &command.output, outcome)?;
    logged
}

/// Reason why a run does not start.
fn not_started(command: &Train, error: TrainError) -> Error {
    match error {
        TrainError::Stopped => {
            Error::Interrupted { message: "interrupted; nothing was saved".to_owned(), help: None }
        }
        error @ TrainError::ChangedCapture { .. } => {
            let again = if command.from.is_some() { "without --from" } else { "again with --force" };
            Error::failed(
                format!("{}: {error}", command.from.as_ref().unwrap_or(&command.output).display()),
                format!("restore it, train {again}, or continue with the changes: --accept-changes"),
            )
        }
        error => Error::plain(error),
    }
}

/// Says what became of a run; an error where it was interrupted.
fn announce(command: &Train, trainer: &Trainer, outcome: Outcome) -> Result<(), Error> {
    let saved = command.output.display();
    match outcome {
        Outcome::Finished => crate::messages::outcome!("saved {saved}"),
        Outcome::Interrupted => {
            let help = format!("continue with: {}", resume_command(command));
            if !trainer.has_begun() {
                let message = "interrupted before the first step; nothing was saved".to_owned();
                return Err(Error::Interrupted { message, help: None });
            }
            if interrupt::requested() {
                return Err(Error::Interrupted {
                    message: format!("interrupted; saved {saved}"),
                    help: Some(help),
                });
            }
            crate::messages::outcome!("stopped; saved {saved}; {help}");
        }
    }
    Ok(())
}

/// The progress of the run, for one event.
fn shown(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Checks that no file is written twice or both read and written, but for the settings, which may be those of an
/// earlier run. [`Destination`] looks at what is there.
fn check_outputs(command: &Train) -> Result<(), Error> {
    let settings_path = &command.output.with_extension("train.toml");
    let mut outputs = Outputs::new(command.force || command.resume);
    let config = command.config.as_deref().filter(|config| *config != settings_path);
    [config, command.from.as_deref()].into_iter().flatten().try_for_each(|input| outputs.reads(input))?;
    outputs.add(&command.output)?;
    outputs.add(settings_path)?;
    command.log.as_deref().map_or(Ok(()), |log| outputs.text(log))?;
    command.report.check(&mut outputs)
}

/// Optimiser steps done by this command, over all stages.
#[derive(Default)]
struct StepCount {
    earlier_stages: u64,
    /// Steps that the present stage had when this command entered it, and has now.
    stage: (u64, u64),
}

impl StepCount {
    fn after(&mut self, event: &TrainEvent) -> u64 {
        match event {
            TrainEvent::StageStarted { iteration, .. } => {
                self.earlier_stages += self.stage.1 - self.stage.0;
                self.stage = (u64::from(*iteration), u64::from(*iteration));
            }
            TrainEvent::Step { iteration, .. } => self.stage.1 = u64::from(*iteration),
            _ => {}
        }
        self.earlier_stages + self.stage.1 - self.stage.0
    }
}

/// The command line that goes on with this run, to be pasted into a shell.
fn resume_command(command: &Train) -> String {
    let capture = &command.capture_options;
    let path = |path: &Path| path.display().to_string();
    let mut words = vec!["train".to_owned(), path(&command.capture), "-o".to_owned(), path(&command.output)];
    let mut option = |name: &str, value: String| words.extend([name.to_owned(), value]);
    if let Some(masks) = &capture.masks {
        option("--masks", path(masks));
    }
    if let Some(layout) = capture.layout.and_then(|layout| layout.to_possible_value()) {
        option("--layout", layout.get_name().to_owned());
    }
    if command.simd != Simd::Auto {
        option("--simd", command.simd.name().to_owned());
    }
    for camera in &capture.frames.without_camera {
        option("--without-camera", camera.clone());
    }
    if let Some(frames) = capture.frames.video_frames {
        option("--video-frames", frames.to_string());
    }
    if let Some(window) = capture.frames.window {
        option("--window", window.to_string());
    }
    #[cfg(feature = "wgpu")]
    if command.backend != super::backend::Backend::Cpu {
        option("--backend", command.backend.name().to_owned());
    }
    let switches = [
        (capture.no_masks, "--no-masks"),
        (capture.center_principal_point, "--center-principal-point"),
        (true, "--resume"),
    ];
    words.extend(switches.into_iter().filter(|(on, _)| *on).map(|(_, name)| name.to_owned()));
    command_line(&words)
}

fn load_state(path: &Path) -> Result<Checkpoint, Error> {
    if !path.exists() {
        return Err(Error::failed(
            format!("{} does not exist, so there is nothing to resume", path.display()),
            "leave --resume away to start a new run",
        ));
    }
    let checkpoint = Checkpoint::load(path).map_err(Error::plain)?;
    if checkpoint.training.is_none() {
        return Err(Error::failed(
            format!("{} is finished: it holds no training state to resume", path.display()),
            "train again with --force, or to another file",
        ));
    }
    Ok(checkpoint)
}

/// A scene to begin with, with its training state where it has one.
fn load_source(path: &Path) -> Result<Checkpoint, Error> {
    if path.is_dir() || !path.exists() {
        return Err(Error::failed(
            format!("--from {}: no such scene", path.display()),
            "give a trained scene (.cif); without --from the reconstruction is trained too",
        ));
    }
    Checkpoint::load(path).map_err(Error::plain)
}

/// Effects that the capture calls for; the paper's settings stay as they are unless the user says otherwise.
fn plan(command: &Train, dataset: &Dataset, phases: &Phases) -> Result<EffectPlan, Error> {
    let config = resolve(command, None, dataset.layout, None)?;
    let basis = if config.preset == Preset::Paper { Basis::All } else { Basis::Auto };
    let choice = command.effects.clone().unwrap_or(EffectChoice { basis, ..EffectChoice::default() });
    EffectPlan::watched(dataset, &config, &choice, phases).map_err(Error::plain)
}

/// Preset or the settings of the scene to begin with, what the capture calls for, file, flags.
fn resolve(
    command: &Train,
    source: Option<&TrainConfig>,
    layout: Layout,
    plan: Option<&EffectPlan>,
) -> Result<TrainConfig, Error> {
    let typed = command.preset.as_deref().map(|name| preset(name, "--preset")).transpose()?;
    let from_file = command.config.as_deref().map(preset_in_file).transpose()?.flatten();
    let mut base = match (typed.or(from_file), source) {
        (None, Some(source)) => {
            let place = command.from.as_deref().unwrap_or(Path::new("the scene"));
            source.validate().map_err(|error| Error::plain(format!("{}: {error}", place.display())))?;
            source.clone()
        }
        (named, _) => TrainConfig::preset(named.unwrap_or_default(), layout),
    };
    if let Some(plan) = plan {
        plan.apply(&mut base);
    }
    let mut layers = Layers::new(base);
    if let Some(path) = &command.config {
        layers.file(path)?;
    }
    if let Some(name) = &command.preset {
        layers.typed("--preset", "preset", name.as_str())?;
    }
    let settings = &command.settings;
    let integers = [
        ("--seed", "seed", settings.seed),
        ("--iterations-coarse", "stages.coarse", settings.iterations_coarse),
        ("--iterations-fine", "stages.fine", settings.iterations_fine),
        ("--iterations-instance", "stages.instance", settings.iterations_instance),
        ("--batch", "stages.batch", settings.batch),
        ("--max-gaussians", "densify.max_gaussians", settings.max_gaussians),
        ("--sh-degree", "model.sh_degree", settings.sh_degree.map(u32::from)),
        ("--evaluate-every", "report.evaluate_every", settings.evaluate_every),
        ("--checkpoint-every", "report.checkpoint_every", settings.checkpoint_every),
        ("--checkpoint-seconds", "report.checkpoint_seconds", settings.checkpoint_seconds),
        ("--downscale", "downscale", command.capture_options.downscale),
    ];
    for (flag, key, value) in integers {
        if let Some(value) = value {
            layers.typed(flag, key, i64::from(value))?;
        }
    }
    let numbers = [
        ("--lambda-instance", "loss.lambda_instance", settings.lambda_instance),
        ("--lambda-dssim", "loss.lambda_dssim", settings.lambda_dssim),
        ("--resampling-rate", "resample.rate", settings.resampling_rate),
    ];
    for (flag, key, value) in numbers {
        if let Some(value) = value {
            layers.typed(flag, key, value)?;
        }
    }
    if let Some(head) = settings.head {
        layers.typed("--head", "head.name", head.head().name())?;
    }
    if settings.antialiased {
        layers.typed("--antialiased", "antialiased", true)?;
    }
    if !settings.ablate.is_empty() {
        let names: Vec<toml::Value> = settings
            .ablate
            .iter()
            .filter_map(|ablation| ablation.to_possible_value())
            .map(|value| toml::Value::String(value.get_name().to_owned()))
            .collect();
        layers.typed("--ablate", "instance.ablate", names)?;
    }
    if !command.motion_of.is_empty() {
        let mut motions = toml::Table::new();
        for assignment in &command.motion_of {
            let Some((label, motion)) = assignment.rsplit_once('=') else {
                return Err(Error::usage(
                    format!("--motion-of {assignment}: expected LABEL=MOTION"),
                    "for example --motion-of 'red mug=rigid'; motions: rigid, free",
                ));
            };
            motions.insert(label.trim().to_owned(), motion.trim().into());
        }
        layers.typed("--motion-of", "motion.of", motions)?;
    }
    for assignment in &command.set {
        layers.assignment(assignment)?;
    }
    layers.validated()
}

/// The preset that a settings file starts from; other problems of the file are found when it is applied.
fn preset_in_file(path: &Path) -> Result<Option<Preset>, Error> {
    let text = cif_input::read_to_string(path).map_err(Error::io("read the settings", path))?;
    let Ok(table) = text.parse::<toml::Table>() else { return Ok(None) };
    let place = format!("{}: key `preset`", path.display());
    table.get("preset").and_then(toml::Value::as_str).map(|name| preset(name, &place)).transpose()
}
