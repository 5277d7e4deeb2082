//! One view of a step, recorded.

use std::sync::Arc;
use std::time::Duration;

use cif_field::parameters::LOG_CALIBRATIONS;
use cif_render::wgpu::deform::DeformedGaussians;
use cif_render::wgpu::{
    Commands, DeviceIdentities, GpuError, GpuStatistics, LabelInput, PendingWords, Submission, ViewInput,
    faults,
};
use cif_render::{InstanceNormalisation, RenderSettings};

use super::flight::{AboutView, LOSS_WORDS, ViewRead};
use super::gpu_engine::GpuEngine;
use super::recording::Recording;
use super::resident::{Resident, ResidentDeformation, ResidentIdentities};
use crate::error::TrainError;
use crate::stage::Stage;
use crate::state::State;
use crate::step::{StepPlan, StepView};
use crate::times::StepTimes;
use crate::wgpu::exposure::ExposedView;
use crate::wgpu::kernels::{Judgement, fault};
use crate::wgpu::losses::{DrawnPixels, GpuTarget, LossWeights, SLOTS};
use crate::wgpu::optimiser::{GaussianStep, Optimised};

/// Faults that stop a step regardless of the parameters that it moves.
const ALWAYS: u32 = fault::NO_ROOM | fault::COLOR_LOSS | fault::INSTANCE_LOSS | fault::POSES;

/// A view of a step as it is drawn and compared.
struct ComparedView<'a> {
    /// The view as it was planned.
    view: &'a StepView,
    /// The step.
    plan: &'a StepPlan,
    /// Frame that the view is compared with.
    target: &'a GpuTarget,
    /// Settings of the render, with instances where the view trains them.
    settings: RenderSettings,
    /// Labels, where the view trains instances.
    labels: Option<LabelInput<'a>>,
    /// Time in 0..=1.
    time: f64,
    /// Row of the camera among the exposures, where it has one.
    camera: Option<u32>,
}

impl<'a> ComparedView<'a> {
    fn new(
        state: &State,
        resident: &Resident,
        plan: &'a StepPlan,
        view: &'a StepView,
        target: &'a GpuTarget,
    ) -> Self {
        let frame = &state.dataset.frames[view.index];
        let cameras = state.progress.exposures.as_ref();
        let row = cameras.and_then(|all| all.position(&frame.camera_name, frame.time));
        let with_instances = plan.trains_instances(view) && resident.identities.is_some();
        let labels = with_instances.then(|| LabelInput {
            labels: &target.labels,
            labelled_pixels: view.frame.labelled,
            weight: (plan.label_share(view) * f64::from(state.config.loss.lambda_instance)) as f32,
        });
        Self {
            view,
            plan,
            target,
            settings: RenderSettings {
                instances: plan.settings.instances.filter(|_| with_instances),
                ..plan.settings
            },
            labels,
            time: frame.time,
            camera: row.map(|row| row as u32),
        }
    }

    fn pixels(&self) -> usize {
        self.target.size[0] as usize * self.target.size[1] as usize
    }

    /// Rows of the identities, where the view trains instances.
    fn rows<'r>(&self, resident: &'r Resident) -> Option<&'r DeviceIdentities> {
        resident.identities.as_ref().filter(|_| self.labels.is_some()).map(|identities| &identities.rows)
    }

    fn weights(&self, state: &State) -> LossWeights {
        let instances = self.settings.instances;
        LossWeights {
            lambda_dssim: state.config.loss.lambda_dssim,
            view: self.plan.view_weight(),
            with_instances: self.labels.is_some(),
            by_coverage: instances
                .is_some_and(|instances| instances.normalisation == InstanceNormalisation::Coverage),
            leaves_out: self.plan.stage == Stage::Coarse && state.guidance.travelling_labels().is_some(),
            leaves_judged: self.view.leaves_judged,
        }
    }
}

impl GpuEngine {
    /// One view, forward and backward; after the last one of a step, the optimiser.
    pub(super) fn view_on(
        &mut self,
        state: &mut State,
        resident: &mut Resident,
        recording: &Recording,
        position: usize,
    ) -> Result<(ViewRead, Submission), TrainError> {
        let view = &recording.plan.views[position];
        let target = self.target_of(view, u64::from(state.config.frame_memory_mib) << 20)?;
        let compared = ComparedView::new(state, resident, &recording.plan, view, &target);
        let (gpu, mut timestamps) = (self.gpu.clone(), self.timestamps.take());
        let commands = Commands::new(&gpu, timestamps.as_mut());
        let recorded = self.record_view(commands, state, resident, recording, position, &compared);
        self.timestamps = timestamps;
        let (pending, submission) = recorded?;
        if let Some(timestamps) = &mut self.timestamps {
            let stages = timestamps.read(&gpu)?;
            add_stage_times(&mut state.times, &stages);
            self.stage_times.extend(stages);
        }
        let about = AboutView {
            pixels: compared.pixels(),
            labelled: if compared.labels.is_some() { view.frame.labelled } else { 0 },
            lambda_dssim: state.config.loss.lambda_dssim,
            gaussians: resident.canonical.len(),
        };
        Ok((ViewRead::new(pending, about), submission))
    }

