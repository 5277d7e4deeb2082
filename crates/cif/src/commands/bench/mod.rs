//! `cif bench`: what a training step costs, and where; what accuracy costs, of scenes and of exported motion; how
//! hard captures fare; how the method compares.

mod accuracy;
mod compare;
mod export;
mod growth;
mod hardness;
mod step;

use std::path::Path;

use clap::{Args, Subcommand};

use crate::error::Error;

/// Measure training steps, exports, accuracy against cost, hard captures, and other methods
#[derive(Debug, Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub(super) struct Bench {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Step(step::BenchStep),
    Growth(growth::BenchGrowth),
    Export(export::BenchExport),
    Hardness(hardness::BenchHardness),
    Accuracy(accuracy::BenchAccuracy),
    Compare(compare::BenchCompare),
}

/// Words of a bench, from its name on.
#[derive(Debug, clap::Parser)]
struct Line {
    #[command(subcommand)]
    what: What,
}

/// Parts of a bench that are jobs of their own, with its captures in `folder`.
///
/// # Errors
/// When the words are not understood, or the bench has no parts.
pub(super) fn parts(words: &[String], folder: &Path) -> Result<Vec<cif_batch::Part>, Error> {
    use clap::Parser;

    let line = std::iter::once("cif bench").chain(words.iter().map(String::as_str));
    match Line::try_parse_from(line).map_err(Error::plain)?.what {
        What::Accuracy(command) => accuracy::parts(command, folder),
        What::Compare(command) => compare::parts(&command, folder),
        What::Step(_) | What::Growth(_) | What::Export(_) | What::Hardness(_) => Err(Error::usage(
            format!("cif bench {} has no parts", words.first().map_or("", String::as_str)),
            "benches of a plan are accuracy and compare; others are a [[step]] with each = \"batch\"",
        )),
    }
}

pub(super) fn run(command: &Bench) -> Result<(), Error> {
    match &command.what {
        What::Step(command) => step::run(command),
        What::Growth(command) => growth::run(command),
        What::Export(command) => export::run(command),
        What::Hardness(command) => hardness::run(command),
        What::Accuracy(command) => accuracy::run(command),
        What::Compare(command) => compare::run(command),
    }
}
