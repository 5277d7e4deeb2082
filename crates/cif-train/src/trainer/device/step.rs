//! One optimiser step on the device; its twin is `trainer/step.rs`.

use std::sync::Arc;
use std::time::Instant;

use cif_geometry::scalar::logit;
use cif_render::RenderSettings;

use super::super::frames::TrainFrame;
use super::super::guard::MAX_RATE;
use super::super::optimiser::StepRates;
use super::super::step::{RENORMALISE_EVERY, StepLoss, exposure_rate};
use super::super::{InstancePass, Trainer};
use super::DeviceTraining;
use super::flight::Flight;
use super::resident::{Resident, Stale};
use crate::adam::PlaneWeights;
use crate::config::Ablation;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::wgpu::kernels::fault;
use crate::wgpu::optimiser::{GaussianStep, GroupStep, GroupSteps};

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
    pub(super) groups: GroupSteps,
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
        self.groups.uncount(groups);
        self.exposures.steps -= u32::from(groups & fault::EXPOSURES != 0);
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
        let (field, optimiser) = (&self.field, &mut self.optimiser);
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
        let rates = StepRates::at(&self.config, stage, iteration, &self.field);
        let (mut moving, mut known) = (0, 0);
        let mut groups = GroupSteps::default();
        let has_values: Vec<bool> =
            self.field.tensors().iter().map(|(_, values)| !values.is_empty()).collect();
        let groups_of_field = self.optimiser.groups_mut().iter_mut().zip(has_values);
        for ((parameter, moments), _) in groups_of_field.filter(|(_, has_values)| *has_values) {
            let rates = rates.of(parameter);
            let fastest = rates.fastest();
            if fastest.is_nan() || fastest.abs() > MAX_RATE {
                known |= fault::bit(parameter);
            }
            if fastest != 0.0 {
                moments.steps += 1;
                moving |= fault::bit(parameter);
            }
            groups.0.push((*parameter, GroupStep { rates, steps: moments.steps }));
        }
        let step = GaussianStep {
            visible_only: self.config.adam.visible_rows_only,
            renormalise: (self.progress.total_steps + 1).is_multiple_of(RENORMALISE_EVERY),
            occupancy_limits: (stage == Stage::Instance && !self.config.ablates(Ablation::ConstantOccupancy))
                .then(|| self.config.instance.occupancy_limits.map(logit)),
        };
        let mut exposures = GroupStep::default();
        if let Some(all) = &mut self.progress.exposures {
            let steps = all.steps_mut();
            *steps += 1;
            moving |= fault::EXPOSURES;
            let rate = exposure_rate(&self.config, self.progress.total_steps);
            exposures = GroupStep::uniform(rate, *steps);
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
            groups,
            exposures,
            moving,
            known,
            gaussians: self.field.gaussians.len(),
        })
    }

    /// Takes back a step of some groups.
    pub(super) fn uncount(&mut self, groups: u32) {
        for (parameter, moments) in self.optimiser.groups_mut() {
            moments.steps -= u32::from(groups & fault::bit(parameter) != 0);
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
