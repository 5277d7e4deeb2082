//! A training run with the file that it saves into.

use cif_train::{Control, Outcome, Phase, TrainError, TrainEvent, Trainer, TrainerView};

use crate::destination::{Destination, Unsaved};
use crate::error::Error;

/// Runs a trainer to its end or to a request to stop, and saves into `destination`, where there is one, whenever the
/// run asks for it and in the end. A run that was stopped, or that failed on the way, is saved with its state, unless it
/// was stopped before it had done anything: what is there, or is not, then stays as it is. `observe` gets the run at the
/// events that come from it.
///
/// # Errors
/// When training fails or a state cannot be saved.
pub fn run(
    trainer: &mut Trainer,
    mut destination: Option<&mut Destination>,
    observe: &mut dyn FnMut(&TrainEvent, Option<&TrainerView<'_>>) -> Control,
) -> Result<Outcome, Error> {
    let mut taken = None;
    let outcome = trainer.run(&mut |event, view| {
        let control = observe(event, Some(view));
        if matches!(event, TrainEvent::CheckpointDue { .. })
            && let Some(destination) = destination.as_deref_mut()
        {
            let phase = view.phases().enter(Phase::Save, 0);
            let saved = destination.save(&view.checkpoint(true), view.config());
            drop(phase);
            match saved {
                Ok(()) => {}
                Err(Unsaved::Taken(error)) => {
                    taken = Some(error);
                    return Control::Stop;
                }
                // There may be space again when the next state is due.
                Err(Unsaved::Refused(error)) => {
                    let message = format!("{error}; the run continues without saving");
                    observe(&TrainEvent::Warning { message }, None);
                }
            }
        }
        control
    });
    if let Some(error) = taken {
        return Err(error);
    }
    let Some(destination) = destination else { return outcome.map_err(Error::plain) };
    let phases = trainer.phases().clone();
    let _run = phases.enter(Phase::Save, 0);
    let outcome = outcome.map_err(|error| stopped_by(&error, trainer, destination))?;
    if outcome == Outcome::Interrupted && !trainer.has_begun() {
        return Ok(outcome);
    }
    destination.save_or_rescue(&trainer.checkpoint(outcome == Outcome::Interrupted), trainer.config())?;
    Ok(outcome)
}

/// Error of a run that failed. Its state is saved: everything up to the failed step is good, and hours may be in it.
fn stopped_by(error: &TrainError, trainer: &Trainer, destination: &mut Destination) -> Error {
    if trainer.steps_done() == 0 {
        return Error::plain(error);
    }
    match destination.save_or_rescue(&trainer.checkpoint(true), trainer.config()) {
        Ok(()) => Error::failed(
            error.to_string(),
            format!("{} holds the state before that step", destination.path().display()),
        ),
        Err(unsaved) => Error::failed(error.to_string(), format!("its state could not be saved: {unsaved}")),
    }
}
