//! Judging steps on the device before they move anything.

use cif_render::wgpu::{Commands, Gpu, GpuError, GpuVec, Kernel, Uniform};

use super::kernels::{JUDGE, Judgement, entries};

/// Recorded after every view of a step.
#[derive(Debug)]
pub struct GpuJudge {
    judgement: Uniform<Judgement>,
    judge: Kernel,
}

impl GpuJudge {
    /// # Errors
    /// When the driver rejects the kernel.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [judge] = entries(gpu, &JUDGE)?;
        Ok(Self { judgement: Uniform::new(gpu, "judgement", &Judgement::default()), judge })
    }

    /// Records the judgement of a view: its `results` and `counts` as losses and renderer leave them. After the last
    /// view of a step, bits of `faults` that count make steps wait for the host.
    pub fn record(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        judgement: Judgement,
        results: &GpuVec<[f32; 4]>,
        counts: &GpuVec<u32>,
        faults: &GpuVec<u32>,
    ) {
        self.judgement.write(gpu, &judgement);
        let bindings = [self.judgement.binding(), results.binding(), counts.binding(), faults.binding()];
        let group = self.judge.bind(gpu, &bindings);
        commands.stage("judge", |stage| stage.dispatch(&self.judge, &group, [1, 1, 1]));
    }
}
