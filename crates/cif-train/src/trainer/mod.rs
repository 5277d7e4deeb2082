//! A run, from a capture to a trained field.
//!
//! | file | answers |
//! |---|---|
//! | `initialize` | what a run starts from |
//! | `near` | how near to the cameras Gaussians are drawn |
//! | `run` | how it goes through its stages, and where it may be stopped |
//! | `plan_step` | what decides a step |
//! | `step` | how a step is done, and what falls behind it |
//! | `heads` | what heads of other systems see and change between steps |
//! | `guidance` | how travelling objects start on the paths that masks tell |
//! | `seeds` | what objects begin with that nothing was made of |
//! | `objects`, `parts` | which objects move as a whole or in a part, and how they join the field |
//! | `identity` | how identity rows come about |
//! | `shares` | how much of a Gaussian is of any instance |
//! | `contradicted` | which Gaussians masks show to be of no instance |
//! | `continued` | where bodies are before the first and after the last training frame |
//! | `from_scene` | how a run begins with an earlier reconstruction |
//! | `resume` | what is saved, and how a run resumes |
//! | `evaluate` | what a run has reached, on a few frames |
//! | `pacing` | when stages end by time, or by what was reached |
//! | `eta` | how long the rest of a run takes |
//! | `saving` | when a run asks to be saved |
//! | `measure`, `shape` | steps for measuring, and what they work on |
//! | `backend` | which engine computes the steps |
//!
//! Random choices depend on the seed and the step alone (see `random`), and all sums have a fixed order: a
//! run that was interrupted and resumed ends bit for bit where an uninterrupted one ends, on any number of
//! threads.

mod backend;
mod continued;
mod contradicted;
mod contributions;
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
mod near;
mod objects;
mod pacing;
mod parts;
mod plan_step;
mod provenance;
mod resume;
mod run;
mod saving;
mod seeds;
#[cfg(feature = "wgpu")]
mod shape;
mod shares;
mod step;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use cif_dataset::{Dataset, MadeFrom, TrainedImages};
use cif_field::Field;
use cif_render::cpu::SimdLevel;
use cif_render::{Gradients, UNLABELLED};

#[cfg(feature = "wgpu")]
pub use self::backend::Probe;
use self::evaluate::MeasuredFrames;
pub(crate) use self::initialize::{
    automatic_time_nodes, deformation_shape, memory_of_gaussians, memory_of_planes,
};
pub use self::measure::InstancePass;
use self::pacing::Pacing;
use self::resume::SavedHead;
pub use self::resume::accept_changes;
use self::saving::Saving;
use crate::clock::{Clock, Seconds};
use crate::config::{HeadName, TrainConfig};
use crate::curve::Curve;
use crate::density::{self, DensifyStatistics, Strategy};
use crate::detail;
use crate::effects::changes::Changes;
use crate::effects::{self, Effect};
use crate::engine::Engine;
use crate::engine::processor::Processor;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::exposure::{Exposures, Recorded, known_points};
use crate::frames::FrameStore;
use crate::guidance::Guidance;
use crate::heads::{Head, HeadTensors, configured};
use crate::objects::KnownObjects;
use crate::optimiser::Optimiser;
use crate::phase::Phase;
use crate::phases::Phases;
use crate::poses::PoseMoments;
use crate::progress::Progress;
use crate::schedule::{Facts, Moment, Stages};
use crate::stage::Stage;
use crate::state::State;
use crate::step::StepLoss;
use crate::stop::Start;
use crate::times::{StepTimes, Work};
use crate::working_size::{self, Whole};

/// Names that a warning lists at most.
const MOST_NAMES: usize = 8;

/// Warning that names the frames left out of training; `None` without such frames.
fn misfit_warning(dataset: &Dataset, left_out: &[usize]) -> Option<TrainEvent> {
    let names: Vec<&str> =
        left_out.iter().take(MOST_NAMES).map(|index| dataset.frames[*index].name.as_str()).collect();
    let more = left_out.len() - names.len();
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    (!names.is_empty()).then(|| {
        TrainEvent::warning(format!(
            "left out of training: {}{more}: they show most instances far from where all other frames see them; \
             check their cameras and masks (motion.misfit = 0 keeps such frames)",
            names.join(", ")
        ))
    })
}

/// Note that counts the masks that were given other labels; `None` where none was.
fn switch_note(dataset: &Dataset, switched: &BTreeMap<usize, BTreeMap<u16, u16>>) -> Option<TrainEvent> {
    let name = |label: u16| dataset.instances[usize::from(label) - 1].label.as_str();
    let (mut exchanged, mut alone): (BTreeMap<[u16; 2], usize>, BTreeMap<u16, usize>) = Default::default();
    for (from, to) in switched.values().flatten() {
        if *to == UNLABELLED {
            *alone.entry(*from).or_default() += 1;
        } else if from < to {
            *exchanged.entry([*from, *to]).or_default() += 1;
        }
    }
    let pairs = exchanged.iter().map(|([a, b], n)| format!("{} and {} exchanged in {n}", name(*a), name(*b)));
    let singles = alone.iter().map(|(label, n)| format!("{} left out in {n}", name(*label)));
    let found: Vec<String> = pairs.chain(singles).collect();
    (!found.is_empty()).then(|| {
        TrainEvent::note(format!(
            "masks show other objects by their colours and places, frames: {} (motion.switches = false keeps such \
             masks)",
            found.join(", ")
        ))
    })
}

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
}

