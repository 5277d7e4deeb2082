//! The plan of a step of the run.

use std::sync::Arc;

use cif_field::parameters::OCCUPANCY_LOGITS;
use cif_geometry::scalar::logit;
use cif_render::RenderSettings;
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;

use super::Trainer;
use crate::adam::PlaneWeights;
use crate::config::{Ablation, TrainConfig};
use crate::effects::is_judged;
use crate::error::TrainError;
use crate::exposure::RATES;
use crate::frames::MOST_AHEAD;
use crate::half_size;
use crate::heads::{CameraBlending, Phase, Target, ValueHead};
use crate::metrics::image::{ssim, unit_color};
use crate::optimiser::StepRates;
use crate::random::{Purpose, stream};
use crate::schedule::{Due, log_linear, may_halve, schedule_steps};
use crate::stage::Stage;
use crate::state::State;
use crate::step::{HeadTarget, InstancePass, StepPlan, StepView};

impl Trainer {
    /// Training views of a stage, those of a head's own cameras where it trains on some alone.
    fn views_of(&self, stage: Stage) -> Vec<u32> {
        let State { frames, dataset, .. } = &self.state;
        let head = self.state.value_head().filter(|_| stage == Stage::Instance);
        let camera = |view: &u32| &dataset.frames[frames.index(*view as usize)].camera_name;
        let all = 0..frames.len() as u32;
        all.filter(|view| head.is_none_or(|head| head.trains_on(camera(view)))).collect()
    }

    /// Training view `position` of a stage: every epoch visits all views, in its own order.
    fn view_at(&mut self, stage: Stage, position: u64) -> usize {
        let views = self.views_of(stage);
        let count = views.len() as u64;
        let key = (stage, position / count);
        if self.order.as_ref().is_none_or(|(at, _)| *at != key) {
            let mut order = views;
            let counter = stream_of(stage) << 48 | key.1;
            order.shuffle(&mut stream(self.state.config.seed, Purpose::Views, counter));
            self.order = Some((key, order));
        }
        let order = self.order.as_ref().map_or(&[][..], |(_, order)| order);
        order[(position % count) as usize] as usize
    }

    /// Has the views from a position of a stage on decoded while the present step is computed, where memory has no room
    /// for all.
    fn expect_views(&mut self, stage: Stage, position: u64, whole: bool) {
        let whole = whole && self.state.whole.is_some();
        let mut coming = Vec::new();
        if whole || self.state.frames.not_kept() > 0 {
            coming.extend((position..).take(MOST_AHEAD).map(|position| self.view_at(stage, position)));
        }
        // Frames of the other size that were begun are given up, with their memory.
        let (of_whole, of_reduced) = if whole { (coming, Vec::new()) } else { (Vec::new(), coming) };
        self.state.frames.expect(of_reduced);
        if let Some(images) = &self.state.whole {
            images.expect(of_whole);
        }
    }

    /// The plan of a step of a stage, from 1.
    pub(super) fn plan_step(&mut self, stage: Stage, iteration: u32) -> Result<StepPlan, TrainError> {
        let batch = self.state.config.stages.batch;
        let at = self.moment(stage, iteration, self.state.progress.total_steps + 1);
        let [halves, sees_whole, holds_out, renormalises] =
            [Due::HalveImages, Due::WholeImages, Due::HoldOut, Due::Renormalise].map(|due| at.has(due));
        let expects_whole = self.moment(stage, iteration.saturating_add(1), 0).has(Due::WholeImages);
        let holds_out = holds_out || self.effects.iter().any(|effect| effect.holds_out(&at));
        let counts_statistics = at.is_of_colors() && self.density.counts_statistics(&at);
        let mut views = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let view = self.view_at(stage, u64::from(iteration - 1) * u64::from(batch) + u64::from(k));
            let index = self.state.frames.index(view);
            let leaves_judged = holds_out && is_judged(&self.state.frames, index);
            // Pixels that are left out are single ones.
            let whole = self.state.whole.as_ref().filter(|_| sees_whole && !leaves_judged);
            let (mut frame, mut camera) = match whole {
                Some(whole) => whole.view(view)?,
                None => (
                    self.state.frames.get(&self.state.dataset, view)?,
                    self.state.dataset.frames[index].camera,
                ),
            };
            if halves && !leaves_judged && may_halve(camera.width, camera.height) {
                (frame, camera) = (Arc::new(half_size::of_frame(&frame)), half_size::of_camera(&camera));
            }
            views.push(StepView { index, frame, camera, leaves_judged });
        }
        self.expect_views(stage, u64::from(iteration) * u64::from(batch), expects_whole);
        let in_instance_stage = stage == Stage::Instance;
        let with_instances = in_instance_stage && self.instance_pass == InstancePass::On;
        let of_head = self.state.value_head().filter(|_| in_instance_stage);
        let phase = of_head.map(|head| head.phase(iteration, self.state.config.stages.instance));
        if let (Some(head), Some(Phase::Head), true) = (of_head, phase, with_instances) {
            let targets = self.head_targets(head, iteration, &views)?;
            return Ok(self.plan_head_step(head, iteration, views, targets));
        }
        let with_instances = with_instances && of_head.is_none();
        let (config, instance) = (&self.state.config, &self.state.config.instance);
        Ok(StepPlan {
            stage,
            iteration,
            labelled: views.iter().map(|view| view.frame.labelled).sum(),
            views,
            settings: RenderSettings {
                instances: self.state.instance_settings().filter(|_| with_instances),
                background: self.state.background.of_steps,
                ..self.state.color_settings()
            },
            trains_head: false,
            head_targets: Vec::new(),
            trains_colors: !in_instance_stage || of_head.is_some() || instance.color_loss,
            pulls: self.guidance_weight(stage, iteration),
            rates: StepRates::at(config, stage, iteration, &self.state.field),
            pose_rate: self.pose_rate(stage, iteration),
            exposure_rate: self
                .state
                .progress
                .exposures
                .is_some()
                .then(|| exposure_rate(config, self.state.progress.total_steps)),
            weights: plane_weights(config),
            visible_rows_only: config.adam.visible_rows_only,
            counts_statistics,
            occupancy_limits: (with_instances && !config.ablates(Ablation::ConstantOccupancy))
                .then(|| instance.occupancy_limits.map(logit)),
            calibration_limit: with_instances.then_some(instance.calibration_limit),
            renormalises,
        })
    }
}