    /// Records and submits a view.
    fn record_view(
        &mut self,
        mut commands: Commands<'_>,
        state: &State,
        resident: &mut Resident,
        recording: &Recording,
        position: usize,
        compared: &ComparedView<'_>,
    ) -> Result<(PendingWords, Submission), TrainError> {
        let (first, last) = (position == 0, position + 1 == recording.plan.views.len());
        if let Some(identities) = resident.identities.as_ref().filter(|_| first && compared.labels.is_some())
        {
            self.optimiser.identities(
                &self.gpu,
                &mut commands,
                &identities.rows.row_offsets,
                &identities.log_estimates,
                &identities.log_calibrations,
                &identities.rows.entries,
            );
        }
        self.compare(&mut commands, state, resident, compared)?;
        self.add_gradients(&mut commands, state, resident, compared)?;
        let judgement = Judgement {
            slot: self.slot as u32,
            counts: recording.moving | ALWAYS,
            known: recording.known,
            is_last: u32::from(last),
        };
        let (results, counts) = (self.losses.results(), self.rasterizer.counts());
        self.judge.record(&self.gpu, &mut commands, judgement, results, counts, &self.faults);
        if last {
            self.move_parameters(&mut commands, resident, recording)?;
        }
        let parts = [
            (self.losses.results().buffer(), 32 * self.slot as u64, LOSS_WORDS),
            (self.rasterizer.counts().buffer(), 0, GpuStatistics::WORDS),
            (self.faults.buffer(), 0, faults::WORDS),
        ];
        let pending = self.readback.record(&self.gpu, commands.encoder(), &parts);
        self.slot = (self.slot + 1) % SLOTS;
        if last {
            // Whether steps wait stays.
            commands.clear_range(&self.faults, 0, 1);
        }
        let submission = commands.submit();
        Ok((pending.send(), submission))
    }

    /// Draws the view, compares it with its frame, and carries the gradients back to the posed Gaussians.
    fn compare(
        &mut self,
        commands: &mut Commands<'_>,
        state: &State,
        resident: &Resident,
        compared: &ComparedView<'_>,
    ) -> Result<(), TrainError> {
        let Self { gpu, rasterizer, losses, exposure, faults, slot, .. } = self;
        let ComparedView { settings, labels, target, .. } = compared;
        let input = ViewInput { camera: &compared.view.camera, settings, labels: *labels };
        let posed = resident.pose(gpu, commands, compared.time);
        let rows = compared.rows(resident);
        rasterizer.project(gpu, commands, posed, rows, &input)?;
        rasterizer.rasterize(gpu, commands, rows, *labels)?;
        let (colors, blended) = (rasterizer.colors(), rasterizer.blended());
        let exposed = resident.exposures.as_ref().zip(compared.camera);
        let exposed = exposed.map(|(cameras, camera)| {
            let pixels = compared.pixels();
            ExposedView { cameras, camera, colors, pixels }
        });
        let mut drawn = DrawnPixels { colors, blended };
        if let Some(exposed) = exposed {
            exposure.expose(gpu, commands, exposed, &losses.v_colors, faults)?;
            drawn.colors = &exposure.recorded;
        }
        losses.record(gpu, commands, drawn, target, &compared.weights(state), *slot)?;
        if !compared.plan.trains_colors {
            commands.clear(&losses.v_colors);
        }
        if let Some(exposed) = exposed {
            exposure.pull_back(gpu, commands, exposed, &losses.v_colors, faults);
        }
        rasterizer.backward(gpu, commands, posed, rows, *labels, &losses.v_colors)?;
        Ok(())
    }

