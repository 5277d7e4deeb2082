//! `cif make`: from videos or photographs to a stage, one command after the other.

mod record;

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use cif_dataset::{Dataset, MadeFrom, OpenOptions, TimeWindow};
use cif_field::Checkpoint;
use clap::Args;
use serde::Serialize;

use self::record::{Record, State};
use crate::commands::shared::command_line;
use crate::commands::shared::step::{RunLine, step};
use crate::error::Error;
use crate::report::{JsonReport, OnlyReport};

/// The file that objects leave in: USD, where this build writes it.
const STAGE: (&str, &str) =
    if cfg!(feature = "usd") { ("--usd", "scene.usda") } else { ("--gltf", "scene.glb") };

/// Frames that are proposed to be painted.
const PROPOSED: usize = 4;

/// Go from videos or photographs to a USD stage: all steps with their defaults
#[derive(Debug, Args)]
#[command(after_help = "\
Every step is a cif command, which is printed before it runs and writes into the output folder:

  capture/     cif capture           frames, cameras, times
  keyframes/   you                   painted masks of a few frames: it stops here and lists them
  masks/       cif masks propagate   masks of all frames
  scene.cif    cif train             the trained scene
  scene.usda   cif export            one moving prim per object (scene.glb in builds without USD)

Run the same command again to continue, also after Ctrl-C. A step is repeated only if one of its inputs has changed (a
file, a setting or the version of cif); the steps after it are then repeated too, and the reason is printed. made.json
lists the inputs of each step. A step that needs other options can be run by hand into the same place: files that cif
make did not write, or that were changed since, are never replaced.

  cif make phone.mp4 -o table
  cif make left.mp4 right.mp4 -o rig --preset draft
  cif make captures/table -o table                    a capture that has masks: train and export
  cif make captures/table -o table --masks tracked    masks of a tracker (cif masks import)
  cif make captures/walk -o walk --windows 4          a long capture, window by window of time, as one stage")]
pub(super) struct Make {
    /// Videos and folders of photographs, as `cif capture` takes them, or the folder of one capture
    #[arg(required = true, value_name = "INPUT")]
    inputs: Vec<OsString>,
    /// Folder for everything that is made
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    output: PathBuf,
    /// Painted masks of a few frames, PNG files of ids named as the frames [default: DIR/keyframes]
    #[arg(long, value_name = "DIR", conflicts_with = "masks")]
    keyframes: Option<PathBuf>,
    /// Continue with the painted frames, even if they are fewer than requested
    #[arg(long, conflicts_with = "masks")]
    as_painted: bool,
    /// Masks of all frames, or a file for each frame of the video, so that none has to be painted
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Named settings of the training: draft, standard, best or paper [default: standard]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Settings file of the training
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Divide a long capture by time, train each window by itself (scene.window001.cif and so on), and export them as one
    /// stage, in which every object keeps one path
    #[cfg(feature = "usd")]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=999))]
    windows: Option<u32>,
    #[command(flatten)]
    report: OnlyReport,
    #[arg(from_global)]
    quiet: bool,
}

/// Files that were made, or were there already.
#[derive(Serialize)]
struct MakeReport<'a> {
    /// Folder of the capture.
    capture: &'a Path,
    /// Folder of the masks; null where the capture has its own.
    masks: Option<&'a Path>,
    /// The trained scene, or that of the first window of time.
    scene: &'a Path,
    /// The exported stage, or glTF file in builds without USD.
    stage: &'a Path,
}

impl JsonReport for MakeReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif make"];
}

