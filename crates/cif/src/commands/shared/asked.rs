//! A trained scene that is asked about what a detector finds in pictures of its capture.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_dataset::Dataset;
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};
use cif_vision::Models;
use cif_vision::grounding::FoundBox;

use super::scene;
use crate::detector::{Asked, Detected, Detector};
use crate::error::Error;
use crate::interrupt;
use crate::mask_query::{self, Found, FoundMasks, Selection, grouping};
use crate::pictures::rgb_picture;

/// Folder inside a capture that keeps masks of models. Readers of captures pass over hidden folders.
const CACHE: &str = ".cif-cache";

/// The detector of a folder of models, which keeps masks in `cache`, else in the capture.
///
/// # Errors
/// When the folder or a file that it names is not there.
pub(in crate::commands) fn models(
    folder: &Path,
    capture: &Path,
    cache: Option<PathBuf>,
) -> Result<Detector, Error> {
    let cache = cache.unwrap_or_else(|| capture.join(CACHE));
    Ok(Detector::Models(Box::new(Models::open(folder)?), cache))
}

/// A scene and the capture whose frames are asked.
pub(in crate::commands) struct AskedScene<'a> {
    field: &'a Field,
    dataset: &'a Dataset,
    settings: RenderSettings,
    renderer: Renderer,
}

impl<'a> AskedScene<'a> {
    /// A scene with identity rows, rendered as it was trained.
    pub(in crate::commands) fn new(field: &'a Field, dataset: &'a Dataset) -> Self {
        let settings = scene::render_settings(field);
        Self { field, dataset, settings, renderer: Renderer::new(SimdLevel::Auto) }
    }

    /// Asks a detector about captured frames.
    pub(in crate::commands) fn detect(
        &self,
        detector: &Detector,
        prompt: &str,
        frames: &[usize],
    ) -> Result<Detected, Error> {
        let picture = |index| self.dataset.load_image(index, self.settings.background).map_err(Error::plain);
        detector.detect(&Asked { dataset: self.dataset, frames, picture: &picture }, prompt)
    }

    /// Instances that lie inside the masks of training frames.
    pub(in crate::commands) fn reproject(
        &mut self,
        masks: &FoundMasks,
        selection: Selection,
    ) -> Result<Found, Error> {
        let Self { field, dataset, settings, renderer } = self;
        mask_query::find(field, dataset, masks, selection, renderer, settings, interrupt::go_on)
    }

    /// Pixels of the answer of [`Self::reproject`] in the view of a frame, where the foreground is at least `gate`.
    pub(in crate::commands) fn reprojected(
        &mut self,
        found: &Found,
        gate: f32,
        frame: usize,
    ) -> PixelGrid<bool> {
        let Self { field, dataset, settings, renderer } = self;
        let frame = &dataset.frames[frame];
        mask_query::render(field, &found.rows, gate, &frame.camera, frame.time, renderer, settings)
    }

    /// Instances that lie inside the mask of the first held-out view as it is rendered, and the boxes there.
    pub(in crate::commands) fn group(
        &mut self,
        detector: &Detector,
        prompt: &str,
    ) -> Result<(Found, BTreeMap<String, Vec<FoundBox>>), Error> {
        let Self { field, dataset, settings, renderer } = self;
        let first = dataset.val_frames().first().copied().unwrap_or(0);
        let frame = &dataset.frames[first];
        let plain = Channels { depth: false, instances: false };
        let view = rgb_picture(&renderer.render(field, &frame.camera, frame.time, settings, plain).color);
        let asked = Asked { dataset, frames: &[first], picture: &|_| Ok(view.clone()) };
        let detected = detector.detect(&asked, prompt)?;
        let mask = dataset.load_found_mask(first, &detected.masks.files[first], true)?;
        let found = grouping::find(field, &mask, &frame.camera, frame.time, renderer, settings);
        Ok((found, detected.boxes))
    }

    /// Pixels of the answer of [`Self::group`] in the view of a frame.
    pub(in crate::commands) fn grouped(&mut self, found: &Found, frame: usize) -> PixelGrid<bool> {
        let Self { field, dataset, settings, renderer } = self;
        let frame = &dataset.frames[frame];
        grouping::render(field, &found.votes, &frame.camera, frame.time, renderer, settings)
    }
}
