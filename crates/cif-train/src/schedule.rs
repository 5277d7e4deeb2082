//! The schedule of a run: how long its stages are, what falls on which step ([`Due`], one table), and how rates run over
//! the steps. Source: methods reference 1.1 and 1.3.

use crate::config::{Ablation, HeadName, TrainConfig};
use crate::stage::Stage;

/// `exp((1 - r) ln first + r ln last)` with `r = step / steps`, clamped to [0, 1].
#[must_use]
pub fn log_linear([first, last]: [f32; 2], step: u32, steps: u32) -> f32 {
    if first <= 0.0 || last <= 0.0 {
        return 0.0;
    }
    let r = if steps == 0 { 1.0 } else { (f64::from(step) / f64::from(steps)).min(1.0) };
    ((1.0 - r) * f64::from(first).ln() + r * f64::from(last).ln()).exp() as f32
}

/// Spherical-harmonics degree after `step` steps of a stage that began with `start`: one more at every
/// multiple of the interval, capped.
#[must_use]
pub fn sh_degree(config: &TrainConfig, start: u8, step: u32) -> u8 {
    let highest = config.model.sh_degree;
    match step.checked_div(config.model.sh_interval) {
        None => highest,
        Some(increases) => highest.min(start.saturating_add(u8::try_from(increases).unwrap_or(u8::MAX))),
    }
}

/// Steps over which scheduled rates run.
#[must_use]
pub fn schedule_steps(config: &TrainConfig) -> u32 {
    match config.rates.schedule_steps {
        0 => config.fine_iterations() + config.stages.instance,
        steps => steps,
    }
}

/// Pixels that the shorter side of a reduced image has at least.
pub(crate) const SMALLEST_SIDE: u32 = 64;

/// True where steps may see images of such a size at half of it.
pub(crate) fn may_halve(width: u32, height: u32) -> bool {
    width.min(height) / 2 >= SMALLEST_SIDE
}

/// Properties of the capture that decide which stages a run has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stages {
    /// More than one time.
    pub is_dynamic: bool,
    /// Masks with labelled pixels.
    pub has_instances: bool,
}

impl Stages {
    /// Steps of a stage.
    pub(crate) fn iterations(self, config: &TrainConfig, stage: Stage) -> u32 {
        match stage {
            Stage::Coarse if self.is_dynamic => config.stages.coarse,
            Stage::Fine if self.is_dynamic => config.fine_iterations(),
            Stage::Fine => config.stages.coarse.saturating_add(config.fine_iterations()),
            // Labels are counted before its first step.
            Stage::Instance if config.head.name == HeadName::DrSplat => 0,
            Stage::Instance if self.has_instances => config.stages.instance,
            _ => 0,
        }
    }

    /// True where Gaussians are held to paths of objects, or in place: without masks nobody knows what may be.
    pub(crate) fn are_guided(self, config: &TrainConfig) -> bool {
        let is_asked = config.motion.guidance > 0.0 || config.motion.stillness > 0.0;
        is_asked && self.is_dynamic && self.has_instances
    }

    /// True where objects are tried for motion before the first step.
    pub(crate) fn search(self, config: &TrainConfig) -> bool {
        let has_steps = [Stage::Coarse, Stage::Fine].iter().any(|stage| self.iterations(config, *stage) > 0);
        config.motion.guidance > 0.0 && self.are_guided(config) && has_steps
    }

    /// The first stage with something to do from `stage` on.
    pub(crate) fn from(self, config: &TrainConfig, stage: Stage) -> Stage {
        [Stage::Search, Stage::Coarse, Stage::Objects, Stage::Fine, Stage::Identity, Stage::Instance]
            .into_iter()
            .filter(|candidate| *candidate >= stage)
            .find(|candidate| match candidate {
                Stage::Search => self.search(config),
                Stage::Objects => self.are_guided(config) && self.iterations(config, Stage::Fine) > 0,
                Stage::Identity => self.has_instances,
                _ => self.iterations(config, *candidate) > 0,
            })
            .unwrap_or(Stage::Done)
    }

