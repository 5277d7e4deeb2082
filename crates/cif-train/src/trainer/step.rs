//! One optimiser step, and what changes the field behind it.

use std::time::Instant;

use cif_field::parameters::{MLP, OPACITY_LOGITS};
use cif_geometry::{PixelGrid, quaternion};
use cif_render::{Gradients, InstanceSettings, OccupancySource, RenderSettings};
use rand::seq::SliceRandom;

use super::Trainer;
use super::guard::{Fault, exposure_fault, gradient_fault};
use super::judged::leave_out_held_out;
use super::progress::AfterStep;
use super::step_plan::{StepPlan, StepView};
use super::times::lap;
use crate::config::Ablation;
use crate::densify::{DensifyStatistics, Rearrangement, add_gaussians, prune, reset_opacities};
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::losses::{SsimScratch, color_loss};
use crate::random::{Purpose, stream};
use crate::resample::{ResampleContext, apply, choose};
use crate::schedule::Due;

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

/// Losses of a step.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StepLoss {
    /// Mean over the views.
    pub color: f64,
    /// Mean over the labelled pixels of all views.
    pub instance: Option<f64>,
    /// Share of them that no covering Gaussian supports.
    pub unsupported: Option<f64>,
    /// The sum that is minimised.
    pub total: f64,
}

/// Measurements of a view of a step.
#[derive(Clone, Copy, Debug)]
pub(super) struct ViewReport {
    /// Of the picture.
    pub psnr: f64,
    /// Mean over the pixels of the view.
    pub color_loss: f64,
    /// Summed over its labelled pixels.
    pub instance_loss: f64,
    /// Labelled pixels that no covering Gaussian supports.
    pub unsupported: f64,
}

impl StepLoss {
    /// Of the views of a step; `lambda_instance` weighs the instance loss.
    pub(super) fn new(plan: &StepPlan, views: &[ViewReport], lambda_instance: f32) -> Self {
        let sum = |of: fn(&ViewReport) -> f64| views.iter().map(of).sum::<f64>();
        let is_labelled = plan.stage == Stage::Instance && plan.labelled > 0;
        let of_labelled = |sum: f64| is_labelled.then(|| sum / plan.labelled as f64);
        let color = sum(|view| view.color_loss) * f64::from(plan.view_weight());
        let instance = of_labelled(sum(|view| view.instance_loss));
        Self {
            color,
            instance,
            unsupported: of_labelled(sum(|view| view.unsupported)),
            total: color + f64::from(lambda_instance) * instance.unwrap_or(0.0),
        }
    }
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

    /// A step, and what the schedule has behind it. Where steps run ahead on a GPU, the loss is that of the last step
    /// that has arrived.
    pub(super) fn step(&mut self, events: &mut Vec<TrainEvent>) -> Result<StepLoss, TrainError> {
        let result = self.try_step(events);
        #[cfg(feature = "wgpu")]
        {
            events.append(&mut self.arrived);
            result.map_err(|error| self.device_failed(error))
        }
        #[cfg(not(feature = "wgpu"))]
        result
    }

    fn try_step(&mut self, events: &mut Vec<TrainEvent>) -> Result<StepLoss, TrainError> {
        let start = Instant::now();
        let (stage, iteration) = (self.progress.stage, self.progress.iteration + 1);
        if self.judges_sh(stage, iteration) {
            self.fetch_from_gpu()?;
            self.judge_sh(stage, iteration, events)?;
        }
        if matches!(stage, Stage::Coarse | Stage::Fine) {
            self.field.sh_degree = self.degree_at(iteration);
        }
        #[cfg(feature = "wgpu")]
        let on_device = self.step_on_device(events)?;
        #[cfg(not(feature = "wgpu"))]
        let on_device = None;
        let loss = match on_device {
            Some(loss) => loss,
            None => {
                let plan = self.plan_step(stage, iteration)?;
                let loss = self.step_on_processor(&plan, events)?;
                self.progress.count_step();
                self.keep_in_range(&plan);
                loss
            }
        };
        let mut since = Instant::now();
        self.progress.after_step = Some(AfterStep::Changes);
        self.finish_step(stage, events)?;
        lap(&mut self.times.rearrange, &mut since);
        self.times.total += start.elapsed();
        self.times.steps += 1;
        Ok(loss)
    }

    /// Renders the views of a step forward and backward, then moves the parameters.
    fn step_on_processor(
        &mut self,
        plan: &StepPlan,
        events: &mut Vec<TrainEvent>,
    ) -> Result<StepLoss, TrainError> {
        // Rendering between steps, for scores and identities, is no part of them.
        self.renderer.reset_times();
        let snapshot = self.snapshot();
        let mut reports = Vec::with_capacity(plan.views.len());
        let fault = self.attempt(plan, &mut reports)?;
        let loss = StepLoss::new(plan, &reports, self.config.loss.lambda_instance);
        match fault {
            Some(fault) => self.roll_back(fault, snapshot, events)?,
            None => self.take_in(&reports),
        }
        Ok(loss)
    }

