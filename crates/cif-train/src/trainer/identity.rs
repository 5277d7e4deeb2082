//! The identity stage: counts label mass over the training frames and makes identity rows of it.

use cif_field::parameters::OCCUPANCY_LOGITS;
use cif_geometry::PixelGrid;
use cif_geometry::scalar::{logit, sigmoid};
use cif_render::cpu::IdentityCounts;
use cif_render::{Gradients, UNLABELLED};

use super::Trainer;
use crate::config::{Ablation, OccupancyStart};
use crate::error::TrainError;
use crate::estimate::{RowSource, estimate};
use crate::events::TrainEvent;

impl Trainer {
    /// Estimates the rows of all Gaussians; `starts` also sets occupancy to where the instance stage begins.
    pub(super) fn estimate_identities(&mut self, starts: bool) -> Result<TrainEvent, TrainError> {
        let k = self.field.instances.len();
        let before = std::mem::replace(&mut self.label_pixels, vec![0.0; k]);
        let (counts, frames) = match self.count_labels() {
            Ok(counted) => counted,
            Err(error) => {
                self.label_pixels = before;
                return Err(error);
            }
        };
        let extent = f64::from(self.field.extent);
        let estimated = estimate(&counts, &self.field.gaussians, extent, &self.config.identity);
        if starts {
            self.start_occupancy(&estimated.sources);
        }
        let n = estimated.identities.len().max(1);
        let empty = estimated.empty_instances();
        let event = TrainEvent::IdentityEstimated {
            frames,
            instances: k,
            entries_per_row: estimated.identities.labels.len() as f64 / n as f64,
            unseen: n - estimated.count(RowSource::Counted),
            uniform: estimated.count(RowSource::Uniform),
            dropped_mass: estimated.dropped_mass,
            empty_instances: empty.iter().map(|k| self.field.instances[usize::from(*k)].id).collect(),
        };
        self.unseen = estimated.sources.iter().map(|source| *source != RowSource::Counted).collect();
        self.field.identities = Some(estimated.identities);
        self.optimiser.start_identities(&self.field);
        self.gradients = Gradients::zeros(&self.field);
        #[cfg(feature = "wgpu")]
        self.identities_changed();
        Ok(event)
    }

    /// Label mass of the frames that identities are estimated from, and how many there are.
    fn count_labels(&mut self) -> Result<(IdentityCounts, usize), TrainError> {
        #[cfg(feature = "wgpu")]
        if let Some(counted) = self.count_on_device()? {
            return Ok(counted);
        }
        let settings = self.color_settings();
        let mut counts = IdentityCounts::zeros(self.field.gaussians.len(), self.field.instances.len());
        let mut frames = 0;
        for view in (0..self.frames.len()).step_by(self.config.identity.stride as usize) {
            self.check_stop()?;
            let data = self.frames.get(&self.dataset, view)?;
            let Some(labels) = data.labels.as_ref().filter(|_| data.labelled > 0) else { continue };
            let frame = &self.dataset.frames[self.frames.index(view)];
            self.renderer.count_identities(
                &self.field,
                &frame.camera,
                frame.time,
                &settings,
                labels,
                &mut counts,
            );
            self.add_label_pixels(labels);
            frames += 1;
        }
        Ok((counts, frames))
    }

    /// Adds the labelled pixels of a frame that identities are estimated from.
    pub(super) fn add_label_pixels(&mut self, labels: &PixelGrid<u16>) {
        for label in labels.pixels.iter().filter(|label| **label != UNLABELLED) {
            self.label_pixels[usize::from(*label) - 1] += 1.0;
        }
    }

    /// Occupancy at the start of the instance stage (A5); Gaussians that nothing is known of start lower.
    fn start_occupancy(&mut self, sources: &[RowSource]) {
        let settings = &self.config.instance;
        let [low, high] = settings.occupancy_limits.map(logit);
        let unseen = logit(self.config.identity.unseen_occupancy);
        let constant = self.config.ablates(Ablation::ConstantOccupancy);
        let gaussians = &mut self.field.gaussians;
        for (row, source) in sources.iter().enumerate() {
            gaussians.occupancy_logits[row] = match (settings.occupancy_start, source) {
                _ if constant => logit(settings.occupancy),
                (_, RowSource::Uniform) => unseen,
                (OccupancyStart::CopyOpacity, _) => {
                    // Through the probability, so that infinite logits cannot come out.
                    logit(sigmoid(gaussians.opacity_logits[row]).clamp(1e-6, 1.0 - 1e-6)).clamp(low, high)
                }
                (OccupancyStart::Constant, _) => logit(settings.occupancy),
            };
        }
        let moments = self.optimiser.of(&OCCUPANCY_LOGITS);
        moments.reset_all();
        moments.steps = 0;
    }
}