    /// The stage after `stage`.
    pub(crate) fn after(self, config: &TrainConfig, stage: Stage) -> Stage {
        let next = match stage {
            Stage::Search => Stage::Coarse,
            Stage::Coarse => Stage::Objects,
            Stage::Objects => Stage::Fine,
            Stage::Fine => Stage::Identity,
            Stage::Identity => Stage::Instance,
            Stage::Instance | Stage::Done => Stage::Done,
        };
        self.from(config, next)
    }

    /// Steps left after `iteration` steps of `stage`.
    pub(crate) fn steps_left(self, config: &TrainConfig, stage: Stage, iteration: u32) -> u64 {
        [Stage::Coarse, Stage::Fine, Stage::Instance]
            .into_iter()
            .filter(|other| *other >= stage)
            .map(|other| u64::from(self.iterations(config, other)))
            .sum::<u64>()
            .saturating_sub(u64::from(iteration))
    }
}

/// Everything that falls on single steps of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Due {
    /// The step sees images of half the width and height.
    HalveImages,
    /// The step sees whole images of a run that works on reduced ones.
    WholeImages,
    /// Before the step: the present degree of spherical harmonics is tried, as the next one is due.
    TryHarmonics,
    /// Before the step: degrees of spherical harmonics that do not help are taken back, for good.
    TakeBackHarmonics,
    /// Held-out pixels of the views that are judged by train nothing.
    HoldOut,
    /// Statistics for densification are counted.
    CountStatistics,
    /// Raw quaternions are renormalised, which keeps their effective rate (methods reference 7, row 18).
    Renormalise,
    /// Behind the step: what is transparent or too large is removed.
    Prune,
    /// Behind the step: Gaussians are cloned and split.
    Add,
    /// Behind the step: all opacities are capped.
    ResetOpacities,
    /// Behind the step: identity rows are estimated anew.
    EstimateIdentities,
    /// Behind the step: Gaussians are relocated to instances that need them.
    Resample,
    /// Behind the step: optional outputs of the deformation are judged.
    JudgeOutputs,
    /// Behind the step: Gaussians that stand still are looked for.
    TestStill,
    /// In that test, everything is taken to stand still that masks do not show to travel.
    StillByMasks,
    /// The step is reported.
    Report,
    /// Held-out frames are evaluated.
    Evaluate,
    /// The run asks to be saved.
    Save,
}

/// A row of the table.
struct Row {
    due: Due,
    falls: fn(&Moment<'_>) -> bool,
}

/// What falls on which step. Source: methods reference 1.5 and 6 (changes of the set), 11 (effects).
const TABLE: [Row; 18] = [
    Row { due: Due::HalveImages, falls: |at| at.sees_half_size() },
    Row { due: Due::WholeImages, falls: |at| at.sees_whole_size() },
    Row {
        due: Due::TryHarmonics,
        falls: |at| at.judges_harmonics() && at.every(at.config.model.sh_interval),
    },
    Row { due: Due::TakeBackHarmonics, falls: |at| at.judges_harmonics() && at.is_half_of_fine() },
    Row { due: Due::HoldOut, falls: |at| at.judges_by_half() || at.still_tests_to_come() },
    Row { due: Due::CountStatistics, falls: |at| at.densifies() },
    Row { due: Due::Renormalise, falls: |at| at.total.is_multiple_of(RENORMALISE_EVERY) },
    Row { due: Due::Prune, falls: |at| at.is_warm() && at.every(at.config.densify.prune_every) },
    Row { due: Due::Add, falls: |at| at.is_warm() && at.every(at.config.densify.every) },
    Row {
        due: Due::ResetOpacities,
        falls: |at| at.densifies() && at.every(at.config.densify.opacity_reset_every),
    },
    Row {
        due: Due::EstimateIdentities,
        falls: |at| at.changes_instances() && at.every(at.config.identity.refresh_every),
    },
    Row {
        due: Due::Resample,
        falls: |at| {
            let resample = &at.config.resample;
            at.changes_instances()
                && at.every(resample.every)
                && (resample.from..=resample.until).contains(&at.iteration)
                && !at.config.ablates(Ablation::NoResampling)
        },
    },
    Row { due: Due::JudgeOutputs, falls: |at| at.config.effects.head_gain > 0.0 && at.is_half_of_fine() },
    Row { due: Due::TestStill, falls: |at| at.tests_still(at.iteration) },
    Row { due: Due::StillByMasks, falls: |at| at.is_still_by_masks() },
    Row { due: Due::Report, falls: |at| at.every(at.config.report.step_every) || at.iteration == at.last() },
    Row { due: Due::Evaluate, falls: |at| at.every_of_all(at.config.report.evaluate_every) },
    Row { due: Due::Save, falls: |at| at.every_of_all(at.config.report.checkpoint_every) },
];

/// Steps between renormalisations of the raw quaternions.
const RENORMALISE_EVERY: u64 = 1_000;

/// Fewest steps of the fine stage, in steps before the first test for Gaussians that stand still, for that test to go by
/// masks: what was taken out of the network too early needs time to recover.
const MASKS_STEPS: f64 = 15.0;

/// Facts about a run, in addition to its settings, that decide what falls on its steps.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facts {
    /// Stages that the capture has.
    pub stages: Stages,
    /// True where all cameras stay in place, so that their images show what changes.
    pub sees_changes: bool,
    /// True where Gaussians of travelling objects are distinguished from the others.
    pub knows_travelling: bool,
    /// True where identity rows are those of the run, not of another system's head.
    pub owns_identities: bool,
}

