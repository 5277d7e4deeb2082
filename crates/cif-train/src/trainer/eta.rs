//! How long the rest of a run takes, by what its steps and fits took so far.

use cif_field::Deformation;

use super::Trainer;
use crate::budget::{COARSE, IDENTITY_STEPS_PER_FRAME, INSTANCE, MOVING, PIXELS_OF_FIT, TRAVELS};
use crate::config::DensifyRule;
use crate::phase::Phase;
use crate::schedule::{Due, may_halve};
use crate::stage::Stage;
use crate::times::{StepShares, StepTimes};
use crate::working_size::PIXEL_SHARE;

/// Steps of a stage that are looked at for what all of it costs.
const SAMPLES: u32 = 200;

/// Shares of the steps between two times.
fn shares(now: &StepTimes, since: &StepTimes) -> Option<StepShares> {
    let (now, since) = (now.seconds_by_growth(), since.seconds_by_growth());
    StepShares::of(std::array::from_fn(|part| now[part] - since[part]))
}

/// Where parts of steps are not timed, as on GPUs.
const UNKNOWN: StepShares = StepShares { pixels: PIXEL_SHARE, moving: 0.0, fixed: 0.0 };

impl Trainer {
    /// Travelling objects that are not fitted yet.
    pub(super) fn objects_to_fit(&self) -> usize {
        if !self.state.config.motion.rigid || !self.stages.are_guided(&self.state.config) {
            return 0;
        }
        let travelling = self.state.guidance.travelling.iter().enumerate().filter(|(_, travels)| **travels);
        travelling.filter(|(label, _)| !self.state.objects.has_poses(*label as u16)).count()
    }

    /// Estimated seconds to the end of the run, within a stage whose steps are done at a rate per second: the budget's
    /// where there is one, else by steps, by the frames that identities are estimated from, and by the objects that are
    /// fitted between the coarse and the fine stage. `since`: times of all steps when the rate began to be counted.
    pub(super) fn eta_s(&self, stage: Stage, rate: f64, since: &StepTimes) -> f64 {
        if let Some(left_s) = self.budget_left_s() {
            return left_s;
        }
        let shares = shares(&self.state.times, since).unwrap_or(UNKNOWN);
        let cost = |stage: Stage| match stage {
            Stage::Coarse if self.stages.is_dynamic => COARSE,
            Stage::Instance => INSTANCE,
            _ => 1.0,
        };
        let all = |of: Stage| self.stages.iterations(&self.state.config, of);
        let done = |of: Stage| if of == stage { self.state.progress.iteration } else { 0 };
        let gaussians = self.state.field.gaussians.len() as f64;
        let last = self.pixels_of_step(stage, done(stage).max(1));
        let test = self.first_test(stage);
        let cost_of = |of: Stage, step: u32, pixels: f64| {
            let more = self.gaussians_at(of, step) / gaussians.max(1.0);
            let is_behind = test.is_some_and(|test| of > stage || step > test);
            let moving = if is_behind { MOVING } else { 1.0 };
            shares.cost(pixels / last, more, moving) * cost(of) / cost(stage)
        };
        // Costs change slowly but for a few steps, so that some stand for all.
        let left = |of: Stage| {
            let (done, all) = (done(of), all(of));
            let every = (all.saturating_sub(done)).div_ceil(SAMPLES).max(1);
            (done + 1..=all)
                .step_by(every as usize)
                .map(|step| {
                    let pixels = self.pixels_of_step(of, step);
                    cost_of(of, step, pixels) * f64::from(every.min(all + 1 - step))
                })
                .sum::<f64>()
        };
        let stages = [Stage::Coarse, Stage::Fine, Stage::Instance].into_iter().filter(|of| *of >= stage);
        let identity = IDENTITY_STEPS_PER_FRAME
            * self.frames_of_identities(stage) as f64
            * cost_of(Stage::Fine, all(Stage::Fine), 1.0);
        let fits_s = if stage == Stage::Coarse { self.fits_s() } else { 0.0 };
        (stages.map(left).sum::<f64>() + identity) / rate.max(1e-9) + fits_s
    }

