//! One view of a step, recorded.

use std::time::Duration;

use cif_field::parameters::{LOG_CALIBRATIONS, MLP, PLANES};
use cif_render::wgpu::{Commands, GpuError, GpuStatistics, LabelInput, Submission, ViewInput, faults};
use cif_render::{InstanceNormalisation, RenderSettings};

use super::flight::{AboutView, LOSS_WORDS, ViewRead};
use super::gpu_engine::GpuEngine;
use super::recording::Recording;
use super::resident::Resident;
use crate::error::TrainError;
use crate::stage::Stage;
use crate::state::State;
use crate::step::{StepPlan, StepView};
use crate::times::StepTimes;
use crate::wgpu::kernels::{Judgement, fault};
use crate::wgpu::losses::{GpuTarget, LossWeights, SLOTS};
use crate::wgpu::optimiser::GaussianStep;

impl GaussianStep {
    fn of(plan: &StepPlan) -> Self {
        Self {
            visible_only: plan.visible_rows_only,
            renormalise: plan.renormalises,
            occupancy_limits: plan.occupancy_limits,
        }
    }
}

/// Faults that stop a step regardless of the parameters that it moves.
const ALWAYS: u32 = fault::NO_ROOM | fault::COLOR_LOSS | fault::INSTANCE_LOSS | fault::POSES;