pub(super) fn run(command: &Make, run_line: RunLine) -> Result<(), Error> {
    command.report.check([])?;
    if command.report.to_stdout() {
        return Err(Error::usage(
            "the steps of cif make print to stdout, where the report cannot be all that is printed",
            "name the file that it is to be written to: --json make.json",
        ));
    }
    // Hours before it is needed.
    #[cfg(feature = "usd")]
    cif_usd::usd_version().map_err(Error::plain)?;
    crate::output::check_new_folder(&command.output.join("capture"))?;
    let mut record = Record::read(&command.output)?;
    let capture = command.capture(&mut record, run_line)?;
    let masks = command.masks(&capture, &mut record, run_line)?;
    let mut scenes = Vec::new();
    for window in command.windows() {
        scenes.push(command.train(&capture, masks.as_deref(), window, &mut record, run_line)?);
    }
    let (flag, name) = STAGE;
    let stage = command.output.join(name);
    let mut made_from = version();
    let named = |scene: &PathBuf| match scenes.len() {
        1 => "the scene".to_owned(),
        _ => format!("the scene {}", scene.file_name().unwrap_or_default().to_string_lossy()),
    };
    made_from.files(scenes.iter().map(|scene| (named(scene), scene.clone())), record.known("stage"));
    let results: Vec<&Path> = scenes.iter().map(PathBuf::as_path).collect();
    let state = record.state("stage", &stage, &made_from, &results)?;
    if !is_made(&state, &stage) {
        record.begin("stage", &stage, made_from)?;
        let mut words: Vec<OsString> = vec!["export".into()];
        words.extend(scenes.iter().map(OsString::from));
        words.extend([flag.into(), stage.clone().into()]);
        if scenes.len() == 1 {
            words.extend(["--check".into(), "--capture".into(), capture.clone().into()]);
            if let Some(masks) = &masks {
                words.extend(["--masks".into(), masks.clone().into()]);
            }
        }
        words.extend(matches!(state, State::Stale(_)).then(|| "--force".into()));
        step(run_line, words, None)?;
        record.end("stage", &stage)?;
    }
    let report = MakeReport { capture: &capture, masks: masks.as_deref(), scene: &scenes[0], stage: &stage };
    command.report.give(
        || report,
        || {
            println!("made: {}", stage.display());
            println!("next: {}", command_line(&["query", &stage.display().to_string(), "--label", "*"]));
        },
    )
}

impl Make {
    /// The capture, made of the inputs unless they are one.
    fn capture(&self, record: &mut Record, run_line: RunLine) -> Result<PathBuf, Error> {
        if let [input] = self.inputs.as_slice()
            && OpenOptions::default().layout_of(Path::new(input)).is_ok()
        {
            return Ok(PathBuf::from(input));
        }
        let place = self.output.join("capture");
        put_back(&place)?;
        let mut made_from = version();
        for (number, input) in self.inputs.iter().enumerate() {
            // As `cif capture` takes them, a camera may have a name.
            let text = input.to_string_lossy();
            let (camera, file) = match text.split_once('=').filter(|_| !Path::new(input).exists()) {
                Some((camera, file)) => (format!("{camera}="), PathBuf::from(file)),
                None => (String::new(), PathBuf::from(input)),
            };
            let name = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy();
            let name = format!("input {} ({camera}{name})", number + 1);
            let known = record.known("capture");
            if file.is_dir() {
                made_from.folder(&name, &file, known);
            } else {
                made_from.files([(name, file)], known);
            }
        }
        let state = match place.join("transforms.json").exists() {
            true => record.state("capture", &place, &made_from, &[])?,
            false => State::Missing,
        };
        if !is_made(&state, &place) {
            std::fs::create_dir_all(&self.output).map_err(Error::io("create", &self.output))?;
            record.begin("capture", &place, made_from)?;
            let mut words = vec!["capture".into()];
            words.extend(self.inputs.iter().cloned());
            words.extend(["-o".into(), place.clone().into()]);
            instead(&state, &place, || step(run_line, self.quietly(words), STEP))?;
            record.end("capture", &place)?;
        }
        Ok(place)
    }

