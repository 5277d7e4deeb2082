//! Pacing of stages: deadlines per stage, and step counts that follow the measured cost of steps.

use super::Budget;
use crate::clock::Seconds;
use crate::stage::Stage;

/// Cost of a coarse step relative to a fine one with as many Gaussians: no deformation.
pub const COARSE: f64 = 0.35;

/// The same of an instance step: the instance pass on top.
pub const INSTANCE: f64 = 1.25;

/// Share of the budget between two looks at what steps cost.
const LOOK_EVERY: f64 = 0.01;

/// Weight of the newest look in the cost of a step.
const NEWEST: f64 = 0.5;

/// Share of the budget that is left for writing the scene, and its least length in seconds.
const SAVING: (f64, f64) = (0.005, 0.2);

/// Part of the time that is left, up to which objects that travel are fitted: poses are worth more to them than steps.
/// Parts up to which other objects are tried for motion, and for parts, and up to which the network learns paths: few of
/// those objects move, and what is not taught is learnt in the fine stage.
pub(crate) const FITS: f64 = 0.35;
pub(crate) const TRIALS: [f64; 2] = [0.05, 0.05];
pub(crate) const REHEARSAL: f64 = 0.1;

/// Passes of identity estimation over the training frames, in steps of the fine stage per frame.
pub(crate) const IDENTITY_STEPS_PER_FRAME: f64 = 0.35;

/// A stage to come with its weight: expected time relative to the others.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageShare {
    /// Stage.
    pub stage: Stage,
    /// Expected time, any unit.
    pub weight: f64,
}

/// Work to come that is no step of a stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OtherWork {
    /// Frames that identity estimation still has to pass over.
    pub identity_frames: usize,
    /// True where objects are fitted behind the present stage.
    pub has_fits: bool,
}

/// Weights of the stages for [`Pacer::enter`]: `steps` of each, in order.
#[must_use]
pub(crate) fn weights(steps: &[(Stage, u32)]) -> Vec<StageShare> {
    let cost = |stage| match stage {
        Stage::Coarse => COARSE,
        Stage::Instance => INSTANCE,
        _ => 1.0,
    };
    steps
        .iter()
        .map(|(stage, steps)| StageShare { stage: *stage, weight: f64::from(*steps) * cost(*stage) })
        .collect()
}

/// Follows a budget. Knows nothing of training: it is told the time and answers with steps.
#[derive(Clone, Debug)]
pub struct Pacer {
    budget: Budget,
    /// Time by which the present stage has to end, seconds of the budget.
    deadline: f64,
    /// Last look: time and step of the stage.
    look: (f64, u32),
    /// Seconds per step of the present stage.
    cost: Option<f64>,
}

impl Pacer {
    /// Paces a run that has used nothing, or a part of its budget.
    #[must_use]
    pub fn new(budget: Budget) -> Self {
        Self { budget, deadline: budget.seconds, look: (0.0, 0), cost: None }
    }

    /// The budget.
    #[must_use]
    pub fn budget(&self) -> &Budget {
        &self.budget
    }

    /// Time by which all steps have to be done.
    fn end(&self) -> f64 {
        self.budget.seconds - (SAVING.0 * self.budget.seconds).max(SAVING.1)
    }

    /// Seconds of the budget that are left for steps and fits.
    #[must_use]
    pub fn left(&self, now: Seconds) -> f64 {
        (self.end() - self.budget.used(now)).max(0.0)
    }

    /// Begins the first of `stages`, which are all that are left and have steps, after `iteration` of its steps.
    pub fn enter(&mut self, stages: &[StageShare], iteration: u32, other: OtherWork, now: Seconds) {
        let used = self.budget.used(now);
        let whole: f64 = stages.iter().map(|share| share.weight).sum();
        let mine = stages.first().map_or(0.0, |share| share.weight);
        let left = self.left(now) * if other.has_fits { 1.0 - FITS } else { 1.0 };
        // A coarse step costs less than a fine one, so that this is too little rather than too much.
        let identity =
            self.cost.map_or(0.0, |cost| cost * IDENTITY_STEPS_PER_FRAME) * other.identity_frames as f64;
        let left = (left - identity.min(0.2 * left)).max(0.0);
        self.deadline = used + if whole > 0.0 { left * mine / whole } else { left };
        self.look = (used, iteration);
    }

