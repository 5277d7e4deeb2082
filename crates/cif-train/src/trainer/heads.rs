//! Heads that blend values of their own: where the run gives them the training views, and what they change.

use std::sync::Arc;

use cif_field::checkpoint::TrainingState;
use cif_geometry::scalar::logit;
use cif_render::Blending;
use cif_render::cpu::Renderer;

use super::Trainer;
use crate::engine::Changed;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::heads::{self, Decoder, Pass, TrainingViews};
use crate::phase::Phase;
use crate::random::{Purpose, stream};
use crate::stage::Stage;
use crate::state::State;

impl Trainer {
    /// Starts the head where the instance stage begins, or would begin if it had any steps.
    pub(super) fn prepare_head(&mut self, stage: Stage) -> Result<(), TrainError> {
        let skipped = stage == Stage::Done && self.state.head_tensors.is_empty();
        if (stage != Stage::Instance && !skipped) || self.state.field.identities.is_none() {
            return Ok(());
        }
        let head = Arc::clone(&self.state.head);
        let Some(head) = heads::value_head(&head, &self.state.config) else { return Ok(()) };
        self.fetch()?;
        self.check_cameras()?;
        let _phase = self.state.phases.enter(Phase::Instance, 0);
        let mut tensors = heads::tensors_at_start(head, &self.state.field, self.state.config.seed);
        head.begin(&mut tensors, &mut self.training_views())?;
        if skipped {
            head.finish(&mut tensors, &mut self.training_views())?;
        }
        if let Some(own) = head.own_opacity() {
            self.state.field.gaussians.occupancy_logits.fill(logit(own.start));
        }
        self.state.head_tensors = tensors;
        Ok(())
    }

    /// Concludes what the head has learnt, behind the last step of the instance stage.
    pub(super) fn finish_head(&mut self, stage: Stage) -> Result<(), TrainError> {
        let head = Arc::clone(&self.state.head);
        let Some(head) = heads::value_head(&head, &self.state.config) else { return Ok(()) };
        if stage != Stage::Instance || self.state.head_tensors.is_empty() {
            return Ok(());
        }
        let _phase = self.state.phases.enter(Phase::Instance, 0);
        let mut tensors = self.state.head_tensors.clone();
        head.finish(&mut tensors, &mut self.training_views())?;
        self.state.head_tensors = tensors;
        Ok(())
    }

    /// Changes of the set of Gaussians that the head has behind a step.
    pub(super) fn rearrange_by_head(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let head = Arc::clone(&self.state.head);
        let steps = self.state.config.stages.instance;
        let Some(head) = heads::value_head(&head, &self.state.config).filter(|_| stage == Stage::Instance)
        else {
            return Ok(());
        };
        let parts = head.rearrangements(iteration, steps);
        if parts == 0 {
            return Ok(());
        }
        self.fetch()?;
        let (before, reported) = (self.state.keep(), events.len());
        let mut random = stream(self.state.config.seed, Purpose::HeadRearrangements, u64::from(iteration));
        for part in 0..parts {
            let change = match head.rearrange(part, iteration, steps, &mut self.training_views(), &mut random)
            {
                Ok(Some(change)) => change,
                Ok(None) => continue,
                Err(error) => {
                    self.state.put_back(before);
                    events.truncate(reported);
                    self.engine.changed(Changed::Everything);
                    return Err(error);
                }
            };
            if change.gaussians.is_empty() {
                return Err(TrainError::NoGaussians { stage, iteration });
            }
            let (cloned, split, pruned) = (change.cloned, change.split, change.pruned);
            let unseen = change.parents.iter().map(|row| self.state.unseen[*row as usize]).collect();
            let rows = self.state.field.identities.as_ref().map(|rows| rows.gather(&change.parents));
            self.rearrange(change);
            self.state.unseen = unseen;
            self.state.field.identities = rows;
            self.state.optimiser.start_identities(&self.state.field);
            self.state.gradients = cif_render::Gradients::zeros(&self.state.field);
            let gaussians = self.state.field.len();
            events.push(TrainEvent::Densified { stage, iteration, cloned, split, pruned, gaussians });
        }
        self.engine.changed(Changed::Everything);
        Ok(())
    }

    /// Tensors that a finished scene keeps of a head.
    pub(super) fn saved_decoder(&self) -> Option<TrainingState> {
        let is_configured = self.state.head.name() == self.state.config.head.name.name();
        let has_values = matches!(self.state.head.pass(&self.state.config), Pass::Values(_));
        let done = self.state.progress.stage == Stage::Done && !self.state.head_tensors.is_empty();
        (is_configured && has_values && done)
            .then(|| Decoder::save(&self.state.config.head, &self.state.head_tensors))
    }

    /// The head as it decodes pixels of the trained field, once a run has returned; `None` where identity rows give
    /// the labels.
    #[must_use]
    pub fn decoder(&self) -> Option<Decoder> {
        Decoder::of_scene(&self.state.field, &self.saved_decoder()?).ok()
    }

    /// True where labels of a finished scene are blended by its opacities.
    pub(super) fn labels_by_opacity(&self) -> bool {
        let head = self.state.value_head().filter(|_| self.state.progress.stage == Stage::Done);
        head.is_some_and(|head| head.blending() == Blending::Color)
    }

    fn training_views(&self) -> TrainingViews<'_> {
        let State { field, dataset, frames, phases, .. } = &self.state;
        let (settings, renderer) = (self.state.color_settings(), Renderer::new(self.simd));
        TrainingViews { field, dataset, frames, phases, settings, renderer }
    }

    /// Refuses a camera for training that the capture has not.
    fn check_cameras(&self) -> Result<(), TrainError> {
        let State { frames, dataset, .. } = &self.state;
        let names = (0..frames.len()).map(|view| &dataset.frames[frames.index(view)].camera_name);
        let Some(head) = self.state.value_head() else { return Ok(()) };
        if names.clone().any(|name| head.trains_on(name)) {
            return Ok(());
        }
        let names: std::collections::BTreeSet<&str> = names.map(String::as_str).collect();
        Err(TrainError::NoSuchCamera {
            camera: self.state.config.head.camera.clone(),
            cameras: names.into_iter().collect::<Vec<_>>().join(", "),
        })
    }
}
