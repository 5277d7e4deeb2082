//! Pacing of stages: deadlines per stage, and step counts that follow the measured cost of steps.

use super::Budget;
use crate::clock::Seconds;
use crate::stage::Stage;

/// Cost of a coarse step relative to a fine one with as many Gaussians, most of which stand still: no deformation. 0.3 to
/// 0.8 on seven captures.
pub const COARSE: f64 = 0.5;

/// The same of an instance step: the instance pass on top, and fewer Gaussians that move. 0.8 to 1.13 on seven captures.
pub const INSTANCE: f64 = 1.05;

/// Share of the Gaussians that go through the network, in the mean of the steps of `standard`: 0.04 to 0.11 on seven captures
/// of one moving camera, 0.26 to 0.28 on four of several places. Of one thing before nothing, all of which moves, it is 0.8.
pub(crate) const MOVING: f64 = 0.16;

/// Time of a fit of an object that travels, of work on pixels in steps, rasterising and losses, in pixels of images: 4e7
/// to 1e8 in the mean of the objects of six captures, with one thread.
pub(crate) const PIXELS_OF_FIT: f64 = 6.5e7;

/// Time of trying an object that does not travel for motion, and of looking for parts of it, in fits of one that travels:
/// geometric means of ten captures, where they are 0.06 to 1.1 and 0.2 to 1.8, and 0.3 to 2.6 in all.
const TRIED: f64 = 0.33;
const JOINTS: f64 = 0.61;

/// Time that an object that does not travel takes, with or without a search for parts, in fits of one that does.
pub(crate) fn fits_of_resting(parts: bool) -> f64 {
    TRIED + if parts { JOINTS } else { 0.0 }
}

/// Some steps of a stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Part {
    /// Share of all steps.
    pub share: f64,
    /// Cost of one, relative to those in the middle of the stage.
    pub cost: f64,
}

/// Costs of the steps of a stage relative to those in its middle, which cost 1: the first ones may cost less, and the last
/// ones more, as they see images of other sizes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepCosts {
    /// The first steps.
    pub first: Part,
    /// The last steps.
    pub last: Part,
}

impl StepCosts {
    /// Mean cost of all steps of the stage.
    #[must_use]
    pub fn mean(&self) -> f64 {
        1.0 - self.first.share * (1.0 - self.first.cost) - self.last.share * (1.0 - self.last.cost)
    }

    /// Cost of the first `done` of so many steps.
    fn cost_up_to(&self, done: u32, steps: u32) -> f64 {
        let (done, steps) = (f64::from(done), f64::from(steps));
        let last = (done - (steps - (self.last.share * steps).floor())).max(0.0);
        let first = (self.first.share * steps).floor().min(done - last);
        done - first * (1.0 - self.first.cost) - last * (1.0 - self.last.cost)
    }

    /// Cost of a step, from 1, of so many.
    fn cost_of(&self, step: u32, steps: u32) -> f64 {
        self.cost_up_to(step, steps) - self.cost_up_to(step.saturating_sub(1), steps)
    }

    /// Steps of the stage where, after the first `done` of so many, there is time for `more` of those in its middle.
    fn steps(&self, done: u32, steps: u32, more: f64) -> f64 {
        let spent = self.cost_up_to(done, steps);
        let done = f64::from(done);
        // Each part of the stage keeps its share of the steps, unless it is over.
        let all = (spent + more) / self.mean();
        if done < self.first.share * all {
            return all;
        }
        let first = (self.first.share * f64::from(steps)).floor().min(done);
        let all = (spent + more + first * (1.0 - self.first.cost))
            / (1.0 - self.last.share * (1.0 - self.last.cost));
        if done < (1.0 - self.last.share) * all { all } else { done + more / self.last.cost }
    }
}

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

/// Time of one view of those that identities are worked out from, before and behind the instance stage, in steps of the fine
/// stage: 0.28 to 0.51 in five runs on four captures.
pub(crate) const STEPS_OF_IDENTITY_VIEW: f64 = 0.4;

/// A stage to come with its weight: expected time relative to the others.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageShare {
    /// Stage.
    pub stage: Stage,
    /// Expected time, any unit.
    pub weight: f64,
    /// What its steps cost.
    pub costs: StepCosts,
}

/// Work to come that is no step of a stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OtherWork {
    /// Views that identities will still be estimated from.
    pub identity_views: usize,
    /// True where objects are fitted behind the present stage.
    pub has_fits: bool,
}

/// Weights of the stages for [`Pacer::enter`]: `steps` of each, in order, and what these cost.
#[must_use]
pub(crate) fn weights(steps: &[(Stage, u32, StepCosts)]) -> Vec<StageShare> {
    let cost = |stage| match stage {
        Stage::Coarse => COARSE,
        Stage::Instance => INSTANCE,
        _ => 1.0,
    };
    let share = |&(stage, steps, costs): &(Stage, u32, StepCosts)| StageShare {
        stage,
        weight: f64::from(steps) * cost(stage) * costs.mean(),
        costs,
    };
    steps.iter().map(share).collect()
}

/// Follows a budget. Knows nothing of training: it is given the time and answers with steps.
#[derive(Clone, Debug)]
pub struct Pacer {
    budget: Budget,
    /// Time by which the present stage has to end, seconds of the budget.
    deadline: f64,
    /// Time of the last look.
    look: f64,
    /// Cost of the steps since then, relative to the last ones of the stage.
    since: f64,
    /// What steps of the present stage cost.
    costs: StepCosts,
    /// Seconds per step of the present stage, of those in its middle.
    cost: Option<f64>,
}

