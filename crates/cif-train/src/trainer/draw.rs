//! Views rendered between steps, for judgements and scores, by what does the steps.

use cif_field::Field;
use cif_render::{Channels, RenderSettings, RenderedImage};

use super::Trainer;
use crate::error::TrainError;

/// Views to render.
#[derive(Clone, Copy)]
pub(super) struct Views<'a> {
    /// Indices in the capture.
    pub frames: &'a [usize],
    pub settings: &'a RenderSettings,
    pub channels: Channels,
}

impl Trainer {
    /// Renders views of the field, or of a `trial` in its stead, as their cameras record them; `each` gets them in
    /// order. Where steps run on a GPU the host is up to date.
    pub(super) fn draw(
        &mut self,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        #[cfg(feature = "wgpu")]
        if self.device.is_some() {
            return self.draw_on_device(trial, views, each);
        }
        for index in views.frames {
            self.check_stop()?;
            let frame = &self.dataset.frames[*index];
            let field = trial.unwrap_or(&self.field);
            let rendered =
                self.renderer.render(field, &frame.camera, frame.time, views.settings, views.channels);
            each(self.recorded(*index, rendered));
        }
        Ok(())
    }

    /// What the camera of a frame makes of a picture.
    pub(super) fn recorded(&self, index: usize, mut rendered: RenderedImage) -> RenderedImage {
        if let Some(exposures) = &self.progress.exposures {
            exposures.at(&self.dataset.frames[index].camera_name).apply(&mut rendered.color);
        }
        rendered
    }
}
