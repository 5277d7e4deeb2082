//! A run, from a capture to a trained field.
//!
//! | file | answers |
//! |---|---|
//! | `initialize` | what a run starts from |
//! | `progress` | which stages there are, and where the run stands |
//! | `step` | what one step does |
//! | `optimiser` | which parameter groups there are, and how fast they move |
//! | `guard` | what happens to a step that leaves the finite numbers |
//! | `still` | which Gaussians skip the deformation network |
//! | `changes` | where cameras that stay in place see the capture change |
//! | `earned` | what has to show that it helps |
//! | `guidance` | how travelling objects start on the paths that masks tell |
//! | `identity` | how identity rows come about |
//! | `from_scene` | how a run begins with an earlier reconstruction |
//! | `state` | what is saved, and how a run resumes |
//! | `draw` | how views are rendered between steps |
//! | `evaluate` | what a run has reached, on a few frames |
//! | `pacing` | when stages end by time, or by what was reached |
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
mod earned;
mod evaluate;
mod frames;
mod from_scene;
mod guard;
#[cfg(test)]
mod guard_tests;
mod guidance;
mod identity;
mod initialize;
mod measure;
mod motions;
mod optimiser;
mod pacing;
mod progress;
mod provenance;
mod state;
mod step;
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
#[cfg(feature = "wgpu")]
pub(crate) use self::earned::{FIRST_JUDGED, JUDGED_SPACING};
use self::evaluate::Yardstick;
use self::frames::FrameStore;
#[cfg(all(test, feature = "wgpu"))]
pub(crate) use self::guard::MAX_GRADIENT;
pub use self::guard::{Fault, Hint, MAX_ROLLBACKS_IN_A_ROW};
use self::guidance::Guidance;
pub(crate) use self::initialize::automatic_time_nodes;
pub use self::measure::InstancePass;
use self::optimiser::Optimiser;
use self::pacing::Pacing;
use self::progress::{Plan, Progress};
use self::step::{Scratch, StepLoss};
pub use self::times::{StepTimes, Work};
use crate::clock::{Clock, SystemClock};
use crate::config::TrainConfig;
use crate::curve::{Curve, MIN_GAP};
use crate::densify::DensifyStatistics;
use crate::error::TrainError;
use crate::events::{Control, Outcome, Stage, TrainEvent, TrainerView};
use crate::exposure::Exposures;
use crate::schedule::falls_on;

/// Observer of a run.
type Observer<'a> = dyn FnMut(&TrainEvent, &TrainerView<'_>) -> Control + 'a;

/// Share of unsupported pixels from which the user is told (methods reference 4.4).
const MANY_UNSUPPORTED: f64 = 0.01;

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
    plan: Plan,
    progress: Progress,
    optimiser: Optimiser,
    statistics: DensifyStatistics,
    /// Gaussians whose identity row is not from their own label mass.
    unseen: Vec<bool>,
    /// Labelled pixels per instance, of the frames that identities were estimated from.
    label_pixels: Vec<f64>,
    /// Whether every camera stays in place, and where these see changes, once that is asked.
    shows_changes: bool,
    changes: Option<Changes>,
    /// Paths that Gaussians are held to.
    guidance: Guidance,
    renderer: Renderer,
    gradients: Gradients,
    scratch: Scratch,
    /// Where the time of steps went.
    times: StepTimes,
    /// Whether every array of a step is looked at.
    debug_validation: bool,
    /// Off only while the cost of the pass is measured.
    instance_pass: InstancePass,
    /// Where the run reads time.
    clock: Arc<dyn Clock>,
    /// Frames that the curve is measured on.
    yardstick: Yardstick,
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

/// What the observer asked for since it was last obeyed.
#[derive(Default)]
struct Requests {
    save: bool,
    stop: bool,
}

impl Requests {
    fn add(&mut self, control: Control) {
        match control {
            Control::Continue => {}
            Control::Save => self.save = true,
            Control::Stop => self.stop = true,
        }
    }
}

impl Trainer {
    /// A run at its start; training frames are decoded into memory.
    ///
    /// # Errors
    /// When a setting cannot work, the capture has no training frame or no initial point, or a frame cannot
    /// be read.
    pub fn new(mut dataset: Dataset, config: TrainConfig) -> Result<Self, TrainError> {
        config.validate()?;
        let yardstick = Yardstick::withhold(&mut dataset, &config);
        let field = initialize::initial_field(&dataset, &config)?;
        let mut trainer = Self::assemble(dataset, yardstick, config, field, None)?;
        trainer.warn_of_capture();
        trainer.find_travelling()?;
        let first = trainer.plan.from(&trainer.config, Stage::Coarse);
        trainer.progress = Progress::at(first);
        trainer.progress.exposures = trainer.exposures();
        trainer.enter(first)?;
        Ok(trainer)
    }

