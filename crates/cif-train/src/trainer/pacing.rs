//! Stages that end by time or by what was reached, rather than after a number of steps.
//!
//! The schedule of everything else follows: learning rates, densification and resampling run over the steps
//! that a stage is expected to have, so that a run that is cut short ends settled. With a budget the number of
//! steps depends on the machine, and so does the result.

use serde_json::{Value, json};

use super::Trainer;
use super::identity::identity_views;
use super::pace::{Pacing, Shares};
use crate::budget::{Budget, FITS, OtherWork, Pacer, REHEARSAL, StepCosts, TRIALS, weights};
use crate::curve::{CurvePoint, Targets};
use crate::error::TrainError;
use crate::phase::Phase;
use crate::phases::Deadline;
use crate::progress::Goals;
use crate::stage::Stage;
use crate::state::State;
use crate::working_size;

/// Points of a stage before its trend is believed.
const POINTS_OF_TREND: usize = 6;

/// Share of all steps after which a target may be called out of reach.
const EARLIEST_VERDICT: f64 = 0.3;

/// A trend may be so much too low, dB and points of mIoU.
const MARGIN: (f64, f64) = (0.5, 2.0);

impl Trainer {
    /// Makes the stages that are left end inside a budget, each with its share. Steps of the settings are where
    /// it starts from, see [`crate::fit::choose`]; [`Self::config`] has those that came of it.
    pub fn set_budget(&mut self, budget: Budget) {
        let fine = f64::from(self.stages.iterations(&self.state.config, Stage::Fine).max(1));
        let instance = f64::from(self.state.config.stages.instance.max(1));
        let shares = Shares {
            densify: f64::from(self.state.config.densify.until) / fine,
            instance: f64::from(self.state.config.stages.instance) / fine,
            schedule: f64::from(self.state.config.rates.schedule_steps) / fine,
            resample: f64::from(self.state.config.resample.until) / instance,
        };
        self.pacing = Some(Pacing { pacer: Pacer::new(budget), shares });
    }

    /// Ends stages as soon as the curve reaches targets. The fine stage ends with the PSNR reached, the
    /// instance stage with all of them; the curve is best measured on withheld frames then
    /// (`report.withhold`).
    ///
    /// # Errors
    /// When mIoU is a target and the capture has no labels.
    pub fn set_targets(&mut self, targets: Targets) -> Result<(), TrainError> {
        if targets.miou.is_some() && !self.stages.has_instances {
            return Err(TrainError::NoLabels { root: self.state.dataset.root.clone() });
        }
        self.state.progress.goals = Goals { targets, ..Goals::default() };
        Ok(())
    }

    /// Targets of the run.
    #[must_use]
    pub fn targets(&self) -> Targets {
        self.state.progress.goals.targets
    }

    /// True when the run has targets and reached all of them.
    #[must_use]
    pub fn reached_targets(&self) -> bool {
        self.state.progress.goals.reached
    }

    /// Gives a stage that begins, or goes on, its deadline.
    pub(super) fn pace_stage(&mut self, stage: Stage) {
        let steps: Vec<(Stage, u32, StepCosts)> = [Stage::Coarse, Stage::Fine, Stage::Instance]
            .into_iter()
            .filter(|other| *other >= stage)
            .map(|other| (other, self.stages.iterations(&self.state.config, other)))
            .map(|(other, steps)| {
                let done = if other == stage { self.state.progress.iteration } else { 0 };
                (other, steps.saturating_sub(done), self.step_costs(other))
            })
            .filter(|(other, steps, _)| *steps > 0 || *other == stage)
            .collect();
        let other = OtherWork {
            identity_views: self.identity_views(stage)[0],
            has_fits: stage == Stage::Coarse && self.objects_to_fit() > 0,
        };
        let now = self.state.phases.now();
        let Some(pacing) = &mut self.pacing else { return };
        pacing.pacer.enter(&weights(&steps), other, now);
    }