    /// The step of the fine stage that looks for Gaussians that stand still before any does; `None` where this step does not
    /// come.
    fn first_test(&self, stage: Stage) -> Option<u32> {
        let still = |deformation: &Deformation| deformation.still.contains(&true);
        if stage != Stage::Fine || self.state.field.deformation.as_ref().is_none_or(still) {
            return None;
        }
        let steps = self.state.progress.iteration + 1..=self.stages.iterations(&self.state.config, stage);
        steps.into_iter().find(|step| self.moment(stage, *step, 0).has(Due::TestStill))
    }

    /// Pixels of the images of a step, relative to those that are worked on.
    pub(super) fn pixels_of_step(&self, stage: Stage, step: u32) -> f64 {
        let at = self.moment(stage, step, 0);
        let reduction = f64::from(self.state.config.stages.reduction.max(1));
        if at.has(Due::WholeImages) {
            return reduction * reduction;
        }
        let camera = &self.state.dataset.frames[self.state.frames.index(0)].camera;
        if at.has(Due::HalveImages) && may_halve(camera.width, camera.height) { 0.25 } else { 1.0 }
    }

    /// Gaussians at a step to come: they grow by equal factors until their set is full, where they are added by a budget.
    fn gaussians_at(&self, stage: Stage, step: u32) -> f64 {
        let (config, progress) = (&self.state.config, &self.state.progress);
        let now = self.state.field.gaussians.len() as f64;
        let most = f64::from(config.densify.max_gaussians);
        let fine = self.stages.iterations(config, Stage::Fine);
        let full = f64::from(config.densify.full_at) * f64::from(fine.min(config.densify.until));
        let grows = config.densify.rule == DensifyRule::Error && most > now;
        // What the coarse stage adds is little.
        if !grows || progress.stage > Stage::Fine || stage == Stage::Coarse || full < 1.0 {
            return now;
        }
        let done = if progress.stage == Stage::Fine { f64::from(progress.iteration) } else { 0.0 };
        let way = match stage {
            Stage::Fine if done < full => ((f64::from(step) - done) / (full - done)).clamp(0.0, 1.0),
            _ => 1.0,
        };
        now * (most / now.max(1.0)).powf(way)
    }

    /// Estimated seconds of the fits to come, by those of objects that were tried before, or by the steps of the coarse
    /// stage where none was.
    fn fits_s(&self) -> f64 {
        let others = self.state.guidance.travelling.iter().skip(1).filter(|travels| !**travels).count();
        // In units of fits of objects that rest.
        let tried = others as f64 + TRAVELS * self.state.objects.moving_count() as f64;
        let spent = self.state.phases.spent(Phase::Search).wall_s;
        let objects = self.objects_to_fit() as f64;
        if tried > 0.0 { TRAVELS * objects * spent / tried } else { objects * PIXELS_OF_FIT * self.pixel_s() }
    }

    /// Seconds that the coarse steps took for each pixel of their images; 0 where their parts were not timed.
    fn pixel_s(&self) -> f64 {
        let times = &self.state.times;
        let [spent_s, ..] = times.seconds_by_growth();
        let camera = &self.state.dataset.frames[self.state.frames.index(0)].camera;
        let pixels =
            f64::from(camera.width) * f64::from(camera.height) * self.pixels_of_step(Stage::Coarse, 1);
        spent_s / (pixels * times.views as f64).max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::guard_tests::support::{Scene, capture, small_config};
    use super::*;

    #[test]
    fn costs_grow_with_what_the_parts_of_steps_grow_with() {
        let known = StepShares { pixels: 0.5, moving: 0.1, fixed: 0.2 };
        assert!((known.cost(1.0, 1.0, 1.0) - 1.0).abs() < 1e-12);
        assert!((known.cost(4.0, 2.0, 1.0) - (2.0 + 0.2 + 0.6)).abs() < 1e-12);
        assert!((known.cost(1.0, 2.0, 0.5) - (0.5 + 0.2 + 2.0 * (0.2 + 0.05))).abs() < 1e-12);
        let since = StepTimes { total: Duration::from_secs(1), ..StepTimes::default() };
        let mut now = StepTimes { total: Duration::from_secs(5), ..since };
        assert_eq!(shares(&now, &since), None, "parts are not timed");
        (now.losses, now.optimiser_mlp) = (Duration::from_secs(1), Duration::from_secs(2));
        now.render.deform = Duration::from_millis(500);
        assert_eq!(shares(&now, &since), Some(StepShares { pixels: 0.25, moving: 0.125, fixed: 0.5 }));
        assert_eq!(shares(&since, &since), None);
    }

    #[test]
    fn fits_to_come_are_known_by_the_coarse_steps_where_none_was_tried() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
        let mut config = small_config();
        (config.motion.rigid, config.motion.guidance) = (true, 1.0);
        let mut trainer = Trainer::new(dataset, config).unwrap();
        assert_eq!(trainer.fits_s(), 0.0, "nothing travels");
        trainer.state.guidance.travelling = vec![false, true, true];
        assert_eq!(trainer.objects_to_fit(), 2);
        assert_eq!(trainer.fits_s(), 0.0, "no step was timed");
        // 20 ns for each pixel of ten views.
        let camera = &trainer.state.dataset.frames[trainer.state.frames.index(0)].camera;
        let pixels = f64::from(camera.width) * f64::from(camera.height);
        trainer.state.times.views = 10;
        trainer.state.times.losses = Duration::from_secs_f64(10.0 * pixels * 20e-9);
        let fits_s = trainer.fits_s();
        assert!((fits_s / (2.0 * PIXELS_OF_FIT * 20e-9) - 1.0).abs() < 1e-3, "{fits_s}");
    }

