//! The state of a run: its capture, its settings, and everything that steps change.
//!
//! Engines compute steps on it; the run decides what falls on which step, and changes it between them.

use cif_dataset::Dataset;
use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::{Gradients, InstanceSettings, OccupancySource, RenderSettings, RenderedImage, UNLABELLED};

use crate::config::{Ablation, TrainConfig};
use crate::densify::DensifyStatistics;
use crate::frames::FrameStore;
use crate::guidance::{Guidance, Pulls};
use crate::optimiser::Optimiser;
use crate::progress::Progress;
use crate::stop::Stop;
use crate::times::StepTimes;

/// Capture, settings, and what steps change.
pub(crate) struct State {
    pub dataset: Dataset,
    pub config: TrainConfig,
    pub frames: FrameStore,
    /// Asked for between two events, and inside long work.
    pub stop: Stop,
    pub field: Field,
    pub optimiser: Optimiser,
    /// Sums for densification.
    pub statistics: DensifyStatistics,
    pub progress: Progress,
    /// Paths that Gaussians are held to.
    pub guidance: Guidance,
    /// Gaussians whose identity row is not from their own label mass.
    pub unseen: Vec<bool>,
    /// Labelled pixels per instance, of the frames that identities were estimated from.
    pub label_pixels: Vec<f64>,
    /// Gradients of a step on the processor; zero between steps.
    pub gradients: Gradients,
    /// Where the time of steps went.
    pub times: StepTimes,
}

/// A copy of what steps and changes of the set of Gaussians change.
pub(crate) struct Kept {
    field: Field,
    optimiser: Optimiser,
    statistics: DensifyStatistics,
    progress: Progress,
    guidance: Guidance,
    unseen: Vec<bool>,
    label_pixels: Vec<f64>,
    times: StepTimes,
}

impl State {
    /// Settings of the instance pass.
    pub(crate) fn instance_settings(&self) -> InstanceSettings {
        InstanceSettings {
            occupancy: if self.config.ablates(Ablation::OpacityOccupancy) {
                OccupancySource::Opacity
            } else {
                OccupancySource::Own
            },
            geometry: self.config.instance.geometry.into(),
            normalisation: self.config.instance.normalisation.into(),
        }
    }

    /// Settings of a view without instances.
    pub(crate) fn color_settings(&self) -> RenderSettings {
        RenderSettings {
            sh_degree: self.field.sh_degree,
            background: self.config.background,
            near: self.config.near,
            antialiased: self.config.antialiased,
            sort_metric: self.config.sort_metric,
            deform: self.field.deformation.is_some(),
            instances: None,
        }
    }

    /// The picture that the camera of a frame records of a rendered one.
    pub(crate) fn recorded(&self, index: usize, mut rendered: RenderedImage) -> RenderedImage {
        if let Some(exposures) = &self.progress.exposures {
            exposures.at(&self.dataset.frames[index].camera_name).apply(&mut rendered.color);
        }
        rendered
    }

    /// Adds the labelled pixels of a frame that identities are estimated from.
    pub(crate) fn add_label_pixels(&mut self, labels: &PixelGrid<u16>) {
        for label in labels.pixels.iter().filter(|label| **label != UNLABELLED) {
            self.label_pixels[usize::from(*label) - 1] += 1.0;
        }
    }

    /// Training views that identities are estimated from.
    pub(crate) fn views_of_identities(&self) -> impl Iterator<Item = usize> + use<> {
        (0..self.frames.len()).step_by(self.config.identity.stride as usize)
    }

    /// Pulls to paths and places at a time; `None` where nothing pulls.
    pub(crate) fn pulls(&self, time: f64, weights: [f32; 2]) -> Option<Pulls> {
        self.guidance.pulls(&self.field, &self.dataset.times, time, weights)
    }

    /// A copy of everything that steps change.
    pub(crate) fn keep(&self) -> Kept {
        Kept {
            field: self.field.clone(),
            optimiser: self.optimiser.clone(),
            statistics: self.statistics.clone(),
            progress: self.progress.clone(),
            guidance: self.guidance.clone(),
            unseen: self.unseen.clone(),
            label_pixels: self.label_pixels.clone(),
            times: self.times,
        }
    }

    /// Stands where the copy was made, with no gradients.
    pub(crate) fn put_back(&mut self, kept: Kept) {
        (self.field, self.optimiser, self.statistics) = (kept.field, kept.optimiser, kept.statistics);
        (self.progress, self.guidance) = (kept.progress, kept.guidance);
        (self.unseen, self.label_pixels) = (kept.unseen, kept.label_pixels);
        self.times = kept.times;
        self.gradients = Gradients::zeros(&self.field);
    }
}
