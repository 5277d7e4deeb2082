//! The subcommands, a file or a folder each; `shared` holds what several of them use.

mod batch;
mod bench;
mod capture;
mod check;
mod completions;
mod demo;
mod diff;
mod embed;
mod eval;
mod export;
mod import;
mod info;
mod label;
mod make;
mod man;
mod masks;
mod plan;
mod query;
mod render;
pub(crate) mod shared;
mod train;
mod view;

use std::ffi::OsString;

use clap::{Args, CommandFactory, Parser, Subcommand};

#[cfg(feature = "wgpu")]
use crate::backend;
use crate::error::Error;
use crate::{messages, report, version};

/// From captured images to an editable, segmented 3D scene.
#[derive(Debug, Parser)]
#[command(
    name = "cif",
    bin_name = "cif",
    version,
    long_version = version::long(),
    max_term_width = 110,
    arg_required_else_help = true,
    subcommand_required = true,
    after_help = TOUR
)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    machine: Machine,
    /// Show no progress, notes or outcomes, but warnings, errors and results
    #[arg(short, long, global = true)]
    quiet: bool,
}

const TOUR: &str = "\
A short tour:
  cif demo                                               see it work, on an example that comes with it
  cif make phone.mp4 -o table                            all steps, from a video to a USD stage
  cif capture walk.mp4 -o captures/table                 frames and cameras out of a video or photographs
  cif info captures/table                                what is in this folder?
  cif plan captures/table                                which effects does it call for?
  cif train captures/table -o table.cif                  train it (--preset draft for a quick look)
  cif eval table.cif captures/table --images pictures    score the held-out views, and look at them
  cif view table.cif                                     look at it in a browser
  cif export table.cif table.usda                        one moving prim per object
  cif import table.usda --base table.cif -o new.cif      apply the edits of that file
  cif query table.usda --label 'red mug' --time 36       which prim is it, and where?
  cif query table.usda --text 'something to drink from'  what could that be? (with cif embed, by meaning)
  cif label table.usda --instance 3 'blue mug'           give it another name
  cif check table.cif                                    is it numerically sound?
  cif batch plan.toml                                    many captures, settings and seeds, here or on a farm

A capture is a folder in the layout of HyperNeRF, DyCheck, Neu3D, D-NeRF, Dynamic 3D Gaussians (CMU
Panoptic), LLFF sequences (NSFF, EndoNeRF), nerfstudio or COLMAP, with instance masks (PNG, value =
instance id, 0 = unlabelled; or Cryptomatte EXR) in its folder masks/ or next to its images.
`cif masks` makes them out of those of other tools, a few painted frames, or with a video tracker.

Times are frames as captured, which are the time codes of exported stages: --time 36. Seconds after the
first frame have an s (--time 1.5s), shares of the whole a percent sign (--time 50%).
--json prints the report of a command as JSON and nothing else on stdout; --json FILE.json writes it.
Tables are folded to the width of the terminal, but not in a pipe.
Existing files are replaced with --force only. -q leaves out progress, notes and outcomes.
Exit code: 0 done, 1 failed, 2 wrong arguments, 130 interrupted.
`cif COMMAND --help` explains one command.";

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Demo),
    Make(make::Make),
    Capture(capture::Capture),
    Plan(plan::Plan),
    Train(train::Train),
    Eval(eval::Eval),
    View(view::View),
    Render(render::Render),
    Export(export::Export),
    Import(import::Import),
    Diff(diff::Diff),
    Query(query::Query),
    Label(label::Label),
    Embed(embed::Embed),
    Info(info::Info),
    Check(check::Check),
    Masks(masks::Masks),
    Bench(bench::Bench),
    Batch(batch::BatchCommand),
    Completions(completions::Completions),
    Man(man::Man),
    /// Run a model for another process of cif, which asks on the standard input
    #[command(hide = true)]
    RunModel,
}

/// Use of the machine; results never depend on the number of threads.
#[derive(Clone, Copy, Debug, Args)]
#[command(next_help_heading = "Machine")]
struct Machine {
    /// Threads to use; all processors by default. Results do not depend on it
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

impl Arguments {
    /// True for a command that does nothing but print, so that it has nothing left to do once its reader has left. Files
    /// that it would write too are work.
    pub(crate) fn only_prints(&self) -> bool {
        let writes = |report: &report::Report| report.file().is_some();
        match &self.command {
            Command::Plan(command) => !writes(command.report.report()),
            Command::Info(command) => !writes(command.report.report()),
            Command::Diff(command) => !writes(command.report.report()),
            Command::Query(command) => !writes(&command.report) && !command.writes_trajectory(),
            Command::Check(command) => !writes(&command.report) && command.fix.is_none(),
            Command::Completions(_) => true,
            _ => false,
        }
    }
}

/// Runs one command.
///
/// # Errors
/// Whatever keeps the command from doing what was asked.
pub fn run(arguments: Arguments) -> Result<(), Error> {
    messages::set_quiet(arguments.quiet);
    crate::workers::run(arguments.machine.threads, || dispatch(arguments.command))?
}

/// Advice on arguments that were not understood, where the message of the parser has none.
#[must_use]
pub fn advice(error: &clap::Error, arguments: &[OsString]) -> Option<String> {
    match error.get(clap::error::ContextKind::InvalidArg)? {
        clap::error::ContextValue::String(word) => report::advice(arguments, word),
        _ => None,
    }
}

/// Runs one command on the threads that are there.
fn dispatch(command: Command) -> Result<(), Error> {
    match command {
        Command::Demo(command) => demo::run(&command, run_line),
        Command::Make(command) => make::run(&command, run_line),
        Command::Capture(command) => capture::run(&command),
        Command::Plan(command) => plan::run(&command),
        Command::Train(command) => train::run(&command),
        Command::Eval(command) => eval::run(&command),
        Command::View(command) => view::run(&command),
        Command::Render(command) => render::run(&command),
        Command::Export(command) => export::run(&command),
        Command::Import(command) => import::run(&command),
        Command::Diff(command) => diff::run(&command),
        Command::Query(command) => query::run(&command),
        Command::Label(command) => label::run(&command),
        Command::Embed(command) => embed::run(&command),
        Command::Info(command) => info::run(&command),
        Command::Check(command) => check::run(&command),
        Command::Masks(command) => masks::run(&command),
        Command::Bench(command) => bench::run(&command),
        Command::Batch(command) => batch::run(&command),
        Command::Completions(command) => completions::run(&command, Arguments::command()),
        Command::Man(command) => man::run(&command, Arguments::command()),
        Command::RunModel => cif_vision::runtime::serve(std::io::stdin().lock(), std::io::stdout().lock())
            .map_err(|error| Error::plain(format!("no process asks for a model any more: {error}"))),
    }
}

/// Runs the command of a command line.
fn run_line(line: Vec<OsString>) -> Result<(), Error> {
    dispatch(Arguments::try_parse_from(line).map_err(Error::plain)?.command)
}
