//! `cif view`: scenes and captures in a browser.

mod images;
mod server;
mod shown;

use std::path::PathBuf;

use clap::Args;

use crate::commands::shared::CaptureOptions;
use crate::error::Error;
use crate::interrupt;
use crate::messages::{note, outcome, warning};
pub(super) use server::Server;
pub(super) use shown::Shown;

/// Look at a scene, an exported file or a capture in a browser
#[derive(Debug, Args)]
#[command(after_help = "\
Plays the scene over time: orbit and fly, look through the recorded cameras, pick objects, isolate, hide
and follow them, and read their labels, paths and poses. With --capture its images are compared with the
scene. A capture alone shows its cameras, points, images and masks, before anything is trained.

  cif view table.cif
  cif view table.cif --capture captures/table     compare with the images
  cif view captures/table                         before training
  cif view table.usda --no-open                   print the address only

The page is served to this machine alone (127.0.0.1, a random port, a random word in the address), and nothing
is written. Over ssh, forward the port: ssh -L PORT:127.0.0.1:PORT HOST. `cif export table.cif table.html`
writes the same page as one file to send.")]
pub(super) struct View {
    /// What to look at: a trained scene, a USD stage, a glTF file, a PLY, or the folder of a capture
    #[arg(value_name = "SCENE.cif|STAGE|FILE.glb|FILE.ply|CAPTURE")]
    path: PathBuf,
    /// Capture whose images are compared with the scene
    #[arg(long, value_name = "CAPTURE")]
    capture: Option<PathBuf>,
    /// Print the address instead of opening a browser
    #[arg(long)]
    no_open: bool,
    /// Port to serve the page on [default: any that is free]
    #[arg(long, value_name = "PORT")]
    port: Option<u16>,
    #[command(flatten)]
    capture_options: CaptureOptions,
}

pub(super) fn run(command: &View) -> Result<(), Error> {
    let shown = shown::open(&command.path, command.capture.as_deref(), &command.capture_options)?;
    let server = Server::start(shown, command.port.unwrap_or(0))?;
    let address = server.address();
    println!("{address}");
    if !command.no_open && open::that_detached(&address).is_err() {
        warning!("no browser could be started; open the address above in one");
    }
    note!("only this machine can see the page; Ctrl-C ends it");
    interrupt::watch();
    server.serve(interrupt::requested);
    outcome!("the page is closed");
    Ok(())
}
