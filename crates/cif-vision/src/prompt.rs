//! The mask of a prompt: boxes of the detector, masks of the segmenter in them, all together.
//!
//! Source: `grouned_sam_output` of Gaussian Grouping, which takes the union over the boxes.

use std::ffi::OsString;

use cif_geometry::PixelGrid;

use crate::grounding::{Detector, FoundBox, Thresholds};
use crate::models::Models;
use crate::segment::Segmenter;
use crate::{Error, Picture, library};

/// Answers prompts by the models of a folder, which are opened when the first question is asked.
#[derive(Debug)]
pub struct Prompter<'a> {
    models: &'a Models,
    pythons: &'a [OsString],
    thresholds: Thresholds,
    opened: Option<(Detector, Segmenter)>,
}

impl<'a> Prompter<'a> {
    /// Nothing is opened yet; `pythons` may have the library, see [`library::find`].
    #[must_use]
    pub fn new(models: &'a Models, pythons: &'a [OsString], thresholds: Thresholds) -> Self {
        Self { models, pythons, thresholds, opened: None }
    }

    /// Opens the models, so that missing files are reported before the first question.
    ///
    /// # Errors
    /// When a model is missing or does not fit, or the library that runs it is not there.
    pub fn open(&mut self) -> Result<(), Error> {
        self.opened().map(drop)
    }

    fn opened(&mut self) -> Result<&mut (Detector, Segmenter), Error> {
        if self.opened.is_none() {
            // Missing models are reported before the library is looked for.
            self.models.detector()?;
            self.models.segmenter()?;
            let library = library::find(self.pythons)?;
            let detector = Detector::open(&library, self.models)?;
            self.opened = Some((detector, Segmenter::open(&library, self.models)?));
        }
        let Some(opened) = &mut self.opened else { unreachable!("opened above") };
        Ok(opened)
    }

    /// Pixels of a picture that show what a prompt names, and the boxes that they were found in, best first.
    ///
    /// # Errors
    /// When a model is missing, does not fit, or fails.
    pub fn mask(
        &mut self,
        picture: &Picture,
        prompt: &str,
    ) -> Result<(PixelGrid<bool>, Vec<FoundBox>), Error> {
        let thresholds = self.thresholds;
        let (detector, segmenter) = self.opened()?;
        let boxes = detector.boxes(picture, prompt, thresholds)?;
        let corners: Vec<[f32; 4]> = boxes.iter().map(|found| found.corners).collect();
        Ok((segmenter.mask(picture, &corners)?, boxes))
    }
}
