//! Steps on the device: planned as any other, recorded, and taken in when they arrive.

use super::super::Trainer;
use super::super::guard::MAX_RATE;
use super::super::step::StepLoss;
use super::super::step_plan::StepPlan;
use super::flight::Flight;
use super::resident::{Resident, Stale};
use super::{DeviceTraining, FETCH_EVERY};
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::wgpu::kernels::fault;
use crate::wgpu::optimiser::{GroupStep, GroupSteps};

/// A step as it is recorded, and recorded again where it has to be.
pub(super) struct Recording {
    pub(super) plan: StepPlan,
    /// Rates and step counts of the parameters.
    pub(super) groups: GroupSteps,
    /// Rate and step count of the exposures.
    pub(super) exposures: GroupStep,
    /// Parameters that move, as bits of the fault word.
    pub(super) moving: u32,
    /// Parameters that cannot move, likewise, as known before the step is recorded.
    pub(super) known: u32,
}

impl Recording {
    /// One step less of some parameters before this one.
    pub(super) fn uncount(&mut self, parameters: u32) {
        self.groups.uncount(parameters);
        self.exposures.steps -= u32::from(parameters & fault::EXPOSURES != 0);
    }
}

impl Trainer {
    /// A step on the device, where there is one; the loss is that of the last step that has arrived.
    pub(in crate::trainer) fn step_on_device(
        &mut self,
        events: &mut Vec<TrainEvent>,
    ) -> Result<Option<StepLoss>, TrainError> {
        if self.device.is_none() {
            return Ok(None);
        }
        if self.debug_validation {
            self.validated_step(events)?;
        } else {
            self.unwatched_step()?;
        }
        Ok(Some(self.last_loss))
    }

    /// True when steps are recorded that the host does not know the results of.
    pub(in crate::trainer) fn device_is_ahead(&self) -> bool {
        self.device.as_ref().is_some_and(|device| device.ahead)
    }

    /// True when so many steps were recorded since the last fetch that a lost device would cost too much.
    pub(in crate::trainer) fn device_is_far_ahead(&self) -> bool {
        self.device.as_ref().is_some_and(|device| device.since_fetch >= FETCH_EVERY)
    }

    /// Records a step, and takes in what has arrived.
    pub(super) fn unwatched_step(&mut self) -> Result<(), TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(()) };
        let waits = device.waits;
        let result = self.step_on(&mut device).and_then(|()| self.receive(&mut device, waits));
        self.device = Some(device);
        result
    }

    fn step_on(&mut self, device: &mut DeviceTraining) -> Result<(), TrainError> {
        if !device.ahead {
            device.fetched = Some(self.counters());
        }
        self.send(device)?;
        let plan = self.plan_step(self.progress.stage, self.progress.iteration + 1)?;
        let recording = self.count(plan);
        self.record(device, recording)?;
        device.ahead = true;
        device.since_fetch += 1;
        self.progress.count_step();
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

    /// Counts a step of every parameter that moves.
    fn count(&mut self, plan: StepPlan) -> Recording {
        let (mut moving, mut known) = (0, 0);
        let mut groups = GroupSteps::default();
        let has_values: Vec<bool> =
            self.field.tensors().iter().map(|(_, values)| !values.is_empty()).collect();
        let groups_of_field = self.optimiser.groups_mut().iter_mut().zip(has_values);
        for ((parameter, moments), _) in groups_of_field.filter(|(_, has_values)| *has_values) {
            let rates = plan.rates.of(parameter);
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
        let mut exposures = GroupStep::default();
        if let (Some(all), Some(rate)) = (&mut self.progress.exposures, plan.exposure_rate) {
            let steps = all.steps_mut();
            *steps += 1;
            moving |= fault::EXPOSURES;
            exposures = GroupStep::uniform(rate, *steps);
        }
        Recording { plan, groups, exposures, moving, known }
    }

    /// Takes back a step of some parameters.
    pub(super) fn uncount(&mut self, parameters: u32) {
        for (parameter, moments) in self.optimiser.groups_mut() {
            moments.steps -= u32::from(parameters & fault::bit(parameter) != 0);
        }
        if let Some(exposures) = &mut self.progress.exposures {
            *exposures.steps_mut() -= u32::from(parameters & fault::EXPOSURES != 0);
        }
    }

    /// Records and submits the views of a step, and the optimiser after them.
    pub(super) fn record(
        &mut self,
        device: &mut DeviceTraining,
        recording: Recording,
    ) -> Result<(), TrainError> {
        let Some(mut resident) = device.resident.take() else { return Ok(()) };
        let mut reads = Vec::with_capacity(recording.plan.views.len());
        let mut submission = None;
        let mut result = Ok(());
        for k in 0..recording.plan.views.len() {
            let recorded = self
                .view_on(device, &mut resident, &recording, k)
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
            device.flights.push(Flight { recording, reads, submission });
        }
        Ok(())
    }
}
