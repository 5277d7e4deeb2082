//! An effect, as a run sees it.

use cif_field::Field;

use super::Bench;
use crate::error::TrainError;
use crate::progress::Progress;
use crate::schedule::Moment;

/// Place of a judgement, relative to the step that it falls on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Before the step.
    Before,
    /// Behind the step and its changes of the set of Gaussians.
    Behind,
}

/// The run as it is when it is decided whether an effect is judged.
#[derive(Clone, Copy)]
pub struct Standing<'a> {
    /// Field, whose set of Gaussians and network are up to date, but not the values that a GPU has trained since.
    pub field: &'a Field,
    pub(crate) progress: &'a Progress,
}

/// Something that costs time and memory, and that is judged while the run trains by what it gains on held-out pixels;
/// one file each. [`Trainer::add_effect`](crate::Trainer::add_effect) takes further ones.
///
/// Effects keep no state of their own: a resumed run judges as an uninterrupted one would, by the step and the field. A
/// judgement behind a step is done as a whole, or leaves everything as it was; what it took is counted by name in the
/// record of the run (`seconds_by_effect`).
pub trait Effect: Send + Sync {
    /// Name, as in the record of the run.
    fn name(&self) -> &'static str;

    /// Place of its judgement around a step.
    fn place(&self) -> Place {
        Place::Behind
    }

    /// True when it is judged around a step.
    fn due(&self, step: &Moment<'_>, standing: &Standing<'_>) -> bool;

    /// True when the pixels that it is judged by must train nothing in a step; those that the effects of every run need
    /// are held out in any case ([`Due::HoldOut`](crate::schedule::Due::HoldOut)).
    fn holds_out(&self, step: &Moment<'_>) -> bool {
        let _ = step;
        false
    }

    /// Collects evidence, decides by it, and applies what was decided.
    ///
    /// # Errors
    /// When a frame cannot be read, the engine fails, or the run is to stop.
    fn judge(&self, bench: &mut Bench<'_>) -> Result<(), TrainError>;
}
