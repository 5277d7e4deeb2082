//! Steps on the device, recorded and submitted.

use super::flight::Flight;
use super::gpu_engine::GpuEngine;
use super::recording::Recording;
use super::resident::{Resident, Stale};
use crate::error::TrainError;
use crate::state::State;

impl GpuEngine {
    /// Sends what the host has changed.
    pub(super) fn send(&mut self, state: &State) -> Result<(), TrainError> {
        if self.resident.is_none() {
            self.resident = Some(Resident::new(&self.gpu)?);
            self.stale = Stale::EVERYTHING;
        }
        let Some(resident) = &mut self.resident else { return Ok(()) };
        resident.send(&self.gpu, self.stale, state)?;
        if self.stale.gaussians {
            self.motion.send(&self.gpu, &state.guidance.guide_of)?;
            self.losses.leave_out(&self.gpu, state.guidance.travelling_labels().unwrap_or(&[]))?;
            self.make_room(state.field.gaussians.len())?;
        }
        self.stale = Stale::default();
        Ok(())
    }

    /// Records and submits the views of a step, and the optimiser after them.
    pub(super) fn record(&mut self, state: &mut State, recording: Recording) -> Result<(), TrainError> {
        let Some(mut resident) = self.resident.take() else { return Ok(()) };
        let mut reads = Vec::with_capacity(recording.plan.views.len());
        let mut submission = None;
        let mut result = Ok(());
        for k in 0..recording.plan.views.len() {
            let recorded = self
                .view_on(state, &mut resident, &recording, k)
                .and_then(|view| self.gpu.check().map(|()| view).map_err(TrainError::from));
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
        self.resident = Some(resident);
        result?;
        if let Some(submission) = submission {
            self.flights.push(Flight { recording, reads, submission });
        }
        Ok(())
    }
}
