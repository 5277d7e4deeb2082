//! How long the rest of a run takes, by what its steps and fits took so far.

use super::Trainer;
use crate::budget::{COARSE, IDENTITY_STEPS_PER_FRAME, INSTANCE};
use crate::phase::Phase;
use crate::stage::Stage;

/// Time of a fit of an object that travels, of that of one that turns out to rest: the first has about 32 000 steps, the
/// second 4 700, each in two sizes of one capture.
const TRAVELS: f64 = 7.0;

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
    /// fitted between the coarse and the fine stage.
    pub(super) fn eta_s(&self, stage: Stage, rate: f64) -> f64 {
        if let Some(left_s) = self.budget_left_s() {
            return left_s;
        }
        let cost = |stage: Stage| match stage {
            Stage::Coarse if self.stages.is_dynamic => COARSE,
            Stage::Instance => INSTANCE,
            _ => 1.0,
        };
        let all = |of: Stage| self.stages.iterations(&self.state.config, of);
        let done = |of: Stage| if of == stage { self.state.progress.iteration } else { 0 };
        let last = self.cheaper(stage).cost_of(done(stage).max(1), all(stage)) * cost(stage);
        let step_s = 1.0 / (rate * last).max(1e-9);
        let left = |of: Stage| {
            let (cheaper, steps) = (self.cheaper(of), all(of).max(done(of)));
            (cheaper.cost_up_to(steps, all(of)) - cheaper.cost_up_to(done(of), all(of))) * cost(of)
        };
        let stages = [Stage::Coarse, Stage::Fine, Stage::Instance].into_iter().filter(|of| *of >= stage);
        let identity = IDENTITY_STEPS_PER_FRAME * self.frames_of_identities(stage) as f64;
        let fits_s = if stage == Stage::Coarse { self.fits_s() } else { 0.0 };
        (stages.map(left).sum::<f64>() + identity) * step_s + fits_s
    }

    /// Estimated seconds of the fits to come, by those of objects that were tried before; 0 where none was.
    fn fits_s(&self) -> f64 {
        let others = self.state.guidance.travelling.iter().skip(1).filter(|travels| !**travels).count();
        // In units of fits of objects that rest.
        let tried = others as f64 + TRAVELS * self.state.objects.moving_count() as f64;
        let spent = self.state.phases.spent(Phase::Search).wall_s;
        if tried > 0.0 { TRAVELS * self.objects_to_fit() as f64 * spent / tried } else { 0.0 }
    }
}
