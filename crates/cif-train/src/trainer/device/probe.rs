//! Which is faster on this scene, the GPU or the processor: steps of the run are tried on both for about a second,
//! and undone.

use cif_render::wgpu::{Gpu, GpuError};

use super::super::Trainer;
use crate::error::TrainError;
use crate::events::Stage;

/// Time that a probe takes on either, seconds; one step is tried however long it takes.
const SECONDS_EACH: f64 = 0.5;

/// Times of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probe {
    /// On the processor, seconds.
    pub processor_s: f64,
    /// On the GPU, seconds.
    pub gpu_s: f64,
    /// Stage that the steps were of.
    pub stage: Stage,
}

impl Probe {
    /// True when the GPU is to be taken.
    #[must_use]
    pub fn gpu_is_faster(&self) -> bool {
        self.gpu_s < self.processor_s
    }
}

impl std::fmt::Display for Probe {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { processor_s, gpu_s, stage } = self;
        let (gpu_ms, processor_ms) = (1e3 * gpu_s, 1e3 * processor_s);
        write!(
            f,
            "a step of the {stage} stage takes {gpu_ms:.1} ms on the GPU and {processor_ms:.1} ms on the processor"
        )
    }
}

impl Trainer {
    /// Tries steps of the run on the processor and on a GPU, undoes them, and goes on with what is faster. Reads the
    /// clock of [`Self::set_clock`].
    ///
    /// # Errors
    /// As [`Self::use_gpu`], and when a step fails; the run then stays on the processor.
    pub fn use_faster(&mut self, gpu: &Gpu) -> Result<Probe, TrainError> {
        self.device = None;
        let kept = self.keep();
        let stage = self.progress.stage;
        let probed = self.probe(gpu);
        let device = self.device.take();
        self.put_back(kept);
        self.arrived.clear();
        let (processor_s, gpu_s) = probed?;
        let probe = Probe { processor_s, gpu_s, stage };
        if probe.gpu_is_faster() {
            self.device = device;
            self.everything_changed();
        }
        Ok(probe)
    }

    /// Seconds of a step on either, at the head of the present stage.
    fn probe(&mut self, gpu: &Gpu) -> Result<(f64, f64), TrainError> {
        if !matches!(self.progress.stage, Stage::Coarse | Stage::Fine | Stage::Instance) {
            // No step is left to compare; whatever is taken has nothing to do.
            return Ok((0.0, 0.0));
        }
        let before = self.keep();
        let on_processor = self.time_of_steps()?;
        self.put_back(before);
        self.use_gpu(gpu)?;
        // Kernels are compiled and the scene is sent in a step that does not count.
        self.step(&mut Vec::new())?;
        self.fetch_from_device()?;
        let on_gpu = self.time_of_steps()?;
        if self.device.is_none() {
            return Err(GpuError::Lost("it failed while it was tried".to_owned()).into());
        }
        Ok((on_processor, on_gpu))
    }

    /// Mean time of a step over [`SECONDS_EACH`], everything recorded being done.
    fn time_of_steps(&mut self) -> Result<f64, TrainError> {
        let start = self.clock.now().wall_s;
        let mut steps = 0_u32;
        loop {
            self.step(&mut Vec::new())?;
            steps += 1;
            if self.clock.now().wall_s - start >= SECONDS_EACH {
                break;
            }
        }
        self.fetch_from_device()?;
        Ok((self.clock.now().wall_s - start) / f64::from(steps))
    }
}
