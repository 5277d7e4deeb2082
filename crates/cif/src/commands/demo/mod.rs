//! `cif demo`: the example that comes with the command, from training to the page, one command after the other.

mod example;

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use cif_field::Checkpoint;
use clap::Args;

use crate::commands::shared::command_line;
use crate::commands::shared::step::{self, RunLine};
use crate::endings;
use crate::error::Error;
use crate::messages::note;

/// Folder that is made unless another one is named.
const FOLDER: &str = "cif-demo";

/// Time for the training unless another one is given.
const BUDGET: &str = "60s";

/// The object that is asked for, and a frame in which it moves.
const OBJECT: [&str; 4] = ["--label", "red mug", "--time", "36"];

/// See cif work, on a small capture that comes with it: train, score, export, query, and look at the scene
#[derive(Debug, Args)]
#[command(after_help = "\
The capture, 80 images of a table with nine objects, is put into the output folder. Then these commands run there, each
printed before it does, to be repeated with other options:

  cif info      what is in the capture
  cif train     for a minute, with the preset draft, into scene.cif
  cif eval      how good it is on frames that were held out
  cif export    one moving prim per object, into scene.usda (scene.glb where USD is missing: pip install 'cif4d[usd]')
  cif query     an object by its label
  cif view      the page in a browser, until Ctrl-C

Run it again to go on after Ctrl-C, or to look again: what is trained and exported stays unless --force is given. Other
files are never replaced, and a folder that holds others is refused.

  cif demo
  cif demo -o table --budget 5m
  cif demo --trained            look at once, at a scene that was trained before, for longer
  cif demo --no-view            end without the page")]
pub(super) struct Demo {
    /// Folder for the capture and everything that is made
    #[arg(short, long, value_name = "DIR", default_value = FOLDER, value_parser = endings::folder())]
    output: PathBuf,
    /// Time for the training, as in `cif train --budget`: 30s, 5m
    #[arg(long, value_name = "DURATION", default_value = BUDGET, value_parser = duration)]
    budget: String,
    /// Train nothing: take the scene that comes with the capture
    #[arg(long, conflicts_with = "budget")]
    trained: bool,
    /// Train and export anew, in place of the scene and the exported file of an earlier run
    #[arg(long)]
    force: bool,
    /// Print the address of the page instead of opening a browser
    #[arg(long)]
    no_open: bool,
    /// End without the page
    #[arg(long, conflicts_with = "no_open")]
    no_view: bool,
    #[arg(from_global)]
    quiet: bool,
}

/// A duration as it was typed, which `cif train` reads again.
fn duration(text: &str) -> Result<String, humantime::DurationError> {
    humantime::parse_duration(text).map(|_| text.to_owned())
}

pub(super) fn run(command: &Demo, run_line: RunLine) -> Result<(), Error> {
    let demo = Running { command, run_line };
    let capture = example::put_into(&command.output)?;
    demo.step(words(["info".as_ref(), capture.as_ref()]))?;
    let scene = match command.trained {
        true => example::put_scene_into(&command.output)?,
        false => demo.train(&capture)?,
    };
    demo.step(words(["eval".as_ref(), scene.as_ref(), capture.as_ref()]))?;
    let exported = demo.export(&scene)?;
    let mut question = words(["query".as_ref(), exported.as_ref()]);
    question.extend(OBJECT.map(OsString::from));
    demo.step(question)?;
    print_made(&[
        (&capture, "the capture"),
        (&scene, "the trained scene"),
        (&exported, "its objects, for Blender and other programs"),
    ]);
    let mut page = words(["view".as_ref(), scene.as_ref(), "--capture".as_ref(), capture.as_ref()]);
    page.extend(command.no_open.then(|| "--no-open".into()));
    if command.no_view {
        println!("next: {}", command_line(&shown(&page)));
        return Ok(());
    }
    demo.step(page)
}

/// The demo while it runs.
struct Running<'a> {
    command: &'a Demo,
    run_line: RunLine,
}

impl Running<'_> {
    fn step(&self, mut words: Vec<OsString>) -> Result<(), Error> {
        words.extend(self.command.quiet.then(|| "--quiet".into()));
        step::step(self.run_line, words, None)
    }

    /// The trained scene; a run that was interrupted goes on, one that has ended is kept.
    fn train(&self, capture: &Path) -> Result<PathBuf, Error> {
        let scene = self.command.output.join("scene.cif");
        let begun = match scene.exists() && !self.command.force {
            true => Some(Checkpoint::load(&scene).map_err(Error::plain)?),
            false => None,
        };
        if begun.as_ref().is_some_and(|begun| begun.training.is_none()) {
            note!("{} is trained already; --force trains it anew", scene.display());
            return Ok(scene);
        }
        let how: &[&str] = match (begun, self.command.force) {
            (Some(_), _) => &["--resume"],
            (None, false) => &["--preset", "draft"],
            (None, true) => &["--preset", "draft", "--force"],
        };
        let mut words = words(["train".as_ref(), capture.as_ref(), "-o".as_ref(), scene.as_ref()]);
        words.extend(how.iter().chain(&["--budget", &self.command.budget]).map(OsString::from));
        self.step(words).map_err(|error| self.continued(error))?;
        Ok(scene)
    }

    /// The error of a run that was interrupted, with the command to go on with all of the demo.
    fn continued(&self, error: Error) -> Error {
        let Error::Interrupted { message, help: Some(_) } = error else { return error };
        let mut again = vec!["demo".to_owned()];
        if self.command.output != Path::new(FOLDER) {
            again.extend(["-o".to_owned(), self.command.output.display().to_string()]);
        }
        Error::Interrupted { message, help: Some(format!("continue with: {}", command_line(&again))) }
    }

    /// The exported file, USD where this build and this machine have it; one that is there already is kept.
    fn export(&self, scene: &Path) -> Result<PathBuf, Error> {
        let (flag, ending) = match cif_usd::usd_version() {
            Ok(_) => ("--usd", "usda"),
            Err(error) => {
                note!("{error}; the objects are exported as glTF");
                ("--gltf", "glb")
            }
        };
        let exported = scene.with_extension(ending);
        let mut words = words(["export".as_ref(), scene.as_ref(), flag.as_ref(), exported.as_ref()]);
        let changed = |path: &Path| std::fs::metadata(path).and_then(|found| found.modified()).ok();
        if exported.exists() && !self.command.force {
            if changed(&exported) < changed(scene) {
                words.push("--force".into());
                return Err(Error::failed(
                    format!(
                        "{} is older than {}, and may be of another scene",
                        exported.display(),
                        scene.display()
                    ),
                    format!("it is kept; to replace it: {}", command_line(&shown(&words))),
                ));
            }
            note!("{} is exported already", exported.display());
            return Ok(exported);
        }
        words.extend(self.command.force.then(|| "--force".into()));
        self.step(words)?;
        Ok(exported)
    }
}

/// Prints what there is now, a path a line.
fn print_made(made: &[(&Path, &str)]) {
    let paths: Vec<String> = made.iter().map(|(path, _)| path.display().to_string()).collect();
    let width = paths.iter().map(|path| path.chars().count()).max().unwrap_or_default();
    println!();
    for (path, (_, what)) in paths.iter().zip(made) {
        println!("{path:<width$}  {what}");
    }
}

/// The words of a command line.
fn words<const N: usize>(words: [&OsStr; N]) -> Vec<OsString> {
    words.map(OsStr::to_owned).to_vec()
}

/// Words as they are shown.
fn shown(words: &[OsString]) -> Vec<String> {
    words.iter().map(|word| word.to_string_lossy().into_owned()).collect()
}