    /// The folder of masks; `None` where the capture has its own.
    fn masks(
        &self,
        capture: &Path,
        record: &mut Record,
        run_line: RunLine,
    ) -> Result<Option<PathBuf>, Error> {
        if let Some(masks) = &self.masks {
            return std::path::absolute(masks).map(Some).map_err(Error::io("find", masks));
        }
        let dataset = Dataset::open(capture, &OpenOptions::default()).map_err(Error::plain)?;
        if dataset.frames.iter().any(|frame| frame.mask.is_some()) {
            return Ok(None);
        }
        let keyframes = self.keyframes.clone().unwrap_or_else(|| self.output.join("keyframes"));
        let masks: Vec<PathBuf> =
            dataset.frames.iter().map(|frame| keyframes.join(format!("{}.png", frame.name))).collect();
        let painted: Vec<&Path> = masks.iter().map(PathBuf::as_path).filter(|file| file.is_file()).collect();
        let place = self.output.join("masks");
        put_back(&place)?;
        let mut made_from = version();
        let known = record.known("masks");
        made_from.capture(&dataset, known).folder("the keyframe file", &keyframes, known);
        let state = record.state("masks", &place, &made_from, &painted)?;
        if !is_made(&state, &place) {
            let asked = proposed(&dataset);
            let missing: Vec<usize> =
                asked.iter().copied().filter(|frame| !masks[*frame].is_file()).collect();
            // Other frames than those asked for will do, if they are as many.
            let is_enough =
                painted.len() >= asked.len() || self.as_painted || matches!(state, State::Stale(_));
            if painted.is_empty() || !is_enough {
                return Err(to_paint(&dataset, &missing, painted.len(), &keyframes, capture));
            }
            std::fs::create_dir_all(&self.output).map_err(Error::io("create", &self.output))?;
            record.begin("masks", &place, made_from)?;
            let words = ["masks", "propagate"].map(OsString::from).into_iter().chain([
                capture.into(),
                "--keyframes".into(),
                keyframes.clone().into(),
                "-o".into(),
                place.clone().into(),
            ]);
            instead(&state, &place, || step(run_line, self.quietly(words.collect()), STEP))?;
            record.end("masks", &place)?;
        }
        std::path::absolute(&place).map(Some).map_err(Error::io("find", &place))
    }

    /// Windows of time, each of which is trained; `None` for all of the capture.
    fn windows(&self) -> Vec<Option<TimeWindow>> {
        #[cfg(feature = "usd")]
        if let Some(count) = self.windows {
            return TimeWindow::all(count).map(Some).collect();
        }
        vec![None]
    }

    /// The trained scene; a run that was interrupted goes on.
    fn train(
        &self,
        capture: &Path,
        masks: Option<&Path>,
        window: Option<TimeWindow>,
        record: &mut Record,
        run_line: RunLine,
    ) -> Result<PathBuf, Error> {
        let name = match window {
            Some(window) => format!("scene.window{:03}", window.number()),
            None => "scene".to_owned(),
        };
        let (name, scene) = (name.as_str(), self.output.join(format!("{name}.cif")));
        let options = OpenOptions { masks: masks.map(Path::to_owned), window, ..OpenOptions::default() };
        let dataset = Dataset::open(capture, &options).map_err(Error::plain)?;
        let mut made_from = version();
        made_from.capture(&dataset, record.known(name)).value("preset", &self.preset);
        let config = self.config.iter().map(|file| ("the settings file".to_owned(), file.clone()));
        made_from.files(config, record.known(name));
        let state = record.state(name, &scene, &made_from, masks.as_slice())?;
        let begun = is_made(&state, &scene);
        if begun && Checkpoint::load(&scene).map_err(Error::plain)?.training.is_none() {
            return Ok(scene);
        }
        std::fs::create_dir_all(&self.output).map_err(Error::io("create", &self.output))?;
        let mut words: Vec<OsString> =
            vec!["train".into(), capture.into(), "-o".into(), scene.clone().into()];
        if let Some(masks) = masks {
            words.extend(["--masks".into(), masks.into()]);
        }
        if let Some(window) = window {
            words.extend(["--window".into(), window.to_string().into()]);
        }
        if begun {
            record.go_on(name, made_from)?;
            words.push("--resume".into());
        } else {
            record.begin(name, &scene, made_from)?;
            let of = |name: &str, value: Option<OsString>| value.map(|value| [name.into(), value]);
            let preset = of("--preset", self.preset.as_ref().map(OsString::from));
            let config = of("--config", self.config.as_ref().map(OsString::from));
            words.extend(preset.into_iter().chain(config).flatten());
            words.extend(matches!(state, State::Stale(_)).then(|| "--force".into()));
        }
        step(run_line, self.quietly(words), None)?;
        record.end(name, &scene)?;
        Ok(scene)
    }