    #[test]
    fn the_rest_of_a_run_counts_sizes_and_gaussians_to_come() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, larger: 8, ..Scene::default() });
        let mut config = small_config();
        let stages = &mut config.stages;
        (stages.coarse, stages.fine, stages.instance) = (0, 100, 0);
        (stages.half_size, stages.reduction, stages.whole_size) = (0.4, 2, 0.2);
        let mut trainer = Trainer::new(dataset, config).unwrap();
        trainer.enter(Stage::Fine).unwrap();
        let now = trainer.field().gaussians.len() as f64;
        let densify = &mut trainer.state.config.densify;
        (densify.rule, densify.until, densify.full_at) = (DensifyRule::Error, 80, 0.5);
        densify.max_gaussians = 4 * now as u32;
        let at = [1, 40, 41, 80, 81, 100].map(|step| trainer.pixels_of_step(Stage::Fine, step));
        assert_eq!(at, [0.25, 0.25, 1.0, 1.0, 4.0, 4.0]);
        let at =
            [0, 20, 40, 90].map(|step| (trainer.gaussians_at(Stage::Fine, step) / now * 1e3).round() / 1e3);
        assert_eq!(at, [1.0, 2.0, 4.0, 4.0]);
        assert_eq!(trainer.gaussians_at(Stage::Instance, 1), 4.0 * now);
        trainer.state.config.densify.rule = DensifyRule::Gradient;
        assert_eq!(trainer.gaussians_at(Stage::Fine, 90), now, "nobody knows");
        // A step on half-size images takes a second; parts are not timed.
        let eta_s = trainer.eta_s(Stage::Fine, 1.0, &StepTimes::default());
        let cost = |pixels: f64| UNKNOWN.cost(4.0 * pixels, 1.0, 1.0);
        let identity = IDENTITY_STEPS_PER_FRAME * trainer.frames_of_identities(Stage::Fine) as f64;
        let expected = 40.0 + (40.0 + identity) * cost(1.0) + 20.0 * cost(4.0);
        assert!((eta_s / expected - 1.0).abs() < 1e-6, "{eta_s} {expected}");
        // One of the size that is worked on takes half a second.
        trainer.state.progress.iteration = 80;
        let eta_s = trainer.eta_s(Stage::Fine, 2.0, &StepTimes::default());
        assert!(
            (eta_s / (10.0 * UNKNOWN.cost(4.0, 1.0, 1.0) + 0.5 * identity) - 1.0).abs() < 1e-6,
            "{eta_s}"
        );
        // Before it is known what stands still, fewer will move behind the first test.
        trainer.shows_changes = false;
        trainer.state.config.effects.still_every = 10;
        (trainer.state.config.effects.still_from, trainer.state.progress.iteration) = (0.3, 10);
        assert_eq!(trainer.first_test(Stage::Fine), Some(30));
        assert_eq!(trainer.first_test(Stage::Coarse), None);
        let count = trainer.field().gaussians.len();
        trainer.state.field.deformation.as_mut().unwrap().still = vec![true; count];
        assert_eq!(trainer.first_test(Stage::Fine), None, "it is known");
    }
}
