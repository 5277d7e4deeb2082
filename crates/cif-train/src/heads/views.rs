//! The training views as heads may look at them between steps, on the processor.

use cif_dataset::{Dataset, Frame};
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::RenderSettings;
use cif_render::cpu::{ContributorRule, IdentityCounts, Renderer};

use crate::error::TrainError;
use crate::frames::FrameStore;
use crate::phases::Phases;

/// Training views with masks, of a field that is up to date.
pub struct TrainingViews<'a> {
    pub(crate) field: &'a Field,
    pub(crate) dataset: &'a Dataset,
    pub(crate) frames: &'a FrameStore,
    pub(crate) phases: &'a Phases,
    /// Settings of views without instances.
    pub(crate) settings: RenderSettings,
    pub(crate) renderer: Renderer,
}

impl<'a> TrainingViews<'a> {
    /// The scene.
    #[must_use]
    pub fn field(&self) -> &'a Field {
        self.field
    }

    /// Settings of views without instances.
    #[must_use]
    pub fn settings(&self) -> RenderSettings {
        self.settings
    }

    /// Calls `each` with every training view that has a mask and whose camera is `chosen`.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub fn each_masked(
        &mut self,
        chosen: &dyn Fn(&str) -> bool,
        each: &mut dyn FnMut(&mut Renderer, &Frame, &PixelGrid<u16>),
    ) -> Result<(), TrainError> {
        for view in 0..self.frames.len() {
            self.phases.check()?;
            let frame = &self.dataset.frames[self.frames.index(view)];
            if !chosen(&frame.camera_name) {
                continue;
            }
            let data = self.frames.get(self.dataset, view)?;
            if let Some(labels) = &data.labels {
                each(&mut self.renderer, frame, labels);
            }
        }
        Ok(())
    }

    /// Adds the mass of contributors of labelled pixels over all views. See [`Renderer::count_contributors`].
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub fn count(&mut self, rule: &ContributorRule) -> Result<IdentityCounts, TrainError> {
        let (field, settings) = (self.field, self.settings);
        let mut counts = IdentityCounts::zeros(field.len(), field.instances.len());
        self.each_masked(&|_| true, &mut |renderer, frame, labels| {
            renderer.prepare(field, &frame.camera, frame.time, &settings);
            renderer.count_contributors(labels, rule, &mut counts);
        })?;
        Ok(counts)
    }

    /// Calls `each` with the mass of contributors of every view by itself, unlabelled pixels being of a label of their
    /// own: labels are those of masks, 0 for none.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub fn each_count(
        &mut self,
        rule: &ContributorRule,
        each: &mut dyn FnMut(&IdentityCounts),
    ) -> Result<(), TrainError> {
        let (field, settings) = (self.field, self.settings);
        self.each_masked(&|_| true, &mut |renderer, frame, masks| {
            let mut counts = IdentityCounts::zeros(field.len(), field.instances.len() + 1);
            let shifted = masks.map(|label| label + 1);
            renderer.prepare(field, &frame.camera, frame.time, &settings);
            renderer.count_contributors(&shifted, rule, &mut counts);
            each(&counts);
        })
    }
}
