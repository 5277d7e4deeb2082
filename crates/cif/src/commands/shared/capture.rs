//! Options that say which capture is read and how, and what is printed about it.

use clap::{Args, ValueEnum};

use super::scene;
use crate::error::Error;
use crate::messages;

/// Which capture, and how it is read.
#[derive(Clone, Debug, Args)]
pub(in crate::commands) struct CaptureOptions {
    /// Mask folder: a name inside the capture, such as masks_tracker, or a path; it holds PNG files of ids
    /// or EXR files with a Cryptomatte, whose objects are matched with the labels of instances.json [default: those
    /// that the capture names for its frames, else its folder masks]
    #[arg(long, value_name = "NAME")]
    pub(in crate::commands) masks: Option<std::path::PathBuf>,
    /// Read no masks
    #[arg(long, conflicts_with = "masks")]
    pub(in crate::commands) no_masks: bool,
    /// Reduce images by 1, 2, 4, ... [default: the largest images stored]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub(in crate::commands) downscale: Option<u32>,
    /// Put the principal point into the image centre instead of where the capture says
    #[arg(long)]
    pub(in crate::commands) center_principal_point: bool,
    /// Read the folder as this layout where two fit
    #[arg(long, value_name = "LAYOUT")]
    pub(in crate::commands) layout: Option<LayoutName>,
    #[command(flatten)]
    pub(in crate::commands) frames: FrameOptions,
}

/// Frames of a capture that are read.
#[derive(Clone, Debug, Default, Args)]
pub(in crate::commands) struct FrameOptions {
    /// Leave the frames of a camera out, as in --without-camera cam13 where its video is not synchronised; may be
    /// repeated
    #[arg(long, value_name = "CAMERA")]
    pub(in crate::commands) without_camera: Vec<String>,
    /// Frames taken of each video of the capture, at most [default: 300]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(in crate::commands) video_frames: Option<u32>,
    /// Read a window of time of a long capture alone, with some frames of its neighbours, as in --window 2/4 for the
    /// second of four [default: that of the scene]
    #[arg(long, value_name = "K/N")]
    pub(in crate::commands) window: Option<cif_dataset::TimeWindow>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub(in crate::commands) enum LayoutName {
    HyperNerf,
    DynamicGaussians,
    Neu3d,
    Llff,
    DNerf,
    Nerfstudio,
    Colmap,
}

impl From<LayoutName> for cif_dataset::Layout {
    fn from(name: LayoutName) -> Self {
        match name {
            LayoutName::HyperNerf => Self::HyperNerf,
            LayoutName::DynamicGaussians => Self::DynamicGaussians,
            LayoutName::Neu3d => Self::Neu3d,
            LayoutName::Llff => Self::Llff,
            LayoutName::DNerf => Self::DNerf,
            LayoutName::Nerfstudio => Self::Nerfstudio,
            LayoutName::Colmap => Self::Colmap,
        }
    }
}

impl CaptureOptions {
    /// The pictures of a capture, without masks, reduced as a scene was trained unless `downscale` says otherwise.
    pub(in crate::commands) fn pictures_of(
        field: &cif_field::Field,
        downscale: Option<u32>,
        layout: Option<LayoutName>,
        frames: &FrameOptions,
    ) -> Self {
        Self {
            masks: None,
            no_masks: true,
            downscale,
            center_principal_point: false,
            layout,
            frames: frames.clone(),
        }
        .as_trained(field)
    }

    /// The reduction of images and the window of time that a scene was trained with, where these options do not say.
    pub(in crate::commands) fn as_trained(&self, field: &cif_field::Field) -> Self {
        let mut options = self.clone();
        options.downscale = options.downscale.or(scene::trained_downscale(field));
        options.frames.window = options.frames.window.or(field.record.window);
        options
    }

    pub(in crate::commands) fn options(&self) -> cif_dataset::OpenOptions {
        cif_dataset::OpenOptions {
            masks: self.masks.clone(),
            without_masks: self.no_masks,
            keyframes: false,
            downscale: self.downscale,
            centre_principal_point: self.center_principal_point,
            layout: self.layout.map(Into::into),
            without_cameras: self.frames.without_camera.clone(),
            video_frames: self.frames.video_frames,
            window: self.frames.window,
        }
    }

    /// The layout that a capture is read as, once `check` has passed for it: wrong settings are reported before a missing
    /// capture, for which they are checked with a layout whose presets are those of all.
    pub(in crate::commands) fn layout_after(
        &self,
        capture: &std::path::Path,
        check: impl FnOnce(cif_dataset::Layout) -> Result<(), Error>,
    ) -> Result<cif_dataset::Layout, Error> {
        let layout = self.options().layout_of(capture).map_err(Error::plain);
        check(*layout.as_ref().unwrap_or(&cif_dataset::Layout::Colmap))?;
        layout
    }

    pub(in crate::commands) fn open(&self, capture: &std::path::Path) -> Result<cif_dataset::Dataset, Error> {
        cif_dataset::Dataset::open(capture, &self.options()).map_err(Error::plain)
    }
}

/// Prints the notes of a capture, and its oddities.
pub(in crate::commands) fn print_warnings(dataset: &cif_dataset::Dataset) {
    for note in &dataset.notes {
        eprintln!("note: {}", messages::plain(note));
    }
    for warning in &dataset.warnings {
        messages::warning!("{warning}");
    }
}

/// Prints in what the views of a capture, and its instances, differ from what a scene recorded of its own capture.
pub(in crate::commands) fn print_misfits(
    field: &cif_field::Field,
    dataset: &cif_dataset::Dataset,
    split: cif_dataset::Split,
) {
    use cif_train::metrics::fit::{Severity, misfits};
    for misfit in misfits(field, dataset, split) {
        match misfit.severity {
            Severity::Warning => messages::warning!("{}", misfit.message),
            Severity::Note => messages::note!("{}", misfit.message),
        }
    }
}
