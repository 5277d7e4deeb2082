//! Masks of a prompt on frames: by a command of the user's own, or by models that cif runs itself.

mod command;
mod models;

use std::collections::BTreeMap;
use std::path::PathBuf;

use cif_dataset::Dataset;
use cif_output::Workplace;
use cif_vision::Models;
use cif_vision::grounding::FoundBox;

use crate::error::Error;
use crate::mask_query::FoundMasks;
use crate::pictures::Picture;

/// Answers prompts.
#[derive(Debug)]
pub enum Detector {
    /// A command that reads frames and writes masks.
    Command(String),
    /// Models of a folder, and the folder that keeps their masks.
    Models(Box<Models>, PathBuf),
}

/// Frames that a detector is asked about.
pub struct Asked<'a> {
    /// Their capture.
    pub dataset: &'a Dataset,
    /// Their indices.
    pub frames: &'a [usize],
    /// The picture of a frame, without lens distortion.
    pub picture: &'a dyn Fn(usize) -> Result<Picture, Error>,
}

/// Masks of a detector; those in a temporary folder are deleted with it.
#[derive(Debug)]
pub struct Detected {
    /// The masks.
    pub masks: FoundMasks,
    /// Boxes by frame, where models found them; a command tells of none.
    pub boxes: BTreeMap<String, Vec<FoundBox>>,
    _folder: Option<Workplace>,
}

impl Detector {
    /// Asks for a prompt.
    ///
    /// # Errors
    /// When the detector cannot be run or fails, or the command is asked to stop.
    pub fn detect(&self, asked: &Asked<'_>, prompt: &str) -> Result<Detected, Error> {
        match self {
            Self::Command(command) => command::detect(asked, command, prompt),
            Self::Models(models, cache) => models::detect(asked, models, cache, prompt),
        }
    }
}

/// A folder for temporary files.
fn temporary() -> Result<Workplace, Error> {
    Workplace::create("cif-detect-").map_err(Error::io("create a temporary folder in", &std::env::temp_dir()))
}
