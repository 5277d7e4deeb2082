//! `cif completions`: what shells complete command lines by.

use clap::Args;
use clap_complete::Shell;

use crate::error::Error;

/// Print the completions of a shell
#[derive(Debug, Args)]
#[command(after_help = "\
Kept where the shell looks for them:

  cif completions bash > ~/.local/share/bash-completion/completions/cif
  cif completions zsh > ~/.zfunc/_cif                  # with fpath+=~/.zfunc before compinit in ~/.zshrc
  cif completions fish > ~/.config/fish/completions/cif.fish
  cif completions powershell >> $PROFILE
  cif completions elvish >> ~/.config/elvish/rc.elv")]
pub(super) struct Completions {
    /// Shell
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

/// `arguments` is the parser of the command line.
pub(super) fn run(command: &Completions, mut arguments: clap::Command) -> Result<(), Error> {
    let mut script = Vec::new();
    clap_complete::generate(command.shell, &mut arguments, "cif", &mut script);
    print!("{}", String::from_utf8_lossy(&script));
    Ok(())
}
