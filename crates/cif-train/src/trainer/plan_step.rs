//! The plan of a step of the run.

use cif_geometry::scalar::logit;
use cif_render::RenderSettings;
use rand::seq::SliceRandom;

use super::{InstancePass, Trainer};
use crate::adam::PlaneWeights;
use crate::config::{Ablation, TrainConfig};
use crate::error::TrainError;
use crate::exposure::RATES;
use crate::optimiser::StepRates;
use crate::random::{Purpose, stream};
use crate::schedule::{log_linear, schedule_steps};
use crate::stage::Stage;
use crate::step::{StepPlan, StepView};

/// Steps between renormalisations of the raw quaternions, which keep their effective rate (row 18).
const RENORMALISE_EVERY: u64 = 1_000;

impl Trainer {
    /// Training view `position` of a stage: every epoch visits all views, in its own order.
    fn view_at(&mut self, stage: Stage, position: u64) -> usize {
        let count = self.state.frames.len() as u64;
        let key = (stage, position / count);
        if self.order.as_ref().is_none_or(|(at, _)| *at != key) {
            let mut order: Vec<u32> = (0..count as u32).collect();
            let counter = (stage as u64) << 48 | key.1;
            order.shuffle(&mut stream(self.state.config.seed, Purpose::Views, counter));
            self.order = Some((key, order));
        }
        let order = self.order.as_ref().map_or(&[][..], |(_, order)| order);
        order[(position % count) as usize] as usize
    }

    /// The plan of a step of a stage, from 1.
    pub(super) fn plan_step(&mut self, stage: Stage, iteration: u32) -> Result<StepPlan, TrainError> {
        let batch = self.state.config.stages.batch;
        let mut views = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let view = self.view_at(stage, u64::from(iteration - 1) * u64::from(batch) + u64::from(k));
            let frame = self.state.frames.get(&self.state.dataset, view)?;
            let index = self.state.frames.index(view);
            let leaves_judged = self.leaves_out_judged(stage, iteration, index);
            views.push(StepView { index, frame, leaves_judged });
        }
        let in_instance_stage = stage == Stage::Instance;
        let with_instances = in_instance_stage && self.instance_pass == InstancePass::On;
        let (config, instance) = (&self.state.config, &self.state.config.instance);
        Ok(StepPlan {
            stage,
            iteration,
            labelled: views.iter().map(|view| view.frame.labelled).sum(),
            views,
            settings: RenderSettings {
                instances: self.state.instance_settings().filter(|_| with_instances),
                ..self.state.color_settings()
            },
            trains_head: with_instances && self.state.value_head().is_some(),
            trains_colors: !in_instance_stage || instance.color_loss,
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
            counts_statistics: matches!(stage, Stage::Coarse | Stage::Fine)
                && iteration < config.densify.until,
            occupancy_limits: (in_instance_stage && !config.ablates(Ablation::ConstantOccupancy))
                .then(|| instance.occupancy_limits.map(logit)),
            calibration_limit: in_instance_stage.then_some(instance.calibration_limit),
            renormalises: (self.state.progress.total_steps + 1).is_multiple_of(RENORMALISE_EVERY),
        })
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