impl GpuEngine {
    /// One view, forward and backward; after the last one of a step, the optimiser.
    pub(super) fn view_on(
        &mut self,
        state: &mut State,
        resident: &mut Resident,
        recording: &Recording,
        position: usize,
    ) -> Result<(ViewRead, Submission), TrainError> {
        let plan = &recording.plan;
        let view = &plan.views[position];
        let (first, last) = (position == 0, position + 1 == plan.views.len());
        self.keep_target(view, u64::from(state.config.frame_memory_mib) << 20)?;
        let Self {
            gpu,
            rasterizer,
            losses,
            exposure,
            optimiser,
            motion,
            targets,
            judge,
            readback,
            faults,
            slot,
            timestamps,
            stage_times,
            ..
        } = self;
        let fresh;
        let target = match targets.get(&key(view)) {
            Some(target) => target,
            None => {
                fresh = GpuTarget::new(gpu, &view.frame.image, view.frame.labels.as_ref())?;
                &fresh
            }
        };
        let frame = &state.dataset.frames[view.index];
        let cameras = state.progress.exposures.as_ref();
        let row = cameras.and_then(|all| all.position(&frame.camera_name, frame.time));
        let camera = row.map(|row| row as u32);
        let with_instances = plan.trains_instances(view) && resident.identities.is_some();
        let settings =
            RenderSettings { instances: plan.settings.instances.filter(|_| with_instances), ..plan.settings };
        let labels = with_instances.then(|| LabelInput {
            labels: &target.labels,
            labelled_pixels: view.frame.labelled,
            weight: (plan.label_share(view) * f64::from(state.config.loss.lambda_instance)) as f32,
        });
        let input = ViewInput { camera: &view.camera, settings: &settings, labels };

        let mut commands = Commands::new(gpu, timestamps.as_mut());
        if let Some(identities) = resident.identities.as_ref().filter(|_| first && with_instances) {
            optimiser.identities(
                gpu,
                &mut commands,
                &identities.rows.row_offsets,
                (&identities.log_estimates, &identities.log_calibrations),
                &identities.rows.entries,
            );
        }
        let posed = resident.pose(gpu, &mut commands, frame.time);
        let rows = resident.identities.as_ref().filter(|_| with_instances).map(|identities| &identities.rows);
        rasterizer.project(gpu, &mut commands, posed, rows, &input)?;
        rasterizer.rasterize(gpu, &mut commands, rows, labels)?;
        let weights = LossWeights {
            lambda_dssim: state.config.loss.lambda_dssim,
            view: plan.view_weight(),
            with_instances,
            by_coverage: settings
                .instances
                .is_some_and(|instances| instances.normalisation == InstanceNormalisation::Coverage),
            leaves_out: plan.stage == Stage::Coarse && state.guidance.travelling_labels().is_some(),
            leaves_judged: view.leaves_judged,
        };
        let exposed = resident.exposures.as_ref().zip(camera);
        let colors = rasterizer.colors();
        let mut recorded = colors;
        if let Some(camera) = exposed {
            let pixels = target.size[0] as usize * target.size[1] as usize;
            exposure.expose(gpu, &mut commands, camera, (colors, pixels), &losses.v_colors, faults)?;
            recorded = &exposure.recorded;
        }
        let images = (recorded, rasterizer.blended());
        losses.record(gpu, &mut commands, images, target, &weights, *slot)?;
        if !plan.trains_colors {
            commands.clear(&losses.v_colors);
        }
        if let Some((cameras, _)) = exposed {
            exposure.pull_back(gpu, &mut commands, cameras, colors, &losses.v_colors, faults);
        }
        rasterizer.backward(gpu, &mut commands, posed, rows, labels, &losses.v_colors)?;

        if let Some(poses) = &resident.poses {
            poses.groups.backward(gpu, &mut commands, &resident.canonical, rasterizer, faults);
        }
        let gradients = rasterizer.gradients();
        if let Some(deformation) = &mut resident.deformation {
            optimiser.add_gaussians(
                gpu,
                &mut commands,
                &gradients.gaussians,
                &resident.gradients,
                false,
                faults,
            );
            if let Some(pulls) = state.pulls(frame.time, plan.pulls) {
                motion.record(
                    gpu,
                    &mut commands,
                    (&pulls.shifts, pulls.strengths, f64::from(state.field.extent)),
                    (&resident.posed, &resident.canonical),
                    (&gradients.gaussians, &resident.gradients),
                )?;
            }
            deformation.gradients.backward(
                gpu,
                &mut commands,
                (&deformation.parameters, frame.time),
                &resident.canonical,
                &gradients.gaussians,
                &resident.gradients,
                faults,
            );
        } else {
            optimiser.add_gaussians(
                gpu,
                &mut commands,
                &gradients.gaussians,
                &resident.gradients,
                true,
                faults,
            );
        }
        optimiser.add_screen(gpu, &mut commands, (&gradients.screen, &resident.screen), faults);
        if let (Some(identities), true) =
            (&resident.identities, labels.is_some_and(|labels| labels.weight != 0.0))
        {
            let sums = (&gradients.calibrations, &identities.gradients);
            optimiser.add_calibrations(gpu, &mut commands, sums, faults);
        }
        let judgement = Judgement {
            slot: *slot as u32,
            counts: recording.moving | ALWAYS,
            known: recording.known,
            is_last: u32::from(last),
        };
        let losses_and_counts = (losses.results(), rasterizer.counts());
        judge.record(gpu, &mut commands, judgement, losses_and_counts, faults);

        if last {
            if plan.counts_statistics {
                let rows = (&resident.screen, &resident.statistics);
                optimiser.add_statistics(gpu, &mut commands, rows, faults);
            }
            optimiser.step_gaussians(
                gpu,
                &mut commands,
                (&GaussianStep::of(plan), &recording.groups),
                (&resident.canonical, &resident.gradients),
                &resident.moments,
                &resident.screen,
                faults,
            );
            commands.clear(&resident.screen);
            if let Some(identities) = &resident.identities {
                optimiser.step_calibrations(
                    gpu,
                    &mut commands,
                    (recording.groups.of(&LOG_CALIBRATIONS), plan.calibration_limit.unwrap_or(f32::MAX)),
                    (&identities.log_calibrations, &identities.gradients),
                    &identities.moments,
                    faults,
                );
            }
            if let Some(poses) = &resident.poses {
                let of = (&poses.groups, &resident.canonical);
                poses.optimiser.step(gpu, &mut commands, plan.pose_rate, of, faults);
            }
            if let Some(cameras) = &resident.exposures {
                exposure.step(gpu, &mut commands, recording.exposures, cameras, faults);
            }
            if let Some(deformation) = &resident.deformation {
                optimiser.step_deformation(
                    gpu,
                    &mut commands,
                    (recording.groups.of(&PLANES), recording.groups.of(&MLP)),
                    &plan.weights,
                    (&deformation.parameters, &deformation.gradients),
                    &deformation.moments,
                    faults,
                )?;
            }
        }

        let parts = [
            (losses.results().buffer(), 32 * *slot as u64, LOSS_WORDS),
            (rasterizer.counts().buffer(), 0, GpuStatistics::WORDS),
            (faults.buffer(), 0, faults::WORDS),
        ];
        let pending = readback.record(gpu, commands.encoder(), &parts);
        *slot = (*slot + 1) % SLOTS;
        if last {
            // Whether steps wait stays.
            commands.clear_range(faults, 0, 1);
        }
        let submission = commands.submit();
        let pending = pending.send();
        if let Some(timestamps) = timestamps {
            let stages = timestamps.read(gpu)?;
            add_stage_times(&mut state.times, &stages);
            stage_times.extend(stages);
        }
        let pixels = target.size[0] as usize * target.size[1] as usize;
        let about = AboutView {
            pixels,
            labelled: if with_instances { view.frame.labelled } else { 0 },
            lambda_dssim: state.config.loss.lambda_dssim,
            gaussians: resident.canonical.len(),
        };
        Ok((ViewRead::new(pending, about), submission))
    }
}

impl GpuEngine {
    /// Keeps a frame on the device, while `budget` bytes hold them.
    pub(super) fn keep_target(&mut self, view: &StepView, budget: u64) -> Result<(), GpuError> {
        if !self.targets.contains_key(&key(view)) && self.target_bytes < budget {
            let target = GpuTarget::new(&self.gpu, &view.frame.image, view.frame.labels.as_ref())?;
            self.target_bytes += target.bytes();
            self.targets.insert(key(view), target);
        }
        Ok(())
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
