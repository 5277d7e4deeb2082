//! A training run that can be interrupted, and goes on when it is asked for again.

use std::path::Path;

use cif_dataset::Dataset;
use cif_field::Checkpoint;
use cif_train::{Control, Outcome, Stage, Start, Stop, TrainConfig, TrainError, TrainEvent, Trainer};

use crate::error::Error;

/// A training run.
pub(crate) struct Run<'a> {
    /// Where it is kept while it is interrupted.
    pub(crate) partial: &'a Path,
    pub(crate) dataset: &'a Dataset,
    pub(crate) config: &'a TrainConfig,
    /// Stage before which it ends; `None` for a whole run.
    pub(crate) until: Option<Stage>,
}

impl Run<'_> {
    /// Trains, going on where it was interrupted with the same settings, else as `begin` says. `progress` gets the
    /// steps done and all of them. `None` when `stop` says so.
    ///
    /// # Errors
    /// When a setting cannot work, or training fails.
    pub(crate) fn train(
        &self,
        begin: &dyn Fn(Start) -> Result<Trainer, TrainError>,
        stop: &Stop,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Option<Trainer>, Error> {
        let begun = match self.partial.is_file() {
            true => Checkpoint::load(self.partial).ok(),
            false => None,
        };
        let start = || Start { dataset: self.dataset.clone(), phases: stop.clone().into() };
        let resumed = begun.and_then(|checkpoint| Trainer::resume(start(), checkpoint).ok());
        let mut trainer = match resumed {
            // Settings may have changed since.
            Some(trainer) if trainer.config() == self.config => trainer,
            _ => match begin(start()) {
                Err(TrainError::Stopped) => return Ok(None),
                begun => begun.map_err(Error::plain)?,
            },
        };
        let whole = trainer.steps_done() + trainer.steps_left();
        let before = trainer.steps_done();
        // Steps of earlier stages, and those that this stage had and has.
        let (mut done, mut stage) = (0, (0, 0));
        let mut is_there = false;
        let outcome = trainer.run(&mut |event, _| {
            if let TrainEvent::StageStarted { stage: begins, iteration, .. } = event {
                (done, stage) = (done + stage.1 - stage.0, (*iteration, *iteration));
                is_there = Some(*begins) == self.until;
            }
            if let TrainEvent::Step { iteration, .. } = event {
                stage.1 = *iteration;
                progress(before + u64::from(done + stage.1 - stage.0), whole);
            }
            if is_there { Control::Stop } else { Control::Continue }
        });
        if outcome.map_err(Error::plain)? == Outcome::Interrupted && !is_there {
            trainer.checkpoint(true).save(self.partial).map_err(Error::plain)?;
            return Ok(None);
        }
        if self.partial.is_file() {
            std::fs::remove_file(self.partial).map_err(Error::io("remove", self.partial))?;
        }
        Ok(Some(trainer))
    }
}