    /// Takes in the views of a step that was taken.
    pub(super) fn take_in(&mut self, views: &[ViewReport]) {
        views.iter().for_each(|view| self.progress.add_psnr(view.psnr));
        self.progress.rollbacks.in_a_row = 0;
    }

    /// The step itself, which moves nothing when it meets a fault, or is undone by the caller when that shows late.
    pub(super) fn attempt(
        &mut self,
        plan: &StepPlan,
        reports: &mut Vec<ViewReport>,
    ) -> Result<Option<Fault>, TrainError> {
        let mut fault = self.fault_before_step();
        for view in &plan.views {
            if fault.is_some() {
                break;
            }
            fault = self.view(plan, view, reports);
        }
        self.times.add_render(&self.renderer.times());
        fault = fault
            .or_else(|| gradient_fault(&self.gradients, &plan.rates))
            .or_else(|| exposure_fault(self.progress.exposures.as_ref()));
        if fault.is_none() {
            if plan.counts_statistics {
                self.statistics.add(&self.gradients);
            }
            self.optimiser
                .step(
                    &mut self.field,
                    &mut self.gradients,
                    &plan.rates,
                    &plan.weights,
                    plan.visible_rows_only,
                    &mut self.times,
                )
                .map_err(|parameter| self.not_finite(parameter.name))?;
            fault = self.fault_after_step();
        }
        if let Some(exposures) = &mut self.progress.exposures {
            match plan.exposure_rate.filter(|_| fault.is_none()) {
                Some(rate) => exposures.step(rate),
                None => exposures.reset(),
            }
        }
        self.gradients.screen.fill([0.0; 2]);
        self.gradients.radii.fill(0.0);
        Ok(fault)
    }

