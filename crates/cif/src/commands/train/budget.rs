//! Budgets and targets of `cif train`.

use std::sync::Arc;
use std::time::Duration;

use cif_dataset::Dataset;
use cif_train::budget::{Budget, BudgetClock};
use cif_train::curve::Targets;
use cif_train::fit::{Choice, Workload, calibrate, choose, share_of_fits};
use cif_train::{Clock, Phase, Phases, Seconds, Stop, SystemClock, TrainConfig, Trainer};
use clap::{Args, ValueEnum};

use crate::commands::shared::CaptureOptions;
use crate::error::Error;
use crate::progress::duration;

/// Training frames that are withheld to measure targets on.
const WITHHELD: u32 = 4;

/// Part of the budget that measuring steps may take, and its limits in seconds.
const CALIBRATION: (f64, f64, f64) = (0.03, 0.2, 3.0);

/// Part of the budget below which the time is not worth using up.
const WORTH_USING: f64 = 0.9;

/// When training ends other than by its steps.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Budget and targets")]
pub(super) struct Goals {
    /// Train for about this long, from the start of the command to the saved scene: 90s, 5m, "1h 30m".
    /// Steps, Gaussians and, where nothing else helps, image size are chosen from the cost of a few
    /// measured steps, and stages end by the clock; so the result depends on the machine
    #[arg(long, value_name = "DURATION", value_parser = humantime::parse_duration,
        conflicts_with_all = ["iterations_coarse", "iterations_fine", "iterations_instance"])]
    budget: Option<Duration>,
    /// Time that --budget counts
    #[arg(long, value_name = "CLOCK", requires = "budget", default_value = "wall")]
    budget_clock: ClockName,
    /// Stop when this PSNR is reached, dB, on training frames that are withheld from training
    /// (report.withhold, 4 of them unless set)
    #[arg(long, value_name = "DB", value_parser = positive)]
    target_psnr: Option<f64>,
    /// Stop when this mIoU is reached, percent, on the same frames
    #[arg(long, value_name = "PERCENT", value_parser = percent)]
    target_miou: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ClockName {
    /// Time that passes
    Wall,
    /// Processor time divided by threads: independent of other load on the machine
    Cpu,
}

fn positive(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "expected a number".to_owned())?;
    if value.is_finite() && value > 0.0 { Ok(value) } else { Err("expected a positive number".to_owned()) }
}

fn percent(text: &str) -> Result<f64, String> {
    positive(text).and_then(|value| {
        if value <= 100.0 { Ok(value) } else { Err("expected at most 100 percent".to_owned()) }
    })
}

/// The time of one command.
pub(super) struct Timing {
    pub(super) clock: Arc<dyn Clock>,
    start: Seconds,
    budget: Option<Budget>,
}

impl Timing {
    /// Time from now on.
    pub(super) fn start() -> Self {
        let clock: Arc<dyn Clock> = Arc::new(SystemClock::start());
        let start = clock.now();
        Self { clock, start, budget: None }
    }

    /// Phases of the command, of which it is in the first.
    pub(super) fn phases(&self, stop: Stop) -> Phases {
        Phases::new(Arc::clone(&self.clock), stop)
    }
}

impl Goals {
    fn targets(&self) -> Targets {
        Targets { psnr: self.target_psnr, miou: self.target_miou }
    }

    /// Settings that measuring targets needs.
    pub(super) fn prepare(&self, config: &mut TrainConfig) {
        if !self.targets().is_empty() && config.report.withhold == 0 {
            config.report.withhold = WITHHELD;
        }
    }

    /// The budget, begun with the command.
    fn budget(&self, timing: &Timing) -> Option<Budget> {
        Some(Budget {
            seconds: self.budget?.as_secs_f64(),
            clock: match self.budget_clock {
                ClockName::Wall => BudgetClock::Wall,
                ClockName::Cpu => BudgetClock::Cpu,
            },
            threads: rayon::current_num_threads(),
            start: timing.start,
        })
    }

