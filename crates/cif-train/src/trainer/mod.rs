//! A run, from a capture to a trained field.
//!
//! | file | answers |
//! |---|---|
//! | `assemble`, `initialize` | what a run starts from |
//! | `near` | how near to the cameras Gaussians are drawn |
//! | `run` | how it goes through its stages, and where it may be stopped |
//! | `plan_step` | what decides a step |
//! | `step` | how a step is done, and what falls behind it |
//! | `heads` | what heads of other systems see and change between steps |
//! | `guidance` | how travelling objects start on the paths that masks show |
//! | `seeds` | what objects begin with that nothing was made of |
//! | `objects`, `parts` | which objects move as a whole or in a part, and how they join the field |
//! | `identity` | how identity rows come about |
//! | `shares` | how much of a Gaussian is of any instance |
//! | `contradicted` | which Gaussians masks show to be of no instance |
//! | `continued` | where bodies are before the first and after the last training frame |
//! | `from_scene` | how a run begins with an earlier reconstruction |
//! | `saved`, `resume` | what is saved, and how a run resumes |
//! | `measured_frames`, `evaluate` | what a run has reached, on a few frames |
//! | `pace`, `pacing` | when stages end by time, or by what was reached |
//! | `cost`, `eta` | what a step costs, and how long the rest of a run takes |
//! | `saving` | when a run asks to be saved |
//! | `measure`, `shape` | steps for measuring, and what they work on |
//! | `backend` | which engine computes the steps |
//!
//! Random choices depend on the seed and the step alone (see `random`), and all sums have a fixed order: a
//! run that was interrupted and resumed ends bit for bit where an uninterrupted one ends, on any number of
//! threads.

mod assemble;
mod backend;
mod continued;
mod contradicted;
mod contributions;
mod cost;
mod eta;
mod evaluate;
mod from_scene;
#[cfg(test)]
#[cfg(feature = "wgpu")]
mod gpu_pose_tests;
#[cfg(test)]
#[cfg(feature = "wgpu")]
mod gpu_tests;
#[cfg(test)]
pub(crate) mod guard_tests;
mod guidance;
#[cfg(test)]
mod guidance_tests;
#[cfg(test)]
mod half_size_tests;
#[cfg(test)]
mod head_tests;
mod heads;
mod identity;
mod initialize;
mod measure;
mod measured_frames;
mod near;
mod objects;
mod pace;
mod pacing;
mod parts;
mod plan_step;
mod provenance;
mod resume;
mod run;
mod saved;
mod saving;
mod seeds;
#[cfg(feature = "wgpu")]
mod shape;
mod shares;
mod step;

use std::collections::BTreeMap;
use std::sync::Arc;

use cif_dataset::{Dataset, MadeFrom};
use cif_field::Field;
use cif_render::cpu::SimdLevel;

#[cfg(feature = "wgpu")]
pub use self::backend::Probe;
use self::cost::Reports;
pub(crate) use self::identity::identity_views;
pub(crate) use self::initialize::{
    automatic_time_nodes, deformation_shape, memory_of_gaussians, memory_of_planes,
};
use self::measured_frames::MeasuredFrames;
use self::pace::Pacing;
pub use self::resume::accept_changes;
use self::saved::SavedHead;
use self::saving::Saving;
use crate::clock::{Clock, Seconds};
use crate::config::TrainConfig;
use crate::curve::Curve;
use crate::density::Strategy;
use crate::effects::Effect;
use crate::effects::changes::Changes;
use crate::engine::Engine;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::heads::Head;
use crate::phases::Phases;
use crate::progress::Progress;
use crate::schedule::{Facts, Moment, Stages};
use crate::stage::Stage;
use crate::state::State;
use crate::step::{InstancePass, StepLoss};
use crate::times::{StepTimes, Work};

