//! `cif man`: the manual pages.

use std::path::PathBuf;

use clap::{Args, CommandFactory};
use clap_mangen::Man as Page;

use super::Arguments;
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

pub(super) fn run(command: &Man) -> Result<(), Error> {
    let mut root = Arguments::command();
    root.build();
    let mut pages = Vec::new();
    collect(&root, "cif".to_owned(), &mut pages)?;
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
fn collect(command: &clap::Command, name: String, pages: &mut Vec<(String, Vec<u8>)>) -> Result<(), Error> {
    let mut page = Vec::new();
    Page::new(command.clone().name(name.clone()))
        .render(&mut page)
        .map_err(|error| Error::plain(format!("the page of {name} cannot be made: {error}")))?;
    pages.push((format!("{name}.1"), page));
    let shown = |sub: &&clap::Command| !sub.is_hide_set() && sub.get_name() != "help";
    command
        .get_subcommands()
        .filter(shown)
        .try_for_each(|sub| collect(sub, format!("{name}-{}", sub.get_name()), pages))
}
