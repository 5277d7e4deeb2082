//! The cost of a step, by what the last ones took.

use std::collections::VecDeque;

use crate::budget::COARSE;
use crate::times::{StepTimes, raster_cost};
use crate::working_size::PIXEL_SHARE;

/// Share of the time of all steps so far whose steps are looked at, and limits of that time, seconds: single reports hold
/// a change of the set of Gaussians or a test of an effect, or do not, and machines do not stay as fast as they were.
const RECENT: f64 = 1.0 / 3.0;
const SHORTEST_S: f64 = 10.0;
const LONGEST_S: f64 = 60.0;

/// Time of a fine step for each of its Gaussians, for each that moves, and whatever it works on, in that which a coarse step
/// takes for each of its Gaussians, apart from rasterising: 1.3 to 2.1, 4.8 to 9.2 and 4 100 to 7 000 on four captures of two
/// sizes.
const ROWS: f64 = 1.5;
const MOVING_ROWS: f64 = 6.0;
const FIXED_ROWS: f64 = 5_000.0;

/// Load of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Load {
    /// Pixels of its image, relative to those that are worked on.
    pub pixels: f64,
    /// Gaussians.
    pub gaussians: f64,
    /// Of these, those that the deformation network moves.
    pub moving: f64,
}

impl Load {
    fn raster(&self) -> f64 {
        raster_cost(self.pixels, self.gaussians)
    }
}

/// Steps from one report to the next.
#[derive(Clone, Copy, Debug, Default)]
struct Report {
    /// Seconds of all steps of the run at its end.
    at_s: f64,
    /// Seconds of these steps, with what passed between them, and of their parts.
    seconds: f64,
    parts: [f64; 4],
    work: Work,
    /// False for the first steps of a stage, which take memory: they show what no other step costs.
    is_typical: bool,
}

/// Sums over steps.
#[derive(Clone, Copy, Debug, Default)]
struct Work {
    steps: f64,
    /// Costs of rasterising, see [`raster_cost`].
    raster: f64,
    gaussians: f64,
    moving: f64,
}

/// Reports of a run, the last ones of which show what a step costs.
#[derive(Debug, Default)]
pub(super) struct Reports {
    reports: VecDeque<Report>,
    /// Seconds of all steps at the last report, and of their parts.
    last: Option<(f64, [f64; 4])>,
}

impl Reports {
    /// Adds `steps` that were done since the last report, each of which worked on `load`: `at_s` seconds and `times` of all
    /// steps of the run. The first ones of a stage count only where there are no others.
    pub(super) fn add(&mut self, at_s: f64, times: StepTimes, steps: u32, load: &Load, are_first: bool) {
        let now = times.seconds_by_growth();
        let Some((before_s, before)) = self.last.replace((at_s, now)) else { return };
        let count = f64::from(steps);
        let report = Report {
            at_s,
            seconds: at_s - before_s,
            parts: std::array::from_fn(|part| now[part] - before[part]),
            work: Work {
                steps: count,
                raster: count * load.raster(),
                gaussians: count * load.gaussians,
                moving: count * load.moving,
            },
            is_typical: !are_first || !self.reports.iter().any(|report| report.work.steps > 0.0),
        };
        self.reports.push_back(report);
        let window_s = (RECENT * at_s).clamp(SHORTEST_S, LONGEST_S);
        while self.reports.len() > 1 && at_s - self.reports[0].at_s >= window_s {
            self.reports.pop_front();
        }
    }

    /// Steps per second between the last two reports.
    pub(super) fn rate(&self) -> f64 {
        self.reports.back().map_or(0.0, |last| last.work.steps / last.seconds.max(1e-9))
    }

    /// The cost of a step; `None` before two reports.
    pub(super) fn cost(&self) -> Option<StepCost> {
        let mut sums = Report::default();
        // Where no others are recent enough, the first ones of a stage have to do.
        let are_typical = self.reports.iter().any(|report| report.is_typical && report.work.steps > 0.0);
        for report in self.reports.iter().filter(|report| report.is_typical || !are_typical) {
            sums.seconds += report.seconds;
            for (sum, part) in sums.parts.iter_mut().zip(report.parts) {
                *sum += part;
            }
            sums.work.steps += report.work.steps;
            sums.work.raster += report.work.raster;
            sums.work.gaussians += report.work.gaussians;
            sums.work.moving += report.work.moving;
        }
        (sums.work.steps > 0.0).then(|| StepCost::of(&sums.work, sums.seconds, sums.parts))
    }
}

/// Seconds of a fine step by what it works on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct StepCost {
    /// For each unit of rasterising.
    raster_s: f64,
    /// For each Gaussian.
    gaussian_s: f64,
    /// For each Gaussian that moves; `None` where none did.
    moving_s: Option<f64>,
    /// Whatever it works on.
    fixed_s: f64,
    /// True where its parts were timed.
    is_timed: bool,
}

