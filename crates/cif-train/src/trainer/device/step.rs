//! One optimiser step on the device; its twin is `trainer/step.rs`.

use std::sync::Arc;
use std::time::Instant;

use cif_geometry::scalar::logit;
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_render::RenderSettings;

use super::super::frames::TrainFrame;
use super::super::guard::MAX_RATE;
use super::super::optimiser::StepRates;
use super::super::step::{RENORMALISE_EVERY, StepLoss, exposure_rate};
use super::super::{InstancePass, Trainer};
use super::DeviceTraining;
use super::flight::Flight;
use super::resident::{Resident, Stale};
use crate::adam::{Moments, PlaneWeights};
use crate::config::Ablation;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::wgpu::kernels::fault;
use crate::wgpu::optimiser::{GaussianStep, GroupStep};

/// A view of a step.
pub(super) struct StepView {
    /// Position among the training views, and index in the capture.
    pub(super) view: usize,
    pub(super) index: usize,
    pub(super) frame: Arc<TrainFrame>,
    /// Whether the pixels that effects are judged by train nothing.
    pub(super) leaves_judged: bool,
    /// Number of the camera among those whose exposures are learnt.
    pub(super) camera: Option<u32>,
}

/// A step, so that it can be recorded, and recorded again.
pub(super) struct StepPlan {
    pub(super) views: Vec<StepView>,
    pub(super) stage: Stage,
    pub(super) iteration: u32,
    pub(super) settings: RenderSettings,
    /// Labelled pixels of all views.
    pub(super) labelled: usize,
    pub(super) weights: PlaneWeights,
    pub(super) step: GaussianStep,
    pub(super) calibration: GroupStep,
    pub(super) planes: GroupStep,
    pub(super) mlp: GroupStep,
    pub(super) exposures: GroupStep,
    /// Groups that move, as bits of the fault word.
    pub(super) moving: u32,
    /// What is wrong with the step before it is recorded, likewise.
    pub(super) known: u32,
    /// Gaussians N.
    pub(super) gaussians: usize,
}

impl StepPlan {
    /// One step less of some groups before this one.
    pub(super) fn uncount(&mut self, groups: u32) {
        let step = &mut self.step;
        let counted = [
            (fault::MEANS, &mut step.means),
            (fault::LOG_SCALES, &mut step.log_scales),
            (fault::QUATERNIONS, &mut step.quaternions),
            (fault::OPACITY, &mut step.opacity),
            (fault::OCCUPANCY, &mut step.occupancy),
            (fault::SH, &mut step.sh),
            (fault::CALIBRATIONS, &mut self.calibration),
            (fault::PLANES, &mut self.planes),
            (fault::MLP, &mut self.mlp),
            (fault::EXPOSURES, &mut self.exposures),
        ];
        for (bit, group) in counted {
            group.steps -= u32::from(groups & bit != 0);
        }
    }
}

impl Trainer {
    /// Renders the step's views forward and backward and moves the parameters, all on the device. The loss is that
    /// of the last step that has arrived.
    pub(in crate::trainer) fn device_step(
        &mut self,
        events: &mut Vec<TrainEvent>,
    ) -> Result<StepLoss, TrainError> {
        let result = self
            .judge_before_step(events)
            .and_then(
                |()| if self.debug_validation { self.validated_step(events) } else { self.unwatched_step() },
            )
            .and_then(|()| self.rare_events(events));
        events.append(&mut self.arrived);
        result.map_err(|error| self.device_failed(error))?;
        Ok(self.last_loss)
    }

