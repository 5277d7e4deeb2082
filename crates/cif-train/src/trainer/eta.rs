//! How long the rest of a run takes, by what its steps and fits took so far.

use cif_field::Deformation;
use cif_field::tracks::NO_GROUP;

use super::Trainer;
use super::cost::Load;
use crate::budget::{INSTANCE, MOVING, PIXELS_OF_FIT, STEPS_OF_IDENTITY_VIEW, fits_of_resting};
use crate::config::DensifyRule;
use crate::density::growth;
use crate::phase::Phase;
use crate::schedule::{Due, may_halve};
use crate::stage::Stage;
use crate::state::State;

/// Steps of a stage that are looked at for what all of it costs.
const SAMPLES: u32 = 200;

impl Trainer {
    /// Travelling objects that are not fitted yet.
    pub(super) fn objects_to_fit(&self) -> usize {
        if !self.state.config.motion.rigid || !self.stages.are_guided(&self.state.config) {
            return 0;
        }
        let travelling = self.state.guidance.travelling.iter().enumerate().filter(|(_, travels)| **travels);
        travelling.filter(|(label, _)| !self.state.objects.is_found(*label as u16)).count()
    }

    /// Estimated seconds to the end of the run: the budget's where there is one, else by steps that cost what the last ones
    /// did, by the views that identities are worked out from, and by the objects that are fitted between the coarse and the
    /// fine stage.
    pub(super) fn eta_s(&self, stage: Stage) -> f64 {
        if let Some(left_s) = self.budget_left_s() {
            return left_s;
        }
        let Some(cost) = self.reports.cost() else { return 0.0 };
        let all = |of: Stage| self.stages.iterations(&self.state.config, of);
        let done = |of: Stage| if of == stage { self.state.progress.iteration } else { 0 };
        let test = self.first_test(stage);
        let share = self.moving_share();
        let step_s = |of: Stage, step: u32| {
            let is_behind = test.is_some_and(|test| of > stage || step > test);
            let moving = if is_behind { MOVING * share } else { share };
            let weight = if of == Stage::Instance { INSTANCE } else { 1.0 };
            weight * cost.step_s(&self.load_at(of, step, moving))
        };
        // Costs change slowly but for a few steps, so that some stand for all.
        let left_s = |of: Stage| {
            let (done, all) = (done(of), all(of));
            let every = (all.saturating_sub(done)).div_ceil(SAMPLES).max(1);
            (done + 1..=all)
                .step_by(every as usize)
                .map(|step| step_s(of, step) * f64::from(every.min(all + 1 - step)))
                .sum::<f64>()
        };
        let stages = [Stage::Coarse, Stage::Fine, Stage::Instance].into_iter().filter(|of| *of >= stage);
        let identity_s = STEPS_OF_IDENTITY_VIEW
            * self.identity_views(stage).iter().sum::<usize>() as f64
            * step_s(Stage::Instance, all(Stage::Instance));
        let fits_s = if stage == Stage::Coarse { self.fits_s() } else { 0.0 };
        stages.map(left_s).sum::<f64>() + identity_s + fits_s
    }

    /// Takes in the steps of a stage that were done since the last report.
    pub(super) fn report_steps(&mut self, stage: Stage, steps: u32) {
        let State { field, phases, times, .. } = &self.state;
        let weight = if stage == Stage::Instance { INSTANCE } else { 1.0 };
        let load = Load {
            pixels: weight * self.pixels_of_step(stage, self.state.progress.iteration.max(1)),
            gaussians: weight * field.gaussians.len() as f64,
            moving: weight * self.moving(),
        };
        let stages = [Stage::Coarse, Stage::Fine, Stage::Instance];
        let at_s = stages.map(|stage| phases.spent(Phase::from(stage)).wall_s).iter().sum();
        let are_first = self.state.progress.iteration == steps;
        self.reports.add(at_s, *times, steps, &load, are_first);
    }

    /// Gaussians that the deformation network moves.
    fn moving(&self) -> f64 {
        let Some(deformation) = &self.state.field.deformation else { return 0.0 };
        self.without_pose().filter(|row| !deformation.is_still(*row)).count() as f64
    }

