//! `cif masks`: masks of other tools; masks out of a few painted ones; sequences for video trackers, and their answers brought back.

mod import;
mod propagate;

use std::path::{Path, PathBuf};

use cif_dataset::masks::{
    INDEX_FILE, SplitReport, ViewOrder, ZigzagIndex, split_tracker_masks, write_zigzag,
};
use clap::{Args, Subcommand, ValueEnum};

use crate::commands::shared::{CaptureOptions, print_warnings};
use crate::error::Error;
use crate::report::{JsonReport, OnlyReport};

/// Make masks: import those of other tools, propagate a few painted frames, or run a video tracker
#[derive(Debug, Args)]
#[command(after_help = "\
Masks of trackers, annotation tools and compositors become the folder that training reads:

  cif masks import deva-output -o table-masks --capture captures/table

Without a tracker, paint the objects of a few frames and let the others follow:

  cif masks propagate captures/table --keyframes painted -o table-masks
  cif train captures/table --masks table-masks -o table.cif

A tracker follows objects through one video. A capture with many cameras becomes one video by running
through the first camera forwards, through the next backwards, and so on: neighbouring images then
differ a little in time or in place, never in both.

  cif masks zigzag captures/kitchen -o sequence
  ... run the tracker on sequence/: one PNG of ids per image ...
  cif masks split sequence tracked -o captures/kitchen/masks
  cif train captures/kitchen -o kitchen.cif

Scores on such masks measure agreement with a consistent tracker, not with human truth.")]
pub(super) struct Masks {
    #[command(subcommand)]
    step: Step,
}

#[derive(Debug, Subcommand)]
enum Step {
    Import(import::Import),
    Propagate(propagate::Propagate),
    /// Write the images of all cameras as one sequence
    Zigzag {
        /// Folder of the capture
        capture: PathBuf,
        /// New folder for the sequence
        #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
        output: PathBuf,
        /// Order of the cameras
        #[arg(long, default_value = "name", value_name = "ORDER")]
        order: Order,
        #[command(flatten)]
        capture_options: CaptureOptions,
        #[command(flatten)]
        report: OnlyReport,
    },
    /// Assign the ids of a tracker to the cameras, and drop objects that some camera never sees
    Split {
        /// Folder that `cif masks zigzag` wrote
        sequence: PathBuf,
        /// Folder of the tracker's id images
        tracked: PathBuf,
        /// New folder for the masks
        #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
        output: PathBuf,
        /// Pixels that an object needs in one frame of every camera
        #[arg(long, default_value_t = 1, value_name = "PIXELS")]
        min_px: u64,
        #[command(flatten)]
        report: OnlyReport,
    },
}

/// Orders of the cameras.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Order {
    /// By name
    Name,
    /// From one end of the rig, always on to the nearest camera left
    Greedy,
}

impl JsonReport for ZigzagIndex {
    const COMMANDS: &'static [&'static str] = &["cif masks zigzag"];
}

impl JsonReport for SplitReport {
    const COMMANDS: &'static [&'static str] = &["cif masks split"];
}

pub(super) fn run(command: &Masks) -> Result<(), Error> {
    match &command.step {
        Step::Import(command) => import::run(command),
        Step::Propagate(command) => propagate::run(command),
        Step::Zigzag { capture, output, order, capture_options, report } => {
            report.check([capture.as_path()])?;
            zigzag(capture, output, *order, capture_options, report)
        }
        Step::Split { sequence, tracked, output, min_px, report } => {
            report.check([sequence.as_path(), tracked.as_path()])?;
            split(sequence, tracked, output, *min_px, report)
        }
    }
}

fn zigzag(
    capture: &Path,
    output: &Path,
    order: Order,
    options: &CaptureOptions,
    report: &OnlyReport,
) -> Result<(), Error> {
    let mut options = options.clone();
    options.no_masks = options.masks.is_none();
    let dataset = options.open(capture)?;
    print_warnings(&dataset);
    let order = match order {
        Order::Name => ViewOrder::Name,
        Order::Greedy => ViewOrder::Greedy,
    };
    let index = write_zigzag(&dataset, output, order).map_err(Error::plain)?;
    report.give(
        || index.clone(),
        || {
            println!("{} images and {INDEX_FILE} in {}", index.images.len(), output.display());
            if index.is_multi_view() {
                let (views, length) = (index.views.join(", "), index.view_path_m);
                println!("cameras in order: {views}; path between them {length:.3} m");
            } else {
                println!("one view, in the order of the capture");
            }
        },
    )
}

fn split(
    sequence: &Path,
    tracked: &Path,
    output: &Path,
    min_px: u64,
    json_report: &OnlyReport,
) -> Result<(), Error> {
    let index = ZigzagIndex::load(sequence).map_err(Error::plain)?;
    let report = split_tracker_masks(&index, tracked, output, min_px).map_err(Error::plain)?;
    json_report.give(
        || report.clone(),
        || {
            println!(
                "{} masks of {} instances in {}",
                report.masks,
                report.instances.len(),
                output.display()
            );
            for removed in &report.removed {
                println!(
                    "removed id {} ({} pixels): not seen by {}",
                    removed.tracker_id,
                    removed.pixels,
                    removed.missing_in.join(", ")
                );
            }
        },
    )?;
    if !report.without_mask.is_empty() {
        crate::messages::warning!("the tracker wrote no mask for {}", report.without_mask.join(", "));
    }
    Ok(())
}