    /// Adds the gradients of the view to those of the step, the deformation differentiated where there is one.
    fn add_gradients(
        &mut self,
        commands: &mut Commands<'_>,
        state: &State,
        resident: &mut Resident,
        compared: &ComparedView<'_>,
    ) -> Result<(), TrainError> {
        let Self { gpu, rasterizer, optimiser, motion, faults, .. } = self;
        if let Some(poses) = &resident.poses {
            poses.groups.backward(gpu, commands, &resident.canonical, rasterizer, faults);
        }
        let gradients = rasterizer.gradients();
        let (view, total) = (&gradients.gaussians, &resident.gradients);
        // Through a deformation, the geometry of the canonical Gaussians gets its gradients below.
        let with_geometry = resident.deformation.is_none();
        optimiser.add_gaussians(gpu, commands, view, total, with_geometry, faults);
        if let Some(deformation) = &mut resident.deformation {
            let both =
                DeformedGaussians { canonical: &resident.canonical, v_posed: view, v_canonical: total };
            if let Some(pulls) = state.pulls(compared.time, compared.plan.pulls) {
                let extent = f64::from(state.field.extent);
                motion.record(gpu, commands, &pulls, extent, &resident.posed, both)?;
            }
            let ResidentDeformation { parameters, gradients, .. } = deformation;
            gradients.backward(gpu, commands, parameters, compared.time, both, faults);
        }
        optimiser.add_screen(gpu, commands, &gradients.screen, &resident.screen, faults);
        let trains_instances = compared.labels.is_some_and(|labels| labels.weight != 0.0);
        if let Some(identities) = resident.identities.as_ref().filter(|_| trains_instances) {
            let (view, total) = (&gradients.calibrations, &identities.gradients);
            optimiser.add_calibrations(gpu, commands, view, total, faults);
        }
        Ok(())
    }

    /// Statistics and optimiser, after the last view of a step.
    fn move_parameters(
        &mut self,
        commands: &mut Commands<'_>,
        resident: &Resident,
        recording: &Recording,
    ) -> Result<(), TrainError> {
        let Self { gpu, exposure, optimiser, faults, .. } = self;
        let Recording { plan, groups, .. } = recording;
        if plan.counts_statistics {
            optimiser.add_statistics(gpu, commands, &resident.screen, &resident.statistics, faults);
        }
        let step = GaussianStep {
            groups,
            visible_only: plan.visible_rows_only,
            renormalise: plan.renormalises,
            occupancy_limits: plan.occupancy_limits,
        };
        let gaussians = Optimised {
            parameters: &resident.canonical,
            gradients: &resident.gradients,
            moments: &resident.moments,
        };
        optimiser.step_gaussians(gpu, commands, &step, &gaussians, &resident.screen, faults);
        commands.clear(&resident.screen);
        if let Some(ResidentIdentities { log_calibrations: parameters, gradients, moments, .. }) =
            &resident.identities
        {
            let (step, limit) = (groups.of(&LOG_CALIBRATIONS), plan.calibration_limit.unwrap_or(f32::MAX));
            let calibrations = Optimised { parameters, gradients, moments };
            optimiser.step_calibrations(gpu, commands, step, limit, &calibrations, faults);
        }
        if let Some(poses) = &resident.poses {
            let canonical = &resident.canonical;
            poses.optimiser.step(gpu, commands, plan.pose_rate, &poses.groups, canonical, faults);
        }
        if let Some(cameras) = &resident.exposures {
            exposure.step(gpu, commands, recording.exposures, cameras, faults);
        }
        if let Some(ResidentDeformation { parameters, gradients, moments }) = &resident.deformation {
            let deformation = Optimised { parameters, gradients, moments };
            optimiser.step_deformation(gpu, commands, groups, &plan.weights, &deformation, faults)?;
        }
        Ok(())
    }

    /// The frame of a view on the device, where it stays while `budget` bytes hold those that do.
    pub(super) fn target_of(&mut self, view: &StepView, budget: u64) -> Result<Arc<GpuTarget>, GpuError> {
        if let Some(target) = self.targets.get(&key(view)) {
            return Ok(Arc::clone(target));
        }
        let target = Arc::new(GpuTarget::new(&self.gpu, &view.frame.image, view.frame.labels.as_ref())?);
        if self.target_bytes < budget {
            self.target_bytes += target.bytes();
            self.targets.insert(key(view), Arc::clone(&target));
        }
        Ok(target)
    }
}

/// Names the image of a view: the index of its frame, and the width.
fn key(view: &StepView) -> (usize, u32) {
    (view.index, view.frame.image.width)
}

/// Adds the times of a submission to the parts of a step.
fn add_stage_times(times: &mut StepTimes, stages: &[(&'static str, Duration)]) {
    let render = &mut times.render;
    for (name, duration) in stages {
        let part = match *name {
            "deform" => &mut render.deform,
            "project" => &mut render.project,
            "sort by depth" | "bin" | "emit" | "sort by tile" | "ranges" => &mut render.bin,
            "rasterize" => &mut render.rasterize,
            "losses" | "exposure" => &mut times.losses,
            "cotangents" | "rasterize backward" => &mut render.rasterize_backward,
            "gather gradients" | "project backward" | "identity backward" | "guidance" => {
                &mut render.project_backward
            }
            "deform backward: network" | "deform backward: planes" | "deform backward: lines" => {
                &mut render.deform_backward
            }
            "optimiser: planes" => &mut times.optimiser_planes,
            "optimiser: network" => &mut times.optimiser_mlp,
            "optimiser: Gaussians" | "accumulate" | "identity" | "judge" => &mut times.optimiser_gaussians,
            // Counted as other.
            _ => continue,
        };
        *part += *duration;
    }
}
