//! Ways for tests to reach what lies on the device.

use std::any::Any;

use cif_render::wgpu::poses::PoseSum;

use super::gpu_engine::{FETCH_EVERY, GpuEngine};
use crate::engine::Engine;

impl GpuEngine {
    /// The engine behind the trait.
    pub(crate) fn of(engine: &mut dyn Engine) -> &mut Self {
        (engine as &mut dyn Any).downcast_mut().expect("steps run on the GPU")
    }

    /// Puts a value into the gradients of the next step, behind the back of everything: into those of a Gaussian's
    /// geometry, or of the exposures.
    pub(crate) fn damage(&mut self, column: Option<usize>, value: f32) {
        let resident = self.resident.as_ref().expect("a step was done");
        match column {
            Some(column) => {
                let mut row = [0.0; 12];
                row[column] = value;
                resident.gradients.geometry.write(&self.gpu, 3, &[row]);
            }
            None => resident.exposures.as_ref().unwrap().gradients().write(&self.gpu, 7, &[value]),
        }
    }

    /// Puts a value into the gradient of the first pose of the next step.
    pub(crate) fn damage_poses(&mut self, value: f32) {
        let poses = self.resident.as_ref().and_then(|resident| resident.poses.as_ref()).expect("groups");
        let sum = PoseSum { turn: [0.0, value, 0.0, 1.0], translation: [0.0; 4] };
        poses.groups.gradients.write(&self.gpu, 0, &[sum]);
    }

    /// Pairs and label slots that views needed so far.
    pub(crate) fn needed(&mut self) -> &mut [usize; 2] {
        &mut self.needed
    }

    /// Makes the run fetch the state behind the next step.
    pub(crate) fn make_far_ahead(&mut self) {
        self.since_fetch = FETCH_EVERY;
    }

    /// True when steps were recorded that the state does not hold.
    pub(crate) fn is_ahead(&self) -> bool {
        self.ahead
    }
}
