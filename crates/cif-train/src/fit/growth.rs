//! Cost of a step by the number of Gaussians and of pixels.

use std::time::{Duration, Instant};

use cif_dataset::Dataset;
use cif_field::Field;

use super::calibrate::few_training_frames;
use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::stage::Stage;
use crate::step::InstancePass;
use crate::times::StepTimes;
use crate::trainer::Trainer;

/// Steps before measuring, on the processor and on a GPU, where eight of them are recorded ahead before any is waited for.
const WARM_UP: (usize, usize) = (2, 20);

/// Fewest steps that are measured, and the most.
const STEPS: (usize, usize) = (3, 50);

/// Steps of the fine stage with some number of Gaussians.
pub struct Grown {
    /// Gaussians.
    pub gaussians: usize,
    /// Width and height of the images.
    pub image_size: [u32; 2],
    /// Steps measured.
    pub steps: Vec<StepTimes>,
}

/// A run that stands at the fine stage, with the points of the capture, or the Gaussians of a scene, thinned out evenly
/// or split until there are `gaussians`; a share of them moves. Those that are split are smaller, as in training.
///
/// # Errors
/// As [`Trainer::new`]; when the scene has other instances than the capture.
pub fn filled(
    dataset: &Dataset,
    config: &TrainConfig,
    scene: Option<Field>,
    gaussians: usize,
    moving: f64,
) -> Result<Trainer, TrainError> {
    let mut config = config.clone();
    config.report.withhold = 0;
    config.motion.guidance = 0.0;
    config.model.max_initial_points = config.model.max_initial_points.min(gaussians as u32);
    let scene = scene.map(|scene| thinned(scene, gaussians));
    let mut trainer = Trainer::for_measuring(few_training_frames(dataset), config, scene, Stage::Fine, 0)?;
    trainer.fill(gaussians, moving);
    Ok(trainer)
}

/// Measures steps of a run, for about as long as `limit`.
///
/// # Errors
/// As [`Trainer::run`].
pub fn grown(trainer: &mut Trainer, limit: Duration) -> Result<Grown, TrainError> {
    for _ in 0..if trainer.gpu_name().is_some() { WARM_UP.1 } else { WARM_UP.0 } {
        trainer.measure_step(InstancePass::Off)?;
    }
    let begun = Instant::now();
    let mut steps = Vec::new();
    while steps.len() < STEPS.0 || (begun.elapsed() < limit && steps.len() < STEPS.1) {
        steps.push(trainer.measure_step(InstancePass::Off)?);
    }
    let camera = trainer.dataset().frames.first().map(|frame| frame.camera);
    let image_size = camera.map_or([0; 2], |camera| [camera.width, camera.height]);
    Ok(Grown { gaussians: trainer.field().gaussians.len(), image_size, steps })
}

/// A scene with so many of its Gaussians at most, spread evenly over its rows.
fn thinned(scene: Field, most: usize) -> Field {
    let count = scene.gaussians.len();
    if count <= most {
        return scene;
    }
    let rows: Vec<u32> = (0..most).map(|k| (k * count / most) as u32).collect();
    scene.gather(&rows)
}