    fn quietly(&self, mut words: Vec<OsString>) -> Vec<OsString> {
        words.extend(self.quiet.then(|| "--quiet".into()));
        words
    }
}

/// True where a result is there and good; says why it is made again.
fn is_made(state: &State, result: &Path) -> bool {
    if let State::Stale(why) = state {
        crate::messages::note!("{} is made again: {why}", result.display());
    }
    matches!(state, State::Good)
}

/// Where the folder that a step makes anew waits until that has succeeded.
fn aside(place: &Path) -> PathBuf {
    let name = place.file_name().unwrap_or_default().to_string_lossy();
    place.with_file_name(format!(".{name}.old"))
}

/// Puts a folder back whose step was killed before it had made another one.
fn put_back(place: &Path) -> Result<(), Error> {
    let aside = aside(place);
    if !aside.exists() {
        Ok(())
    } else if place.exists() {
        std::fs::remove_dir_all(&aside).map_err(Error::io("remove", &aside))
    } else {
        std::fs::rename(&aside, place).map_err(Error::io("put back", place))
    }
}

/// Runs a step that makes a folder; a stale one, which is as a step left it, is put aside until that has succeeded.
fn instead(state: &State, place: &Path, step: impl FnOnce() -> Result<(), Error>) -> Result<(), Error> {
    if !matches!(state, State::Stale(_)) {
        return step();
    }
    std::fs::rename(place, aside(place)).map_err(Error::io("put aside", place))?;
    let done = step();
    put_back(place)?;
    done
}

/// Inputs of every step.
fn version() -> MadeFrom {
    MadeFrom::new().value("version", env!("CARGO_PKG_VERSION")).clone()
}

/// Keeps a command from printing the next step, which is printed here.
const STEP: Option<&str> = Some("--step");

/// Frames of the first camera that are proposed to be painted: the first and the last, and some between.
fn proposed(dataset: &Dataset) -> Vec<usize> {
    let camera = dataset.frames.first().map(|frame| &frame.camera_name);
    let of_camera = |index: &usize| Some(&dataset.frames[*index].camera_name) == camera;
    let frames: Vec<usize> = (0..dataset.frames.len()).filter(of_camera).collect();
    let count = PROPOSED.min(frames.len());
    (0..count).map(|k| frames[k * (frames.len() - 1) / (count - 1).max(1)]).collect()
}

/// The stop at which a person is needed: frames to be painted, in addition to those that are.
fn to_paint(dataset: &Dataset, frames: &[usize], painted: usize, keyframes: &Path, capture: &Path) -> Error {
    let line = |index: &usize| {
        let frame = &dataset.frames[*index];
        let mask = keyframes.join(format!("{}.png", frame.name));
        format!("  {}  ->  {}", frame.image.display(), mask.display())
    };
    let lines = frames.iter().map(line).collect::<Vec<_>>().join("\n");
    if painted > 0 {
        return Error::failed(
            format!(
                "{painted} of {PROPOSED} frames are painted; masks of the others would be guessed from these. Missing:\n{lines}"
            ),
            "paint them too, or as many other frames, and run the same command again; or continue with the painted ones: \
             --as-painted",
        );
    }
    let strangers = std::fs::read_dir(keyframes).into_iter().flatten().flatten().map(|entry| entry.path());
    let strangers = strangers.filter(|path| path.extension().is_some_and(|ending| ending == "png")).count();
    let named = match strangers {
        0 => String::new(),
        count => format!("\n({} has {count} PNG files, none of them named as a frame)", keyframes.display()),
    };
    Error::failed(
        format!("{} frames have to be painted:\n{lines}{named}", frames.len()),
        format!(
            "paint each object in the value of its id, 1 to 255, on 0 in an 8-bit grey or palette PNG of the same size \
             (any paint program, or a tracker's first answer); name the ids in instances.json next to them, \
             [{{\"id\": 1, \"label\": \"red mug\"}}]; then run the same command again; without objects: {}",
            command_line(&["train", &capture.display().to_string(), "-o", "scene.cif"])
        ),
    )
}
