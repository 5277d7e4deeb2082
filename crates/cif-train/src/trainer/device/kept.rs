//! What a trial step may change, kept so that it can be put back.

use cif_field::Field;
use cif_render::Gradients;

use super::super::guidance::Guidance;
use super::super::optimiser::Optimiser;
use super::super::progress::Progress;
use super::super::times::StepTimes;
use super::super::{StepLoss, Trainer};
use crate::densify::DensifyStatistics;

/// The host's side of a run.
pub(super) struct Kept {
    field: Field,
    optimiser: Optimiser,
    statistics: DensifyStatistics,
    progress: Progress,
    guidance: Guidance,
    unseen: Vec<bool>,
    label_pixels: Vec<f64>,
    times: StepTimes,
    loss: StepLoss,
    warnings: usize,
    debug_validation: bool,
}

impl Trainer {
    /// A copy of everything that steps change.
    pub(super) fn keep(&self) -> Kept {
        Kept {
            field: self.field.clone(),
            optimiser: self.optimiser.clone(),
            statistics: self.statistics.clone(),
            progress: self.progress.clone(),
            guidance: self.guidance.clone(),
            unseen: self.unseen.clone(),
            label_pixels: self.label_pixels.clone(),
            times: self.times,
            loss: self.last_loss,
            warnings: self.warnings.len(),
            debug_validation: self.debug_validation,
        }
    }

    /// Stands where the copy was made, with no gradients.
    pub(super) fn put_back(&mut self, kept: Kept) {
        (self.field, self.optimiser, self.statistics) = (kept.field, kept.optimiser, kept.statistics);
        (self.progress, self.guidance) = (kept.progress, kept.guidance);
        (self.unseen, self.label_pixels) = (kept.unseen, kept.label_pixels);
        (self.times, self.last_loss) = (kept.times, kept.loss);
        self.warnings.truncate(kept.warnings);
        self.set_debug_validation(kept.debug_validation);
        self.gradients = Gradients::zeros(&self.field);
    }
}