/// A step of a stage, as the table sees it.
pub struct Moment<'a> {
    /// Settings of the run.
    pub config: &'a TrainConfig,
    /// Stage of the step.
    pub stage: Stage,
    /// Step of the stage, from 1.
    pub iteration: u32,
    /// Steps of all stages up to this one.
    pub total: u64,
    pub(crate) facts: Facts,
}

impl Moment<'_> {
    /// True when something falls on the step.
    #[must_use]
    pub fn has(&self, due: Due) -> bool {
        TABLE.iter().any(|row| row.due == due && (row.falls)(self))
    }

    /// Everything that falls on the step, in order.
    #[must_use]
    pub fn all(&self) -> Vec<Due> {
        TABLE.iter().filter(|row| (row.falls)(self)).map(|row| row.due).collect()
    }

    /// Last step of the stage.
    fn last(&self) -> u32 {
        self.facts.stages.iterations(self.config, self.stage)
    }

    fn last_of_fine(&self) -> u32 {
        self.facts.stages.iterations(self.config, Stage::Fine)
    }

    /// Last fine step that sees images of half the size; 0: none does.
    fn last_of_half_size(&self) -> u32 {
        (f64::from(self.config.stages.half_size) * f64::from(self.last_of_fine())) as u32
    }

    /// True of the last fine steps of a run that works on reduced images.
    fn sees_whole_size(&self) -> bool {
        let (stages, last) = (&self.config.stages, self.last_of_fine());
        let whole = (f64::from(stages.whole_size) * f64::from(last)) as u32;
        stages.reduction > 1 && self.stage == Stage::Fine && self.iteration > last - whole.min(last)
    }

    fn every(&self, steps: u32) -> bool {
        falls_on(self.iteration, steps)
    }

    fn every_of_all(&self, steps: u32) -> bool {
        falls_on((self.total % u64::from(u32::MAX)) as u32, steps)
    }

    /// True of the stages that learn colours alone.
    pub(crate) fn is_of_colors(&self) -> bool {
        matches!(self.stage, Stage::Coarse | Stage::Fine)
    }

    fn densifies(&self) -> bool {
        self.is_of_colors() && self.iteration < self.config.densify.until
    }

    /// Additions, with the one behind this step, in which the set is to become full (`densify.full_at`): those of this
    /// stage, and of the fine stage where that is to come.
    pub(crate) fn additions_left(&self) -> u32 {
        let densify = &self.config.densify;
        let full_at =
            |stage: Stage| densify.full_after(self.facts.stages.iterations(self.config, stage)) as u32;
        let between = |from: u32, to: u32| (to / densify.every).saturating_sub(from / densify.every);
        let left = between(self.iteration, full_at(self.stage)) + 1;
        match self.stage {
            Stage::Coarse if self.facts.stages.is_dynamic => {
                left + between(densify.from, full_at(Stage::Fine))
            }
            _ => left,
        }
    }

    /// True of the first fine steps, and of coarse ones unless fits measure what these reconstruct.
    fn sees_half_size(&self) -> bool {
        match self.stage {
            Stage::Coarse => self.config.stages.half_size > 0.0 && !self.facts.stages.are_guided(self.config),
            Stage::Fine => self.iteration <= self.last_of_half_size() && !self.sees_whole_size(),
            _ => false,
        }
    }

    fn is_warm(&self) -> bool {
        self.densifies() && self.iteration > self.config.densify.from
    }

    /// True in the instance stage, but for its last step, which has none behind it to make good for changes.
    fn changes_instances(&self) -> bool {
        self.stage == Stage::Instance && self.iteration < self.last() && self.facts.owns_identities
    }

    fn judges_harmonics(&self) -> bool {
        self.config.effects.sh_gain > 0.0 && self.is_of_colors()
    }

    /// True on the step at half of the fine stage: sooner effects have not learnt what they are worth, and later nothing
    /// is left to make good for what is taken back.
    fn is_half_of_fine(&self) -> bool {
        self.stage == Stage::Fine && self.iteration == (self.last_of_fine() / 2).max(1)
    }

    /// True until everything is judged that is judged at half of the fine stage.
    fn judges_by_half(&self) -> bool {
        let effects = &self.config.effects;
        let is_before = self.stage == Stage::Coarse
            || (self.stage == Stage::Fine && self.iteration <= self.last_of_fine() / 2);
        (effects.sh_gain > 0.0 || effects.head_gain > 0.0) && is_before
    }

    /// Step of the fine stage with the first test for Gaussians that stand still: its first, where images show what
    /// moves.
    fn first_still_test(&self) -> u32 {
        if self.facts.sees_changes {
            return 1;
        }
        let effects = &self.config.effects;
        let from = (f64::from(effects.still_from) * f64::from(self.last_of_fine())).round() as u32;
        let by_masks = if self.facts.knows_travelling { effects.still_told } else { from };
        from.min(by_masks).max(1)
    }

    /// True when Gaussians that stand still are looked for on a step of the stage: from the first test on, then every so
    /// many steps, never at its end, where nothing is left to make good for it; and once more when the instance stage
    /// begins.
    fn tests_still(&self, iteration: u32) -> bool {
        let every = self.config.effects.still_every;
        if every == 0 || iteration >= self.last() {
            return false;
        }
        match self.stage {
            Stage::Fine => {
                let first = self.first_still_test();
                iteration >= first && (iteration - first).is_multiple_of(every)
            }
            Stage::Instance => iteration == 1,
            _ => false,
        }
    }

    /// True when they are looked for on this step or a later one.
    fn still_tests_to_come(&self) -> bool {
        let every = self.config.effects.still_every;
        if every == 0 || !self.facts.stages.is_dynamic {
            return false;
        }
        match self.stage {
            Stage::Coarse => true,
            // The instance stage begins with a test; else the last one is in this stage.
            Stage::Fine => {
                self.facts.stages.has_instances
                    || (self.iteration..self.last()).take(every as usize).any(|later| self.tests_still(later))
                    || self.iteration < self.first_still_test()
            }
            _ => self.iteration <= 1,
        }
    }

    /// True on the first test of a long fine stage, where masks show what travels: the network has then helped
    /// everything into place and learnt little else that could be lost.
    fn is_still_by_masks(&self) -> bool {
        self.stage == Stage::Fine
            && self.iteration == self.first_still_test()
            && MASKS_STEPS * f64::from(self.iteration) <= f64::from(self.last_of_fine())
            && !self.facts.sees_changes
            && self.facts.knows_travelling
    }
}