    /// Costs of the steps of a stage, of which the first and the last see images of other sizes.
    pub(super) fn step_costs(&self, stage: Stage) -> StepCosts {
        let State { dataset, frames, config, .. } = &self.state;
        let camera = &dataset.frames[frames.index(0)].camera;
        match stage {
            Stage::Fine => working_size::step_costs(
                [camera.width, camera.height],
                config.stages.reduction,
                &config.stages,
            ),
            _ => StepCosts::default(),
        }
    }

    /// Views that identities will still be worked out from in a stage, or behind it: before the instance stage, and behind.
    pub(super) fn identity_views(&self, stage: Stage) -> [usize; 2] {
        if !self.stages.has_instances {
            return [0; 2];
        }
        let [before, behind] = identity_views(&self.state.config, self.state.frames.len());
        [if stage < Stage::Identity { before } else { 0 }, behind]
    }

    /// Time by which fits have to be done that a budget can do without.
    pub(super) fn deadline(&self, phase: Phase) -> Option<Deadline> {
        let pacer = &self.pacing.as_ref()?.pacer;
        let [search, joints] = TRIALS;
        let share = match phase {
            Phase::Search => search,
            Phase::Joints => joints,
            Phase::Rehearsal => REHEARSAL,
            _ => FITS,
        };
        let (budget, now) = (*pacer.budget(), self.state.phases.now());
        Some(Deadline { budget, at_s: budget.used(now) + share * pacer.left(now) })
    }

    /// Seconds left of the budget; `None` without one.
    pub(super) fn budget_left_s(&self) -> Option<f64> {
        let pacer = &self.pacing.as_ref()?.pacer;
        Some(pacer.left(self.state.phases.now()))
    }

    /// Stretches or ends the stage as the budget says.
    pub(super) fn follow_budget(&mut self, stage: Stage) {
        let (iteration, now) = (self.state.progress.iteration, self.state.phases.now());
        let planned = self.stages.iterations(&self.state.config, stage);
        let Some(pacing) = &mut self.pacing else { return };
        let Some(steps) = pacing.pacer.after_step(iteration, planned, now) else { return };
        let shares = pacing.shares;
        self.set_steps(stage, steps);
        let scaled = |share: f64, steps: u32| (share * f64::from(steps)).round() as u32;
        if stage == Stage::Fine {
            self.state.config.densify.until = scaled(shares.densify, steps);
            self.state.config.stages.instance =
                scaled(shares.instance, steps).max(u32::from(shares.instance > 0.0));
            self.state.config.rates.schedule_steps = scaled(shares.schedule, steps);
        }
        self.state.config.resample.until = scaled(shares.resample, self.state.config.stages.instance);
    }

    /// Gives a stage another number of steps.
    fn set_steps(&mut self, stage: Stage, steps: u32) {
        let stages = &mut self.state.config.stages;
        match stage {
            Stage::Coarse => stages.coarse = steps,
            Stage::Fine if self.stages.is_dynamic && stages.fine_includes_coarse => {
                stages.fine = steps.saturating_add(stages.coarse);
            }
            Stage::Fine if self.stages.is_dynamic => stages.fine = steps,
            Stage::Fine => (stages.coarse, stages.fine, stages.fine_includes_coarse) = (0, steps, false),
            Stage::Instance => stages.instance = steps,
            Stage::Search | Stage::Objects | Stage::Identity | Stage::Done => {}
        }
    }

    /// Ends the stage when a point reaches what it is to reach; a warning when that is out of reach.
    pub(super) fn follow_targets(&mut self, point: &CurvePoint) -> Option<String> {
        let targets = self.state.progress.goals.targets;
        if targets.is_empty() {
            return None;
        }
        let (stage, last) = (point.stage, self.last_stage());
        self.state.progress.goals.reached = targets.reached_by(point.psnr, point.miou);
        let psnr_reached = Targets { miou: None, ..targets }.reached_by(point.psnr, None);
        let ends = match stage {
            Stage::Fine if last == Stage::Fine => self.state.progress.goals.reached,
            // What instances add is measured only behind the fine stage.
            Stage::Fine => targets.psnr.is_some() && psnr_reached,
            Stage::Instance => self.state.progress.goals.reached,
            _ => false,
        };
        if ends {
            let planned = self.stages.iterations(&self.state.config, stage).max(1);
            if stage == Stage::Fine && self.stages.has_instances {
                let share = f64::from(point.iteration) / f64::from(planned);
                let shortened = |steps: u32| (f64::from(steps) * share).ceil() as u32;
                self.state.config.stages.instance = shortened(self.state.config.stages.instance);
                self.state.config.resample.until = shortened(self.state.config.resample.until);
            }
            self.set_steps(stage, point.iteration);
            return None;
        }
        self.doubt(point)
    }

