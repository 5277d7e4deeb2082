//! A run, from a capture to a trained field.
//!
//! | file | answers |
//! |---|---|
//! | `initialize` | what a run starts from |
//! | `progress` | which stages there are, and where the run stands |
//! | `run` | how it goes through its stages, and where it may be stopped |
//! | `step_plan` | a step as data: its views, settings, rates and limits, for either backend |
//! | `step` | a step on the processor, what either backend reports of one, and what falls behind it |
//! | `optimiser` | moments and rates of the parameters |
//! | `guard` | what happens to a step that leaves the finite numbers |
//! | `still` | which Gaussians skip the deformation network |
//! | `changes` | where cameras that stay in place see the capture change |
//! | `judged` | degrees of harmonics and outputs of the network that must show that they help |
//! | `guidance` | how travelling objects start on the paths that masks tell |
//! | `identity` | how identity rows come about |
//! | `from_scene` | how a run begins with an earlier reconstruction |
//! | `state` | what is saved, and how a run resumes |
//! | `draw` | how views are rendered between steps |
//! | `evaluate` | what a run has reached, on a few frames |
//! | `pacing` | when stages end by time, or by what was reached |
//! | `saving` | when a run asks to be saved |
//! | `times`, `measure` | where the time of a step goes |
//! | `device` | how steps run on a GPU, behind the feature `wgpu` |
//!
//! Random choices depend on the seed and the step alone (see `random`), and all sums have a fixed order: a
//! run that was interrupted and resumed ends bit for bit where an uninterrupted one ends, on any number of
//! threads.

mod changes;
#[cfg(feature = "wgpu")]
mod device;
mod draw;
mod evaluate;
mod frames;
mod from_scene;
mod guard;
#[cfg(test)]
mod guard_tests;
mod guidance;
mod identity;
mod initialize;
mod judged;
mod measure;
mod motions;
mod optimiser;
mod pacing;
mod progress;
mod provenance;
mod run;
mod saving;
mod state;
mod step;
mod step_plan;
mod still;
mod times;

use std::sync::Arc;

use cif_dataset::Dataset;
use cif_field::Field;
use cif_render::Gradients;
use cif_render::cpu::{Renderer, SimdLevel};

use self::changes::Changes;
#[cfg(feature = "wgpu")]
pub use self::device::Probe;
use self::evaluate::MeasuredFrames;
use self::frames::FrameStore;
#[cfg(all(test, feature = "wgpu"))]
pub(crate) use self::guard::MAX_GRADIENT;
pub use self::guard::{Fault, Hint, MAX_ROLLBACKS_IN_A_ROW};
use self::guidance::Guidance;
pub(crate) use self::initialize::automatic_time_nodes;
#[cfg(feature = "wgpu")]
pub(crate) use self::judged::{FIRST_JUDGED, JUDGED_SPACING};
pub use self::measure::InstancePass;
use self::optimiser::Optimiser;
use self::pacing::Pacing;
use self::progress::{Progress, Stages};
use self::saving::Saving;
use self::step::Scratch;
#[cfg(feature = "wgpu")]
use self::step::StepLoss;
pub use self::times::{StepTimes, Work};
use crate::clock::{Clock, SystemClock};
use crate::config::TrainConfig;
use crate::curve::Curve;
use crate::densify::DensifyStatistics;
use crate::error::TrainError;
use crate::events::Stage;
#[cfg(feature = "wgpu")]
use crate::events::TrainEvent;
use crate::exposure::Exposures;
use crate::stop::{Start, Stop};

/// Names that a warning lists at most.
const MOST_NAMES: usize = 8;

/// What is told of frames that were left out.
fn misfit_warning(dataset: &Dataset, left_out: &[usize]) -> Option<String> {
    let names: Vec<&str> =
        left_out.iter().take(MOST_NAMES).map(|index| dataset.frames[*index].name.as_str()).collect();
    let more = left_out.len() - names.len();
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    (!names.is_empty()).then(|| {
        format!(
            "left out of training: {}{more}: they show most instances far from where all other frames see them; \
             check their cameras and masks (motion.misfit = 0 keeps such frames)",
            names.join(", ")
        )
    })
}

