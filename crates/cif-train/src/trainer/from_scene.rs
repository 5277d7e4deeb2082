//! Runs that begin with the Gaussians and the deformation of a trained scene: other masks, or another variant
//! of the instance stage, on one and the same reconstruction.

use cif_dataset::{Dataset, MadeFrom, Split, TrainedImages};
use cif_field::{Checkpoint, Field};
use cif_geometry::PinholeCamera;
use cif_geometry::scalar::logit;

use super::measured_frames::MeasuredFrames;
use super::resume::{SavedState, restore};
use super::saved::inputs_of;
use super::{Trainer, initialize};
use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::phase::Phase;
use crate::progress::{Progress, Source};
use crate::stage::Stage;
use crate::start::Start;

/// Times that differ by less are the same.
const SAME_TIME: f64 = 1e-9;

/// Poses whose numbers differ by less, relative to the extent where they are lengths, are the same.
const SAME_POSE: f64 = 1e-5;

impl Trainer {
    /// A run at its identity stage, with Gaussians and deformation of `scene`, which `name` calls; identities,
    /// occupancy, calibration and the table of instances start anew. Coarse and fine steps of `config` only
    /// place the learning rates.
    ///
    /// A scene saved with its state where the reconstruction ended keeps the moments of the optimiser too: the
    /// run then ends bit for bit where one run through all stages ends. Without it, the paths that guided the
    /// reconstruction are not known any more, and nothing is held to them or in place.
    ///
    /// # Errors
    /// When a setting cannot work; when the scene is of other times, frames or cameras than the capture, does
    /// not move, or is not reconstructed yet; when images that it was trained on have changed since, unless
    /// [`accept_changes`](crate::accept_changes) was asked; when no training mask has a labelled pixel; when a frame
    /// cannot be read; [`TrainError::Stopped`] when the stop of `start` was requested meanwhile.
    pub fn from_scene(
        start: impl Into<Start>,
        mut config: TrainConfig,
        scene: Checkpoint,
        name: &str,
    ) -> Result<Self, TrainError> {
        let Start { mut dataset, phases } = start.into();
        let _run = phases.enter(Phase::Other, 0);
        config.validate()?;
        // Settings of a scene without instances say that there shall be none; here they are all there is to train.
        config.effects.instances = true;
        let measured_frames = MeasuredFrames::withhold(&mut dataset, &config);
        let Checkpoint { mut field, training, .. } = scene;
        let inputs = inputs_of(&dataset);
        check_capture(&field, &dataset, &inputs)?;
        let mut progress = Progress::at(Stage::Identity);
        let mut state = None;
        let mut has_same_masks = false;
        if let Some(training) = training {
            let parsed = SavedState::parse(training.json)?;
            match parsed.progress.stage {
                stage if stage < Stage::Identity => {
                    return Err(TrainError::Unfinished { scene: name.to_owned(), stage });
                }
                Stage::Identity => {
                    has_same_masks = parsed.is_known_of(&dataset, &inputs);
                    progress = parsed.progress;
                    state = Some((training.tensors, parsed.adam_steps));
                }
                _ => {}
            }
        }
        if config.effects.motion && dataset.times.len() > 1 && field.deformation.is_none() {
            return Err(TrainError::NoMotion {
                scene: name.to_owned(),
                times: dataset.times.len(),
                root: dataset.root,
            });
        }
        progress.source = Some(Source {
            scene: name.to_owned(),
            gaussians: field.gaussians.len(),
            train: serde_json::to_value(&field.record.run).unwrap_or_default(),
        });
        if !has_same_masks {
            // Groups may be of other objects by these masks.
            field.replace_instances(initialize::instances(&dataset));
        }
        field.gaussians.occupancy_logits.fill(logit(config.instance.occupancy));
        field.sort_metric = config.sort_metric;
        let mut trainer = Self::assemble(
            Start { dataset, phases: phases.clone() },
            measured_frames,
            config,
            field,
            Some(progress),
        )?;
        if !trainer.stages.has_instances {
            return Err(TrainError::NoLabels { root: trainer.state.dataset.root });
        }
        let known = trainer.state.field.record.drawing.clone();
        let effects = &trainer.state.config.effects;
        let is_learnt = effects.exposure || effects.exposure_in_time;
        if !is_learnt || trainer.state.progress.exposures.is_none() {
            trainer.state.progress.exposures = trainer.exposures()?.map(|fresh| fresh.start_with(&known));
        }
        if let Some((mut tensors, steps)) = state {
            restore(&mut trainer.state.optimiser, &mut tensors, &steps)?;
            trainer.restore_guidance(&mut tensors)?;
            trainer.restore_poses(&mut tensors)?;
        }
        trainer.warn_of_capture();
        trainer.begin(Stage::Identity);
        Ok(trainer)
    }
}

/// Refuses a capture that the scene was not trained on: masks, labels and the resolution of images may differ, what was
/// seen, from where and when may not.
fn check_capture(field: &Field, dataset: &Dataset, inputs: &MadeFrom) -> Result<(), TrainError> {
    let other = |what, expected: String, found: String| {
        Err(TrainError::OtherCapture { what, expected, found, root: dataset.root.clone() })
    };
    let (times, found) = (&field.timeline.times, &dataset.times);
    if times.len() != found.len() {
        return other("the number of times", times.len().to_string(), found.len().to_string());
    }
    if let Some((a, b)) = times.iter().zip(found).find(|(a, b)| (*a - *b).abs() > SAME_TIME) {
        return other("a time", a.to_string(), b.to_string());
    }
    let (cameras, frames) = (&field.cameras, &dataset.frames);
    if cameras.len() != frames.len() {
        return other("the number of frames", cameras.len().to_string(), frames.len().to_string());
    }
    for (camera, frame) in cameras.iter().zip(frames) {
        let role = |trained| if trained { "trained on" } else { "held out" };
        let expected = format!("{} at time {}, {}", camera.name, camera.time_index, role(camera.trained));
        let trained = frame.split == Split::Train;
        let found = format!("{} at time {}, {}", frame.camera_name, frame.time_index, role(trained));
        if expected != found {
            return other("a frame", expected, found);
        }
        if !same_pose(&camera.camera, &frame.camera, f64::from(field.extent)) {
            let at = |camera: &PinholeCamera| {
                format!("{expected} from {:.4}", camera.camera_from_world.inverse().translation)
            };
            return other("the pose of a camera", at(&camera.camera), at(&frame.camera));
        }
    }
    let trained = field.record.images.clone().and_then(|images| serde_json::from_value(images).ok());
    let difference =
        trained.and_then(|trained: TrainedImages| trained.difference(&TrainedImages::of(dataset, inputs)));
    match difference {
        Some(difference) => Err(TrainError::ChangedCapture { difference, root: dataset.root.clone() }),
        None => Ok(()),
    }
}

fn same_pose(a: &PinholeCamera, b: &PinholeCamera, extent: f64) -> bool {
    let (a, b) = (&a.camera_from_world, &b.camera_from_world);
    a.rotation.abs_diff_eq(b.rotation, SAME_POSE)
        && a.translation.abs_diff_eq(b.translation, SAME_POSE * extent.max(1.0))
}
