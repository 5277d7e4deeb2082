//! Steps on the processor: the definition of what an engine does. Nothing runs ahead.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use cif_field::Field;
use cif_geometry::{PixelGrid, quaternion};
use cif_render::cpu::{BlendWeightGradients, IdentityCounts, Renderer, SimdLevel};
use cif_render::{BlendRequest, Blending, Channels, GeometryPath, Gradients, RenderSettings, RenderedImage};

use super::{Changed, Engine, Views};
use crate::density::Rearrangement;
use crate::density::contributions::ones_and_errors;
use crate::density::relocate::{Pair, Relocated};
use crate::error::TrainError;
use crate::guard::{Fault, exposure_fault, gradient_fault, loss_fault, value_fault};
use crate::heads;
use crate::losses::held_out::leave_out_held_out;
use crate::losses::{SsimScratch, color_loss};
use crate::poses::{object_sizes, pose_fault};
use crate::stage::Stage;
use crate::state::State;
use crate::step::{StepPlan, StepReport, StepView, ViewReport};
use crate::times::lap;

/// The processor, with memory that is kept between steps.
pub(crate) struct Processor {
    renderer: Renderer,
    v_color: PixelGrid<[f32; 3]>,
    ssim: SsimScratch,
    /// True when every array of a step is looked at.
    inspects: bool,
    /// Steps that were not received yet.
    done: VecDeque<StepReport>,
}

impl Processor {
    pub(crate) fn new(simd: SimdLevel) -> Self {
        Self {
            renderer: Renderer::new(simd),
            v_color: PixelGrid::filled(0, 0, [0.0; 3]),
            ssim: SsimScratch::default(),
            inspects: false,
            done: VecDeque::new(),
        }
    }

    /// The step itself, which moves nothing when it meets a fault.
    fn attempt(
        &mut self,
        state: &mut State,
        plan: &StepPlan,
        reports: &mut Vec<ViewReport>,
    ) -> Result<Option<Fault>, TrainError> {
        let mut fault = None;
        for position in 0..plan.head_targets.len() {
            fault = fault.or_else(|| self.head_view(state, plan, position, reports));
        }
        for view in plan.views.iter().filter(|_| !plan.trains_head) {
            fault = fault.or_else(|| self.view(state, plan, view, reports));
        }
        state.times.add_render(&self.renderer.times());
        let head = Arc::clone(&state.head);
        if plan.trains_head {
            fault = fault.or_else(|| state.head_tensors.fault());
        }
        fault = fault
            .or_else(|| gradient_fault(&state.gradients, &plan.rates))
            .or_else(|| pose_fault(&state.gradients.poses))
            .or_else(|| exposure_fault(state.progress.exposures.as_ref()));
        if fault.is_none() {
            if plan.counts_statistics {
                state.statistics.add(&state.gradients);
            }
            let State { field, gradients, optimiser, times, .. } = state;
            let stepped =
                optimiser.step(field, gradients, &plan.rates, &plan.weights, plan.visible_rows_only, times);
            if let Err(parameter) = stepped {
                // Leftovers of the failed step must not reach another one.
                state.gradients.reset();
                let (stage, iteration) = (plan.stage, plan.iteration);
                return Err(TrainError::NotFinite { stage, iteration, tensor: parameter.name });
            }
        }
        if let Some(tracks) = state.field.tracks.as_mut().filter(|_| fault.is_none() && plan.pose_rate > 0.0)
        {
            let Gradients { poses, pose_views, .. } = &state.gradients;
            let sizes = object_sizes(tracks, &state.field.gaussians);
            state.pose_moments.step(tracks, &sizes, poses, pose_views, plan.pose_rate);
            tracks.hold_joints();
        }
        state.gradients.reset_poses();
        if let Some(exposures) = &mut state.progress.exposures {
            match plan.exposure_rate.filter(|_| fault.is_none()) {
                Some(rate) => exposures.step(rate),
                None => exposures.reset(),
            }
        }
        if let Some(head) = plan.head(&head, &state.config).filter(|_| fault.is_none()) {
            heads::step_tensors(head, &mut state.head_tensors, plan.iteration, state.config.stages.instance);
        }
        if fault.is_some() {
            state.head_tensors.reset();
            state.gradients.reset();
        }
        state.gradients.screen.fill([0.0; 2]);
        state.gradients.radii.fill(0.0);
        Ok(fault)
    }

