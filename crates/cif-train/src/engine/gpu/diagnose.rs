//! Where a step that the device refused went wrong.

use cif_render::cpu::SimdLevel;

use super::super::processor::Processor;
use super::super::validation;
use super::gpu_engine::GpuEngine;
use super::recording::Recording;
use crate::error::TrainError;
use crate::guard::Fault;
use crate::state::State;
use crate::wgpu::kernels::fault_name;

impl GpuEngine {
    /// The fault of a step that the device refused, whose parameters are not counted any more: the step is repeated
    /// on the processor, with every array looked at. What goes wrong on the device alone is identified by the group whose
    /// gradient it was.
    pub(super) fn diagnose(
        &mut self,
        state: &mut State,
        recording: &Recording,
        found: u32,
    ) -> Result<Fault, TrainError> {
        let (part, tensor) = fault_name(found);
        let unknown = Fault { part, tensor, index: 0, value: "not finite, on the GPU alone".to_owned() };
        let Some(resident) = &self.resident else { return Ok(unknown) };
        // The trial may change anything: all of it is put back.
        let kept = state.keep();
        let result = resident.fetch(&self.gpu, state).and_then(|()| {
            state.gradients = cif_render::Gradients::zeros(&state.field);
            let mut processor = Processor::new(SimdLevel::Auto);
            validation::step(&mut processor, state, recording.plan.clone())
        });
        state.put_back(kept);
        match result {
            Ok(report) => Ok(report.fault.unwrap_or(unknown)),
            // A lost device, say.
            Err(error @ TrainError::Device(_)) => Err(error),
            Err(_) => Ok(unknown),
        }
    }
}
