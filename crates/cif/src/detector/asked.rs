//! Frames that a detector is asked about, and its answer.

use std::collections::BTreeMap;

use cif_dataset::Dataset;
use cif_output::Workplace;
use cif_vision::grounding::FoundBox;

use crate::error::Error;
use crate::mask_query::FoundMasks;
use crate::pictures::Picture;

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
    /// Boxes by frame, where models found them; a command reports none.
    pub boxes: BTreeMap<String, Vec<FoundBox>>,
    pub(super) _folder: Option<Workplace>,
}

/// A folder for temporary files.
pub(super) fn temporary() -> Result<Workplace, Error> {
    Workplace::create("cif-detect-").map_err(Error::io("create a temporary folder in", &std::env::temp_dir()))
}
