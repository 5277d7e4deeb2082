//! The plan of a step: everything that decides it, as data. What computes the step, and where, is no part of it.

use std::sync::Arc;

use cif_geometry::scalar::logit;
use cif_render::RenderSettings;

use super::frames::TrainFrame;
use super::optimiser::StepRates;
use super::{InstancePass, Trainer};
use crate::adam::PlaneWeights;
use crate::config::{Ablation, TrainConfig};
use crate::error::TrainError;
use crate::events::Stage;
use crate::exposure::RATES;
use crate::schedule::{log_linear, schedule_steps};

/// Steps between renormalisations of the raw quaternions, which keep their effective rate (row 18).
const RENORMALISE_EVERY: u64 = 1_000;

/// A view of a step.
pub(super) struct StepView {
    /// Position among the training views.
    pub view: usize,
    /// Index of its frame in the capture.
    pub index: usize,
    pub frame: Arc<TrainFrame>,
    /// True when the pixels that effects are judged by train nothing.
    pub leaves_judged: bool,
    /// Number of its camera among those whose exposures are learnt.
    pub camera: Option<usize>,
}

/// A step.
pub(super) struct StepPlan {
    pub stage: Stage,
    /// Step of the stage, from 1.
    pub iteration: u32,
    pub views: Vec<StepView>,
    /// Labelled pixels of all views.
    pub labelled: usize,
    /// Settings of views with labels; those without have no instances.
    pub settings: RenderSettings,
    /// False when only the instance loss is differentiated.
    pub trains_colors: bool,
    /// Weights of the pulls to paths, and to where Gaussians are.
    pub pulls: [f32; 2],
    pub rates: StepRates,
    /// Learning rate of the exposures; `None` where none are learnt.
    pub exposure_rate: Option<f32>,
    pub weights: PlaneWeights,
    /// True when only rows that some view shows move.
    pub visible_rows_only: bool,
    /// True when densification counts what the step sees.
    pub counts_statistics: bool,
    /// Limits of the occupancy logits after the step (row 42).
    pub occupancy_limits: Option<[f32; 2]>,
    /// Largest magnitude of a calibration after the step (methods reference 5.3).
    pub calibration_limit: Option<f32>,
    /// True when raw quaternions become unit ones after the step.
    pub renormalises: bool,
    /// Gaussians N.
    pub gaussians: usize,
}

impl StepPlan {
    /// Share of the colour loss that a view has.
    pub(super) fn view_weight(&self) -> f32 {
        1.0 / self.views.len() as f32
    }

    /// Share of the labelled pixels of the step that a view has (A4).
    pub(super) fn label_share(&self, view: &StepView) -> f64 {
        view.frame.labelled as f64 / self.labelled.max(1) as f64
    }
}

impl Trainer {
    /// The plan of a step of a stage, from 1.
    pub(super) fn plan_step(&mut self, stage: Stage, iteration: u32) -> Result<StepPlan, TrainError> {
        let batch = self.config.stages.batch;
        let mut views = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let view = self.view_at(stage, u64::from(iteration - 1) * u64::from(batch) + u64::from(k));
            let frame = self.frames.get(&self.dataset, view)?;
            let index = self.frames.index(view);
            let name = &self.dataset.frames[index].camera_name;
            let camera = self.progress.exposures.as_ref().and_then(|all| all.position(name));
            let leaves_judged = self.leaves_out_judged(stage, iteration, index);
            views.push(StepView { view, index, frame, leaves_judged, camera });
        }
        let in_instance_stage = stage == Stage::Instance;
        let with_instances = in_instance_stage && self.instance_pass == InstancePass::On;
        let (config, instance) = (&self.config, &self.config.instance);
        Ok(StepPlan {
            stage,
            iteration,
            labelled: views.iter().map(|view| view.frame.labelled).sum(),
            views,
            settings: RenderSettings {
                instances: with_instances.then(|| self.instance_settings()),
                ..self.color_settings()
            },
            trains_colors: !in_instance_stage || instance.color_loss,
            pulls: self.guidance_weight(stage, iteration),
            rates: StepRates::at(config, stage, iteration, &self.field),
            exposure_rate: self
                .progress
                .exposures
                .is_some()
                .then(|| exposure_rate(config, self.progress.total_steps)),
            weights: plane_weights(config),
            visible_rows_only: config.adam.visible_rows_only,
            counts_statistics: matches!(stage, Stage::Coarse | Stage::Fine)
                && iteration < config.densify.until,
            occupancy_limits: (in_instance_stage && !config.ablates(Ablation::ConstantOccupancy))
                .then(|| instance.occupancy_limits.map(logit)),
            calibration_limit: in_instance_stage.then_some(instance.calibration_limit),
            renormalises: (self.progress.total_steps + 1).is_multiple_of(RENORMALISE_EVERY),
            gaussians: self.field.gaussians.len(),
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