    /// The last stage with steps.
    fn last_stage(&self) -> Stage {
        if self.stages.iterations(&self.state.config, Stage::Instance) > 0 {
            Stage::Instance
        } else {
            Stage::Fine
        }
    }

    /// Says once that the trend does not lead to a target.
    fn doubt(&mut self, point: &CurvePoint) -> Option<String> {
        let curve = &self.state.progress.curve;
        let of_stage = curve.points.iter().filter(|other| other.stage == point.stage).count();
        let all = self.state.progress.total_steps + self.steps_left();
        let early = (point.step as f64) < EARLIEST_VERDICT * all as f64;
        if self.state.progress.goals.doubted || of_stage < POINTS_OF_TREND || early {
            return None;
        }
        let targets = self.state.progress.goals.targets;
        let short = |name: &str,
                     unit: &str,
                     target: Option<f64>,
                     now: Option<f64>,
                     end: Option<f64>,
                     margin| {
            let (target, now, end) = (target?, now?, end?);
            (end + margin < target).then(|| {
                format!(
                    "{name} {target} is out of reach of these settings: it is {now:.2}{unit} now, and by its \
                     trend {end:.1}{unit} after all {all} steps; more Gaussians, more steps or larger images may \
                     help"
                )
            })
        };
        let psnr =
            short("PSNR", " dB", targets.psnr, point.psnr, curve.trend(|point| point.psnr, all), MARGIN.0);
        let miou =
            short("mIoU", " %", targets.miou, point.miou, curve.trend(|point| point.miou, all), MARGIN.1);
        let message = psnr.or(miou)?;
        self.state.progress.goals.doubted = true;
        Some(message)
    }

    /// Message about the targets missed at the end; `None` when there are no targets or all were reached.
    pub(super) fn missed_targets(&self) -> Option<String> {
        let goals = &self.state.progress.goals;
        if goals.targets.is_empty() || goals.reached {
            return None;
        }
        let last = self.state.progress.curve.points.last();
        let mut missed = Vec::new();
        let values = [
            ("PSNR", " dB", goals.targets.psnr, last.and_then(|point| point.psnr)),
            ("mIoU", " %", goals.targets.miou, last.and_then(|point| point.miou)),
        ];
        for (name, unit, target, value) in values {
            match (target, value) {
                (Some(target), Some(value)) if value < target => {
                    missed.push(format!("{name} {value:.2} of {target}{unit}"));
                }
                (Some(target), None) => {
                    missed.push(format!("{name} of {target}{unit} could not be measured"))
                }
                _ => {}
            }
        }
        Some(format!(
            "not reached on {}: {}; more Gaussians, more steps or larger images may help",
            self.state.progress.curve.frames.describe(),
            missed.join(", ")
        ))
    }

    /// Budget and targets as recorded; null without.
    pub(super) fn goals_record(&self) -> Value {
        let budget = self.pacing.as_ref().map(|pacing| {
            let budget = pacing.pacer.budget();
            json!({
                "seconds": budget.seconds,
                "clock": budget.clock,
                "threads": budget.threads,
                "used_s": budget.used(self.state.phases.now()),
            })
        });
        let goals = &self.state.progress.goals;
        let targets = (!goals.targets.is_empty()).then(
            || json!({ "psnr": goals.targets.psnr, "miou": goals.targets.miou, "reached": goals.reached }),
        );
        match (budget, targets) {
            (None, None) => Value::Null,
            (budget, targets) => json!({ "budget": budget, "targets": targets }),
        }
    }
}
