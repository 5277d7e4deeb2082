//! Cost of a step on this machine and this capture, measured on a few of them.

use std::sync::Arc;

use cif_dataset::{Dataset, Split};

use crate::budget::{Budget, BudgetClock, MOVING};
use crate::clock::{Clock, Seconds};
use crate::config::{DensifyRule, TrainConfig};
use crate::error::TrainError;
use crate::stage::Stage;
use crate::step::InstancePass;
use crate::times::StepShares;
use crate::trainer::Trainer;

/// Training frames that steps are measured on; decoding more would cost more than it gains.
const FRAMES: usize = 8;

/// Steps before measuring, and the most that are measured.
const STEPS: (usize, usize) = (4, 64);

/// Time of a step of trained Gaussians, of one of as many that are split from points: of these fewer overlap. 1.19 to 1.35 on
/// four captures.
const TRAINED: f64 = 1.3;

/// Cost of a step of the fine stage with a full set of Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// Gaussians that the run begins with.
    pub initial: usize,
    /// Most Gaussians that densification adds up to with the settings and the detail of the images.
    pub most: u32,
    /// Gaussians of the steps measured.
    pub gaussians: usize,
    /// Seconds per step, on the clock of the budget.
    pub step_s: f64,
    /// Its shares.
    pub shares: StepShares,
    /// Share of the Gaussians of these steps that moved.
    pub moving: f64,
    /// Width and height of the images.
    pub image_size: [u32; 2],
    /// Steps measured.
    pub steps: usize,
}

impl Calibration {
    /// Expected seconds per step with so many Gaussians, images reduced by `reduction` more.
    #[must_use]
    pub fn step_s(&self, gaussians: f64, reduction: u32) -> f64 {
        self.step_with(gaussians, self.moving, reduction)
    }

    /// The same of a step before it is known what stands still: all Gaussians move.
    #[must_use]
    pub fn step_before_s(&self, gaussians: f64, reduction: u32) -> f64 {
        self.step_with(gaussians, 1.0, reduction)
    }

    fn step_with(&self, gaussians: f64, moving: f64, reduction: u32) -> f64 {
        let pixels = 1.0 / f64::from(reduction * reduction);
        let gaussians = gaussians / self.gaussians.max(1) as f64;
        self.step_s * self.shares.cost(pixels, gaussians, moving / self.moving.max(1e-6))
    }
}

/// A capture that trains on a few of its frames.
pub(super) fn few_training_frames(dataset: &Dataset) -> Dataset {
    let mut few = dataset.clone();
    let training: Vec<usize> = few
        .frames
        .iter()
        .enumerate()
        .filter(|(_, frame)| frame.split == Split::Train)
        .map(|(index, _)| index)
        .collect();
    let count = training.len().min(FRAMES);
    let chosen: Vec<usize> = (0..count).map(|k| training[k * training.len() / count]).collect();
    for index in training.into_iter().filter(|index| !chosen.contains(index)) {
        few.frames[index].split = Split::Val;
    }
    few
}

/// Measures steps of the fine stage for about `limit_s`, with the points of the capture split into as many Gaussians as
/// there will be; nothing is kept.
///
/// # Errors
/// As [`Trainer::new`].
pub fn calibrate(
    dataset: &Dataset,
    config: &TrainConfig,
    clock: &Arc<dyn Clock>,
    on: BudgetClock,
    threads: usize,
    limit_s: f64,
) -> Result<Calibration, TrainError> {
    let few = few_training_frames(dataset);
    let mut config = config.clone();
    config.report.withhold = 0;
    config.motion.guidance = 0.0;
    // Colours have the most coefficients that they may get, as in most steps.
    (config.model.sh_interval, config.effects.sh_gain) = (0, 0.0);
    let camera = few.frames.iter().find(|frame| frame.split == Split::Train).map(|frame| frame.camera);
    let image_size = camera.map_or([0; 2], |camera| [camera.width, camera.height]);
    let mut trainer = Trainer::for_measuring(few, config, None, Stage::Fine, 0)?;
    let initial = trainer.field().gaussians.len();
    let moving = if trainer.config().effects.still_every > 0 { MOVING } else { 1.0 };
    // By gradients, nobody knows how many there will be.
    let full = match trainer.config().densify.rule {
        DensifyRule::Error => trainer.config().densify.max_gaussians as usize,
        DensifyRule::Gradient => initial,
    };
    trainer.fill(full, moving);
    let budget = Budget { seconds: limit_s, clock: on, threads, start: clock.now() };
    let (mut steps, mut seconds) = (0, [0.0; 4]);
    let mut start = Seconds::default();
    for step in 0..STEPS.0 + STEPS.1 {
        if step == STEPS.0 {
            start = clock.now();
        }
        let times = trainer.measure_step(InstancePass::Off)?;
        if step < STEPS.0 {
            continue;
        }
        steps += 1;
        for (sum, seconds) in seconds.iter_mut().zip(times.seconds_by_growth()) {
            *sum += seconds;
        }
        if steps >= 3 && budget.used(clock.now()) > limit_s {
            break;
        }
    }
    let spent = Budget { start, ..budget }.used(clock.now());
    Ok(Calibration {
        initial,
        most: trainer.config().densify.max_gaussians,
        gaussians: trainer.field().gaussians.len(),
        step_s: (TRAINED * spent / f64::from(steps)).max(1e-6),
        shares: StepShares::of(seconds).unwrap_or(StepShares { pixels: 0.0, moving: 0.0, fixed: 0.0 }),
        moving,
        image_size,
        steps: steps as usize,
    })
}
