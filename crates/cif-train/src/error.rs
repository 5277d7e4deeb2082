//! Errors that stop a run.

use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::config::ConfigError;
use crate::guard::{Fault, Hint};
use crate::stage::Stage;

/// Errors of training.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A setting cannot work.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The deformation network cannot be made.
    #[error("settings under `model`: {0}")]
    Deformation(#[from] cif_field::deformation::ConfigError),
    /// The deformation network takes more memory than is free.
    #[error(
        "settings under `model`: {0}; take a smaller spatial_resolution, fewer channels, or fewer or smaller multipliers"
    )]
    Memory(#[from] cif_system::memory::TooLittle),
    /// Gaussians up to the limit of the settings take more memory than is free.
    #[error("densify.max_gaussians: {0}; set a lower one")]
    MemoryOfGaussians(cif_system::memory::TooLittle),
    /// The initial points are not usable.
    #[error("the initial points of the capture: {0}")]
    Points(#[from] cif_field::FieldError),
    /// A frame cannot be read.
    #[error(transparent)]
    Dataset(#[from] cif_dataset::Error),
    /// Nothing to train on.
    #[error("{}: no training frame; check the split lists of the capture", root.display())]
    NoTrainingFrames {
        /// Folder of the capture.
        root: PathBuf,
    },
    /// Nothing to start from.
    #[error("{}: no initial point; give points.npy, a PLY file or a COLMAP model", root.display())]
    NoPoints {
        /// Folder of the capture.
        root: PathBuf,
    },
    /// Motion is given of an object that the capture does not have.
    #[error("{}: the motion of `{label}` is told, but no instance has this label; {known}", root.display())]
    UnknownObject {
        /// Folder of the capture.
        root: PathBuf,
        /// Label that was given.
        label: String,
        /// Labels of the capture, in words.
        known: String,
    },
    /// The optimisation left the finite numbers.
    #[error(
        "{stage} stage, step {iteration}: the gradient of {tensor} is not finite; the field of the last finite step is kept. \
         Try a smaller learning rate for it, or another seed"
    )]
    NotFinite {
        /// Stage.
        stage: Stage,
        /// Step, from 1.
        iteration: u32,
        /// Parameter, by name.
        tensor: &'static str,
    },
    /// Step after step left the finite numbers.
    #[error(
        "{stage} stage, step {iteration}: {in_a_row} steps in a row met values that are not finite, the last in \
         {fault}; the field of the last finite step is kept. {hint}"
    )]
    Diverged {
        /// Stage.
        stage: Stage,
        /// The last such step, from 1.
        iteration: u32,
        /// Number of such steps in a row.
        in_a_row: u32,
        /// Fault of the last one.
        fault: Fault,
        /// Advice on settings to try.
        hint: Hint,
    },
    /// The GPU cannot hold the scene, or failed.
    #[error(transparent)]
    Device(Box<dyn std::error::Error + Send + Sync>),
    /// All Gaussians were pruned.
    #[error(
        "{stage} stage, step {iteration}: every Gaussian was pruned; the cameras may look past the initial \
         points, or `densify.prune_opacity` is too high"
    )]
    NoGaussians {
        /// Stage.
        stage: Stage,
        /// Step, from 1.
        iteration: u32,
    },
    /// A stop was requested inside work that has no result half way.
    #[error("stopped before the first step")]
    Stopped,
    /// The budget has no time left for work that can be left out.
    #[error("the budget leaves no time for it")]
    OutOfTime,
    /// No labels for the instance stage.
    #[error("{}: no training mask has a labelled pixel, so there is no instance stage", root.display())]
    NoLabels {
        /// Folder of the capture.
        root: PathBuf,
    },
    /// The scene moves by record, which training cannot change.
    #[error(
        "the scene holds recorded motion of {groups} groups (from an animated file, or from edits), which has no \
         gradients; train the scene as it was before, and import the edits again"
    )]
    RecordedMotion {
        /// Groups of [`cif_field::Tracks`].
        groups: usize,
    },
    /// The checkpoint was written without training state.
    #[error("the checkpoint holds a finished scene without training state, so the run cannot be resumed")]
    NoState,
    /// The training state does not fit.
    #[error("the training state of the checkpoint is not usable: {reason}")]
    BadState {
        /// The problem.
        reason: String,
    },
    /// The head saved with a scene cannot be used.
    #[error("the head of the scene is not usable: {reason}; train it again")]
    BadHead {
        /// The problem.
        reason: String,
    },
    /// No training frame is of the camera that a head is to be trained on.
    #[error("head.camera = {camera}: no training frame is of that camera; training cameras: {cameras}")]
    NoSuchCamera {
        /// Camera asked for.
        camera: String,
        /// Cameras of the training frames.
        cameras: String,
    },
    /// A scene to begin with has no motion, and the capture has.
    #[error(
        "{scene} has no deformation, but {} has {times} times; begin with a scene that was trained on them",
        root.display()
    )]
    NoMotion {
        /// Name of the scene.
        scene: String,
        /// Times of the capture.
        times: usize,
        /// Folder of the capture.
        root: PathBuf,
    },
    /// A scene to begin with was interrupted before its reconstruction was whole.
    #[error("{scene} was interrupted in its {stage} stage; finish it first, with --resume")]
    Unfinished {
        /// Name of the scene.
        scene: String,
        /// Stage it stands in.
        stage: Stage,
    },
    /// Something is wrong with the scene that the run goes on from.
    #[error("{}: {problem}", path.display())]
    Scene {
        /// File of the scene.
        path: PathBuf,
        /// Problem of the scene.
        problem: Box<TrainError>,
    },
    /// The checkpoint belongs to another capture.
    #[error("the checkpoint was trained on another capture: {what} was {expected}, and is {found} in {}", root.display())]
    OtherCapture {
        /// Property that differs.
        what: &'static str,
        /// In the checkpoint.
        expected: String,
        /// In the capture.
        found: String,
        /// Folder of the capture given.
        root: PathBuf,
    },
    /// The checkpoint belongs to this capture as it was.
    #[error("{} is no longer what the scene was trained on: {difference}", root.display())]
    ChangedCapture {
        /// The change, a sentence.
        difference: String,
        /// Folder of the capture.
        root: PathBuf,
    },
}

impl TrainError {
    /// The error with the file of the scene that a run goes on from, where something is wrong with that scene:
    /// readers of scenes in memory do not know it.
    #[must_use]
    pub fn of_scene(self, path: &Path) -> Self {
        match self {
            Self::Config(_)
            | Self::Deformation(_)
            | Self::RecordedMotion { .. }
            | Self::NoState
            | Self::BadState { .. }
            | Self::BadHead { .. }
            | Self::OtherCapture { .. } => Self::Scene { path: path.to_owned(), problem: Box::new(self) },
            other => other,
        }
    }
}