    /// Gaussians that have no poses.
    fn without_pose(&self) -> impl Iterator<Item = usize> + '_ {
        let field = &self.state.field;
        let group_of = |row: usize| field.tracks.as_ref()?.group_of.get(row).filter(|of| **of != NO_GROUP);
        (0..field.gaussians.len()).filter(move |row| group_of(*row).is_none())
    }

    /// Share of the Gaussians that the deformation network moves, or will once there is one.
    fn moving_share(&self) -> f64 {
        match self.state.progress.stage {
            _ if !self.stages.is_dynamic => 0.0,
            Stage::Coarse => MOVING,
            _ => self.moving() / (self.state.field.gaussians.len() as f64).max(1.0),
        }
    }

    /// Load of a step to come, in which a share of the Gaussians moves, but in the coarse stage.
    fn load_at(&self, stage: Stage, step: u32, share: f64) -> Load {
        let gaussians = self.gaussians_at(stage, step);
        let moving = if stage == Stage::Coarse { 0.0 } else { share * gaussians };
        Load { pixels: self.pixels_of_step(stage, step), gaussians, moving }
    }

    /// The step of the fine stage that looks for Gaussians that stand still before any does; `None` where this step does not
    /// come.
    fn first_test(&self, stage: Stage) -> Option<u32> {
        // What has poses never goes through the network.
        let still = |deformation: &Deformation| self.without_pose().any(|row| deformation.is_still(row));
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
        let full = config.densify.full_after(fine);
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
        growth::grown(now, most, way)
    }

    /// Estimated seconds of the fits to come, by those of objects that were tried before, or by the steps of the coarse
    /// stage where none was.
    fn fits_s(&self) -> f64 {
        let tried = self.state.objects.rigid.len() as f64 * fits_of_resting(self.state.config.motion.parts);
        let spent = |phase| self.state.phases.spent(phase).wall_s;
        let of_tried = spent(Phase::Search) + spent(Phase::Joints);
        let fit_s = if tried > 0.0 { of_tried / tried } else { PIXELS_OF_FIT * self.pixel_s() };
        self.objects_to_fit() as f64 * fit_s
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
    use std::sync::Arc;
    use std::time::Duration;

    use cif_field::Gaussians;
    use cif_field::tracks::Tracks;

    use super::super::cost::Reports;
    use super::super::guard_tests::support::{Scene, capture, small_config};
    use super::super::guidance_tests::explained;
    use super::*;
    use crate::clock::testing::Manual;
    use crate::objects::Found;
    use crate::times::{StepTimes, raster_cost};
    use crate::working_size::PIXEL_SHARE;

    #[test]
    fn fits_to_come_are_known_by_the_coarse_steps_where_none_was_tried() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
        let mut config = small_config();
        (config.motion.rigid, config.motion.parts, config.motion.guidance) = (true, true, 1.0);
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
        // Four others took 12 and 9 seconds, and two of them were found to move in place.
        let clock = Arc::new(Manual::default());
        trainer.state.phases.set_clock(clock.clone());
        for (phase, seconds) in [(Phase::Search, 12.0), (Phase::Joints, 9.0)] {
            let _entered = trainer.state.phases.enter(phase, 4);
            clock.pass(seconds);
        }
        trainer.state.guidance.travelling = vec![false, true, true, true, true, false, false];
        trainer.state.objects.rigid = [5, 6].map(|label| (label, Found::Nothing)).into();
        let found = explained(Gaussians::from_points(&[[0.0; 3]], &[[0.5; 3]]).unwrap());
        let moves = [3, 4].map(|label| (label, Found::Moves(Box::new(found.clone()))));
        trainer.state.objects.rigid.extend(moves);
        let expected = 2.0 * 21.0 / (4.0 * fits_of_resting(true));
        let fits_s = trainer.fits_s();
        assert!((fits_s / expected - 1.0).abs() < 1e-9, "{fits_s} {expected}");
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
        // Steps on half-size images take a second; parts are not timed.
        let (n, times) = (now, StepTimes::default());
        let step = |pixels: f64| Load { pixels, gaussians: n, moving: n };
        trainer.reports.add(0.0, times, 0, &step(0.25), false);
        trainer.reports.add(10.0, times, 10, &step(0.25), false);
        let cost = |pixels: f64| PIXEL_SHARE * raster_cost(4.0 * pixels, 1.0) + 1.0 - PIXEL_SHARE;
        let identity =
            STEPS_OF_IDENTITY_VIEW * trainer.identity_views(Stage::Fine).iter().sum::<usize>() as f64;
        let expected = 40.0 + (40.0 + INSTANCE * identity) * cost(1.0) + 20.0 * cost(4.0);
        let eta_s = trainer.eta_s(Stage::Fine);
        assert!((eta_s / expected - 1.0).abs() < 1e-6, "{eta_s} {expected}");
        // Steps of the size that is worked on take two seconds.
        trainer.state.progress.iteration = 80;
        trainer.reports = Reports::default();
        trainer.reports.add(0.0, times, 0, &step(1.0), false);
        trainer.reports.add(20.0, times, 10, &step(1.0), false);
        let expected = 2.0 * (20.0 * cost(1.0) + INSTANCE * identity);
        let eta_s = trainer.eta_s(Stage::Fine);
        assert!((eta_s / expected - 1.0).abs() < 1e-6, "{eta_s} {expected}");
        // Reports take in what moves: all at first.
        trainer.reports = Reports::default();
        trainer.state.times.steps = 1;
        trainer.report_steps(Stage::Fine, 0);
        assert_eq!(trainer.moving(), n);
        trainer.state.field.deformation.as_mut().unwrap().still = (0..now as usize).map(|k| k > 2).collect();
        assert_eq!(trainer.moving(), 3.0);
        assert_eq!(trainer.load_at(Stage::Fine, 90, trainer.moving_share()).moving, 3.0);
        assert_eq!(trainer.load_at(Stage::Coarse, 90, trainer.moving_share()).moving, 0.0);
        trainer.state.field.deformation.as_mut().unwrap().still.clear();
        // Before it is known what stands still, fewer will move behind the first test.
        trainer.shows_changes = false;
        trainer.state.config.effects.still_every = 10;
        (trainer.state.config.effects.still_from, trainer.state.progress.iteration) = (0.3, 10);
        assert_eq!(trainer.first_test(Stage::Fine), Some(30));
        assert_eq!(trainer.first_test(Stage::Coarse), None);
        let count = trainer.field().gaussians.len();
        // What has poses stands still from the start.
        let field = &mut trainer.state.field;
        let group_of = (0..count).map(|row| if row < 5 { 0 } else { NO_GROUP }).collect();
        field.tracks = Some(Tracks { group_of, ..Tracks::default() });
        field.deformation.as_mut().unwrap().still = (0..count).map(|row| row < 5).collect();
        assert_eq!(trainer.first_test(Stage::Fine), Some(30));
        trainer.state.field.deformation.as_mut().unwrap().still = vec![true; count];
        assert_eq!(trainer.first_test(Stage::Fine), None, "it is known");
    }
}
