//! The identity stage: counts label mass over the training frames and makes identity rows of it.

use cif_field::parameters::OCCUPANCY_LOGITS;
use cif_geometry::scalar::{logit, sigmoid};
use cif_render::Gradients;

use super::Trainer;
use crate::config::{Ablation, HeadName, OccupancyStart, TrainConfig};
use crate::engine::Changed;
use crate::error::TrainError;
use crate::estimate::{RowSource, estimate};
use crate::events::TrainEvent;

/// Most views that identities are held against behind the instance stage, spread evenly.
const HELD_AGAINST: usize = 100;

/// Views that identities are estimated from, of so many training views, and those that they are held against behind the
/// instance stage, each as often as that is done: once for what masks contradict, and in every round of shares.
pub(crate) fn identity_views(config: &TrainConfig, views: usize) -> [usize; 2] {
    let all = views.div_ceil(config.identity.stride.max(1) as usize);
    let rounds = match config.head.name {
        HeadName::Cif if config.stages.instance > 0 => 1 + config.identity.share_rounds as usize,
        _ => 0,
    };
    [all, rounds * all.div_ceil(all.div_ceil(HELD_AGAINST).max(1))]
}

impl Trainer {
    /// Views that identities are held against behind the instance stage.
    pub(super) fn views_held_against(&self) -> Vec<usize> {
        let all: Vec<usize> = self.state.views_of_identities().collect();
        all.iter().copied().step_by(all.len().div_ceil(HELD_AGAINST).max(1)).collect()
    }

    /// Estimates the rows of all Gaussians; `starts` also sets occupancy to where the instance stage begins.
    pub(super) fn estimate_identities(&mut self, starts: bool) -> Result<TrainEvent, TrainError> {
        let k = self.state.field.instances.len();
        let before = std::mem::replace(&mut self.state.label_pixels, vec![0.0; k]);
        let (counts, frames) = match self.engine.count_labels(&mut self.state) {
            Ok(counted) => counted,
            Err(error) => {
                self.state.label_pixels = before;
                return Err(error);
            }
        };
        let extent = f64::from(self.state.field.extent);
        let estimated = estimate(&counts, &self.state.field.gaussians, extent, &self.state.config.identity);
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
            empty_instances: empty.iter().map(|k| self.state.field.instances[usize::from(*k)].id).collect(),
        };
        self.state.unseen = estimated.sources.iter().map(|source| *source != RowSource::Counted).collect();
        self.state.field.identities = Some(estimated.identities);
        self.state.optimiser.start_identities(&self.state.field);
        self.state.gradients = Gradients::zeros(&self.state.field);
        self.engine.changed(Changed::Identities);
        Ok(event)
    }

    /// Occupancy at the start of the instance stage (A5); Gaussians that nothing is known of start lower.
    fn start_occupancy(&mut self, sources: &[RowSource]) {
        let settings = &self.state.config.instance;
        let [low, high] = settings.occupancy_limits.map(logit);
        let unseen = logit(self.state.config.identity.unseen_occupancy);
        let constant = self.state.config.ablates(Ablation::ConstantOccupancy);
        let gaussians = &mut self.state.field.gaussians;
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
        let moments = self.state.optimiser.of(&OCCUPANCY_LOGITS);
        moments.reset_all();
        moments.steps = 0;
    }
}
