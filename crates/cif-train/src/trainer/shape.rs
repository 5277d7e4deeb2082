//! Sizes of a step: numbers of Gaussians, pairs and pixels that its stages work on.

use cif_render::constants::TILE;

use super::Trainer;
use crate::floors::{DeformationShape, StepShape};
use crate::stage::Stage;
use crate::times::StepTimes;

impl Trainer {
    /// Size of a step of the present stage, mean over measured `steps`. Pixels are those of a mean frame;
    /// evaluated pairs are 0 where none of the steps counts them, as those on a GPU do not.
    #[must_use]
    pub fn step_shape(&self, steps: &[StepTimes]) -> StepShape {
        let mean =
            |of: fn(&StepTimes) -> u64| steps.iter().map(of).sum::<u64>() as f64 / steps.len().max(1) as f64;
        let frames = &self.state.dataset.frames;
        let of_frames = |of: &dyn Fn(u32, u32) -> f64| {
            let sum: f64 = frames.iter().map(|frame| of(frame.camera.width, frame.camera.height)).sum();
            sum / frames.len().max(1) as f64
        };
        let views = mean(|step| step.views);
        let degree = f64::from(self.state.field.sh_degree);
        let entries = self.state.field.identities.as_ref().map_or(0, |rows| rows.labels.len());
        let n = self.state.field.gaussians.len();
        StepShape {
            views,
            gaussians: n as f64,
            visible: mean(|step| step.visible),
            pairs: mean(|step| step.tile_pairs),
            evaluated_pairs: mean(|step| step.evaluated_pairs),
            pixels: views * of_frames(&|width, height| f64::from(width) * f64::from(height)),
            tiles: of_frames(&|width, height| f64::from(width.div_ceil(TILE) * height.div_ceil(TILE))),
            coefficients: (degree + 1.0) * (degree + 1.0),
            identity_entries: if self.stage() == Stage::Instance { entries as f64 } else { 0.0 },
            similarity: self.state.config.loss.lambda_dssim > 0.0,
            deformation: self.state.field.deformation.as_ref().and_then(|d| DeformationShape::new(d, n)),
        }
    }
}
