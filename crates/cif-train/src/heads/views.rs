//! The training views as heads may look at them between steps, on the processor.

use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::BlendedImage;
use cif_render::cpu::{ContributorRule, IdentityCounts, Renderer};

use super::{HeadTensors, ValueHead, blended};
use crate::error::TrainError;
use crate::state::State;

/// Training views with masks, of a field that is up to date.
pub struct TrainingViews<'a> {
    pub(crate) state: &'a State,
    pub(crate) renderer: Renderer,
}

impl TrainingViews<'_> {
    /// The scene.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.state.field
    }

    /// Calls `each` with every training view that has a mask and whose camera `wanted` takes.
    fn masked(
        &mut self,
        wanted: &dyn Fn(&str) -> bool,
        each: &mut dyn FnMut(&mut Renderer, usize, &PixelGrid<u16>),
    ) -> Result<(), TrainError> {
        for view in 0..self.state.frames.len() {
            self.state.phases.check()?;
            let index = self.state.frames.index(view);
            if !wanted(&self.state.dataset.frames[index].camera_name) {
                continue;
            }
            let data = self.state.frames.get(&self.state.dataset, view)?;
            if let Some(labels) = &data.labels {
                each(&mut self.renderer, index, labels);
            }
        }
        Ok(())
    }

    /// Adds the mass of contributors of labelled pixels over all views. See [`Renderer::count_contributors`].
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub fn count(&mut self, rule: &ContributorRule) -> Result<IdentityCounts, TrainError> {
        let mut counts = IdentityCounts::zeros(self.state.field.len(), self.state.field.instances.len());
        let (state, settings) = (self.state, self.state.color_settings());
        self.masked(&|_| true, &mut |renderer, index, labels| {
            let frame = &state.dataset.frames[index];
            let counted = (labels, rule);
            renderer.count_contributors(
                &state.field,
                &frame.camera,
                frame.time,
                &settings,
                counted,
                &mut counts,
            );
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
        let (state, settings) = (self.state, self.state.color_settings());
        let labels = state.field.instances.len() + 1;
        self.masked(&|_| true, &mut |renderer, index, masks| {
            let frame = &state.dataset.frames[index];
            let mut counts = IdentityCounts::zeros(state.field.len(), labels);
            let shifted = masks.map(|label| label + 1);
            let counted = (&shifted, rule);
            renderer.count_contributors(
                &state.field,
                &frame.camera,
                frame.time,
                &settings,
                counted,
                &mut counts,
            );
            each(&counts);
        })
    }

    /// Blends the values of a head over every view that trains it.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub fn blend(
        &mut self,
        head: &dyn ValueHead,
        tensors: &HeadTensors,
        each: &mut dyn FnMut(&BlendedImage, &PixelGrid<u16>),
    ) -> Result<(), TrainError> {
        let state = self.state;
        let settings = state.color_settings();
        self.masked(&|camera| head.trains_on(camera), &mut |renderer, index, labels| {
            let frame = &state.dataset.frames[index];
            let view = (&frame.camera, frame.time);
            each(&blended(renderer, (head, tensors), &state.field, view, &settings), labels);
        })
    }
}
