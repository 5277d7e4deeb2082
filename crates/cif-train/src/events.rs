//! Events that a run reports to its observer.

use serde::Serialize;

use crate::guard::Fault;
use crate::phase::Phase;
use crate::stage::Stage;
use crate::times::Work;

/// Something that happened. Serialises as one JSON object with the key `event`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum TrainEvent {
    /// A phase begins. Events of phases go to the receiver of [`Phases`](crate::Phases), all others to the observer of
    /// the run.
    PhaseStarted {
        /// Phase.
        phase: Phase,
        /// Units of work that it has, see [`Phase::unit`]; 0 where they are not counted.
        total: u64,
    },
    /// How far a phase is; sent a few times a second while it goes on. Stages send [`Self::Step`] instead.
    PhaseProgress {
        /// Phase.
        phase: Phase,
        /// Units done.
        done: u64,
        /// Units in all; 0 where they are not counted.
        total: u64,
        /// Steps of fits so far, over all units.
        steps: u64,
        /// Time since the phase began, seconds.
        elapsed_s: f64,
        /// Estimated time to the end of the phase, seconds; none before a unit is done.
        eta_s: Option<f64>,
    },
    /// A phase is over, completed or not.
    PhaseEnded {
        /// Phase.
        phase: Phase,
        /// Units done.
        done: u64,
        /// Units in all.
        total: u64,
        /// Steps of fits, over all units.
        steps: u64,
        /// Time that it took, phases inside it not counted, seconds.
        wall_s: f64,
        /// Processor time that it took, all threads together, seconds.
        cpu_s: f64,
    },
    /// A stage begins, or goes on after a resume.
    StageStarted {
        /// Stage.
        stage: Stage,
        /// Steps already done in it.
        iteration: u32,
        /// Steps it has.
        iterations: u32,
        /// Gaussians.
        gaussians: usize,
    },
    /// A stage is complete.
    StageEnded {
        /// Stage.
        stage: Stage,
        /// Time that it took, with everything inside it and over interruptions, seconds.
        wall_s: f64,
        /// Gaussians.
        gaussians: usize,
    },
    /// Steps were done; sent every `report.step_every` steps.
    Step {
        /// Stage.
        stage: Stage,
        /// Steps done in the stage.
        iteration: u32,
        /// Steps of the stage.
        iterations: u32,
        /// Loss of the last step: colour plus weighted instance loss, without regularisers.
        loss: f64,
        /// Colour loss.
        color_loss: f64,
        /// Instance loss before its weight; none outside the instance stage.
        instance_loss: Option<f64>,
        /// Fraction of labelled pixels whose label no covering Gaussian supports, last step.
        unsupported_px: Option<f64>,
        /// Gaussians.
        gaussians: usize,
        /// PSNR of training views, running mean, dB.
        psnr: f64,
        /// Steps per second, over the steps since the last event.
        iterations_per_second: f64,
        /// Estimated time to the end of the run, seconds.
        eta_s: f64,
    },
    /// Gaussians were added or removed.
    Densified {
        /// Stage.
        stage: Stage,
        /// Steps done in the stage.
        iteration: u32,
        /// Duplicated.
        cloned: usize,
        /// Replaced by two.
        split: usize,
        /// Removed.
        pruned: usize,
        /// Gaussians afterwards.
        gaussians: usize,
    },
    /// Identity rows were estimated.
    IdentityEstimated {
        /// Frames counted.
        frames: usize,
        /// Instances.
        instances: usize,
        /// Mean entries per row.
        entries_per_row: f64,
        /// Gaussians without mass, which took their neighbours' rows.
        unseen: usize,
        /// Of these, those without neighbours, which got uniform rows.
        uniform: usize,
        /// Probability dropped by truncation, mean per row.
        dropped_mass: f64,
        /// Instances that won no Gaussian, by mask id.
        empty_instances: Vec<u16>,
    },
    /// Gaussians were relocated.
    Resampled {
        /// Steps done in the instance stage.
        iteration: u32,
        /// Relocated Gaussians.
        pairs: usize,
        /// Instances that took part.
        labels: usize,
        /// Gaussians that were split up.
        sources: usize,
        /// Occupancies raised to their floor.
        floored: usize,
    },
    /// A step met a value that is not finite; parameters and moments are those before it, and the run goes on.
    RolledBack {
        /// Stage.
        stage: Stage,
        /// The step, from 1; it counts as done.
        iteration: u32,
        /// Fault, and where it was met.
        fault: Fault,
        /// Such steps since the last good one.
        in_a_row: u32,
        /// Such steps in the whole run.
        total: u64,
    },
    /// Gaussians were tested for standing still.
    Settled {
        /// Stage.
        stage: Stage,
        /// Steps done in the stage.
        iteration: u32,
        /// Gaussians that stand still now: they skip the deformation network.
        still: usize,
        /// Of these, those found by this test.
        settled: usize,
        /// Gaussians that stood still and move again.
        released: usize,
        /// Gaussians.
        gaussians: usize,
    },
    /// Something had to show that it helps.
    Judged {
        /// Stage.
        stage: Stage,
        /// Steps done in the stage.
        iteration: u32,
        /// Part of the model that was judged, in words.
        what: String,
        /// Its gain on held-out pixels of training views, dB.
        gain_db: f64,
        /// True when it stays; else it is removed for good.
        kept: bool,
    },
    /// Held-out frames were scored.
    Evaluated {
        /// Stage.
        stage: Stage,
        /// Steps done in the stage.
        iteration: u32,
        /// Frames scored.
        frames: usize,
        /// Mean PSNR, dB; none without held-out frames.
        psnr: Option<f64>,
        /// Mean SSIM.
        ssim: Option<f64>,
        /// Mean IoU over the whole image, percent; none before identities exist or without masks.
        iou: Option<f64>,
        /// mIoU over labelled pixels alone, percent.
        miou: Option<f64>,
        /// mAcc-pix, percent.
        macc_pix: Option<f64>,
    },
    /// A point of the run's curve was measured, see [`crate::curve`].
    Measured {
        /// The point.
        #[serde(flatten)]
        point: crate::curve::CurvePoint,
        /// Frames that it was measured on.
        frames: usize,
        /// Wall time that measuring took so far, which no point counts, seconds.
        measuring_s: f64,
    },
    /// Something that may be wrong; the run goes on.
    Warning {
        /// One sentence.
        message: String,
    },
    /// Something that was found, or decided, and is as it should be.
    Note {
        /// One sentence.
        message: String,
    },
    /// A checkpoint is wanted now: `report.checkpoint_seconds` or `report.checkpoint_every` says so, a stage has
    /// ended, or [`Control::Save`] was returned.
    CheckpointDue {
        /// Stage.
        stage: Stage,
        /// Steps done in the stage.
        iteration: u32,
    },
    /// The run is complete.
    Finished {
        /// Wall time of all phases so far, interruptions not counted, seconds.
        wall_s: f64,
        /// Optimiser steps of all stages.
        iterations: u64,
        /// Gaussians.
        gaussians: usize,
        /// PSNR of training views, running mean, dB.
        psnr: f64,
        /// Largest resident memory of the process, MB; none where the system does not tell.
        peak_rss_mb: Option<f64>,
        /// Steps that were rolled back.
        rolled_back: u64,
        /// Counts of the work of all steps.
        work: Work,
    },
}

impl TrainEvent {
    pub(crate) fn note(message: impl Into<String>) -> Self {
        Self::Note { message: message.into() }
    }

    pub(crate) fn warning(message: impl Into<String>) -> Self {
        Self::Warning { message: message.into() }
    }
}

/// Request of the observer in reply to an event.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Control {
    /// Go on.
    #[default]
    Continue,
    /// Send [`TrainEvent::CheckpointDue`] after this step, then go on.
    Save,
    /// Finish this step, then return [`Outcome::Interrupted`].
    Stop,
}

/// Way in which a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All stages are done.
    Finished,
    /// The observer or a [`Stop`](crate::Stop) stopped it; [`Trainer::checkpoint`](crate::Trainer::checkpoint) with
    /// state can be resumed.
    Interrupted,
}
