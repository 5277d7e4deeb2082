//! The optimiser of poses on the device.

use cif_render::wgpu::{Commands, Gpu, GpuError, GpuGaussians, GpuPoses, GpuVec, Kernel, Uniform};

use super::kernels::{ADAM_POSES, PoseRates, PoseState, entries};
use crate::poses::PoseMoments;

/// Recorded after the last view of a step.
#[derive(Debug)]
pub(crate) struct GpuPoseOptimiser {
    moments: GpuVec<PoseState>,
    rates: Uniform<PoseRates>,
    step: Kernel,
    hold_joints: Kernel,
}

impl GpuPoseOptimiser {
    /// A copy of the moments of the poses of a field.
    ///
    /// # Errors
    /// When the device is out of memory; when the driver rejects the kernel.
    pub(crate) fn new(gpu: &Gpu, moments: &PoseMoments) -> Result<Self, GpuError> {
        let [step, hold_joints] = entries(gpu, &ADAM_POSES)?;
        Ok(Self {
            moments: GpuVec::from_slice(gpu, "moments of the poses", &rows(moments))?,
            rates: Uniform::new(gpu, "rate of the poses", &PoseRates::default()),
            step,
            hold_joints,
        })
    }

    /// Reads the moments, waiting for the device.
    ///
    /// # Errors
    /// When the device is lost.
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<PoseMoments, GpuError> {
        let rows = self.moments.read(gpu)?;
        let six = |turn: [f32; 4], translation: [f32; 4]| {
            [turn[0], turn[1], turn[2], translation[0], translation[1], translation[2]].map(f64::from)
        };
        Ok(PoseMoments {
            first: rows.iter().map(|row| six(row.first_turn, row.first_translation)).collect(),
            second: rows.iter().map(|row| six(row.second_turn, row.second_translation)).collect(),
            steps: rows.iter().map(|row| row.first_turn[3] as u32).collect(),
            shares: rows.iter().map(|row| f64::from(row.first_translation[3])).collect(),
        })
    }

    /// Records the step of the poses that views were drawn of, at a `rate` of 0 none; gradients become zero, and parts
    /// stay on their joints. Nothing
    /// moves while the second word of `faults` makes steps wait.
    pub(crate) fn step(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        rate: f64,
        groups: &GpuPoses,
        canonical: &GpuGaussians,
        faults: &GpuVec<u32>,
    ) {
        self.rates.write(gpu, &PoseRates { rate: rate as f32, ..PoseRates::default() });
        let bindings = [
            self.rates.binding(),
            groups.views.binding(),
            groups.members.binding(),
            canonical.geometry.binding(),
            groups.poses.binding(),
            groups.gradients.binding(),
            self.moments.binding(),
            faults.binding(),
        ];
        let group = self.step.bind(gpu, &bindings);
        let joints = self.hold_joints.bind(gpu, &bindings);
        commands.stage("optimiser: Gaussians", |stage| {
            stage.dispatch(&self.step, &group, [groups.groups() as u32, 1, 1]);
            stage.dispatch(&self.hold_joints, &joints, [1, 1, 1]);
        });
    }
}

/// Moments in the layout of the device.
fn rows(moments: &PoseMoments) -> Vec<PoseState> {
    let halves = |six: &[f64; 6]| {
        let [a, b, c, d, e, f] = six.map(|value| value as f32);
        ([a, b, c, 0.0], [d, e, f, 0.0])
    };
    let PoseMoments { first, second, steps, shares } = moments;
    let rows = first.iter().zip(second).zip(steps.iter().zip(shares));
    rows.map(|((first, second), (steps, share))| {
        let ((mut first_turn, mut first_translation), (second_turn, second_translation)) =
            (halves(first), halves(second));
        (first_turn[3], first_translation[3]) = (*steps as f32, *share as f32);
        PoseState { first_turn, first_translation, second_turn, second_translation }
    })
    .collect()
}
