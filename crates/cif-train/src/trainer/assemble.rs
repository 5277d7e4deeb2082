//! A run at its start: what is read, checked and made before the first step.

use std::collections::BTreeMap;
use std::path::Path;

use cif_dataset::{Dataset, TrainedImages};
use cif_field::Field;
use cif_render::cpu::SimdLevel;
use cif_render::{Gradients, UNLABELLED};

use super::cost::Reports;
use super::measured_frames::MeasuredFrames;
use super::saved::inputs_of;
use super::saving::Saving;
use super::{Trainer, initialize, near};
use crate::background::Background;
use crate::config::{DensifyConfig, HeadName, MotionConfig, TrainConfig};
use crate::density::{self, DensifyStatistics};
use crate::detail;
use crate::effects;
use crate::effects::changes::Changes;
use crate::engine::processor::Processor;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::exposure::{Exposures, Recorded, known_points};
use crate::frames::FrameStore;
use crate::guidance::Guidance;
use crate::heads::{HeadTensors, configured};
use crate::objects::KnownObjects;
use crate::optimiser::Optimiser;
use crate::phase::Phase;
use crate::phases::Phases;
use crate::poses::PoseMoments;
use crate::progress::Progress;
use crate::schedule::Stages;
use crate::stage::Stage;
use crate::start::Start;
use crate::state::State;
use crate::step::{InstancePass, StepLoss};
use crate::switches::Correction;
use crate::times::StepTimes;
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

/// Note that counts the masks that were changed; `None` where none was.
fn correction_note(dataset: &Dataset, corrections: &BTreeMap<usize, Correction>) -> Option<TrainEvent> {
    let name = |label: u16| dataset.instances[usize::from(label) - 1].label.as_str();
    let mut exchanged: BTreeMap<[u16; 2], usize> = BTreeMap::new();
    let (mut alone, mut blobs): (BTreeMap<u16, usize>, BTreeMap<u16, usize>) = Default::default();
    for correction in corrections.values() {
        for (from, to) in &correction.renamed {
            if *to == UNLABELLED {
                *alone.entry(*from).or_default() += 1;
            } else if from < to {
                *exchanged.entry([*from, *to]).or_default() += 1;
            }
        }
        correction.foreign.keys().for_each(|label| *blobs.entry(*label).or_default() += 1);
    }
    let pairs = exchanged.iter().map(|([a, b], n)| format!("{} and {} exchanged in {n}", name(*a), name(*b)));
    let singles = alone.iter().map(|(label, n)| format!("{} left out in {n}", name(*label)));
    let apart = blobs.iter().map(|(label, n)| format!("blobs apart from {} left out in {n}", name(*label)));
    let found: Vec<String> = pairs.chain(singles).chain(apart).collect();
    (!found.is_empty()).then(|| {
        TrainEvent::note(format!(
            "masks show something else by their colours and places, frames: {} (motion.switches = false keeps such \
             masks)",
            found.join(", ")
        ))
    })
}

/// Checks the masks of training frames as far as the settings ask for it, and changes those that are wrong; with messages
/// about what was found.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop.
fn put_masks_right(
    frames: &mut FrameStore,
    dataset: &Dataset,
    motion: &MotionConfig,
    phases: &Phases,
) -> Result<Vec<TrainEvent>, TrainError> {
    let mut messages = Vec::new();
    let finds_outliers = motion.misfit > 0.0;
    let reads = finds_outliers || motion.switches;
    if !reads && !motion.edges {
        return Ok(messages);
    }
    let passes = usize::from(reads) + usize::from(motion.edges);
    let _phase = phases.enter(Phase::Masks, passes * frames.len());
    let mut read = Vec::new();
    if reads {
        read = frames.read_masks(dataset, motion.switches, phases)?;
    }
    if finds_outliers {
        let left_out = frames.leave_out_outliers(dataset, &mut read, f64::from(motion.misfit));
        messages.extend(misfit_warning(dataset, &left_out));
    }
    if motion.switches {
        messages.extend(correction_note(dataset, frames.put_masks_right(read)));
    }
    if motion.edges && frames.put_edges_right(dataset, phases)? {
        messages.push(TrainEvent::note(
            "outlines of masks are rough, and were moved to where the colours change (motion.edges = false keeps \
             them)",
        ));
    }
    Ok(messages)
}

/// Allows more Gaussians where images show much detail, with a note that says so.
///
/// # Errors
/// When a frame cannot be read.
fn allow_detail(
    densify: &mut DensifyConfig,
    dataset: &Dataset,
    frames: &FrameStore,
) -> Result<Option<TrainEvent>, TrainError> {
    let found = detail::most_gaussians(dataset, frames, densify)?;
    densify.detail = 0.0;
    Ok(found.map(|(most, pixels)| {
        let before = std::mem::replace(&mut densify.max_gaussians, most);
        TrainEvent::note(format!(
            "images show much detail, {pixels} pixels that half the size would not show: up to {most} Gaussians \
             instead of {before} (--max-gaussians sets another number)"
        ))
    }))
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
        trainer.check_declared()?;
        let first = trainer.stages.from(&trainer.state.config, Stage::Search);
        trainer.state.progress = Progress::at(first);
        trainer.state.progress.exposures = trainer.exposures()?;
        trainer.enter(first)?;
        Ok(trainer)
    }

    /// Everything but the state of the optimiser; frames of `measured_frames` are no training frames of the capture.
    pub(super) fn assemble(
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
        let inputs = inputs_of(&capture);
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
        let mut frames = FrameStore::open(&dataset, config.laid_over(), maps, budget, &phases)?;
        let has_instances =
            config.effects.instances && !dataset.instances.is_empty() && frames.has_labels(&dataset);
        let mut messages = Vec::new();
        if has_instances {
            messages.extend(put_masks_right(&mut frames, &dataset, &config.motion, &phases)?);
        }
        messages.extend(allow_detail(&mut config.densify, &dataset, &frames)?);
        let background = Background::of(&dataset, &frames, &config)?;
        field.background = background.shown;
        let near = match config.near {
            0.0 => field.record.drawing.near.unwrap_or_else(|| near::automatic(&dataset)),
            near => near,
        };
        let training = (0..frames.len()).map(|k| frames.index(k)).collect();
        let whole = capture.map(|capture| Whole::of(capture, training, config.laid_over()));
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
            reports: Reports::default(),
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
                background,
                near,
                frames,
                phases,
                field,
            },
        })
    }

    /// Exposures to begin with, where they are to be learnt: neutral ones of cameras, and those of single images as points
    /// show them.
    pub(super) fn exposures(&self) -> Result<Option<Exposures>, TrainError> {
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
                if let Some(gains) = recorded.relative_to_colors() {
                    exposures.begin_with(&frame.camera_name, frame.time, gains);
                }
            }
            exposures.take_off_common();
        }
        Ok(Some(exposures))
    }

    pub(super) fn warn_of_capture(&mut self) {
        if !self.stages.has_instances {
            let (why, is_intended) = if !self.state.config.effects.instances {
                ("instances are switched off", true)
            } else if self.state.dataset.instances.is_empty() {
                ("the capture has no masks", true)
            } else {
                ("no training mask has a labelled pixel", false)
            };
            let message = format!("{why}: colour only, without identity and instance stages");
            let message = if is_intended { TrainEvent::note(message) } else { TrainEvent::warning(message) };
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
}
