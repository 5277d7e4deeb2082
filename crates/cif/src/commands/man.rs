//! `cif man`: the manual pages.

use std::path::PathBuf;

use clap::Args;
use clap_mangen::Man as Page;

use crate::endings;
use crate::error::Error;
use crate::messages::outcome;
use crate::output::{self, Outputs};

/// Write the manual pages, one per command
#[derive(Debug, Args)]
#[command(after_help = "\
  cif man ~/.local/share/man/man1
  man cif-export")]
pub(super) struct Man {
    /// Folder to write into: cif.1, cif-train.1 and so on
    #[arg(value_name = "DIR", value_parser = endings::folder())]
    folder: PathBuf,
    /// Replace existing pages
    #[arg(long)]
    force: bool,
}

/// `arguments` is the parser of the command line.
pub(super) fn run(command: &Man, arguments: clap::Command) -> Result<(), Error> {
    // The long version is that of this machine.
    let mut root = arguments.disable_help_subcommand(true).long_version(None::<&'static str>);
    root.build();
    let mut pages = Vec::new();
    collect(&root, &mut pages)?;
    std::fs::create_dir_all(&command.folder).map_err(Error::io("create the folder", &command.folder))?;
    let mut outputs = Outputs::new(command.force);
    for (name, _) in &pages {
        outputs.file(&command.folder.join(name))?;
    }
    for (name, page) in &pages {
        output::write_file(&command.folder.join(name), page)?;
    }
    outcome!("wrote {} pages into {}", pages.len(), command.folder.display());
    Ok(())
}

/// The page of a command, and those of its subcommands.
fn collect(command: &clap::Command, pages: &mut Vec<(String, Vec<u8>)>) -> Result<(), Error> {
    // Once built, a subcommand is displayed as `cif-train`.
    let name = command.get_display_name().unwrap_or_else(|| command.get_name());
    let mut page = Vec::new();
    Page::new(command.clone())
        .render(&mut page)
        .map_err(|error| Error::plain(format!("the page of {name} cannot be made: {error}")))?;
    pages.push((format!("{name}.1"), page));
    command.get_subcommands().filter(|sub| !sub.is_hide_set()).try_for_each(|sub| collect(sub, pages))
}