/// Trains one field on one capture.
pub struct Trainer {
    dataset: Dataset,
    config: TrainConfig,
    field: Field,
    frames: FrameStore,
    stages: Stages,
    progress: Progress,
    optimiser: Optimiser,
    statistics: DensifyStatistics,
    /// Gaussians whose identity row is not from their own label mass.
    unseen: Vec<bool>,
    /// Labelled pixels per instance, of the frames that identities were estimated from.
    label_pixels: Vec<f64>,
    /// True when every camera stays in place, and where these see changes, once that is asked.
    shows_changes: bool,
    changes: Option<Changes>,
    /// Paths that Gaussians are held to.
    guidance: Guidance,
    renderer: Renderer,
    gradients: Gradients,
    scratch: Scratch,
    /// Where the time of steps went.
    times: StepTimes,
    /// True when every array of a step is looked at.
    debug_validation: bool,
    /// Off only while the cost of the pass is measured.
    instance_pass: InstancePass,
    /// Where the run reads time.
    clock: Arc<dyn Clock>,
    /// What may stop the run between two events.
    stop: Stop,
    /// When the next state is saved by time.
    saving: Saving,
    /// Frames that the curve is measured on.
    measured_frames: MeasuredFrames,
    /// A budget that stages keep to.
    pacing: Option<Pacing>,
    /// Warnings not sent yet.
    warnings: Vec<String>,
    /// The GPU that steps run on.
    #[cfg(feature = "wgpu")]
    device: Option<Box<device::DeviceTraining>>,
    /// Loss of the last step that has arrived from the GPU.
    #[cfg(feature = "wgpu")]
    last_loss: StepLoss,
    /// Events of steps that have arrived from it, not sent yet.
    #[cfg(feature = "wgpu")]
    arrived: Vec<TrainEvent>,
}

impl Trainer {
    /// A run at its start; training frames are decoded into memory.
    ///
    /// # Errors
    /// When a setting cannot work, the capture has no training frame or no initial point, or a frame cannot
    /// be read; [`TrainError::Stopped`] when the stop of `start` was requested meanwhile.
    pub fn new(start: impl Into<Start>, config: TrainConfig) -> Result<Self, TrainError> {
        let Start { mut dataset, stop } = start.into();
        config.validate()?;
        let measured_frames = MeasuredFrames::withhold(&mut dataset, &config);
        let field = initialize::initial_field(&dataset, &config)?;
        let mut trainer = Self::assemble(Start { dataset, stop }, measured_frames, config, field, None)?;
        trainer.warn_of_capture();
        trainer.find_travelling()?;
        let first = trainer.stages.from(&trainer.config, Stage::Coarse);
        trainer.progress = Progress::at(first);
        trainer.progress.exposures = trainer.exposures();
        trainer.enter(first)?;
        Ok(trainer)
    }

    /// Everything but the state of the optimiser; frames of `measured_frames` are no training frames of the capture.
    fn assemble(
        Start { dataset, stop }: Start,
        measured_frames: MeasuredFrames,
        config: TrainConfig,
        field: Field,
        progress: Option<Progress>,
    ) -> Result<Self, TrainError> {
        if let Some(tracks) = &field.tracks {
            return Err(TrainError::RecordedMotion { groups: tracks.groups.len() });
        }
        let budget = u64::from(config.frame_memory_mib) << 20;
        let mut frames = FrameStore::open(&dataset, config.background, budget, &stop)?;
        let has_instances =
            config.effects.instances && !dataset.instances.is_empty() && frames.has_labels(&dataset);
        let mut warnings = Vec::new();
        if has_instances && config.motion.misfit > 0.0 {
            let left_out = frames.leave_out_misfits(&dataset, f64::from(config.motion.misfit), &stop)?;
            warnings.extend(misfit_warning(&dataset, &left_out));
        }
        let n = field.gaussians.len();
        Ok(Self {
            stages: Stages { is_dynamic: config.effects.motion && dataset.times.len() > 1, has_instances },
            progress: progress.unwrap_or_else(|| Progress::at(Stage::Coarse)),
            optimiser: Optimiser::new(&field),
            statistics: DensifyStatistics::zeros(n),
            unseen: Vec::new(),
            label_pixels: Vec::new(),
            shows_changes: Changes::are_shown(&dataset, &frames),
            changes: None,
            guidance: Guidance::default(),
            renderer: Renderer::new(SimdLevel::Auto),
            gradients: Gradients::zeros(&field),
            scratch: Scratch::new(),
            times: StepTimes::default(),
            debug_validation: false,
            instance_pass: InstancePass::On,
            clock: Arc::new(SystemClock::start()),
            stop,
            saving: Saving::default(),
            measured_frames,
            pacing: None,
            warnings,
            #[cfg(feature = "wgpu")]
            device: None,
            #[cfg(feature = "wgpu")]
            last_loss: StepLoss::default(),
            #[cfg(feature = "wgpu")]
            arrived: Vec::new(),
            dataset,
            config,
            field,
            frames,
        })
    }