impl Pacer {
    /// Paces a run that has used nothing, or a part of its budget.
    #[must_use]
    pub fn new(budget: Budget) -> Self {
        let costs = StepCosts::default();
        Self { budget, deadline: budget.seconds, look: 0.0, since: 0.0, costs, cost: None }
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

    /// Begins the first of `stages`, which are all that are left and have steps, or goes on with it.
    pub fn enter(&mut self, stages: &[StageShare], other: OtherWork, now: Seconds) {
        let used = self.budget.used(now);
        let whole: f64 = stages.iter().map(|share| share.weight).sum();
        let mine = stages.first().map_or(0.0, |share| share.weight);
        let left = self.left(now) * if other.has_fits { 1.0 - FITS } else { 1.0 };
        // A coarse step costs less than a fine one, so that this is too little rather than too much.
        let identity =
            self.cost.map_or(0.0, |cost| cost * STEPS_OF_IDENTITY_VIEW) * other.identity_views as f64;
        let left = (left - identity.min(0.2 * left)).max(0.0);
        self.deadline = used + if whole > 0.0 { left * mine / whole } else { left };
        (self.look, self.since) = (used, 0.0);
        self.costs = stages.first().map_or(StepCosts::default(), |share| share.costs);
    }

    /// Steps that the present stage shall have in all, after `iteration` of the `steps` planned so far; none keeps these.
    /// The stage is over when that is no more than `iteration`.
    #[must_use]
    pub fn after_step(&mut self, iteration: u32, steps: u32, now: Seconds) -> Option<u32> {
        self.since += self.costs.cost_of(iteration, steps);
        let used = self.budget.used(now);
        let left = self.deadline - used;
        let gap = LOOK_EVERY * self.budget.seconds;
        if left > 2.0 * gap && used - self.look < gap {
            return None;
        }
        let newest = (used - self.look) / self.since.max(1e-9);
        if used - self.look >= gap {
            self.cost = Some(self.cost.map_or(newest, |old| old + NEWEST * (newest - old)));
            (self.look, self.since) = (used, 0.0);
        }
        if left <= 0.0 {
            return Some(iteration);
        }
        let cost = self.cost.unwrap_or(newest);
        // At least one more: the deadline itself ends the stage.
        let steps = self.costs.steps(iteration, steps, left / cost.max(1e-9));
        let more = (steps - f64::from(iteration)).ceil().clamp(1.0, f64::from(u32::MAX / 2));
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
            .map(|(stage, weight)| StageShare { stage, weight, costs: StepCosts::default() });
        let mut done = Vec::new();
        for (k, share) in shares.iter().enumerate() {
            let start = now;
            if share.stage == Stage::Instance {
                now += identity;
            }
            let identity_views = if share.stage == Stage::Instance { 0 } else { 100 };
            pacer.enter(&shares[k..], OtherWork { identity_views, has_fits: false }, at(now));
            let (mut iteration, mut steps) = (0, 1_000);
            while iteration < steps {
                iteration += 1;
                now += cost(share.stage, now / seconds);
                if let Some(paced) = pacer.after_step(iteration, steps, at(now)) {
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
    fn first_and_last_steps_of_other_costs_are_as_many_as_their_shares_say() {
        let budget =
            Budget { seconds: 100.0, clock: BudgetClock::Wall, threads: 1, start: Seconds::default() };
        let none = (0.0, 0.0);
        let cases = [((0.0, 0.4), none), ((0.4, 0.4), none), ((0.7, 0.1), none), ((1.0, 0.3), none)];
        let with_last =
            [((0.4, 0.4), (0.2, 3.0)), (none, (0.3, 2.0)), ((0.4, 0.5), (0.5, 4.0)), (none, (1.0, 2.0))];
        for (first, last) in cases.into_iter().chain(with_last) {
            let [first, last] = [first, last].map(|(share, cost)| Part { share, cost });
            let costs = StepCosts { first, last };
            let mut pacer = Pacer::new(budget);
            let stage = StageShare { stage: Stage::Fine, weight: 1.0, costs };
            let mut now = Seconds::default();
            pacer.enter(&[stage], OtherWork::default(), now);
            let (mut iteration, mut steps, mut of_kinds, mut least) = (0, 700, [0, 0], u32::MAX);
            while iteration < steps {
                iteration += 1;
                let is_first = f64::from(iteration) <= first.share * f64::from(steps);
                let is_last = iteration > steps - (last.share * f64::from(steps)) as u32;
                of_kinds[0] += u32::from(is_first);
                of_kinds[1] += u32::from(is_last);
                now.wall_s += 0.1
                    * match (is_first, is_last) {
                        (true, _) => first.cost,
                        (_, true) => last.cost,
                        _ => 1.0,
                    };
                steps = pacer.after_step(iteration, steps, now).unwrap_or(steps);
                if now.wall_s > 3.0 {
                    least = least.min(steps);
                }
            }
            let expected = 99.5 / (0.1 * costs.mean());
            assert!((f64::from(steps) / expected - 1.0).abs() < 0.01, "{steps} of {expected}: {costs:?}");
            for (count, share) in of_kinds.into_iter().zip([first.share, last.share]) {
                let found = f64::from(count) / f64::from(steps);
                assert!((found - share).abs() < 0.02, "{count} of {steps}: {costs:?}");
            }
            // Known from the start, not when steps become dear.
            assert!(f64::from(least) > 0.97 * expected, "{least} of {expected}: {costs:?}");
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