impl Trainer {
    /// The plan of a step that trains a head on the field as it is, but for opacities of its own.
    fn plan_head_step(
        &self,
        head: &dyn ValueHead,
        iteration: u32,
        views: Vec<StepView>,
        head_targets: Vec<HeadTarget>,
    ) -> StepPlan {
        let own = head.own_opacity().map(|own| (OCCUPANCY_LOGITS, own.rate));
        StepPlan {
            stage: Stage::Instance,
            iteration,
            labelled: views.iter().map(|view| view.frame.labelled).sum(),
            views,
            settings: RenderSettings {
                instances: self.state.instance_settings(),
                ..self.state.color_settings()
            },
            trains_head: true,
            head_targets,
            trains_colors: false,
            pulls: [0.0; 2],
            rates: StepRates::uniform(own),
            pose_rate: 0.0,
            exposure_rate: None,
            weights: plane_weights(&self.state.config),
            visible_rows_only: false,
            counts_statistics: false,
            occupancy_limits: None,
            calibration_limit: None,
            renormalises: false,
        }
    }
}

impl Trainer {
    /// Targets of a head in a step: views with masks, or feature maps, and cameras between them where it asks for such.
    fn head_targets(
        &self,
        head: &dyn ValueHead,
        iteration: u32,
        views: &[StepView],
    ) -> Result<Vec<HeadTarget>, TrainError> {
        let frames = &self.state.dataset.frames;
        let shows = |view: &&StepView| match head.target() {
            Target::Labels => view.frame.labels.is_some(),
            Target::Features => view.frame.features.is_some(),
        };
        let shown = || views.iter().filter(shows);
        let mut targets: Vec<HeadTarget> = shown()
            .map(|view| HeadTarget {
                camera: frames[view.index].camera,
                time: frames[view.index].time,
                masks: vec![(Arc::clone(&view.frame), 1.0)],
            })
            .collect();
        let Some(blending) = head.camera_blending() else { return Ok(targets) };
        let mut random = stream(self.state.config.seed, Purpose::HeadCameras, u64::from(iteration));
        for view in shown() {
            targets.extend(self.between(view, &blending, &mut random)?);
        }
        Ok(targets)
    }

    /// A camera between a view and another training view of its time, held to the masks of both; none where there is no
    /// such view.
    fn between(
        &self,
        view: &StepView,
        blending: &CameraBlending,
        random: &mut Pcg64,
    ) -> Result<Option<HeadTarget>, TrainError> {
        let State { frames: store, dataset, .. } = &self.state;
        let here = &dataset.frames[view.index];
        let size = [here.camera.width, here.camera.height];
        let is_partner = |k: &usize| {
            let other = &dataset.frames[store.index(*k)];
            other.time_index == here.time_index
                && other.camera_name != here.camera_name
                && other.mask.is_some()
                && [other.camera.width, other.camera.height] == size
        };
        let partners: Vec<usize> = (0..store.len()).filter(is_partner).collect();
        let [low, high] = blending.ratio;
        let (chosen, ratio) = (random.random::<u64>(), random.random_range(low..high));
        let Some(chosen) = chosen.checked_rem(partners.len() as u64) else { return Ok(None) };
        let partner = partners[chosen as usize];
        let other = store.get(dataset, partner)?;
        let images = [&view.frame.image, &other.image].map(unit_color);
        let weight = blending.weight * ssim(&images[0], &images[1]).max(0.0) as f32;
        let camera = here.camera.toward(&dataset.frames[store.index(partner)].camera, f64::from(ratio));
        let masks = vec![(Arc::clone(&view.frame), weight * (1.0 - ratio)), (other, weight * ratio)];
        Ok(Some(HeadTarget { camera, time: here.time, masks }))
    }
}

/// Number of a stage with steps in the stream that orders its views.
fn stream_of(stage: Stage) -> u64 {
    match stage {
        Stage::Fine => 1,
        Stage::Instance => 3,
        _ => 0,
    }
}

/// Weights of the regularisers of the planes.
pub(super) fn plane_weights(config: &TrainConfig) -> PlaneWeights {
    PlaneWeights {
        smoothness: config.loss.plane_smoothness,
        time_smoothness: config.loss.time_smoothness,
        time_sparsity: config.loss.time_sparsity,
    }
}

/// Learning rate of exposures after so many steps of all stages.
fn exposure_rate(config: &TrainConfig, total_steps: u64) -> f32 {
    let done = u32::try_from(total_steps).unwrap_or(u32::MAX);
    log_linear(RATES, done, schedule_steps(config))
}
