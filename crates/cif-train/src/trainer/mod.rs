//! A run, from a capture to a trained field.

use cif_dataset::Dataset;
use cif_field::Field;
use cif_field::checkpoint::Checkpoint;

use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::events::{Control, Outcome, TrainEvent, TrainerView};

/// Trains one field on one capture.
pub struct Trainer {
    dataset: Dataset,
    config: TrainConfig,
    field: Field,
}

impl Trainer {
    /// A run at its start.
    ///
    /// # Errors
    /// When a setting cannot work, or the capture has no training frame or no initial point.
    pub fn new(_dataset: Dataset, _config: TrainConfig) -> Result<Self, TrainError> {
        todo!()
    }

    /// A run where a checkpoint with state left it; settings come from the checkpoint.
    ///
    /// # Errors
    /// When the checkpoint has no training state, or belongs to another capture.
    pub fn resume(_dataset: Dataset, _checkpoint: Checkpoint) -> Result<Self, TrainError> {
        todo!()
    }

    /// Runs all stages that are left; `observer` sees every event and may stop the run.
    ///
    /// # Errors
    /// When a frame cannot be read, or a loss or gradient is not finite; the field is the last finite one.
    pub fn run(
        &mut self,
        _observer: &mut dyn FnMut(&TrainEvent, &TrainerView<'_>) -> Control,
    ) -> Result<Outcome, TrainError> {
        todo!()
    }

    /// The field as it is now; with state, what [`Trainer::resume`] needs as well.
    #[must_use]
    pub fn checkpoint(&self, _with_state: bool) -> Checkpoint {
        todo!()
    }

    /// The field as it is now.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The run's settings.
    #[must_use]
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// The capture.
    #[must_use]
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }
}
