//! One optimiser step.

use std::time::Instant;

use cif_field::parameters::{MLP, OPACITY_LOGITS};
use cif_geometry::scalar::logit;
use cif_geometry::{PixelGrid, quaternion};
use cif_render::{Gradients, InstanceSettings, OccupancySource, RenderSettings};
use rand::seq::SliceRandom;

use super::earned::leave_out_held_out;
use super::guard::{exposure_fault, gradient_fault};
use super::optimiser::StepRates;
use super::progress::AfterStep;
use super::times::lap;
use super::{InstancePass, Trainer};
use crate::adam::PlaneWeights;
use crate::config::{Ablation, TrainConfig};
use crate::densify::{DensifyStatistics, Rearrangement, add_gaussians, prune, reset_opacities};
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::exposure::RATES;
use crate::losses::{SsimScratch, color_loss};
use crate::random::{Purpose, stream};
use crate::resample::{ResampleContext, apply, plan};
use crate::schedule::{falls_on, log_linear, schedule_steps};

/// Steps between renormalisations of the raw quaternions, which keep their effective rate (row 18).
pub(super) const RENORMALISE_EVERY: u64 = 1_000;

/// Learning rate of exposures after so many steps of all stages.
pub(super) fn exposure_rate(config: &TrainConfig, total_steps: u64) -> f32 {
    let done = u32::try_from(total_steps).unwrap_or(u32::MAX);
    log_linear(RATES, done, schedule_steps(config))
}

/// Memory kept between steps.
pub(super) struct Scratch {
    pub(super) v_color: PixelGrid<[f32; 3]>,
    ssim: SsimScratch,
    /// Order of the training views of an epoch, by stage and epoch.
    order: Option<((Stage, u64), Vec<u32>)>,
}

impl Scratch {
    pub(super) fn new() -> Self {
        Self { v_color: PixelGrid::filled(0, 0, [0.0; 3]), ssim: SsimScratch::default(), order: None }
    }
}

/// What a step measured.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StepLoss {
    pub color: f64,
    pub instance: Option<f64>,
    pub unsupported: Option<f64>,
    pub total: f64,
}

impl Trainer {
    /// Settings of the instance pass.
    pub(super) fn instance_settings(&self) -> InstanceSettings {
        InstanceSettings {
            occupancy: if self.config.ablates(Ablation::OpacityOccupancy) {
                OccupancySource::Opacity
            } else {
                OccupancySource::Own
            },
            geometry: self.config.instance.geometry.into(),
            normalisation: self.config.instance.normalisation.into(),
        }
    }

    /// Settings of a view without instances.
    pub(super) fn color_settings(&self) -> RenderSettings {
        RenderSettings {
            sh_degree: self.field.sh_degree,
            background: self.config.background,
            near: self.config.near,
            antialiased: self.config.antialiased,
            sort_metric: self.config.sort_metric,
            deform: self.field.deformation.is_some(),
            instances: None,
        }
    }

    /// Training view `position` of a stage: every epoch visits all views, in its own order.
    pub(super) fn view_at(&mut self, stage: Stage, position: u64) -> usize {
        let count = self.frames.len() as u64;
        let key = (stage, position / count);
        if self.scratch.order.as_ref().is_none_or(|(at, _)| *at != key) {
            let mut order: Vec<u32> = (0..count as u32).collect();
            let counter = (stage as u64) << 48 | key.1;
            order.shuffle(&mut stream(self.config.seed, Purpose::Views, counter));
            self.scratch.order = Some((key, order));
        }
        let order = self.scratch.order.as_ref().map_or(&[][..], |(_, order)| order);
        order[(position % count) as usize] as usize
    }

