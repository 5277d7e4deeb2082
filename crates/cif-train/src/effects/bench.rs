//! Evidence for effects: errors of the field, and of trials in its stead, on pixels that train nothing.

use cif_field::Field;
use cif_render::cpu::SimdLevel;
use cif_render::{Channels, RenderSettings};

use super::changes::Changes;
use crate::config::TrainConfig;
use crate::engine::failure::draw;
use crate::engine::{Changed, Engine, Views};
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::frames::FrameStore;
use crate::losses::held_out::held_out;
use crate::schedule::{Facts, Moment};
use crate::stage::Stage;
use crate::state::State;

/// Views that are compared.
const VIEWS: usize = 8;

/// Training views that are judged by, evenly spread.
fn judged_views(views: usize) -> impl Iterator<Item = usize> {
    let count = views.min(VIEWS);
    (0..count).map(move |k| k * views / count)
}

/// True where a frame of the capture is one of those that effects are judged by.
pub(crate) fn is_judged(frames: &FrameStore, frame: usize) -> bool {
    judged_views(frames.len()).any(|view| frames.index(view) == frame)
}

/// The step that a judgement falls on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    pub stage: Stage,
    /// Step of the stage, from 1.
    pub iteration: u32,
    /// Steps of all stages up to this one.
    pub total: u64,
    pub facts: Facts,
}

/// A run at a judgement.
pub struct Bench<'a> {
    pub(crate) step: Step,
    pub(crate) state: &'a mut State,
    pub(crate) engine: &'a mut Box<dyn Engine>,
    pub(crate) simd: SimdLevel,
    /// Where cameras that stay in place see changes, once that was asked.
    pub(crate) changes: &'a mut Option<Changes>,
    pub(crate) events: &'a mut Vec<TrainEvent>,
}

impl Bench<'_> {
    /// The step, as the schedule sees it.
    #[must_use]
    pub fn moment(&self) -> Moment<'_> {
        let Step { stage, iteration, total, facts } = self.step;
        Moment { config: &self.state.config, stage, iteration, total, facts }
    }

    /// The run's settings.
    #[must_use]
    pub fn config(&self) -> &TrainConfig {
        &self.state.config
    }

    /// The field as it is.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.state.field
    }

    /// Mean squared colour error of the field, or of a `trial` in its stead, over the held-out pixels of evenly spread
    /// training views; colours are in [0, 1].
    ///
    /// # Errors
    /// When a frame cannot be read, the engine fails, or the run is to stop.
    pub fn error(&mut self, trial: Option<&Field>) -> Result<f64, TrainError> {
        let settings = self.state.color_settings();
        self.error_with(trial, &settings)
    }

    /// The same with other settings of a view.
    pub(crate) fn error_with(
        &mut self,
        trial: Option<&Field>,
        settings: &RenderSettings,
    ) -> Result<f64, TrainError> {
        Ok(self.errors(trial, settings)?.all.mean())
    }

    /// The same of all pixels, and of those of each label.
    pub(crate) fn errors(
        &mut self,
        trial: Option<&Field>,
        settings: &RenderSettings,
    ) -> Result<JudgedErrors, TrainError> {
        let state = &mut *self.state;
        let views: Vec<usize> = judged_views(state.frames.len()).collect();
        let frames: Vec<usize> = views.iter().map(|view| state.frames.index(*view)).collect();
        let mut truth = Vec::with_capacity(views.len());
        for view in views {
            truth.push(state.frames.get(&state.dataset, view)?);
        }
        let labels = state.field.instances.len() + 1;
        let mut errors =
            JudgedErrors { all: SquaredError::default(), of_labels: vec![SquaredError::default(); labels] };
        let channels = Channels { depth: false, instances: false };
        let mut truth = truth.iter();
        let views = Views { frames: &frames, whole: false, settings, channels };
        draw(self.engine, state, self.simd, trial, views, &mut |rendered| {
            let Some(data) = truth.next() else { return };
            for pixel in held_out(data.image.width, data.image.height) {
                let label = data.labels.as_ref().map_or(0, |labels| labels.pixels[pixel]);
                for channel in 0..3 {
                    let target = f64::from(data.image.pixels[pixel][channel]) / 255.0;
                    let difference = f64::from(rendered.color.pixels[pixel][channel]) - target;
                    errors.all.add(difference);
                    errors.of_labels[usize::from(label)].add(difference);
                }
            }
        })?;
        Ok(errors)
    }

    /// Reports a judgement: `what` was judged, in words, its gain on held-out pixels, dB, and whether it stays.
    pub fn report(&mut self, what: String, gain_db: f64, kept: bool) {
        let Step { stage, iteration, .. } = self.step;
        self.events.push(TrainEvent::Judged { stage, iteration, what, gain_db, kept });
    }

    /// Goes on with a trial in place of the field.
    ///
    /// # Panics
    /// When it has another number of Gaussians, or another network, than the field.
    pub fn take(&mut self, trial: Field) {
        assert_eq!(trial.len(), self.state.field.len(), "a judgement keeps the set of Gaussians");
        let network = |field: &Field| field.deformation.as_ref().map(|network| network.mlp.len());
        assert_eq!(network(&trial), network(&self.state.field), "a judgement keeps the network");
        self.state.field = trial;
        self.engine.changed(Changed::Everything);
    }
}

/// A mean of squares under way.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SquaredError {
    sum: f64,
    values: u64,
}

impl SquaredError {
    pub(crate) fn add(&mut self, difference: f64) {
        self.sum += difference.powi(2);
        self.values += 1;
    }

    pub(crate) fn sum(&self) -> f64 {
        self.sum
    }

    /// 0 without values.
    pub(crate) fn mean(&self) -> f64 {
        self.sum / self.values.max(1) as f64
    }
}

/// Squared colour errors of held-out pixels.
#[derive(Clone, Debug)]
pub(crate) struct JudgedErrors {
    pub(crate) all: SquaredError,
    /// By label: dense index + 1, or 0.
    pub(crate) of_labels: Vec<SquaredError>,
}

/// Gain of a smaller error, dB.
pub(crate) fn gain(without: f64, with: f64) -> f64 {
    10.0 * (without.max(1e-12) / with.max(1e-12)).log10()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_pixel_of_sixty_four_is_held_out() {
        let pixels: Vec<usize> = held_out(64, 48).collect();
        assert_eq!(pixels.len(), 64 * 48 / 64);
        assert_eq!(pixels[0], 5 * 64 + 3);
        assert!(held_out(3, 5).next().is_none(), "tiny images have none");
    }

    #[test]
    fn few_of_many_views_are_judged_by() {
        assert_eq!(judged_views(3).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(judged_views(80).collect::<Vec<_>>(), [0, 10, 20, 30, 40, 50, 60, 70]);
        assert_eq!(judged_views(0).count(), 0);
    }

    #[test]
    fn a_smaller_error_is_a_gain() {
        assert!((gain(0.02, 0.01) - 3.0103).abs() < 1e-3);
        assert_eq!(gain(0.0, 0.0), 0.0);
        assert!(gain(0.01, 0.02) < 0.0);
    }
}
