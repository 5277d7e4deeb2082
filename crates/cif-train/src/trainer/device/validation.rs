//! Bad steps on a GPU: where they went wrong, and every array of a step looked at.

use super::super::Trainer;
use super::super::guard::Fault;
use super::DeviceTraining;
use super::step::Recording;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::wgpu::kernels::fault_name;

impl Trainer {
    /// Where a step that the device refused went wrong: it is repeated on the processor, with every array looked at.
    /// What goes wrong on the device alone is told by the group whose gradient it was.
    pub(super) fn diagnose(
        &mut self,
        device: &DeviceTraining,
        recording: &Recording,
        found: u32,
    ) -> Result<Fault, TrainError> {
        let (part, tensor) = fault_name(found);
        let unknown = Fault { part, tensor, index: 0, value: "not finite, on the GPU alone".to_owned() };
        let Some(resident) = &device.resident else { return Ok(unknown) };
        // The trial may change anything: all of it is put back.
        let kept = self.keep();
        let exposures = self.progress.exposures.as_mut();
        let (field, optimiser) = (&mut self.field, &mut self.optimiser);
        let fetched = resident.fetch(&device.gpu, field, optimiser, &mut self.statistics, exposures);
        let result = fetched.and_then(|()| {
            self.uncount(recording.moving);
            self.gradients = cif_render::Gradients::zeros(&self.field);
            self.set_debug_validation(true);
            self.attempt(&recording.plan, &mut Vec::new())
        });
        self.put_back(kept);
        match result {
            Ok(Some(fault)) => Ok(fault),
            // A lost device, say.
            Err(error @ TrainError::Gpu(_)) => Err(error),
            _ => Ok(unknown),
        }
    }

    /// A step under debug validation: the host looks at every parameter before it and at every parameter and moment
    /// after it; what is between is looked at by [`Self::diagnose`] where the device refuses the step.
    pub(super) fn validated_step(&mut self, events: &mut Vec<TrainEvent>) -> Result<(), TrainError> {
        self.fetch_from_device()?;
        let (snapshot, statistics) = (self.snapshot(), self.statistics.clone());
        let (exposures, psnr_before) = (self.progress.exposures.clone(), self.progress.psnr);
        let fault = match self.fault_before_step() {
            Some(fault) => {
                self.progress.count_step();
                Some(fault)
            }
            None => {
                self.unwatched_step()?;
                self.fetch_from_device()?;
                self.fault_after_step()
            }
        };
        let Some(fault) = fault else { return Ok(()) };
        // As before the step, but that it counts as done.
        self.progress.iteration -= 1;
        self.progress.psnr = psnr_before;
        let undone = self.roll_back(fault, snapshot, events);
        self.statistics = statistics;
        self.progress.exposures = exposures;
        self.everything_changed();
        self.progress.iteration += 1;
        if undone.is_err() {
            self.progress.uncount_steps(1);
        }
        undone
    }
}