    /// Renders the step's views forward and backward, then moves the parameters.
    pub(super) fn step(&mut self, events: &mut Vec<TrainEvent>) -> Result<StepLoss, TrainError> {
        #[cfg(feature = "wgpu")]
        if self.device.is_some() {
            return self.device_step(events);
        }
        let start = Instant::now();
        let stage = self.progress.stage;
        let iteration = self.progress.iteration + 1;
        let batch = self.config.stages.batch;
        if matches!(stage, Stage::Coarse | Stage::Fine) {
            self.judge_sh(stage, iteration, events)?;
            self.field.sh_degree = self.degree_at(iteration);
        }
        let mut views = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let view = self.view_at(stage, u64::from(iteration - 1) * u64::from(batch) + u64::from(k));
            views.push((self.frames.index(view), self.frames.get(&self.dataset, view)?));
        }
        let settings = RenderSettings {
            instances: (stage == Stage::Instance && self.instance_pass == InstancePass::On)
                .then(|| self.instance_settings()),
            ..self.color_settings()
        };
        // Rendering between steps, for scores and identities, is no part of them.
        self.renderer.reset_times();
        let labelled: usize = views.iter().map(|(_, frame)| frame.labelled).sum();
        let weight = 1.0 / batch as f32;
        let mut loss = StepLoss::default();
        let (mut instance_loss, mut unsupported) = (0.0, 0.0);
        let pull = self.guidance_weight(stage, iteration);
        let (psnr_before, snapshot) = (self.progress.psnr, self.snapshot());
        let mut fault = self.fault_before_step();
        for (index, data) in &views {
            if fault.is_some() {
                break;
            }
            let frame = &self.dataset.frames[*index];
            let time = frame.time;
            let labels = data.labels.as_ref().filter(|_| data.labelled > 0);
            let with_instances = settings.instances.is_some() && labels.is_some();
            let settings =
                RenderSettings { instances: settings.instances.filter(|_| with_instances), ..settings };
            let labels = labels.filter(|_| with_instances);
            let pass = self.renderer.forward(&self.field, &frame.camera, time, &settings, labels);
            let mut since = Instant::now();
            let exposure = self.progress.exposures.as_ref().map(|all| all.at(&frame.camera_name));
            let recorded = exposure.map(|exposure| {
                let mut recorded = pass.color.clone();
                exposure.apply(&mut recorded);
                recorded
            });
            let color = color_loss(
                recorded.as_ref().unwrap_or(&pass.color),
                &data.image,
                self.config.loss.lambda_dssim,
                weight,
                &mut self.scratch.v_color,
                &mut self.scratch.ssim,
            );
            lap(&mut self.times.losses, &mut since);
            loss.color += color.loss * f64::from(weight);
            self.progress.add_psnr(color.psnr());
            if stage == Stage::Instance && !self.config.instance.color_loss {
                self.scratch.v_color.pixels.fill([0.0; 3]);
            }
            if stage == Stage::Coarse {
                self.leave_out_travelling(data);
            }
            if self.leaves_out_judged(stage, iteration, *index) {
                leave_out_held_out(&mut self.scratch.v_color);
            }
            if let (Some(exposure), Some(all)) = (exposure, &mut self.progress.exposures) {
                let gradient = exposure.pull_back(&pass.color, &mut self.scratch.v_color);
                all.add(&self.dataset.frames[*index].camera_name, &gradient);
            }
            // The mean is over the labelled pixels of all views of the step (A4).
            let share = if with_instances { data.labelled as f64 / labelled as f64 } else { 0.0 };
            instance_loss += share * pass.instance_loss;
            unsupported += pass.unsupported_pixels as f64;
            fault = self.fault_of_view(color.loss, pass.instance_loss);
            if fault.is_some() {
                break;
            }
            let instance_weight = (share * f64::from(self.config.loss.lambda_instance)) as f32;
            let v_displacements = self.displacement_gradients(time, pull);
            self.renderer.backward_displaced(
                &self.field,
                &self.scratch.v_color,
                instance_weight,
                &v_displacements,
                &mut self.gradients,
            );
            fault = self.fault_of_backward();
            let statistics = self.renderer.statistics();
            self.times.add_view(self.field.gaussians.len(), &statistics);
            self.progress.work.add_view(self.field.gaussians.len(), &statistics);
        }
        self.times.add_render(&self.renderer.times());
        loss.total = loss.color;
        if stage == Stage::Instance && labelled > 0 {
            loss.instance = Some(instance_loss);
            loss.unsupported = Some(unsupported / labelled as f64);
            loss.total += f64::from(self.config.loss.lambda_instance) * instance_loss;
        }
        let rates = StepRates::at(&self.config, stage, iteration, &self.field);
        let weights = PlaneWeights {
            smoothness: self.config.loss.plane_smoothness,
            time_smoothness: self.config.loss.time_smoothness,
            time_sparsity: self.config.loss.time_sparsity,
        };
        fault = fault
            .or_else(|| gradient_fault(&self.gradients, &rates))
            .or_else(|| exposure_fault(self.progress.exposures.as_ref()));
        if fault.is_none() {
            if matches!(stage, Stage::Coarse | Stage::Fine) && iteration < self.config.densify.until {
                self.statistics.add(&self.gradients);
            }
            self.optimiser
                .step(
                    &mut self.field,
                    &mut self.gradients,
                    &rates,
                    &weights,
                    self.config.adam.visible_rows_only,
                    &mut self.times,
                )
                .map_err(|parameter| self.not_finite(parameter.name))?;
            fault = self.fault_after_step();
        }
        if let Some(exposures) = &mut self.progress.exposures {
            if fault.is_none() {
                exposures.step(exposure_rate(&self.config, self.progress.total_steps));
            } else {
                exposures.reset();
            }
        }
        match fault {
            Some(fault) => self.roll_back(fault, snapshot, psnr_before, events)?,
            None => self.progress.rollbacks.in_a_row = 0,
        }
        self.gradients.screen.fill([0.0; 2]);
        self.gradients.radii.fill(0.0);

