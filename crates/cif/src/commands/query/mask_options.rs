//! Options of `cif query` by masks.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use crate::commands::shared::{FrameOptions, LayoutName};
use crate::endings;
use crate::mask_query::Selection;

/// Masks that a detector found, and their use.
#[derive(Debug, Args)]
#[command(next_help_heading = "By masks")]
pub(super) struct ByMasks {
    /// Folder of what a detector found on frames of the capture
    #[arg(
        long,
        value_name = "DIR",
        requires = "capture",
        conflicts_with_all = ["label", "taxonomy", "point", "region", "time", "interval", "prompt"]
    )]
    pub(super) masks: Option<PathBuf>,
    /// Words for the detector
    #[arg(
        long,
        value_name = "TEXT",
        requires = "capture",
        conflicts_with_all = ["label", "taxonomy", "point", "region", "time", "interval", "text"]
    )]
    pub(super) prompt: Option<String>,
    /// Command that reads the frames in {frames} and writes the masks of {prompt} into {masks}; without
    /// these words the folder of frames, the folder of masks and the prompt are its last arguments
    #[arg(long, value_name = "CMD", requires = "prompt", conflicts_with = "models")]
    pub(super) detector: Option<String>,
    /// Keep the masks that models make in this folder, for the next time [default: .cif-cache in the capture]
    #[arg(long, value_name = "DIR", requires = "prompt", requires = "models")]
    pub(super) cache: Option<PathBuf>,
    /// Rule by which instances are chosen
    #[arg(long, value_name = "RULE", default_value = "reproject")]
    pub(super) protocol: Protocol,
    /// Capture that the masks belong to
    #[arg(long, value_name = "CAPTURE")]
    pub(super) capture: Option<PathBuf>,
    /// Gaussians that make up the result
    #[arg(long, value_name = "SET", default_value = "instance")]
    pub(super) select: Select,
    /// Least foreground of a pixel of the rendered masks, 0 to 1: below it a pixel is background. The paper has no
    /// such gate (0) [default: 0.5]
    #[arg(long, value_name = "SHARE", value_parser = share, requires = "eval")]
    pub(super) foreground: Option<f32>,
    /// Render the result from held-out frames and compare it with the masks there
    #[arg(long, requires = "capture")]
    pub(super) eval: bool,
    /// Write the rendered masks of --eval into this folder
    #[arg(short, long, value_name = "DIR", requires = "eval", value_parser = endings::folder())]
    pub(super) output: Option<PathBuf>,
    /// Reduce images by 1, 2, 4, ... [default: as the scene was trained]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub(super) downscale: Option<u32>,
    /// Read the capture as this layout where two fit
    #[arg(long, value_name = "LAYOUT")]
    pub(super) layout: Option<LayoutName>,
    #[command(flatten)]
    pub(super) frames: FrameOptions,
}

/// Which Gaussians make up the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Select {
    /// Those of the chosen instances
    Instance,
    /// Those inside the masks themselves
    Gaussian,
    /// Those that are both: a part of an instance
    Both,
}

/// Rule by which instances are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Protocol {
    /// Those that lie mostly inside the masks of the training frames
    Reproject,
    /// Those with more than 0.7 of their pixels inside the mask of the first held-out view as it is rendered; their
    /// answer in a view are the pixels with a probability above 0.2, as in Gaussian Grouping
    Grouping,
}

impl Protocol {
    /// As it is typed.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Reproject => "reproject",
            Self::Grouping => "grouping",
        }
    }
}

impl From<Select> for Selection {
    fn from(select: Select) -> Self {
        match select {
            Select::Instance => Self::Instance,
            Select::Gaussian => Self::Gaussian,
            Select::Both => Self::Both,
        }
    }
}

impl ByMasks {
    /// True when the question is asked by masks.
    pub(super) fn is_asked(&self) -> bool {
        self.masks.is_some() || self.prompt.is_some()
    }
}

/// A number in [0, 1].
fn share(text: &str) -> Result<f32, String> {
    let share: f32 = text.parse().map_err(|_| "expected a number".to_owned())?;
    if (0.0..=1.0).contains(&share) { Ok(share) } else { Err("expected 0 to 1".to_owned()) }
}
