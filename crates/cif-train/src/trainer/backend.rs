//! The engine of a run: the processor unless a GPU is given, or the faster of both, determined by steps of the run that are
//! tried on both for about a second, and undone.

use std::time::Duration;

#[cfg(feature = "wgpu")]
pub use self::on_gpu::Probe;
use cif_render::cpu::{Renderer, SimdLevel};

use super::Trainer;
use crate::engine::processor::Processor;

impl Trainer {
    /// Chooses the vector instructions of the processor, the widest there are by default. Results of two levels
    /// differ by rounding.
    pub fn set_simd(&mut self, simd: SimdLevel) {
        self.simd = simd;
        if self.engine.gpu_name().is_none() {
            self.engine = Box::new(Processor::new(simd));
        }
    }

    /// Name of the vector instructions in use.
    #[must_use]
    pub fn simd_name(&self) -> String {
        Renderer::new(self.simd).simd_name()
    }

    /// Name of the vector instructions that runs take unless set otherwise.
    #[must_use]
    pub fn vector_instructions() -> String {
        Renderer::new(SimdLevel::Auto).simd_name()
    }

    /// Name of the GPU that steps run on, or `None` for the processor.
    #[must_use]
    pub fn gpu_name(&self) -> Option<&str> {
        self.engine.gpu_name()
    }

    /// Times the stages of every step on the GPU, where it has timestamps; steps then wait for it.
    pub fn time_gpu_stages(&mut self) {
        self.engine.time_stages();
    }

    /// Times of stages on the GPU since this was last asked, in the order in which they ran; none unless
    /// [`Self::time_gpu_stages`] was called and the device has timestamps.
    pub fn take_gpu_stages(&mut self) -> Vec<(&'static str, Duration)> {
        self.engine.take_stage_times()
    }
}

#[cfg(feature = "wgpu")]
mod on_gpu {
    use cif_render::wgpu::{Gpu, GpuError};

    use super::super::{Trainer, initialize};
    use crate::engine::Changed;
    use crate::engine::gpu::GpuEngine;
    use crate::engine::processor::Processor;
    use crate::error::TrainError;
    use crate::stage::Stage;

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
        /// Makes the steps of this run run on a GPU. May be called before or between runs.
        ///
        /// # Errors
        /// When the scene may grow beyond what the device holds, with the arithmetic; when the driver rejects a
        /// kernel.
        pub fn use_gpu(&mut self, gpu: &Gpu) -> Result<(), TrainError> {
            let state = &self.state;
            let fresh = match &state.field.deformation {
                None if self.stages.is_dynamic => {
                    Some(initialize::initial_deformation(&state.dataset, &state.config)?)
                }
                _ => None,
            };
            let deformation = state.field.deformation.as_ref().or(fresh.as_ref());
            let (dataset, config) = (&state.dataset, &state.config);
            let engine = GpuEngine::new(gpu, dataset, config, state.field.gaussians.len(), deformation)?;
            self.engine = Box::new(engine);
            Ok(())
        }

        /// Tries steps of the run on the processor and on a GPU, undoes them, and goes on with what is faster. Reads
        /// the clock of [`Self::set_clock`].
        ///
        /// # Errors
        /// As [`Self::use_gpu`], and when a step fails; the run then stays on the processor.
        pub fn use_faster(&mut self, gpu: &Gpu) -> Result<Probe, TrainError> {
            self.engine = Box::new(Processor::new(self.simd));
            let (kept, loss, messages) = (self.state.keep(), self.last_loss, self.messages.len());
            let stage = match self.state.progress.stage {
                // Fits leave no other steps to try.
                Stage::Search | Stage::Objects => Stage::Coarse,
                stage => stage,
            };
            let probed = self.probe(gpu, stage);
            self.state.put_back(kept);
            self.last_loss = loss;
            self.messages.truncate(messages);
            self.arrived.clear();
            let probe = probed.map(|(processor_s, gpu_s)| Probe { processor_s, gpu_s, stage });
            match &probe {
                Ok(probe) if probe.gpu_is_faster() => self.engine.changed(Changed::Everything),
                _ => self.engine = Box::new(Processor::new(self.simd)),
            }
            probe
        }

        /// Seconds of a step of a stage on either.
        fn probe(&mut self, gpu: &Gpu, stage: Stage) -> Result<(f64, f64), TrainError> {
            if !stage.has_steps() {
                // No step is left to compare; whatever is taken has nothing to do.
                return Ok((0.0, 0.0));
            }
            self.state.progress.stage = stage;
            let before = self.state.keep();
            let on_processor = self.time_of_steps()?;
            self.state.put_back(before);
            self.use_gpu(gpu)?;
            // Kernels are compiled and the scene is sent in a step that does not count.
            self.step(&mut Vec::new())?;
            self.fetch()?;
            let on_gpu = self.time_of_steps()?;
            if self.engine.gpu_name().is_none() {
                return Err(GpuError::Lost("it failed while it was tried".to_owned()).into());
            }
            Ok((on_processor, on_gpu))
        }

        /// Mean time of a step over [`SECONDS_EACH`], everything recorded being done.
        fn time_of_steps(&mut self) -> Result<f64, TrainError> {
            let start = self.state.phases.now().wall_s;
            let mut steps = 0_u32;
            loop {
                self.step(&mut Vec::new())?;
                steps += 1;
                if self.state.phases.now().wall_s - start >= SECONDS_EACH {
                    break;
                }
            }
            self.fetch()?;
            Ok((self.state.phases.now().wall_s - start) / f64::from(steps))
        }
    }
}