    /// Steps that the present stage shall have in all, after `iteration` of them; none keeps them as they are.
    /// The stage is over when that is no more than `iteration`.
    #[must_use]
    pub fn after_step(&mut self, iteration: u32, now: Seconds) -> Option<u32> {
        let used = self.budget.used(now);
        let left = self.deadline - used;
        let gap = LOOK_EVERY * self.budget.seconds;
        if left > 2.0 * gap && used - self.look.0 < gap {
            return None;
        }
        let steps = iteration.saturating_sub(self.look.1);
        if steps > 0 && used - self.look.0 >= gap {
            let cost = (used - self.look.0) / f64::from(steps);
            self.cost = Some(self.cost.map_or(cost, |old| old + NEWEST * (cost - old)));
            self.look = (used, iteration);
        }
        if left <= 0.0 {
            return Some(iteration);
        }
        let cost = self.cost.or_else(|| (steps > 0).then(|| (used - self.look.0) / f64::from(steps)))?;
        // At least one more: the deadline itself ends the stage.
        let more = (left / cost.max(1e-9)).ceil().clamp(1.0, f64::from(u32::MAX / 2));
        Some(iteration.saturating_add(more as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::BudgetClock;

    /// A run whose steps cost what `cost` says of stage and progress; returns steps per stage and the end.
    fn simulate(
        seconds: f64,
        before: f64,
        identity: f64,
        cost: impl Fn(Stage, f64) -> f64,
    ) -> (Vec<(Stage, u32, f64)>, f64) {
        let budget = Budget {
            seconds,
            clock: BudgetClock::Wall,
            threads: 1,
            start: Seconds { wall_s: 7.0, cpu_s: 3.0 },
        };
        let mut pacer = Pacer::new(budget);
        let mut now = before;
        let at = |now: f64| Seconds { wall_s: 7.0 + now, cpu_s: 0.0 };
        let shares = [(Stage::Coarse, 0.02), (Stage::Fine, 0.78), (Stage::Instance, 0.2)]
            .map(|(stage, weight)| StageShare { stage, weight });
        let mut done = Vec::new();
        for (k, share) in shares.iter().enumerate() {
            let start = now;
            if share.stage == Stage::Instance {
                now += identity;
            }
            let identity_frames = if share.stage == Stage::Instance { 0 } else { 100 };
            pacer.enter(&shares[k..], 0, OtherWork { identity_frames, has_fits: false }, at(now));
            let (mut iteration, mut steps) = (0, 1_000);
            while iteration < steps {
                iteration += 1;
                now += cost(share.stage, now / seconds);
                if let Some(paced) = pacer.after_step(iteration, at(now)) {
                    steps = paced;
                }
            }
            done.push((share.stage, iteration, now - start));
        }
        (done, now)
    }

    #[test]
    fn runs_land_on_their_budget_whatever_steps_cost() {
        let growing = |stage: Stage, progress: f64| match stage {
            Stage::Coarse => 0.004,
            Stage::Fine => 0.01 + 0.03 * progress,
            _ => 0.05,
        };
        // The machine slows down threefold half way.
        let slower = |_: Stage, progress: f64| if progress < 0.5 { 0.02 } else { 0.06 };
        let steady = |_: Stage, _: f64| 0.5;
        for seconds in [30.0, 90.0, 300.0] {
            for (name, cost) in [
                ("growing", &growing as &dyn Fn(Stage, f64) -> f64),
                ("slower", &slower),
                ("steady", &steady),
            ] {
                let (stages, end) = simulate(seconds, 0.03 * seconds, 0.02 * seconds, cost);
                assert!((0.95..=1.02).contains(&(end / seconds)), "{name}, {seconds} s: {end}");
                for (stage, steps, time) in stages {
                    let share = time / seconds;
                    let range = match stage {
                        Stage::Coarse => 0.0..0.05,
                        Stage::Fine => 0.55..0.85,
                        _ => 0.1..0.35,
                    };
                    assert!(steps > 0 && range.contains(&share), "{name}, {seconds} s, {stage}: {share}");
                }
            }
        }
    }

    #[test]
    fn a_budget_that_is_used_up_still_gives_every_stage_a_step() {
        let (stages, _) = simulate(10.0, 11.0, 0.0, |_, _| 0.1);
        assert!(stages.iter().all(|(_, steps, _)| *steps == 1), "{stages:?}");
    }

    #[test]
    fn processor_time_is_shared_by_threads() {
        let start = Seconds { wall_s: 1.0, cpu_s: 2.0 };
        let budget = Budget { seconds: 10.0, clock: BudgetClock::Cpu, threads: 2, start };
        assert_eq!(budget.used(Seconds { wall_s: 100.0, cpu_s: 8.0 }), 3.0);
        let wall = Budget { clock: BudgetClock::Wall, ..budget };
        assert_eq!(wall.used(Seconds { wall_s: 4.5, cpu_s: 8.0 }), 3.5);
    }
}