/// Trains one field on one capture.
pub struct Trainer {
    pub(crate) state: State,
    /// Adds and removes Gaussians.
    density: Arc<dyn Strategy>,
    /// Effects that are judged while it trains, in order.
    effects: Vec<Arc<dyn Effect>>,
    /// Computes the steps.
    engine: Box<dyn Engine>,
    /// Vector instructions of the processor.
    simd: SimdLevel,
    stages: Stages,
    /// Order of the training views of an epoch, by stage and epoch.
    order: Option<((Stage, u64), Vec<u32>)>,
    /// True when every camera stays in place, and where these see changes, once that is asked.
    shows_changes: bool,
    changes: Option<Changes>,
    /// True when every array of a step is looked at.
    debug_validation: bool,
    /// Off only while the cost of the pass is measured.
    instance_pass: InstancePass,
    /// When the next state is saved by time.
    saving: Saving,
    /// Frames that the curve is measured on.
    measured_frames: MeasuredFrames,
    /// Content of the capture.
    inputs: MadeFrom,
    /// A budget that stages keep to.
    pacing: Option<Pacing>,
    /// Notes and warnings not sent yet.
    messages: Vec<TrainEvent>,
    /// Head of a saved run, and its arrays, until it is set.
    saved_head: Option<SavedHead>,
    /// Loss of the last step that was taken in.
    last_loss: StepLoss,
    /// The stage that runs, and the time on the clock since when, seconds.
    stage_since: Option<(Stage, f64)>,
    /// Events of steps that were taken in, not sent yet.
    arrived: Vec<TrainEvent>,
    /// Times of its steps so far.
    reports: Reports,
}