    /// A view of a step, forward and backward.
    fn view(&mut self, plan: &StepPlan, view: &StepView, reports: &mut Vec<ViewReport>) -> Option<Fault> {
        let frame = &self.dataset.frames[view.index];
        let (time, data) = (frame.time, &*view.frame);
        let with_instances = plan.settings.instances.is_some() && data.labelled > 0;
        let labels = data.labels.as_ref().filter(|_| with_instances);
        let with_instances = labels.is_some();
        let settings =
            RenderSettings { instances: plan.settings.instances.filter(|_| with_instances), ..plan.settings };
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
            plan.view_weight(),
            &mut self.scratch.v_color,
            &mut self.scratch.ssim,
        );
        lap(&mut self.times.losses, &mut since);
        let labelled = if with_instances { data.labelled as f64 } else { 0.0 };
        reports.push(ViewReport {
            psnr: color.psnr(),
            color_loss: color.loss,
            instance_loss: labelled * pass.instance_loss,
            unsupported: pass.unsupported_pixels as f64,
        });
        if !plan.trains_colors {
            self.scratch.v_color.pixels.fill([0.0; 3]);
        }
        if plan.stage == Stage::Coarse {
            self.leave_out_travelling(data);
        }
        if view.leaves_judged {
            leave_out_held_out(&mut self.scratch.v_color);
        }
        if let (Some(exposure), Some(all)) = (exposure, &mut self.progress.exposures) {
            let gradient = exposure.pull_back(&pass.color, &mut self.scratch.v_color);
            all.add(&self.dataset.frames[view.index].camera_name, &gradient);
        }
        if let Some(fault) = self.fault_of_view(color.loss, pass.instance_loss) {
            return Some(fault);
        }
        let share = if with_instances { plan.label_share(view) } else { 0.0 };
        let instance_weight = (share * f64::from(self.config.loss.lambda_instance)) as f32;
        let v_displacements = self.displacement_gradients(time, plan.pulls);
        self.renderer.backward_displaced(
            &self.field,
            &self.scratch.v_color,
            instance_weight,
            &v_displacements,
            &mut self.gradients,
        );
        let fault = self.fault_of_backward();
        let statistics = self.renderer.statistics();
        self.times.add_view(self.field.gaussians.len(), &statistics);
        self.progress.work.add_view(self.field.gaussians.len(), &statistics);
        fault
    }

    /// What changes the field behind a step, from where a stop cut it short.
    pub(super) fn finish_step(
        &mut self,
        stage: Stage,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let iteration = self.progress.iteration;
        let due = Due::after(&self.config, stage, iteration, self.stages.iterations(&self.config, stage));
        let judges = [self.judges_heads(stage, iteration), self.settles(stage, iteration)];
        #[cfg(feature = "wgpu")]
        if judges.contains(&true) || due.estimates_identities || self.device_is_far_ahead() {
            self.fetch_from_device()?;
        }
        if self.progress.after_step == Some(AfterStep::Changes) {
            if due.changes_gaussians() {
                self.change_gaussians(stage, iteration, &due, events)?;
            }
            self.progress.after_step = Some(AfterStep::Heads);
        }
        if self.progress.after_step == Some(AfterStep::Heads) {
            if judges[0] {
                self.wholly(events, |trainer, events| trainer.judge_heads(stage, iteration, events))?;
            }
            self.progress.after_step = Some(AfterStep::Still);
        }
        if self.progress.after_step == Some(AfterStep::Still) {
            if judges[1] {
                self.wholly(events, |trainer, events| trainer.settle(stage, iteration, events))?;
            }
            self.progress.after_step = None;
        }
        Ok(())
    }

    /// Changes of the set of Gaussians, or of whose they are, behind a step.
    fn change_gaussians(
        &mut self,
        stage: Stage,
        iteration: u32,
        due: &Due,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        #[cfg(feature = "wgpu")]
        if self.device_is_ahead() {
            return self.change_gaussians_on_device(stage, iteration, due, events);
        }
        self.change_gaussians_here(stage, iteration, due, events)?;
        #[cfg(feature = "wgpu")]
        self.identities_changed();
        Ok(())
    }

    /// The same from the host's own state.
    pub(super) fn change_gaussians_here(
        &mut self,
        stage: Stage,
        iteration: u32,
        due: &Due,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        match stage {
            Stage::Instance => self.instance_events(iteration, due, events),
            _ => self.densify(stage, iteration, due, events),
        }
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

    /// Limits of occupancies and calibrations, and unit quaternions now and then.
    fn keep_in_range(&mut self, plan: &StepPlan) {
        if let Some([low, high]) = plan.occupancy_limits {
            for value in &mut self.field.gaussians.occupancy_logits {
                *value = value.clamp(low, high);
            }
        }
        if let (Some(limit), Some(identities)) = (plan.calibration_limit, &mut self.field.identities) {
            for value in &mut identities.log_calibrations {
                *value = value.clamp(-limit, limit);
            }
        }
        if plan.renormalises {
            for raw in &mut self.field.gaussians.quaternions {
                if let Some(unit) = quaternion::try_normalize(*raw) {
                    *raw = unit;
                }
            }
        }
    }

    /// Pruning, additions and opacity resets that fall on this step.
    fn densify(
        &mut self,
        stage: Stage,
        iteration: u32,
        due: &Due,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let config = self.config.densify.clone();
        let extent = self.field.extent;
        let (mut cloned, mut split, mut pruned) = (0, 0, 0);
        if due.prunes {
            let reset = self.progress.opacities_were_reset;
            if let Some(change) = prune(&self.field.gaussians, &self.statistics, &config, extent, reset) {
                if change.gaussians.is_empty() {
                    return Err(TrainError::NoGaussians { stage, iteration });
                }
                pruned = change.pruned;
                self.rearrange(change);
            }
        }
        if due.adds {
            let mut rng = stream(self.config.seed, Purpose::Split, self.progress.total_steps);
            let change = add_gaussians(&self.field.gaussians, &self.statistics, &config, extent, &mut rng);
            if let Some(change) = change {
                (cloned, split) = (change.cloned, change.split);
                self.rearrange(change);
            }
            self.statistics = DensifyStatistics::zeros(self.field.gaussians.len());
        }
        if due.resets_opacities {
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
    fn instance_events(
        &mut self,
        iteration: u32,
        due: &Due,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        if due.estimates_identities {
            let event = self.estimate_identities(false)?;
            events.push(event);
        }
        if !due.resamples {
            return Ok(());
        }
        let context = ResampleContext {
            config: &self.config.resample,
            unseen: &self.unseen,
            label_pixels: &self.label_pixels,
            opacity_is_occupancy: self.config.ablates(Ablation::OpacityOccupancy),
            occupancy_is_constant: self.config.ablates(Ablation::ConstantOccupancy),
            occupancy_floor: self.config.instance.occupancy_limits[0],
        };
        let mut rng = stream(self.config.seed, Purpose::Resample, u64::from(iteration));
        let relocations = choose(&self.field, &context, &mut rng);
        if relocations.pairs.is_empty() {
            return Ok(());
        }
        let relocated = apply(&mut self.field, &relocations, &context, &mut rng);
        #[cfg(feature = "wgpu")]
        self.relocates_on_device(&relocations.pairs);
        self.optimiser.relocate(&relocated.weak, &relocated.sources, &relocated.entry_origins);
        for pair in &relocations.pairs {
            self.guidance.copy(pair.weak, pair.source);
            self.copy_still(pair.weak, pair.source);
            self.unseen[pair.weak as usize] = self.unseen[pair.source as usize];
        }
        self.gradients = Gradients::zeros(&self.field);
        events.push(TrainEvent::Resampled {
            iteration,
            pairs: relocations.pairs.len(),
            labels: relocations.labels,
            sources: relocated.sources.len(),
            floored: relocated.floored,
        });
        Ok(())
    }
}