/// True when an event that happens `every` steps (0: never) falls on `step`.
#[must_use]
pub fn falls_on(step: u32, every: u32) -> bool {
    step > 0 && step.checked_rem(every) == Some(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_run_log_linearly_and_stay_at_the_end() {
        let rate = |step| log_linear([1.6e-4, 1.6e-6], step, 20_000);
        assert!((rate(0) / 1.6e-4 - 1.0).abs() < 1e-6);
        assert!((rate(10_000) / 1.6e-5 - 1.0).abs() < 1e-6);
        assert!((rate(20_000) / 1.6e-6 - 1.0).abs() < 1e-6);
        assert_eq!(rate(20_000), rate(90_000));
        assert_eq!(log_linear([0.0; 2], 5, 10), 0.0);
    }

    #[test]
    fn the_degree_grows_by_one_per_interval() {
        let mut config = TrainConfig::default();
        config.model.sh_interval = 1_000;
        let degrees: Vec<u8> = [0, 999, 1_000, 2_999, 3_000, 9_000].map(|s| sh_degree(&config, 0, s)).into();
        assert_eq!(degrees, [0, 0, 1, 2, 3, 3]);
        assert_eq!(sh_degree(&config, 2, 1_500), 3);
        config.model.sh_interval = 0;
        assert_eq!(sh_degree(&config, 0, 0), 3);
        config.model.sh_degree = 1;
        assert_eq!(sh_degree(&config, 0, 9_000), 1);
    }

    /// Steps up to `last` of a stage on which something falls.
    fn falling(config: &TrainConfig, facts: Facts, stage: Stage, due: Due) -> Vec<u32> {
        let at = |iteration| Moment { config, stage, iteration, total: u64::from(iteration), facts };
        (1..=500).filter(|iteration| at(*iteration).has(due)).collect()
    }

    const FACTS: Facts = Facts {
        stages: Stages { is_dynamic: true, has_instances: true },
        sees_changes: false,
        knows_travelling: false,
        owns_identities: true,
    };

    /// Settings of 200 steps of each stage in which nothing falls on single steps but what a test asks for.
    fn quiet() -> TrainConfig {
        let mut config = TrainConfig::default();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (200, 200, 200);
        (config.stages.fine_includes_coarse, config.stages.half_size) = (false, 0.0);
        config.densify.until = 0;
        (config.identity.refresh_every, config.resample.every) = (0, 0);
        let effects = &mut config.effects;
        (effects.still_every, effects.sh_gain, effects.head_gain) = (0, 0.0, 0.0);
        let report = &mut config.report;
        (report.step_every, report.evaluate_every, report.checkpoint_every) = (0, 0, 0);
        config
    }

    #[test]
    fn changes_of_the_set_fall_where_settings_and_ablations_say() {
        let mut config = quiet();
        let densify = &mut config.densify;
        (densify.from, densify.until, densify.every, densify.prune_every) = (100, 401, 50, 100);
        densify.opacity_reset_every = 300;
        let resample = &mut config.resample;
        (resample.from, resample.until, resample.every) = (50, 200, 50);
        config.identity.refresh_every = 100;
        let on = |config: &TrainConfig, stage, due| falling(config, FACTS, stage, due);
        assert_eq!(on(&config, Stage::Fine, Due::Add), [150, 200, 250, 300, 350, 400]);
        assert_eq!(on(&config, Stage::Coarse, Due::Prune), [200, 300, 400]);
        assert_eq!(on(&config, Stage::Fine, Due::ResetOpacities), [300]);
        assert_eq!(on(&config, Stage::Instance, Due::Resample), [50, 100, 150], "not on the last");
        assert_eq!(on(&config, Stage::Instance, Due::EstimateIdentities), [100]);
        let of_other_head = Facts { owns_identities: false, ..FACTS };
        assert!(falling(&config, of_other_head, Stage::Instance, Due::Resample).is_empty());
        config.instance.ablate.insert(Ablation::NoResampling);
        assert!(on(&config, Stage::Instance, Due::Resample).is_empty());
    }

    #[test]
    fn tests_for_what_stands_still_fall_after_the_warm_up_and_never_at_the_end() {
        let mut config = quiet();
        (config.effects.still_every, config.effects.still_from, config.effects.still_told) = (50, 0.25, 10);
        let on = |config: &TrainConfig, facts, stage| falling(config, facts, stage, Due::TestStill);
        assert_eq!(on(&config, FACTS, Stage::Fine), [50, 100, 150]);
        assert_eq!(on(&config, FACTS, Stage::Instance), [1]);
        assert!(on(&config, FACTS, Stage::Coarse).is_empty());
        let by_images = Facts { sees_changes: true, ..FACTS };
        assert_eq!(on(&config, by_images, Stage::Fine), [1, 51, 101, 151]);
        let by_masks = Facts { knows_travelling: true, ..FACTS };
        assert_eq!(on(&config, by_masks, Stage::Fine), [10, 60, 110, 160]);
        let of_masks = |facts| falling(&config, facts, Stage::Fine, Due::StillByMasks);
        assert_eq!(of_masks(by_masks), [10], "the first alone");
        assert!(of_masks(FACTS).is_empty() && of_masks(Facts { sees_changes: true, ..by_masks }).is_empty());
        config.stages.fine = 170;
        assert_eq!(on(&config, FACTS, Stage::Fine), [43, 93, 143]);
        assert!(falling(&config, by_masks, Stage::Fine, Due::StillByMasks) == [10]);
        config.stages.fine = 149;
        assert!(
            falling(&config, by_masks, Stage::Fine, Due::StillByMasks).is_empty(),
            "too short to recover"
        );
        config.effects.still_every = 0;
        assert!(on(&config, FACTS, Stage::Fine).is_empty());
    }

    #[test]
    fn effects_are_judged_at_half_of_the_fine_stage_and_hold_pixels_out_until_then() {
        let mut config = quiet();
        let on = |config: &TrainConfig, stage, due| falling(config, FACTS, stage, due);
        assert!(on(&config, Stage::Fine, Due::HoldOut).is_empty());
        (config.effects.sh_gain, config.effects.head_gain) = (0.1, 0.1);
        config.model.sh_interval = 60;
        assert_eq!(on(&config, Stage::Fine, Due::TakeBackHarmonics), [100]);
        assert_eq!(on(&config, Stage::Fine, Due::JudgeOutputs), [100]);
        assert!(on(&config, Stage::Coarse, Due::JudgeOutputs).is_empty());
        assert_eq!(on(&config, Stage::Coarse, Due::TryHarmonics)[..3], [60, 120, 180]);
        assert!(on(&config, Stage::Instance, Due::TryHarmonics).is_empty());
        assert_eq!(on(&config, Stage::Coarse, Due::HoldOut).len(), 500, "on every step");
        assert_eq!(on(&config, Stage::Fine, Due::HoldOut), (1..=100).collect::<Vec<_>>());
        // Later tests for what stands still go by these pixels too, up to that of the instance stage.
        config.effects.still_every = 50;
        assert_eq!(on(&config, Stage::Fine, Due::HoldOut).len(), 500);
        assert_eq!(on(&config, Stage::Instance, Due::HoldOut), [1]);
        let colors = Facts { stages: Stages { has_instances: false, ..FACTS.stages }, ..FACTS };
        config.effects.still_from = 0.25;
        let held_out = falling(&config, colors, Stage::Fine, Due::HoldOut);
        assert_eq!(held_out, (1..=150).collect::<Vec<_>>(), "up to the last test");
    }

    #[test]
    fn images_are_halved_on_the_first_fine_steps_and_on_coarse_ones_that_nothing_is_measured_in() {
        let mut config = quiet();
        let on = |config: &TrainConfig, facts, stage| falling(config, facts, stage, Due::HalveImages);
        assert!(on(&config, FACTS, Stage::Fine).is_empty());
        config.stages.half_size = 0.3;
        assert_eq!(on(&config, FACTS, Stage::Fine), (1..=60).collect::<Vec<_>>());
        assert!(
            on(&config, FACTS, Stage::Coarse).is_empty() && on(&config, FACTS, Stage::Instance).is_empty()
        );
        let colors = Facts { stages: Stages { has_instances: false, ..FACTS.stages }, ..FACTS };
        assert_eq!(on(&config, colors, Stage::Coarse).len(), 500, "on every step");
        config.stages.half_size = 0.0;
        assert!(on(&config, colors, Stage::Coarse).is_empty());
        assert!(
            may_halve(128, 400) && !may_halve(127, 400) && !may_halve(400, 96),
            "small images stay whole"
        );
    }

    #[test]
    fn a_set_becomes_full_at_a_share_of_the_steps_with_additions() {
        let mut config = quiet();
        let densify = &mut config.densify;
        (densify.from, densify.until, densify.every, densify.full_at) = (10, 100, 10, 0.5);
        let left = |stages: Stages, stage: Stage, iteration: u32| {
            let facts = Facts { stages, ..FACTS };
            Moment { config: &config, stage, iteration, total: 0, facts }.additions_left()
        };
        // Additions of a stage fall on 20, 30, ..., 90; the set is full behind that on 50.
        let of_fine = [20, 30, 40, 50, 60, 90].map(|step| left(FACTS.stages, Stage::Fine, step));
        assert_eq!(of_fine, [4, 3, 2, 1, 1, 1]);
        // Before them, those of the coarse stage.
        let of_coarse = [20, 50, 90].map(|step| left(FACTS.stages, Stage::Coarse, step));
        assert_eq!(of_coarse, [8, 5, 5]);
    }

    #[test]
    fn all_that_falls_on_a_step_is_listed_in_order() {
        let mut config = quiet();
        (config.densify.until, config.densify.every, config.densify.from) = (1_001, 50, 0);
        (config.densify.prune_every, config.densify.opacity_reset_every) = (0, 1_000);
        (config.report.step_every, config.report.evaluate_every) = (100, 500);
        let at = |iteration: u32, total| Moment {
            config: &config,
            stage: Stage::Fine,
            iteration,
            total,
            facts: FACTS,
        };
        assert_eq!(at(50, 1_000).all(), [Due::CountStatistics, Due::Renormalise, Due::Add, Due::Evaluate]);
        assert_eq!(at(7, 7).all(), [Due::CountStatistics]);
        assert_eq!(at(200, 200).all(), [Due::CountStatistics, Due::Add, Due::Report]);
        assert_eq!(
            at(1_000, 2_001).all(),
            [Due::CountStatistics, Due::Add, Due::ResetOpacities, Due::Report]
        );
    }

    #[test]
    fn events_fall_on_multiples_and_never_on_zero() {
        assert!(!falls_on(0, 100) && falls_on(100, 100) && !falls_on(150, 100) && !falls_on(100, 0));
    }

    #[test]
    fn stages_follow_what_the_capture_has() {
        let walk = |plan: Stages, config: &TrainConfig| {
            let mut stages = vec![plan.from(config, Stage::Search)];
            while stages[stages.len() - 1] != Stage::Done {
                stages.push(plan.after(config, stages[stages.len() - 1]));
            }
            stages
        };
        use Stage::{Coarse, Done, Fine, Identity, Instance, Objects, Search};
        let mut config = TrainConfig::default();
        let whole = Stages { is_dynamic: true, has_instances: true };
        assert_eq!(walk(whole, &config), [Search, Coarse, Objects, Fine, Identity, Instance, Done]);
        assert_eq!(
            walk(Stages { has_instances: false, ..whole }, &config),
            [Coarse, Fine, Done],
            "without masks nothing is known of objects"
        );
        let still = Stages { is_dynamic: false, ..whole };
        assert_eq!(walk(still, &config), [Fine, Identity, Instance, Done]);
        config.motion.guidance = 0.0;
        assert_eq!(
            walk(whole, &config),
            [Coarse, Objects, Fine, Identity, Instance, Done],
            "what is at rest is held"
        );
        config.motion.stillness = 0.0;
        assert_eq!(walk(whole, &config), [Coarse, Fine, Identity, Instance, Done]);
        assert_eq!(still.iterations(&config, Fine), config.stages.coarse + config.stages.fine);
    }

    #[test]
    fn steps_left_count_later_stages() {
        let mut config = TrainConfig::default();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (10, 20, 5);
        let plan = Stages { is_dynamic: true, has_instances: true };
        assert_eq!(plan.steps_left(&config, Stage::Coarse, 4), 31);
        assert_eq!(plan.steps_left(&config, Stage::Fine, 4), 21);
        assert_eq!(plan.steps_left(&config, Stage::Done, 0), 0);
    }
}