    /// Neutral exposures of the cameras, where they are to be learnt.
    fn exposures(&self) -> Option<Exposures> {
        self.config.effects.exposure.then(|| Exposures::of(&self.dataset)).flatten()
    }

    fn warn_of_capture(&mut self) {
        if !self.stages.has_instances {
            let why = if !self.config.effects.instances {
                "instances are switched off"
            } else if self.dataset.instances.is_empty() {
                "the capture has no masks"
            } else {
                "no training mask has a labelled pixel"
            };
            self.warnings.push(format!("{why}: colour only, without identity and instance stages"));
        }
        if !self.stages.is_dynamic {
            let why = if self.dataset.times.len() > 1 {
                "motion is switched off"
            } else {
                "the capture has a single time"
            };
            self.warnings.push(format!("{why}: trained without deformation"));
        }
        if self.frames.len() == 1 {
            self.warnings.push("one training frame: depth and occluded parts are not determined".into());
        }
        let not_kept = self.frames.not_kept();
        if not_kept > 0 {
            self.warnings.push(format!(
                "{not_kept} of {} training frames do not fit into frame_memory_mib = {} and are decoded \
                 whenever they are needed",
                self.frames.len(),
                self.config.frame_memory_mib
            ));
        }
    }

    /// The field as it is now; its record is up to date once a run has returned.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The trained field, once a run has returned.
    #[must_use]
    pub fn into_field(mut self) -> Field {
        self.field.record = self.provenance();
        self.field
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

    /// Stage of the run.
    #[must_use]
    pub fn stage(&self) -> Stage {
        self.progress.stage
    }

    /// Steps done in the stage.
    #[must_use]
    pub fn iteration(&self) -> u32 {
        self.progress.iteration
    }

    /// Steps done in all stages.
    #[must_use]
    pub fn steps_done(&self) -> u64 {
        self.progress.total_steps
    }

    /// Steps left in all stages.
    #[must_use]
    pub fn steps_left(&self) -> u64 {
        self.stages.steps_left(&self.config, self.progress.stage, self.progress.iteration)
    }

    /// Records what was planned for the capture, for the field's record.
    pub fn record_effects(&mut self, plan: serde_json::Value) {
        self.progress.effects = Some(plan);
    }

    /// Chooses the vector instructions of the renderer, the widest there are by default. Results of two levels
    /// differ by rounding.
    pub fn set_simd(&mut self, simd: SimdLevel) {
        self.renderer = Renderer::new(simd);
        self.renderer.set_inspection(self.debug_validation);
    }

    /// Reads time from another clock; times of the run and its curve follow it.
    pub fn set_clock(&mut self, clock: Arc<dyn Clock>) {
        self.clock = clock;
    }

    /// What the run reached when, so far.
    #[must_use]
    pub fn curve(&self) -> &Curve {
        &self.progress.curve
    }

    /// Name of the vector instructions in use.
    #[must_use]
    pub fn simd_name(&self) -> String {
        self.renderer.simd_name()
    }

    /// Name of the vector instructions that runs take unless told otherwise.
    #[must_use]
    pub fn vector_instructions() -> String {
        Renderer::new(SimdLevel::Auto).simd_name()
    }

    /// Where the time of the steps since [`Self::reset_times`] went, and what they did.
    #[must_use]
    pub fn times(&self) -> StepTimes {
        self.times
    }

    /// What the steps of the whole run worked on, over interruptions.
    #[must_use]
    pub fn work(&self) -> Work {
        self.progress.work
    }

    /// Sets times and counts to zero.
    pub fn reset_times(&mut self) {
        self.times = StepTimes::default();
    }
}