impl Trainer {
    /// A step of a stage (from 1), and of all stages, as the schedule sees it.
    fn moment(&self, stage: Stage, iteration: u32, total: u64) -> Moment<'_> {
        let state = &self.state;
        let facts = Facts {
            stages: self.stages,
            sees_changes: self.shows_changes,
            knows_travelling: state.guidance.knows_what_travels() || state.field.tracks.is_some(),
            owns_identities: state.value_head().is_none(),
        };
        Moment { config: &state.config, stage, iteration, total, facts }
    }

    /// The step that comes next.
    fn coming(&self) -> Moment<'_> {
        let Progress { stage, iteration, total_steps, .. } = self.state.progress;
        self.moment(stage, iteration + 1, total_steps + 1)
    }

    /// The step that was done last.
    fn done(&self) -> Moment<'_> {
        let Progress { stage, iteration, total_steps, .. } = self.state.progress;
        self.moment(stage, iteration, total_steps)
    }

    /// The field as it is now; its record is up to date once a run has returned.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.state.field
    }

    /// The trained field, once a run has returned.
    #[must_use]
    pub fn into_field(mut self) -> Field {
        self.state.field.record = self.provenance();
        self.state.field
    }

    /// The run's settings.
    #[must_use]
    pub fn config(&self) -> &TrainConfig {
        &self.state.config
    }

    /// The capture.
    #[must_use]
    pub fn dataset(&self) -> &Dataset {
        self.state.capture()
    }

    /// Stage of the run.
    #[must_use]
    pub fn stage(&self) -> Stage {
        self.state.progress.stage
    }

    /// Steps done in the stage.
    #[must_use]
    pub fn iteration(&self) -> u32 {
        self.state.progress.iteration
    }

    /// Steps done in all stages.
    #[must_use]
    pub fn steps_done(&self) -> u64 {
        self.state.progress.total_steps
    }

    /// True once there is something that a run begun anew would have to do again.
    #[must_use]
    pub fn has_begun(&self) -> bool {
        self.steps_done() > 0 || self.stage() > Stage::Objects || !self.state.objects.is_empty()
    }

    /// Steps left in all stages.
    #[must_use]
    pub fn steps_left(&self) -> u64 {
        self.stages.steps_left(&self.state.config, self.state.progress.stage, self.state.progress.iteration)
    }

    /// Records what was planned for the capture, for the field's record.
    pub fn record_effects(&mut self, plan: serde_json::Value) {
        self.state.progress.effects = Some(plan);
    }

    /// Trains another head in the instance stage than the one that the settings name. A run that was saved in or behind that
    /// stage goes on with the head that it was saved with.
    ///
    /// # Errors
    /// When the run was saved with another head.
    pub fn set_head(&mut self, head: Arc<dyn Head>) -> Result<(), TrainError> {
        self.state.head = head;
        self.restore_head()
    }

    /// Adds and removes Gaussians by other rules than the settings name. They are not saved with the run: one that is
    /// resumed is to be given them again.
    pub fn set_density(&mut self, strategy: Arc<dyn Strategy>) {
        self.density = strategy;
    }

    /// Judges a further effect, behind those of every run. It is not saved with the run: one that is resumed is to be given
    /// it again.
    pub fn add_effect(&mut self, effect: Arc<dyn Effect>) {
        self.effects.push(effect);
    }

    /// Reads time from another clock; times of the run and its curve follow it.
    pub fn set_clock(&mut self, clock: Arc<dyn Clock>) {
        self.state.phases.set_clock(clock);
    }

    /// Phases of the run, which work of the caller may enter too.
    #[must_use]
    pub fn phases(&self) -> &Phases {
        &self.state.phases
    }

    /// Progress with the time of the run so far.
    fn progress(&self) -> Progress {
        let mut progress = self.state.progress.with_times(&self.state.phases.times());
        if let Some((stage, since_s)) = self.stage_since {
            progress.add_stage_s(stage, self.state.phases.now().wall_s - since_s);
        }
        progress
    }

    /// Time of the run so far, over interruptions, by name of [`Phase`](crate::Phase): what its phases took add up to what passed on
    /// the clock while it was prepared, trained and saved.
    #[must_use]
    pub fn wall_s_by_phase(&self) -> BTreeMap<String, f64> {
        self.progress().wall_s
    }

    /// The time of the run so far, without [`Phase::Measure`](crate::Phase::Measure) and [`Phase::Evaluate`](crate::Phase::Evaluate), which only look at what was
    /// reached: the time that points of the curve count.
    #[must_use]
    pub fn time_of_training(&self) -> Seconds {
        self.progress().of_training()
    }

    /// Quality of the field over the run, as measured so far.
    #[must_use]
    pub fn curve(&self) -> &Curve {
        &self.state.progress.curve
    }

    /// Looks at every array of a step, so that a value which is not finite is reported with the part, the tensor and
    /// the index where it first appeared. Costs time and a second copy of field and moments; results do not
    /// change.
    pub fn set_debug_validation(&mut self, on: bool) {
        self.debug_validation = on;
    }

    /// Steps rolled back so far, over interruptions.
    #[must_use]
    pub fn rolled_back(&self) -> u64 {
        self.state.progress.rollbacks.total
    }

    /// Where the time of the steps since [`Self::reset_times`] went, and what they did.
    #[must_use]
    pub fn times(&self) -> StepTimes {
        self.state.times
    }

    /// Work done by the steps of the whole run, including those before interruptions.
    #[must_use]
    pub fn work(&self) -> Work {
        self.state.progress.work
    }

    /// Sets times and counts to zero.
    pub fn reset_times(&mut self) {
        self.state.times = StepTimes::default();
    }
}

/// Read access to the trainer for an observer during an event.
pub struct TrainerView<'a> {
    pub(crate) trainer: &'a Trainer,
}

impl TrainerView<'_> {
    /// The field as it is now.
    #[must_use]
    pub fn field(&self) -> &cif_field::Field {
        self.trainer.field()
    }

    /// The run's settings.
    #[must_use]
    pub fn config(&self) -> &crate::TrainConfig {
        self.trainer.config()
    }

    /// Phases of the run, which work of the observer may enter too.
    #[must_use]
    pub fn phases(&self) -> &Phases {
        self.trainer.phases()
    }

    /// A checkpoint, see [`Trainer::checkpoint`].
    #[must_use]
    pub fn checkpoint(&self, with_state: bool) -> cif_field::checkpoint::Checkpoint {
        self.trainer.checkpoint(with_state)
    }
}