impl StepCost {
    /// By steps that took `seconds`, with what passed between them; their parts by what they grow with
    /// ([`StepTimes::seconds_by_growth`]) are not timed on GPUs.
    fn of(work: &Work, seconds: f64, [pixels, moving, fixed, total]: [f64; 4]) -> Self {
        let each = |seconds: f64, of: f64| if of > 0.0 { seconds / of } else { 0.0 };
        if total <= 0.0 || pixels <= 0.0 {
            return Self {
                raster_s: each(PIXEL_SHARE * seconds, work.raster),
                gaussian_s: each((1.0 - PIXEL_SHARE) * seconds, work.gaussians),
                moving_s: (work.moving > 0.0).then_some(0.0),
                fixed_s: 0.0,
                is_timed: false,
            };
        }
        let with_others = (seconds / total).max(1.0);
        let gaussians = (total - pixels - moving - fixed).max(0.0);
        Self {
            raster_s: with_others * each(pixels, work.raster),
            gaussian_s: with_others * each(gaussians, work.gaussians),
            moving_s: (work.moving > 0.0).then(|| with_others * each(moving, work.moving)),
            fixed_s: with_others * each(fixed, work.steps),
            is_timed: true,
        }
    }

    /// Seconds of a step.
    pub(super) fn step_s(&self, load: &Load) -> f64 {
        let raster = self.raster_s * load.raster();
        let still = raster + self.gaussian_s * load.gaussians + self.fixed_s;
        match self.moving_s {
            Some(moving_s) => still + moving_s * load.moving,
            None if load.moving > 0.0 && self.is_timed => {
                let rows = ROWS * load.gaussians + MOVING_ROWS * load.moving + FIXED_ROWS;
                raster + self.gaussian_s * rows
            }
            None if load.moving > 0.0 => still / COARSE,
            None => still,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn seconds(seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds)
    }

    #[test]
    fn parts_of_steps_grow_with_what_they_work_on() {
        // 100 steps: pixels, what moves, and whatever they work on; a tenth of the time passes between them.
        let step = Load { pixels: 0.25, gaussians: 2e3, moving: 500.0 };
        let work = Work { steps: 100.0, raster: 100.0 * step.raster(), gaussians: 2e5, moving: 5e4 };
        let cost = StepCost::of(&work, 11.0, [5.0, 1.0, 2.0, 10.0]);
        assert!((cost.step_s(&step) - 0.11).abs() < 1e-12, "{cost:?}");
        let larger = Load { pixels: 1.0, gaussians: 8e3, moving: 500.0 };
        let raster = 4.0_f64.powf(0.6) * 2.0;
        let expected = 1.1 * (0.05 * raster + 0.01 + 0.02 + 4.0 * 0.02);
        assert!((cost.step_s(&larger) - expected).abs() < 1e-12, "{cost:?}");
        // Before anything moved.
        let coarse = StepCost::of(&Work { moving: 0.0, ..work }, 5.0, [4.0, 0.0, 0.0, 5.0]);
        let rows = ROWS * 2e3 + MOVING_ROWS * 500.0 + FIXED_ROWS;
        assert!((coarse.step_s(&step) - 0.04 - 0.01 * rows / 2e3).abs() < 1e-12, "{coarse:?}");
        assert!((coarse.step_s(&Load { moving: 0.0, ..step }) - 0.05).abs() < 1e-12);
        // On a GPU.
        let cost = StepCost::of(&work, 1.0, [0.0, 0.0, 0.0, 10.0]);
        assert!((cost.step_s(&step) - 0.01).abs() < 1e-12, "{cost:?}");
        let coarse = StepCost::of(&Work { moving: 0.0, ..work }, 1.0, [0.0, 0.0, 0.0, 10.0]);
        assert!((coarse.step_s(&step) - 0.01 / COARSE).abs() < 1e-12, "{coarse:?}");
        let ratio = cost.step_s(&larger) / cost.step_s(&step);
        assert!((ratio - PIXEL_SHARE * raster - (1.0 - PIXEL_SHARE) * 4.0).abs() < 1e-12, "{ratio}");
    }

    #[test]
    fn single_reports_do_not_decide_but_old_ones_are_forgotten() {
        let mut reports = Reports::default();
        let step = Load { pixels: 1.0, gaussians: 1e3, moving: 0.0 };
        let mut at_s = 0.0;
        let mut run = |reports: &mut Reports, steps: u32, step_s: f64, are_first: bool| {
            at_s += f64::from(steps) * step_s;
            let times = StepTimes { total: seconds(at_s), losses: seconds(at_s), ..StepTimes::default() };
            reports.add(at_s, times, steps, &step, are_first);
        };
        assert_eq!(reports.cost(), None);
        run(&mut reports, 0, 0.0, false);
        for _ in 0..100 {
            run(&mut reports, 10, 0.01, false);
        }
        // A report with a second of other work.
        run(&mut reports, 1, 1.0, false);
        assert!((reports.rate() - 1.0).abs() < 1e-9);
        let cost = reports.cost().unwrap().step_s(&step);
        assert!((0.01..0.012).contains(&cost), "{cost}");
        // A stage begins with steps that take memory.
        run(&mut reports, 10, 0.5, true);
        assert!((reports.rate() - 2.0).abs() < 1e-9);
        let cost = reports.cost().unwrap().step_s(&step);
        assert!((0.01..0.013).contains(&cost), "{cost}");
        // The machine becomes half as fast, for good.
        for _ in 0..400 {
            run(&mut reports, 10, 0.02, false);
        }
        let cost = reports.cost().unwrap().step_s(&step);
        assert!((cost - 0.02).abs() < 1e-9, "{cost}");
    }
}
