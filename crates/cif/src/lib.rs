//! The `cif` command as a library: [`run`] is what both the binary and the Python package call, each after
//! [`own_process`] where the process is theirs.
//!
//! | module | answers |
//! |---|---|
//! | [`commands`] | one file per subcommand |
//! | [`settings`] | preset, file, flags: which value counts |
//! | [`starting_points`] | points of captures that have none |
//! | [`training`] | runs that save into a file |
//! | [`destination`] | that file: saved into by one run, never over what others put there |
//! | [`lock`] | who writes a file |
//! | [`progress`] | bars, plain lines and JSON lines of a training run |
//! | [`interrupt`] | what Ctrl-C and SIGTERM do |
//! | [`output`] | files written whole, never over existing ones |
//! | [`pictures`] | instance, depth and error colours, panels, PNG files |
//! | `backend` | whether the processor or a GPU does the work, behind the feature `wgpu` |
//! | [`camera_file`] | views that no capture has |
//! | [`formats`] | the formats that scenes are exchanged in |
//! | [`mask_query`] | which objects 2D masks show |
//! | [`detector`] | what makes such masks: a command, or models |
//! | [`instance_views`] | which views show an object best, and what they show of it |
//! | [`words`] | words of a text, matched with the names of objects |
//! | [`evaluation`] | scores of a scene on a capture, as they are reported |
//! | [`ground_truth`] | exported motion against known motion |
//! | `program` | the program that this process runs, which it starts again for jobs and models |
//! | `report` | reports as JSON: where they go |
//! | `moment` | times as they are typed |
//! | `endings` | names of outputs, and what they may end in |
//! | `messages` | notes and outcomes on stderr, and who wants none |
//! | `streams` | stdout and stderr, whose readers may leave |
//! | `version` | what `cif --version` says |
//! | [`error`] | what is reported, and the exit code |

// Its macros stand in for those of the standard library in all modules below.
#[macro_use]
mod streams;

#[cfg(feature = "wgpu")]
pub mod backend;
pub mod camera_file;
pub mod commands;
pub mod destination;
pub mod detector;
mod endings;
pub mod error;
pub mod evaluation;
pub mod formats;
pub mod ground_truth;
pub mod instance_views;
pub mod interrupt;
pub mod lock;
pub mod mask_query;
mod messages;
mod moment;
pub mod output;
pub mod pictures;
mod program;
pub mod progress;
mod report;
pub mod settings;
pub mod starting_points;
pub mod training;
mod version;
pub mod words;
pub mod workers;

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::PathBuf;

use cif_system::environment::NO_COLOR;
use clap::Parser;
use miette::{GraphicalReportHandler, GraphicalTheme};

pub use cif_capture::structure::pythons;
pub use error::Error;

/// Names the Python that this process is part of, which has the command as its module in the folder `packages`: programs of
/// Python run in it, and so do models, each in a process of its own.
pub fn set_python(program: PathBuf, packages: PathBuf) {
    cif_capture::structure::set_python(program.clone());
    program::set_python(program, packages);
    run_models_apart();
}

/// Models are run in processes of their own.
fn run_models_apart() {
    cif_vision::runtime::run_apart(|| {
        let mut command = program::command();
        command.arg(RUN_MODEL);
        command
    });
}

/// From here on signals stop the command, and one that only prints ends without a word when whatever reads its output has
/// seen enough, as in `cif query ... | head`. For processes that are nothing but the command: others would end with it,
/// and lose their own handlers.
///
/// Models are run by the same program in processes of their own, unless [`set_python`] was called before.
pub fn own_process() {
    program::set_own();
    run_models_apart();
    interrupt::own_process();
}

/// The subcommand that runs a model for another process.
const RUN_MODEL: &str = "run-model";

/// Runs a command line, the first argument being the name of the program, and returns the exit code:
/// 0 done, 1 failed, 2 not understood, 130 interrupted. Errors are written to stderr. A command that writes files goes on
/// when a reader of its stdout or stderr leaves.
pub fn run(arguments: Vec<OsString>) -> i32 {
    let words = report::join_files(arguments);
    let arguments = match commands::Arguments::try_parse_from(&words) {
        Ok(arguments) => arguments,
        Err(error) => {
            // Nothing is left to be said when even stderr is closed.
            let _ = error.print();
            if let Some(advice) = commands::advice(&error, &words) {
                eprintln!("\n{advice}");
            }
            return error.exit_code();
        }
    };
    if interrupt::is_own_process() && arguments.only_prints() {
        streams::end_with_reader();
    }
    match commands::run(arguments).and_then(|()| streams::check()) {
        Ok(()) => 0,
        Err(error) => {
            report(&error);
            error.exit_code()
        }
    }
}

fn report(error: &Error) {
    let theme = if std::io::stderr().is_terminal() && NO_COLOR.value().is_none() {
        GraphicalTheme::unicode()
    } else {
        GraphicalTheme::unicode_nocolor()
    };
    // Unwrapped, so that file names in messages stay whole.
    let handler = GraphicalReportHandler::new_themed(theme).with_wrap_lines(false).with_links(false);
    let mut text = String::new();
    match handler.render_report(&mut text, error) {
        Ok(()) => eprint!("Error:{text}"),
        Err(_) => eprintln!("Error: {error}"),
    }
}
