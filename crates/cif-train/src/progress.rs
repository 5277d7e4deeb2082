//! Where a run stands.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::clock::Seconds;
use crate::curve::{Curve, Targets};
use crate::exposure::Exposures;
use crate::guard::Rollbacks;
use crate::phase::Phase;
use crate::stage::Stage;
use crate::times::Work;

/// Counters of a run; saved with its state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Progress {
    /// Current stage.
    pub stage: Stage,
    /// Steps done in it.
    pub iteration: u32,
    /// Steps done in all stages.
    pub total_steps: u64,
    /// Steps done per finished or current stage.
    pub steps: BTreeMap<String, u64>,
    /// Wall time per phase, before this process, seconds.
    pub wall_s: BTreeMap<String, f64>,
    /// Processor time per phase, all threads together, seconds.
    #[serde(default)]
    pub cpu_s: BTreeMap<String, f64>,
    /// Wall time per stage, with everything inside it, seconds.
    #[serde(default)]
    pub stages_s: BTreeMap<String, f64>,
    /// Time that judgements of effects took, by name, seconds.
    #[serde(default)]
    pub effects_s: BTreeMap<String, f64>,
    /// Quality over the run, as measured so far.
    #[serde(default)]
    pub curve: Curve,
    /// Targets of the run, and their state.
    #[serde(default)]
    pub goals: Goals,
    /// Spherical-harmonics degree at the start of the stage.
    pub sh_start: u8,
    /// Highest degree of spherical harmonics that was seen to help.
    #[serde(default)]
    pub sh_judged: u8,
    /// Highest degree that is left, once one did not help.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sh_cap: Option<u8>,
    /// Rung of the ladder of limits that held at the last test for Gaussians that stand still.
    #[serde(default)]
    pub still_rung: u32,
    /// Work done by the steps.
    #[serde(default)]
    pub work: Work,
    /// Exposures of the cameras, where there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposures: Option<Exposures>,
    /// Plan that was made for the capture, as recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effects: Option<serde_json::Value>,
    /// Next part of the work after the last step, where it is not complete.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after_step: Option<AfterStep>,
    /// True when opacities were reset in this stage.
    pub opacities_were_reset: bool,
    /// Running mean PSNR of training views, dB.
    pub psnr: Option<f64>,
    /// True when the user was warned about unsupported pixels.
    pub warned_of_unsupported: bool,
    /// Steps that were rolled back.
    #[serde(default, skip_serializing_if = "Rollbacks::is_empty")]
    pub rollbacks: Rollbacks,
    /// The scene whose Gaussians and deformation the run began with, where it began with one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<Source>,
}

/// Goals of a run, saved with its state; the budget is not among them, since it belongs to a single call.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Goals {
    /// Values to reach.
    pub targets: Targets,
    /// True when all of it was.
    pub reached: bool,
    /// True when the user was warned that a target is out of reach.
    pub doubted: bool,
}

/// Parts of the work that follows a step, in order; each is done as a whole or not at all.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum AfterStep {
    /// Densification; refreshed identities and resampling in the instance stage.
    Changes,
    /// Judgement of the optional outputs of the deformation, the first of the effects.
    Heads,
    /// The test for Gaussians that stand still, the second.
    Still,
    /// Judgement of an effect that was added to the run, counted from 0.
    Added(usize),
    /// A point of the curve.
    Curve,
    /// Evaluation on held-out frames.
    Evaluation,
}

impl AfterStep {
    /// Judgement of effect `k` of those behind a step.
    pub(crate) fn effect(k: usize) -> Self {
        match k {
            0 => Self::Heads,
            1 => Self::Still,
            added => Self::Added(added - 2),
        }
    }
}

/// A scene that a run began with, as recorded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Source {
    /// Its name, without the folder.
    pub scene: String,
    /// Its Gaussians.
    pub gaussians: usize,
    /// Record of its own training; null where it has none.
    pub train: serde_json::Value,
}