    /// Records a step, and takes in what has arrived.
    pub(super) fn unwatched_step(&mut self) -> Result<(), TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(()) };
        let waits = device.waits;
        let result = self.step_on(&mut device).and_then(|()| {
            let start = Instant::now();
            let received = self.receive(&mut device, waits);
            // Only what waits is measured.
            if waits {
                self.times.total += start.elapsed();
            }
            received
        });
        self.device = Some(device);
        result
    }

    fn step_on(&mut self, device: &mut DeviceTraining) -> Result<(), TrainError> {
        let start = Instant::now();
        if !device.ahead {
            device.fetched = Some(self.counters());
        }
        let stage = self.progress.stage;
        let iteration = self.progress.iteration + 1;
        if matches!(stage, Stage::Coarse | Stage::Fine) {
            self.field.sh_degree = self.degree_at(iteration);
        }
        self.send(device)?;
        let plan = self.plan_step(stage, iteration)?;
        self.record(device, plan)?;
        device.ahead = true;
        device.since_fetch += 1;
        self.progress.count_step();
        self.times.total += start.elapsed();
        self.times.steps += 1;
        Ok(())
    }

    /// Sends what the host has changed.
    pub(super) fn send(&mut self, device: &mut DeviceTraining) -> Result<(), TrainError> {
        if device.resident.is_none() {
            device.resident = Some(Resident::new(&device.gpu)?);
            device.stale = Stale::EVERYTHING;
        }
        let Some(resident) = &mut device.resident else { return Ok(()) };
        let exposures = self.progress.exposures.as_ref();
        let (field, optimiser) = (&self.field, &self.optimiser);
        resident.send(&device.gpu, device.stale, field, optimiser, &self.statistics, exposures)?;
        if device.stale.gaussians {
            device.motion.send(&device.gpu, self.guide_of())?;
            device.losses.leave_out(&device.gpu, self.travelling_labels().unwrap_or(&[]))?;
            device.make_room(self.field.gaussians.len())?;
        }
        device.stale = Stale::default();
        Ok(())
    }

    fn plan_step(&mut self, stage: Stage, iteration: u32) -> Result<StepPlan, TrainError> {
        let batch = self.config.stages.batch;
        let mut views = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let view = self.view_at(stage, u64::from(iteration - 1) * u64::from(batch) + u64::from(k));
            let frame = self.frames.get(&self.dataset, view)?;
            let index = self.frames.index(view);
            let name = &self.dataset.frames[index].camera_name;
            let camera = self.progress.exposures.as_ref().and_then(|all| all.position(name));
            views.push(StepView {
                view,
                index,
                frame,
                leaves_judged: self.leaves_out_judged(stage, iteration, index),
                camera: camera.map(|camera| camera as u32),
            });
        }
        let settings = RenderSettings {
            instances: (stage == Stage::Instance && self.instance_pass == InstancePass::On)
                .then(|| self.instance_settings()),
            ..self.color_settings()
        };
        let rates = StepRates::at(&self.config, stage, iteration, self.field.extent);
        let mut moving = 0;
        let mut known = 0;
        let mut group = |moments: &mut Moments, bit: u32, rate: f32, fastest: f32| {
            if fastest.is_nan() || fastest.abs() > MAX_RATE {
                known |= bit;
            }
            if fastest != 0.0 {
                moments.steps += 1;
                moving |= bit;
            }
            GroupStep { rate, steps: moments.steps }
        };
        let optimiser = &mut self.optimiser;
        let fastest_sh = rates.sh_base.max(rates.sh_rest);
        let step = GaussianStep {
            means: group(&mut optimiser.means, fault::MEANS, rates.means, rates.means),
            log_scales: group(
                &mut optimiser.log_scales,
                fault::LOG_SCALES,
                rates.log_scales,
                rates.log_scales,
            ),
            quaternions: group(
                &mut optimiser.quaternions,
                fault::QUATERNIONS,
                rates.quaternions,
                rates.quaternions,
            ),
            opacity: group(&mut optimiser.opacity, fault::OPACITY, rates.opacity, rates.opacity),
            occupancy: group(&mut optimiser.occupancy, fault::OCCUPANCY, rates.occupancy, rates.occupancy),
            sh: group(&mut optimiser.sh, fault::SH, rates.sh_base, fastest_sh),
            sh_rest: rates.sh_rest,
            sh_active: 3 * coefficient_count(self.field.sh_degree),
            visible_only: self.config.adam.visible_rows_only,
            own_corrections: self.config.adam.fresh_row_bias_correction,
            renormalise: (self.progress.total_steps + 1).is_multiple_of(RENORMALISE_EVERY),
            occupancy_limits: (stage == Stage::Instance && !self.config.ablates(Ablation::ConstantOccupancy))
                .then(|| self.config.instance.occupancy_limits.map(logit)),
        };
        let mut calibration = GroupStep::default();
        if self.field.identities.is_some() {
            let rate = rates.calibration;
            calibration = group(&mut optimiser.calibration, fault::CALIBRATIONS, rate, rate);
        }
        let (mut planes, mut mlp) = (GroupStep::default(), GroupStep::default());
        if self.field.deformation.is_some() {
            planes = group(&mut optimiser.planes, fault::PLANES, rates.planes, rates.planes);
            mlp = group(&mut optimiser.mlp, fault::MLP, rates.mlp, rates.mlp);
        }
        let mut exposures = GroupStep::default();
        if let Some(all) = &mut self.progress.exposures {
            let steps = all.steps_mut();
            *steps += 1;
            moving |= fault::EXPOSURES;
            exposures =
                GroupStep { rate: exposure_rate(&self.config, self.progress.total_steps), steps: *steps };
        }
        Ok(StepPlan {
            labelled: views.iter().map(|view| view.frame.labelled).sum(),
            views,
            stage,
            iteration,
            settings,
            weights: PlaneWeights {
                smoothness: self.config.loss.plane_smoothness,
                time_smoothness: self.config.loss.time_smoothness,
                time_sparsity: self.config.loss.time_sparsity,
            },
            step,
            calibration,
            planes,
            mlp,
            exposures,
            moving,
            known,
            gaussians: self.field.gaussians.len(),
        })
    }

    /// Takes back a step of some groups.
    pub(super) fn uncount(&mut self, groups: u32) {
        let optimiser = &mut self.optimiser;
        let counted = [
            (fault::MEANS, &mut optimiser.means),
            (fault::LOG_SCALES, &mut optimiser.log_scales),
            (fault::QUATERNIONS, &mut optimiser.quaternions),
            (fault::OPACITY, &mut optimiser.opacity),
            (fault::OCCUPANCY, &mut optimiser.occupancy),
            (fault::SH, &mut optimiser.sh),
            (fault::CALIBRATIONS, &mut optimiser.calibration),
            (fault::PLANES, &mut optimiser.planes),
            (fault::MLP, &mut optimiser.mlp),
        ];
        for (bit, moments) in counted {
            moments.steps -= u32::from(groups & bit != 0);
        }
        if let Some(exposures) = &mut self.progress.exposures {
            *exposures.steps_mut() -= u32::from(groups & fault::EXPOSURES != 0);
        }
    }

    /// Records and submits the views of a step, and the optimiser after them.
    pub(super) fn record(&mut self, device: &mut DeviceTraining, plan: StepPlan) -> Result<(), TrainError> {
        let Some(mut resident) = device.resident.take() else { return Ok(()) };
        let mut reads = Vec::with_capacity(plan.views.len());
        let mut submission = None;
        let mut result = Ok(());
        for k in 0..plan.views.len() {
            let recorded = self
                .view_on(device, &mut resident, &plan, k)
                .and_then(|view| device.gpu.check().map(|()| view).map_err(TrainError::from));
            match recorded {
                Ok((read, submitted)) => {
                    reads.push(read);
                    submission = Some(submitted);
                }
                Err(error) => {
                    result = Err(error);
                    break;
                }
            }
        }
        device.resident = Some(resident);
        result?;
        if let Some(submission) = submission {
            device.flights.push(Flight { plan, reads, submission });
        }
        Ok(())
    }
}
