//! Cost of a step on this machine and this capture, measured on a few of them.

use std::sync::Arc;

use cif_dataset::{Dataset, Split};

use crate::budget::{Budget, BudgetClock, MOVING};
use crate::clock::{Clock, Seconds};
use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::stage::Stage;
use crate::trainer::{InstancePass, Trainer};

/// Training frames that steps are measured on; decoding more would cost more than it tells.
const FRAMES: usize = 8;

/// Steps before measuring, and the most that are measured.
const STEPS: (usize, usize) = (4, 64);

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
    /// Share of the step that grows with pixels: rasterising and losses.
    pub pixel_share: f64,
    /// Share that grows with neither pixels nor Gaussians: planes and network of the deformation.
    pub fixed_share: f64,
    /// Share that grows with the Gaussians that move.
    pub moving_share: f64,
    /// Share of the Gaussians of these steps that moved.
    pub moving: f64,
    /// Width and height of the images.
    pub image_size: [u32; 2],
    /// Steps measured.
    pub steps: usize,
}

impl Calibration {
    /// Expected seconds per step with so many Gaussians, images reduced by `reduction` more. Where there are more they
    /// are smaller, so that rasterising grows with pixels alone.
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
        let rows = (1.0 - self.pixel_share - self.fixed_share - self.moving_share).max(0.0);
        let pixels = self.pixel_share / f64::from(reduction * reduction);
        let rows = rows + self.moving_share * moving / self.moving.max(1e-6);
        self.step_s * (pixels + self.fixed_share + rows * gaussians / self.gaussians.max(1) as f64)
    }
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
    let mut config = config.clone();
    config.report.withhold = 0;
    config.motion.guidance = 0.0;
    let camera = few.frames.iter().find(|frame| frame.split == Split::Train).map(|frame| frame.camera);
    let image_size = camera.map_or([0; 2], |camera| [camera.width, camera.height]);
    let mut trainer = Trainer::for_measuring(few, config, None, Stage::Fine, 0)?;
    let initial = trainer.field().gaussians.len();
    let moving = if trainer.config().effects.still_every > 0 { MOVING } else { 1.0 };
    trainer.fill(moving);
    let budget = Budget { seconds: limit_s, clock: on, threads, start: clock.now() };
    let (mut steps, mut pixel_s, mut fixed_s, mut moving_s, mut total_s) = (0, 0.0, 0.0, 0.0, 0.0);
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
        let render = &times.render;
        pixel_s += (render.rasterize + render.rasterize_backward + times.losses).as_secs_f64();
        fixed_s += (times.optimiser_planes + times.optimiser_mlp).as_secs_f64();
        moving_s += (render.deform + render.deform_backward).as_secs_f64();
        total_s += times.total.as_secs_f64();
        if steps >= 3 && budget.used(clock.now()) > limit_s {
            break;
        }
    }
    let spent = Budget { start, ..budget }.used(clock.now());
    let share = |part: f64| if total_s > 0.0 { part / total_s } else { 0.0 };
    Ok(Calibration {
        initial,
        most: trainer.config().densify.max_gaussians,
        gaussians: trainer.field().gaussians.len(),
        step_s: (spent / f64::from(steps)).max(1e-6),
        pixel_share: share(pixel_s),
        fixed_share: share(fixed_s),
        moving_share: share(moving_s),
        moving,
        image_size,
        steps: steps as usize,
    })
}