    /// A view of a step, forward and backward.
    fn view(
        &mut self,
        state: &mut State,
        plan: &StepPlan,
        view: &StepView,
        reports: &mut Vec<ViewReport>,
    ) -> Option<Fault> {
        let frame = &state.dataset.frames[view.index];
        let (time, data) = (frame.time, &*view.frame);
        let with_instances = plan.trains_instances(view);
        let labels = data.labels.as_ref().filter(|_| with_instances);
        let with_instances = labels.is_some();
        let instances = plan.settings.instances.filter(|_| with_instances);
        let settings = RenderSettings { instances, ..plan.settings };
        let pass = self.renderer.forward(&state.field, &view.camera, time, &settings, labels);
        let mut since = Instant::now();
        let exposure = state.progress.exposures.as_ref().map(|all| all.at(&frame.camera_name, time));
        let recorded = exposure.map(|exposure| {
            let mut recorded = pass.color.clone();
            exposure.apply(&mut recorded);
            recorded
        });
        let color = color_loss(
            recorded.as_ref().unwrap_or(&pass.color),
            &data.image,
            state.config.loss.lambda_dssim,
            plan.view_weight(),
            &mut self.v_color,
            &mut self.ssim,
        );
        lap(&mut state.times.losses, &mut since);
        let labelled = if with_instances { data.labelled as f64 } else { 0.0 };
        let report = ViewReport {
            psnr: Some(color.psnr()),
            color_loss: color.loss,
            instance_loss: labelled * pass.instance_loss,
            unsupported: pass.unsupported_pixels as f64,
        };
        if !plan.trains_colors {
            self.v_color.pixels.fill([0.0; 3]);
        }
        if plan.stage == Stage::Coarse {
            state.guidance.leave_out_travelling(data.labels.as_ref(), &mut self.v_color);
        }
        if view.leaves_judged {
            leave_out_held_out(&mut self.v_color);
        }
        if let (Some(exposure), Some(all)) = (exposure, &mut state.progress.exposures) {
            let gradient = exposure.pull_back(&pass.color, &mut self.v_color);
            all.add(&frame.camera_name, time, &gradient);
        }
        reports.push(report);
        if let Some(fault) = self.fault_of_view(color.loss, pass.instance_loss) {
            return Some(fault);
        }
        let share = if with_instances { plan.label_share(view) } else { 0.0 };
        let instance_weight = (share * f64::from(state.config.loss.lambda_instance)) as f32;
        let pulls = state.pulls(time, plan.pulls);
        let v_displacements = pulls.map_or_else(Vec::new, |pulls| {
            state.guidance.gradients(&pulls, &state.field, self.renderer.posed_means())
        });
        self.renderer.backward_displaced(
            &state.field,
            &self.v_color,
            instance_weight,
            &v_displacements,
            &mut state.gradients,
        );
        let fault = self.renderer.take_not_finite().map(Fault::from);
        let statistics = self.renderer.statistics();
        let gaussians = state.field.gaussians.len();
        state.times.add_view(gaussians, &statistics);
        state.progress.work.add_view(gaussians, &statistics);
        fault
    }

    /// A view of a step that trains a head, forward and backward; the field stays as it is, but for opacities of the
    /// head's own.
    fn head_view(
        &mut self,
        state: &mut State,
        plan: &StepPlan,
        position: usize,
        reports: &mut Vec<ViewReport>,
    ) -> Option<Fault> {
        let target = &plan.head_targets[position];
        let head = Arc::clone(&state.head);
        let head = plan.head(&head, &state.config)?;
        let State { head_tensors: tensors, field, gradients, config, .. } = state;
        self.renderer.prepare(field, &target.camera, target.time, &plan.settings);
        let positions = || match self.renderer.posed_means() {
            [] => field.gaussians.means.clone(),
            posed => posed.to_vec(),
        };
        let pairs = plan.compared(head, config, position, &positions);
        let mut rows = self.renderer.listed_rows();
        rows.extend(pairs.as_flattened());
        rows.sort_unstable();
        rows.dedup();
        let values = head.values_of(tensors, field, target.time, &rows);
        let (channels, blending) = (head.channels(field), head.blending());
        let request = BlendRequest { values: &values.values[..], channels, blending };
        let blended = self.renderer.blend(&request);
        let mut v_blended = vec![0.0; blended.values.len()];
        let seed = plan.head_seed(config, position);
        let loss = target.loss(head, tensors, &blended, seed, plan.view_weight(), &mut v_blended);
        let mut v_values = vec![0.0; values.values.len()];
        let weights = head.own_opacity().map(|_| BlendWeightGradients {
            field,
            blended: &blended,
            geometry: GeometryPath::Off,
            gradients,
        });
        self.renderer.blend_backward(&request, &v_blended, &mut v_values, weights);
        head.regularise(tensors, &pairs, &values.values, &mut v_values);
        head.values_backward(tensors, field, &values, &v_values);
        reports.push(ViewReport::of_head(loss));
        let fault = self.renderer.take_not_finite().map(Fault::from);
        fault.or_else(|| loss_fault("instance loss", loss.loss))
    }

    /// A value that the renderer met, then a loss that is not finite.
    fn fault_of_view(&mut self, color_loss: f64, instance_loss: f64) -> Option<Fault> {
        if let Some(found) = self.renderer.take_not_finite() {
            return Some(found.into());
        }
        loss_fault("colour loss", color_loss).or_else(|| loss_fault("instance loss", instance_loss)).or_else(
            || {
                let v_color = self.v_color.pixels.as_flattened();
                self.inspects.then(|| value_fault("losses", "gradient of colour", v_color))?
            },
        )
    }
}