impl Trainer {
    /// A run at its start; training frames are decoded into memory.
    ///
    /// # Errors
    /// When a setting cannot work, the capture has no training frame or no initial point, or a frame cannot
    /// be read; [`TrainError::Stopped`] when the stop of `start` was requested meanwhile.
    pub fn new(start: impl Into<Start>, config: TrainConfig) -> Result<Self, TrainError> {
        let Start { mut dataset, phases } = start.into();
        let _run = phases.enter(Phase::Other, 0);
        config.validate()?;
        let measured_frames = MeasuredFrames::withhold(&mut dataset, &config);
        let field = initialize::initial_field(&dataset, &config)?;
        let start = Start { dataset, phases: phases.clone() };
        let mut trainer = Self::assemble(start, measured_frames, config, field, None)?;
        trainer.warn_of_capture();
        trainer.check_told()?;
        let first = trainer.stages.from(&trainer.state.config, Stage::Search);
        trainer.state.progress = Progress::at(first);
        trainer.state.progress.exposures = trainer.exposures()?;
        trainer.enter(first)?;
        Ok(trainer)
    }

    /// Everything but the state of the optimiser; frames of `measured_frames` are no training frames of the capture.
    fn assemble(
        Start { dataset: capture, phases }: Start,
        measured_frames: MeasuredFrames,
        mut config: TrainConfig,
        mut field: Field,
        progress: Option<Progress>,
    ) -> Result<Self, TrainError> {
        if let Some(tracks) = field.tracks.as_ref().filter(|tracks| !tracks.is_rigid()) {
            return Err(TrainError::RecordedMotion { groups: tracks.groups.len() });
        }
        config.stages.reduction = working_size::reduction(&capture, &config);
        let reduction = config.stages.reduction;
        let inputs = resume::inputs_of(&capture);
        // Gaussians of another scene were trained on its images.
        field.record.images.get_or_insert_with(|| serde_json::json!(TrainedImages::of(&capture, &inputs)));
        let (dataset, capture) = if reduction > 1 {
            (working_size::reduced(capture.clone(), reduction), Some(capture))
        } else {
            (capture, None)
        };
        let budget = u64::from(config.frame_memory_mib) << 20;
        let maps = match config.head.name {
            HeadName::LangSplat => cif_dataset::feature_maps(&dataset, Path::new(&config.head.maps))?,
            _ => BTreeMap::new(),
        };
        let mut frames = FrameStore::open(&dataset, config.background, maps, budget, &phases)?;
        let has_instances =
            config.effects.instances && !dataset.instances.is_empty() && frames.has_labels(&dataset);
        let mut messages = Vec::new();
        let motion = &config.motion;
        let checks = [motion.misfit > 0.0, motion.switches, motion.edges].map(|on| on && has_instances);
        if checks.contains(&true) {
            let passes = usize::from(checks[0] || checks[1]) + usize::from(checks[2]);
            let _phase = phases.enter(Phase::Masks, passes * frames.len());
            let mut read = Vec::new();
            if checks[0] || checks[1] {
                read = frames.read_masks(&dataset, checks[1], &phases)?;
            }
            if checks[0] {
                let left_out = frames.leave_out_misfits(&dataset, &mut read, f64::from(motion.misfit));
                messages.extend(misfit_warning(&dataset, &left_out));
            }
            if checks[1] {
                messages.extend(switch_note(&dataset, frames.put_switches_right(read)));
            }
            if checks[2] && frames.put_edges_right(&dataset, &phases)? {
                messages.push(TrainEvent::note(
                    "outlines of masks are rough, and were moved to where the colours change (motion.edges = false \
                     keeps them)",
                ));
            }
        }
        if let Some((most, pixels)) = detail::most_gaussians(&dataset, &frames, &config.densify)? {
            messages.push(TrainEvent::note(format!(
                "images show much detail, {pixels} pixels that half the size would not show: up to {most} Gaussians \
                 instead of {} (--max-gaussians sets another number)",
                config.densify.max_gaussians
            )));
            config.densify.max_gaussians = most;
        }
        config.densify.detail = 0.0;
        let near = match config.near {
            0.0 => field.record.drawing.near.unwrap_or_else(|| near::automatic(&dataset)),
            near => near,
        };
        let training = (0..frames.len()).map(|k| frames.index(k)).collect();
        let whole = capture.map(|capture| Whole::of(capture, training, config.background));
        let n = field.gaussians.len();
        let simd = SimdLevel::Auto;
        Ok(Self {
            stages: Stages { is_dynamic: config.effects.motion && dataset.times.len() > 1, has_instances },
            density: density::of(config.densify.rule),
            effects: effects::all(),
            engine: Box::new(Processor::new(simd)),
            simd,
            order: None,
            shows_changes: Changes::are_shown(&dataset, &frames),
            changes: None,
            debug_validation: false,
            instance_pass: InstancePass::On,
            saving: Saving::default(),
            measured_frames,
            inputs,
            pacing: None,
            messages,
            saved_head: None,
            last_loss: StepLoss::default(),
            stage_since: None,
            arrived: Vec::new(),
            state: State {
                progress: progress.unwrap_or_else(|| Progress::at(Stage::Coarse)),
                optimiser: Optimiser::new(&field),
                pose_moments: PoseMoments::zeros(field.tracks.as_ref()),
                head: configured(&config.head),
                head_tensors: HeadTensors::default(),
                statistics: DensifyStatistics::zeros(n),
                objects: KnownObjects::default(),
                guidance: Guidance::default(),
                unseen: Vec::new(),
                label_pixels: Vec::new(),
                gradients: Gradients::zeros(&field),
                times: StepTimes::default(),
                dataset,
                whole,
                config,
                near,
                frames,
                phases,
                field,
            },
        })
    }