    /// Everything but the state of the optimiser; frames of `yardstick` are no training frames of `dataset`.
    fn assemble(
        dataset: Dataset,
        yardstick: Yardstick,
        config: TrainConfig,
        field: Field,
        progress: Option<Progress>,
    ) -> Result<Self, TrainError> {
        if let Some(tracks) = &field.tracks {
            return Err(TrainError::RecordedMotion { groups: tracks.groups.len() });
        }
        let budget = u64::from(config.frame_memory_mib) << 20;
        let mut frames = FrameStore::open(&dataset, config.background, budget)?;
        let has_instances =
            config.effects.instances && !dataset.instances.is_empty() && frames.has_labels(&dataset);
        let mut warnings = Vec::new();
        if has_instances && config.motion.misfit > 0.0 {
            let left_out = frames.leave_out_misfits(&dataset, f64::from(config.motion.misfit))?;
            warnings.extend(misfit_warning(&dataset, &left_out));
        }
        let n = field.gaussians.len();
        Ok(Self {
            plan: Plan { is_dynamic: config.effects.motion && dataset.times.len() > 1, has_instances },
            progress: progress.unwrap_or_else(|| Progress::at(Stage::Coarse)),
            optimiser: Optimiser::new(&field, config.adam.fresh_row_bias_correction),
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
            yardstick,
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
        if !self.plan.has_instances {
            let why = if !self.config.effects.instances {
                "instances are switched off"
            } else if self.dataset.instances.is_empty() {
                "the capture has no masks"
            } else {
                "no training mask has a labelled pixel"
            };
            self.warnings.push(format!("{why}: colour only, without identity and instance stages"));
        }
        if !self.plan.is_dynamic {
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

    /// The field as it is now; its provenance is up to date once a run has returned.
    #[must_use]
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The trained field, once a run has returned.
    #[must_use]
    pub fn into_field(mut self) -> Field {
        self.field.provenance = self.provenance();
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
        self.plan.steps_left(&self.config, self.progress.stage, self.progress.iteration)
    }

    /// Records what was planned for the capture, for the field's provenance.
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

    /// Runs all stages that are left; `observer` sees every event and may stop the run.
    ///
    /// # Errors
    /// When a frame cannot be read, or too many steps in a row leave the finite numbers; the field then still is
    /// finite.
    pub fn run(&mut self, observer: &mut Observer<'_>) -> Result<Outcome, TrainError> {
        let result = self.run_stages(observer);
        self.field.provenance = self.provenance();
        result
    }

    fn run_stages(&mut self, observer: &mut Observer<'_>) -> Result<Outcome, TrainError> {
        let mut requests = Requests::default();
        for message in std::mem::take(&mut self.warnings) {
            requests.add(self.emit(observer, &TrainEvent::Warning { message }));
        }
        loop {
            let stage = self.progress.stage;
            if stage == Stage::Done {
                break;
            }
            let iterations = self.plan.iterations(&self.config, stage);
            let started = TrainEvent::StageStarted {
                stage,
                iteration: self.progress.iteration,
                iterations,
                gaussians: self.field.gaussians.len(),
            };
            requests.add(self.emit(observer, &started));
            if stage == Stage::Identity {
                if requests.stop {
                    return Ok(Outcome::Interrupted);
                }
                let start = self.clock.now();
                let event = self.estimate_identities(true)?;
                self.progress.add_time(stage, self.clock.now() - start);
                requests.add(self.emit(observer, &event));
                if let TrainEvent::IdentityEstimated { empty_instances, .. } = &event
                    && !empty_instances.is_empty()
                {
                    let message = format!(
                        "no Gaussian is most probably of instance {empty_instances:?}: too small, or hidden \
                         in the frames with masks"
                    );
                    requests.add(self.emit(observer, &TrainEvent::Warning { message }));
                }
            } else {
                let outcome = self.run_steps(stage, observer, &mut requests);
                // Whatever ended the steps, the field is whole again.
                let fetched = self.fetch_from_gpu();
                #[cfg(feature = "wgpu")]
                for event in self.arrived_events() {
                    requests.add(self.emit(observer, &event));
                }
                if outcome? == Outcome::Interrupted {
                    return fetched.map(|()| Outcome::Interrupted);
                }
                fetched?;
            }
            let next = self.plan.after(&self.config, stage);
            let ends = stage == Stage::Identity || next == Stage::Done || self.progress.iteration >= MIN_GAP;
            if ends {
                self.follow_curve(stage, true, observer, &mut requests)?;
            }
            self.enter(next)?;
            if requests.stop && self.progress.stage != Stage::Done {
                return Ok(Outcome::Interrupted);
            }
        }
        if let Some(message) = self.missed_targets() {
            self.emit(observer, &TrainEvent::Warning { message });
        }
        let finished = TrainEvent::Finished {
            wall_s: self.progress.total_wall_s(),
            iterations: self.progress.total_steps,
            gaussians: self.field.gaussians.len(),
            psnr: self.progress.psnr.unwrap_or(0.0),
            peak_rss_mb: provenance::peak_rss_mb(),
            rolled_back: self.progress.rollbacks.total,
            work: self.progress.work,
        };
        self.emit(observer, &finished);
        Ok(Outcome::Finished)
    }

    /// Steps of the current stage until its end or a stop.
    fn run_steps(
        &mut self,
        stage: Stage,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<Outcome, TrainError> {
        let mut events = Vec::new();
        let (mut lap, mut lap_steps) = (0.0, 0);
        self.pace_stage(stage);
        // A budget or a target may change how many there are.
        while self.progress.iteration < self.plan.iterations(&self.config, stage) {
            if requests.stop {
                return Ok(Outcome::Interrupted);
            }
            let start = self.clock.now();
            let loss = self.step(&mut events)?;
            let spent = self.clock.now() - start;
            self.progress.add_time(stage, spent);
            (lap, lap_steps) = (lap + spent.wall_s, lap_steps + 1);
            for message in std::mem::take(&mut self.warnings) {
                events.push(TrainEvent::Warning { message });
            }
            for event in events.drain(..) {
                requests.add(self.emit(observer, &event));
            }
            let iteration = self.progress.iteration;
            let iterations = self.plan.iterations(&self.config, stage);
            if falls_on(iteration, self.config.report.step_every) || iteration == iterations {
                let rate = f64::from(lap_steps) / lap.max(1e-9);
                let event = self.step_event(stage, iterations, &loss, rate);
                requests.add(self.emit(observer, &event));
                (lap, lap_steps) = (0.0, 0);
            }
            if let Some(share) = loss.unsupported.filter(|share| *share > MANY_UNSUPPORTED)
                && !self.progress.warned_of_unsupported
            {
                self.progress.warned_of_unsupported = true;
                let message = format!(
                    "{:.1} % of the labelled pixels of step {iteration} are covered by no Gaussian of their \
                     instance; more Gaussians or a longer fine stage may help",
                    100.0 * share
                );
                requests.add(self.emit(observer, &TrainEvent::Warning { message }));
            }
            self.follow_curve(stage, false, observer, requests)?;
            self.follow_budget(stage);
            let total = (self.progress.total_steps % u64::from(u32::MAX)) as u32;
            if falls_on(total, self.config.report.evaluate_every) {
                self.fetch_from_gpu()?;
                let event = self.evaluate(stage)?;
                requests.add(self.emit(observer, &event));
            }
            if falls_on(total, self.config.report.checkpoint_every) || requests.save {
                requests.save = false;
                self.fetch_from_gpu()?;
                requests.add(self.emit(observer, &TrainEvent::CheckpointDue { stage, iteration }));
            }
        }
        Ok(Outcome::Finished)
    }

    /// Measures a point of the curve where one is due, and acts on it.
    fn follow_curve(
        &mut self,
        stage: Stage,
        ends: bool,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<(), TrainError> {
        let Some(event) = self.measure_curve(stage, ends)? else { return Ok(()) };
        requests.add(self.emit(observer, &event));
        if let TrainEvent::Measured { point, .. } = &event
            && let Some(message) = self.follow_targets(point)
        {
            requests.add(self.emit(observer, &TrainEvent::Warning { message }));
        }
        Ok(())
    }

    fn step_event(&self, stage: Stage, iterations: u32, loss: &StepLoss, rate: f64) -> TrainEvent {
        TrainEvent::Step {
            stage,
            iteration: self.progress.iteration,
            iterations,
            loss: loss.total,
            color_loss: loss.color,
            instance_loss: loss.instance,
            unsupported_px: loss.unsupported,
            gaussians: self.field.gaussians.len(),
            psnr: self.progress.psnr.unwrap_or(0.0),
            iterations_per_second: rate,
            eta_s: self.steps_left() as f64 / rate,
        }
    }

    fn emit(&self, observer: &mut Observer<'_>, event: &TrainEvent) -> Control {
        observer(event, &TrainerView { trainer: self })
    }

    /// Brings the field and the optimiser up to date where steps run on a GPU.
    fn fetch_from_gpu(&mut self) -> Result<(), TrainError> {
        #[cfg(feature = "wgpu")]
        self.fetch_from_device()?;
        Ok(())
    }

    /// Begins a stage: the fine stage gets its deformation and a new optimiser (methods reference 1.3).
    fn enter(&mut self, stage: Stage) -> Result<(), TrainError> {
        if stage == Stage::Fine {
            if self.plan.is_dynamic {
                self.field.deformation = Some(initialize::initial_deformation(&self.dataset, &self.config)?);
            }
            self.start_guidance()?;
            self.optimiser = Optimiser::new(&self.field, self.config.adam.fresh_row_bias_correction);
            self.gradients = Gradients::zeros(&self.field);
        }
        self.begin(stage);
        Ok(())
    }

    /// Stands at the start of a stage, with the field and the optimiser as they are.
    fn begin(&mut self, stage: Stage) {
        self.progress.stage = stage;
        self.progress.iteration = 0;
        self.progress.sh_start = self.field.sh_degree;
        self.progress.opacities_were_reset = false;
        self.statistics = DensifyStatistics::zeros(self.field.gaussians.len());
        #[cfg(feature = "wgpu")]
        self.everything_changed();
    }
}