        self.progress.count_step();
        self.keep_in_range(stage);
        let mut since = Instant::now();
        self.progress.after_step = Some(AfterStep::Changes);
        self.finish_step(stage, events)?;
        lap(&mut self.times.rearrange, &mut since);
        self.times.total += start.elapsed();
        self.times.steps += 1;
        Ok(loss)
    }

    /// What changes the field behind a step, from where a stop cut it short.
    pub(super) fn finish_step(
        &mut self,
        stage: Stage,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let iteration = self.progress.iteration;
        if self.progress.after_step == Some(AfterStep::Changes) {
            match stage {
                Stage::Instance => self.instance_events(iteration, events)?,
                _ => self.densify(stage, iteration, events)?,
            }
            self.progress.after_step = Some(AfterStep::Heads);
        }
        if self.progress.after_step == Some(AfterStep::Heads) {
            if self.judges_heads(stage, iteration) {
                self.wholly(events, |trainer, events| trainer.judge_heads(stage, iteration, events))?;
            }
            self.progress.after_step = Some(AfterStep::Still);
        }
        if self.progress.after_step == Some(AfterStep::Still) {
            if self.settles(stage, iteration) {
                self.wholly(events, |trainer, events| trainer.settle(stage, iteration, events))?;
            }
            self.progress.after_step = None;
        }
        Ok(())
    }

    /// Does work that judges the field, or leaves everything as it was when that fails or is stopped.
    fn wholly(
        &mut self,
        events: &mut Vec<TrainEvent>,
        work: impl FnOnce(&mut Self, &mut Vec<TrainEvent>) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let told = events.len();
        let before = (self.field.clone(), self.optimiser.of(&MLP).clone(), self.progress.still_rung);
        let result = work(self, events);
        if result.is_err() {
            (self.field, *self.optimiser.of(&MLP), self.progress.still_rung) = before;
            self.gradients = Gradients::zeros(&self.field);
            events.truncate(told);
        }
        result
    }

    fn not_finite(&mut self, tensor: &'static str) -> TrainError {
        // Leftovers of the failed step must not reach another one.
        self.gradients.reset();
        TrainError::NotFinite { stage: self.progress.stage, iteration: self.progress.iteration + 1, tensor }
    }

    /// Limits of occupancy (row 42) and calibration (5.3), and unit quaternions now and then (row 18).
    fn keep_in_range(&mut self, stage: Stage) {
        if stage == Stage::Instance {
            let [low, high] = self.config.instance.occupancy_limits.map(logit);
            if !self.config.ablates(Ablation::ConstantOccupancy) {
                for value in &mut self.field.gaussians.occupancy_logits {
                    *value = value.clamp(low, high);
                }
            }
            let limit = self.config.instance.calibration_limit;
            if let Some(identities) = &mut self.field.identities {
                for value in &mut identities.log_calibrations {
                    *value = value.clamp(-limit, limit);
                }
            }
        }
        if self.progress.total_steps.is_multiple_of(RENORMALISE_EVERY) {
            for raw in &mut self.field.gaussians.quaternions {
                if let Some(unit) = quaternion::try_normalize(*raw) {
                    *raw = unit;
                }
            }
        }
    }

    /// Pruning, additions and opacity resets that fall on this step.
    pub(super) fn densify(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let config = self.config.densify.clone();
        if iteration >= config.until {
            return Ok(());
        }
        let extent = self.field.extent;
        let (mut cloned, mut split, mut pruned) = (0, 0, 0);
        if iteration > config.from && falls_on(iteration, config.prune_every) {
            let reset = self.progress.opacities_were_reset;
            if let Some(change) = prune(&self.field.gaussians, &self.statistics, &config, extent, reset) {
                if change.gaussians.is_empty() {
                    return Err(TrainError::NoGaussians { stage, iteration });
                }
                pruned = change.pruned;
                self.rearrange(change);
            }
        }
        if iteration > config.from && falls_on(iteration, config.every) {
            let mut rng = stream(self.config.seed, Purpose::Split, self.progress.total_steps);
            let change = add_gaussians(&self.field.gaussians, &self.statistics, &config, extent, &mut rng);
            if let Some(change) = change {
                (cloned, split) = (change.cloned, change.split);
                self.rearrange(change);
            }
            self.statistics = DensifyStatistics::zeros(self.field.gaussians.len());
        }
        if falls_on(iteration, config.opacity_reset_every) {
            reset_opacities(&mut self.field.gaussians, config.opacity_reset_to);
            self.optimiser.of(&OPACITY_LOGITS).reset_all();
            self.progress.opacities_were_reset = true;
        }
        if cloned + split + pruned > 0 {
            let gaussians = self.field.gaussians.len();
            events.push(TrainEvent::Densified { stage, iteration, cloned, split, pruned, gaussians });
        }
        Ok(())
    }

    /// Replaces the set of Gaussians, and everything that has a row per Gaussian.
    fn rearrange(&mut self, change: Rearrangement) {
        #[cfg(feature = "wgpu")]
        let follows = self.follows_on_device(&change);
        #[cfg(not(feature = "wgpu"))]
        let follows = false;
        if follows {
            #[cfg(feature = "wgpu")]
            self.optimiser.resize(change.origins.len());
        } else {
            self.optimiser.gather(&change.origins);
        }
        self.statistics.gather(&change.origins);
        self.guidance.gather(&change.parents);
        self.gather_still(&change.parents);
        self.field.gaussians = change.gaussians;
        self.gradients = Gradients::zeros(&self.field);
    }

    /// Refreshed estimates and relocations that fall on this step.
    pub(super) fn instance_events(
        &mut self,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let last = self.plan.iterations(&self.config, Stage::Instance);
        if falls_on(iteration, self.config.identity.refresh_every) && iteration < last {
            let event = self.estimate_identities(false)?;
            events.push(event);
        }
        let config = &self.config.resample;
        let falls = falls_on(iteration, config.every) && (config.from..=config.until).contains(&iteration);
        if !falls || iteration >= last || self.config.ablates(Ablation::NoResampling) {
            return Ok(());
        }
        let context = ResampleContext {
            config,
            unseen: &self.unseen,
            label_pixels: &self.label_pixels,
            opacity_is_occupancy: self.config.ablates(Ablation::OpacityOccupancy),
            occupancy_is_constant: self.config.ablates(Ablation::ConstantOccupancy),
            occupancy_floor: self.config.instance.occupancy_limits[0],
        };
        let mut rng = stream(self.config.seed, Purpose::Resample, u64::from(iteration));
        let plan = plan(&self.field, &context, &mut rng);
        if plan.pairs.is_empty() {
            return Ok(());
        }
        let relocated = apply(&mut self.field, &plan, &context, &mut rng);
        #[cfg(feature = "wgpu")]
        self.relocates_on_device(&plan.pairs);
        self.optimiser.relocate(&relocated.weak, &relocated.sources, &relocated.entry_origins);
        for pair in &plan.pairs {
            self.guidance.copy(pair.weak, pair.source);
            self.copy_still(pair.weak, pair.source);
            self.unseen[pair.weak as usize] = self.unseen[pair.source as usize];
        }
        self.gradients = Gradients::zeros(&self.field);
        events.push(TrainEvent::Resampled {
            iteration,
            pairs: plan.pairs.len(),
            labels: plan.labels,
            sources: relocated.sources.len(),
            floored: relocated.floored,
        });
        Ok(())
    }
}