    /// Exposures to begin with, where they are to be learnt: neutral ones of cameras, and those of single images as points
    /// show them.
    fn exposures(&self) -> Result<Option<Exposures>, TrainError> {
        let State { config, dataset, frames, phases, .. } = &self.state;
        let in_time = config.effects.exposure_in_time;
        if !config.effects.exposure && !in_time {
            return Ok(None);
        }
        let Some(mut exposures) = Exposures::of(dataset, in_time) else { return Ok(None) };
        if in_time {
            let points = known_points(dataset);
            for view in 0..frames.len() {
                phases.check()?;
                let frame = &dataset.frames[frames.index(view)];
                let mut recorded = Recorded::of(&points);
                recorded.add(&frames.get(dataset, view)?.image, &frame.camera);
                if let Some(gains) = recorded.beside_colors() {
                    exposures.begin_with(&frame.camera_name, frame.time, gains);
                }
            }
            exposures.take_off_common();
        }
        Ok(Some(exposures))
    }

    fn warn_of_capture(&mut self) {
        if !self.stages.has_instances {
            let (why, is_wanted) = if !self.state.config.effects.instances {
                ("instances are switched off", true)
            } else if self.state.dataset.instances.is_empty() {
                ("the capture has no masks", true)
            } else {
                ("no training mask has a labelled pixel", false)
            };
            let message = format!("{why}: colour only, without identity and instance stages");
            let message = if is_wanted { TrainEvent::note(message) } else { TrainEvent::warning(message) };
            self.messages.push(message);
        }
        if !self.stages.is_dynamic {
            let why = if self.state.dataset.times.len() > 1 {
                "motion is switched off"
            } else {
                "the capture has a single time"
            };
            self.messages.push(TrainEvent::note(format!("{why}: trained without deformation")));
        }
        if self.state.frames.len() == 1 {
            let message = "one training frame: depth and occluded parts are not determined";
            self.messages.push(TrainEvent::warning(message));
        }
        if self.state.whole.is_some() {
            let size = working_size::captured(self.state.capture());
            let [width, height] = working_size::reduced_size(size, self.state.config.stages.reduction);
            self.messages.push(TrainEvent::note(format!(
                "images of {} x {} pixels are worked on at {width} x {height}, but for the last {:.0} % of the fine \
                 steps: {} Gaussians show no more (stages.reduction = 1 takes whole ones)",
                size[0],
                size[1],
                100.0 * self.state.config.stages.whole_size,
                self.state.config.densify.max_gaussians
            )));
        }
        let not_kept = self.state.frames.not_kept();
        if not_kept > 0 {
            self.messages.push(TrainEvent::note(format!(
                "{not_kept} of {} training frames do not fit into frame_memory_mib = {} and are decoded \
                 again for every step that needs them",
                self.state.frames.len(),
                self.state.config.frame_memory_mib
            )));
        }
    }

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

    /// Time of the run so far, over interruptions, by name of [`Phase`]: what its phases took add up to what passed on
    /// the clock while it was prepared, trained and saved.
    #[must_use]
    pub fn wall_s_by_phase(&self) -> BTreeMap<String, f64> {
        self.progress().wall_s
    }

    /// The time of the run so far, without [`Phase::Measure`] and [`Phase::Evaluate`], which only look at what was
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

    /// Looks at every array of a step, so that a value which is not finite is told with the part, the tensor and
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