/// Limits of occupancies and calibrations, and unit quaternions now and then.
fn keep_in_range(field: &mut Field, plan: &StepPlan) {
    if let Some([low, high]) = plan.occupancy_limits {
        for value in &mut field.gaussians.occupancy_logits {
            *value = value.clamp(low, high);
        }
    }
    if let (Some(limit), Some(identities)) = (plan.calibration_limit, &mut field.identities) {
        for value in &mut identities.log_calibrations {
            *value = value.clamp(-limit, limit);
        }
    }
    if plan.renormalises {
        for raw in &mut field.gaussians.quaternions {
            if let Some(unit) = quaternion::try_normalize(*raw) {
                *raw = unit;
            }
        }
    }
}

impl Engine for Processor {
    fn gpu_name(&self) -> Option<&str> {
        None
    }

    fn step(&mut self, state: &mut State, plan: StepPlan) -> Result<(), TrainError> {
        // Rendering between steps, for scores and identities, is no part of them.
        self.renderer.reset_times();
        let mut views = Vec::with_capacity(plan.views.len());
        let fault = self.attempt(state, &plan, &mut views)?;
        if fault.is_none() {
            keep_in_range(&mut state.field, &plan);
        }
        self.done.push_back(StepReport { plan, views, fault });
        Ok(())
    }

    fn receive(&mut self, _state: &mut State, _all: bool) -> Result<Option<StepReport>, TrainError> {
        Ok(self.done.pop_front())
    }

    fn give_up(&mut self, _state: &mut State) -> u32 {
        0
    }

    fn fetch(&mut self, _state: &mut State) -> Result<(), TrainError> {
        Ok(())
    }

    fn is_far_ahead(&self) -> bool {
        false
    }

    fn changed(&mut self, _what: Changed) {}

    fn begin_changes(&mut self, _state: &mut State, _relocates: bool) -> Result<(), TrainError> {
        Ok(())
    }

    fn sums_of_view(&mut self, state: &State, view: usize) -> Result<Vec<f32>, TrainError> {
        let data = state.frames.get(&state.dataset, view)?;
        let index = state.frames.index(view);
        let (frame, settings) = (&state.dataset.frames[index], state.color_settings());
        let mut color = self.renderer.forward(&state.field, &frame.camera, frame.time, &settings, None).color;
        state.record_color(index, &mut color);
        let cotangents = ones_and_errors(&color, &data.image);
        // Any values do: their gradients are sums of the weights.
        let values = vec![0.0; 2 * state.field.gaussians.len()];
        let request = BlendRequest { values: &values[..], channels: 2, blending: Blending::Color };
        let mut sums = vec![0.0; values.len()];
        self.renderer.blend_backward(&request, &cotangents, &mut sums, None);
        Ok(sums)
    }

    fn rearrange(&mut self, state: &mut State, change: &Rearrangement) {
        state.optimiser.gather(&change.origins);
    }

    fn relocate(&mut self, state: &mut State, _pairs: &[Pair], relocated: &Relocated) {
        state.optimiser.relocate(&relocated.weak, &relocated.sources, &relocated.entry_origins);
    }

    fn end_changes(&mut self, _state: &mut State, _resets: Option<bool>) -> Result<(), TrainError> {
        Ok(())
    }

    fn draw(
        &mut self,
        state: &State,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        for index in views.frames {
            state.phases.check()?;
            let frame = &views.dataset(state).frames[*index];
            let field = trial.unwrap_or(&state.field);
            let by_values = state.started_head().filter(|_| views.channels.instances);
            let channels =
                Channels { instances: by_values.is_none() && views.channels.instances, ..views.channels };
            let mut rendered =
                self.renderer.render(field, &frame.camera, frame.time, views.settings, channels);
            if let Some(head) = by_values {
                let (view, tensors) = ((&frame.camera, frame.time), &state.head_tensors);
                let blended = heads::blended(&mut self.renderer, head, tensors, field, view, views.settings);
                let image = heads::instance_image(head, tensors, &blended, &rendered.alpha);
                rendered.instances = Some(image);
            }
            each(state.recorded(*index, rendered));
        }
        Ok(())
    }

    fn count_labels(&mut self, state: &mut State) -> Result<(IdentityCounts, usize), TrainError> {
        let settings = state.color_settings();
        let mut counts = IdentityCounts::zeros(state.field.gaussians.len(), state.field.instances.len());
        let mut frames = 0;
        for view in state.views_of_identities() {
            state.phases.check()?;
            let data = state.frame_of_identities(view)?;
            let Some(labels) = data.labels.as_ref().filter(|_| data.labelled > 0) else { continue };
            let frame = &state.dataset.frames[state.frames.index(view)];
            let (camera, time) = (&frame.camera, frame.time);
            self.renderer.count_identities(&state.field, camera, time, &settings, labels, &mut counts);
            state.add_label_pixels(labels);
            frames += 1;
        }
        Ok((counts, frames))
    }

    fn inspect(&mut self, on: bool) {
        self.inspects = on;
        self.renderer.set_inspection(on);
    }

    fn withdraw(&mut self, _state: &mut State) {}
}