    /// Chooses settings that fit the budget, when there is one; images are opened anew where they have to be
    /// smaller. `preset` is what was not typed.
    pub(super) fn fit(
        &self,
        timing: &mut Timing,
        config: &mut TrainConfig,
        preset: &TrainConfig,
        dataset: Dataset,
        capture: &CaptureOptions,
        phases: &Phases,
        quiet: bool,
    ) -> Result<Dataset, Error> {
        let Some(mut budget) = self.budget(timing) else { return Ok(dataset) };
        let phase = phases.enter(Phase::Calibrate, 0);
        let (part, least, most) = CALIBRATION;
        let limit = (part * budget.seconds).clamp(least, most);
        let calibration = calibrate(&dataset, config, &timing.clock, budget.clock, budget.threads, limit)
            .map_err(Error::plain)?;
        let work = Workload {
            may_reduce: capture.downscale.is_none() && config.downscale == preset.downscale,
            may_change_gaussians: config.densify.max_gaussians == preset.densify.max_gaussians,
            ..Workload::of(&dataset, 0)
        };
        drop(phase);
        let left = (budget.seconds - budget.used(timing.clock.now())).max(0.0);
        // Fits of objects have their part; where they need less of it, steps get the rest.
        let left = left * (1.0 - share_of_fits(config, work));
        let choice = choose(config, &calibration, work, left);
        if !quiet {
            announce(&budget, &choice, config, calibration.steps);
        }
        if choice.expected_s < WORTH_USING * left {
            budget.seconds += choice.expected_s - left;
            eprintln!(
                "note: training will end after about {}: more steps bring next to nothing",
                duration(choice.expected_s)
            );
        }
        timing.budget = Some(budget);
        let reopened = choice.config.downscale != config.downscale;
        *config = choice.config;
        if reopened {
            let options = CaptureOptions { downscale: config.downscale, ..capture.clone() };
            let _phase = phases.enter(Phase::Open, 0);
            // Points that were triangulated are no files of the capture.
            return Ok(Dataset { points: dataset.points, ..options.open(&dataset.root)? });
        }
        Ok(dataset)
    }

    /// Holds a run to budget and targets.
    pub(super) fn apply(&self, timing: &Timing, trainer: &mut Trainer) -> Result<(), Error> {
        if let Some(budget) = timing.budget.or_else(|| self.budget(timing)) {
            trainer.set_budget(budget);
        }
        let targets = self.targets();
        if targets.is_empty() {
            return Ok(());
        }
        if trainer.config().report.withhold == 0 {
            eprintln!(
                "note: this run withheld no training frames from its start, so the targets are measured on \
                 held-out frames of the capture"
            );
        }
        trainer.set_targets(targets).map_err(|error| {
            Error::failed(format!("--target-miou: {error}"), "leave it away, or give masks with --masks")
        })
    }

    /// True when steps may differ from those of the settings.
    pub(super) fn changes_steps(&self) -> bool {
        self.budget.is_some() || !self.targets().is_empty()
    }

    /// Prints the time used of the budget, and the targets that were reached.
    pub(super) fn report(&self, timing: &Timing, trainer: &Trainer) {
        let curve = trainer.curve();
        if let Some(budget) = self.budget(timing) {
            eprintln!(
                "used {:.1} s of the budget of {:.0} s",
                budget.used(timing.clock.now()),
                budget.seconds
            );
        }
        if trainer.reached_targets() {
            let last = curve.points.last();
            let value = |value: Option<f64>| value.map_or("n/a".to_owned(), |value| format!("{value:.2}"));
            eprintln!(
                "targets reached on {} {}: PSNR {} dB, mIoU {} %, after {} steps",
                curve.frame_names.len(),
                curve.frames.describe(),
                value(last.and_then(|point| point.psnr)),
                value(last.and_then(|point| point.miou)),
                trainer.steps_done()
            );
        }
    }
}

/// Says what the budget buys.
fn announce(budget: &Budget, choice: &Choice, base: &TrainConfig, measured: usize) {
    let name = serde_json::to_value(base.preset).unwrap_or_default();
    let name = name.as_str().unwrap_or("standard");
    eprintln!(
        "budget {:.0} s: the settings of {name} would take about {} here ({measured} steps measured)",
        budget.seconds,
        duration(choice.base_s)
    );
    if choice.changes.is_empty() {
        return;
    }
    let heading = if choice.expected_s < choice.base_s { "given up" } else { "added" };
    let mut table = crate::commands::shared::table([heading, name, "now, about"]);
    for change in &choice.changes {
        table.add_row([change.setting.to_owned(), change.from.clone(), change.to.clone()]);
    }
    eprintln!("{table}");
}