/// Weight of the newest view in the running PSNR.
const PSNR_SHARE: f64 = 0.02;

/// More steps than any run does.
const MAX_STEPS: u64 = 1 << 48;

/// PSNR that equal images count as, dB.
const MAX_PSNR: f64 = 100.0;

impl Progress {
    /// Description of a value that no run leads to, in progress that was read; `None` where there is none.
    pub(crate) fn problem(&self) -> Option<&'static str> {
        let degrees = [self.sh_start, self.sh_judged, self.sh_cap.unwrap_or(0)];
        let steps = self.steps.values().chain([&self.total_steps]);
        if degrees.iter().any(|degree| *degree > 3) {
            Some("it knows a degree of spherical harmonics beyond 3")
        } else if self.iteration == u32::MAX || steps.copied().any(|steps| steps > MAX_STEPS) {
            Some("it counts more steps than can be done")
        } else if self.exposures.as_ref().is_some_and(|exposures| !exposures.are_whole()) {
            Some("its exposures do not fit their cameras")
        } else {
            None
        }
    }

    /// A step of the current stage is done.
    pub(crate) fn count_step(&mut self) {
        self.iteration += 1;
        self.total_steps += 1;
        *self.steps.entry(self.stage.name().to_owned()).or_default() += 1;
    }

    /// The last steps of the current stage are not done after all.
    pub(crate) fn uncount_steps(&mut self, steps: u32) {
        self.iteration -= steps;
        self.total_steps -= u64::from(steps);
        if let Some(of_stage) = self.steps.get_mut(self.stage.name()) {
            *of_stage -= u64::from(steps);
        }
    }

    pub(crate) fn at(stage: Stage) -> Self {
        Self {
            stage,
            iteration: 0,
            total_steps: 0,
            steps: BTreeMap::new(),
            wall_s: BTreeMap::new(),
            cpu_s: BTreeMap::new(),
            stages_s: BTreeMap::new(),
            effects_s: BTreeMap::new(),
            curve: Curve::default(),
            goals: Goals::default(),
            sh_start: 0,
            sh_judged: 0,
            sh_cap: None,
            still_rung: 0,
            work: Work::default(),
            exposures: None,
            effects: None,
            after_step: None,
            opacities_were_reset: false,
            psnr: None,
            warned_of_unsupported: false,
            rollbacks: Rollbacks::default(),
            source: None,
        }
    }

    pub(crate) fn add_psnr(&mut self, psnr: f64) {
        let psnr = psnr.min(MAX_PSNR);
        self.psnr = Some(self.psnr.map_or(psnr, |mean| mean + PSNR_SHARE * (psnr - mean)));
    }

    /// Adds time of a stage, seconds.
    pub(crate) fn add_stage_s(&mut self, stage: Stage, wall_s: f64) {
        *self.stages_s.entry(stage.name().to_owned()).or_default() += wall_s;
    }

    /// The same with the time of this process.
    pub(crate) fn with_times(&self, times: &BTreeMap<Phase, Seconds>) -> Self {
        let mut progress = self.clone();
        for (phase, spent) in times {
            *progress.wall_s.entry(phase.name().to_owned()).or_default() += spent.wall_s;
            *progress.cpu_s.entry(phase.name().to_owned()).or_default() += spent.cpu_s;
        }
        progress
    }

    /// Time of all phases.
    pub(crate) fn total(&self) -> Seconds {
        Seconds { wall_s: self.wall_s.values().sum(), cpu_s: self.cpu_s.values().sum() }
    }

    /// Time of all phases but those that only look at what was reached.
    pub(crate) fn of_training(&self) -> Seconds {
        let measuring = [Phase::Measure, Phase::Evaluate].map(Phase::name);
        let sum = |times: &BTreeMap<String, f64>| {
            times.iter().filter(|(name, _)| !measuring.contains(&name.as_str())).map(|(_, s)| s).sum()
        };
        Seconds { wall_s: sum(&self.wall_s), cpu_s: sum(&self.cpu_s) }
    }
}
