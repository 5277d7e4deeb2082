//! The state of a run: its capture, its settings, and everything that steps change.
//!
//! Engines compute steps on it; the run decides what falls on which step, and changes it between them.

use std::sync::Arc;

use cif_dataset::Dataset;
use cif_field::Field;
use cif_field::tracks::NO_GROUP;
use cif_geometry::PixelGrid;
use cif_render::{Blending, Gradients, InstanceSettings, RenderSettings, RenderedImage, UNLABELLED};

use crate::background::Background;
use crate::config::{ObjectMotion, TrainConfig};
use crate::density::DensifyStatistics;
use crate::error::TrainError;
use crate::frames::{FrameStore, TrainFrame};
use crate::guidance::{Guidance, Pulls};
use crate::heads::{self, Head, HeadTensors, Pass, Target, ValueHead};
use crate::objects::KnownObjects;
use crate::optimiser::Optimiser;
use crate::phases::Phases;
use crate::poses::PoseMoments;
use crate::progress::Progress;
use crate::times::StepTimes;
use crate::working_size::Whole;

/// Capture, settings, and what steps change.
pub(crate) struct State {
    /// The capture, with its images at the size that is worked on.
    pub dataset: Dataset,
    /// The capture as it is, where that is another size.
    pub whole: Option<Whole>,
    pub config: TrainConfig,
    /// What shows where no Gaussian is.
    pub background: Background,
    /// Gaussians nearer to the camera than this are not drawn.
    pub near: f32,
    pub frames: FrameStore,
    /// Asked for a stop between two events, and inside long work.
    pub phases: Phases,
    pub field: Field,
    pub optimiser: Optimiser,
    /// Moments of the poses of groups.
    pub pose_moments: PoseMoments,
    /// Head that the instance stage trains, with its own tensors from the start of that stage on.
    pub head: Arc<dyn Head>,
    pub head_tensors: HeadTensors,
    /// Sums for densification.
    pub statistics: DensifyStatistics,
    pub progress: Progress,
    /// Fits of objects, until the field takes them over.
    pub objects: KnownObjects,
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

/// A copy of what steps and changes of the set of Gaussians change; what was found about objects stays known.
pub(crate) struct Kept {
    field: Field,
    optimiser: Optimiser,
    pose_moments: PoseMoments,
    head_tensors: HeadTensors,
    statistics: DensifyStatistics,
    progress: Progress,
    guidance: Guidance,
    unseen: Vec<bool>,
    label_pixels: Vec<f64>,
    times: StepTimes,
}

impl State {
    /// The capture as it is, whatever the size of images that is worked on.
    pub(crate) fn capture(&self) -> &Dataset {
        self.whole.as_ref().map_or(&self.dataset, |whole| &whole.capture)
    }

    /// Settings of the instance pass, or of the weights of a head that blends values of its own by those; `None` where it
    /// blends them like colour.
    pub(crate) fn instance_settings(&self) -> Option<InstanceSettings> {
        match self.head.pass(&self.config) {
            Pass::Identities(settings) => Some(settings),
            Pass::Values(head) => (head.blending() == Blending::Own).then(InstanceSettings::default),
        }
    }

    /// The head, where it blends values of its own.
    pub(crate) fn value_head(&self) -> Option<&dyn ValueHead> {
        heads::value_head(&self.head, &self.config)
    }

    /// The same once it has started, where it decodes labels: views then show them.
    pub(crate) fn started_head(&self) -> Option<&dyn ValueHead> {
        self.value_head().filter(|head| head.target() == Target::Labels && !self.head_tensors.is_empty())
    }

    /// Settings of a view without instances.
    pub(crate) fn color_settings(&self) -> RenderSettings {
        RenderSettings {
            sh_degree: self.field.sh_degree,
            background: self.background.shown,
            near: self.near,
            antialiased: self.config.antialiased,
            sort_metric: self.config.sort_metric,
            deform: self.field.deformation.is_some(),
            ..RenderSettings::default()
        }
    }

    /// Object that every Gaussian was made for, from 1 on; 0 for one that was made for none.
    pub(crate) fn made_for(&self) -> Vec<u32> {
        let guides = self.guidance.guides.len() as u32;
        let group_of =
            |row| self.field.tracks.as_ref()?.group_of.get(row).filter(|group| **group != NO_GROUP);
        let guide_of = |row| self.guidance.guide_of.get(row).map_or(0, |guide| u32::from(*guide));
        let made_for = |row| group_of(row).map_or_else(|| guide_of(row), |group| guides + 1 + group);
        (0..self.field.len()).map(made_for).collect()
    }

    /// Motion that an object (a label: dense index + 1) is declared to have.
    pub(crate) fn told(&self, label: u16) -> Option<ObjectMotion> {
        let name = &self.field.instances[usize::from(label) - 1].label;
        self.config.motion.of.get(name).copied()
    }

    /// The picture that the camera of a frame records of a rendered one.
    pub(crate) fn recorded(&self, index: usize, mut rendered: RenderedImage) -> RenderedImage {
        self.record_color(index, &mut rendered.color);
        rendered
    }

    /// Makes a rendered color that which the camera of a frame records of it.
    pub(crate) fn record_color(&self, index: usize, color: &mut PixelGrid<[f32; 3]>) {
        if let Some(exposures) = &self.progress.exposures {
            let frame = &self.dataset.frames[index];
            exposures.at(&frame.camera_name, frame.time).apply(color);
        }
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

    /// The frame of a view of [`Self::views_of_identities`]; those behind it are read ahead.
    pub(crate) fn frame_of_identities(&self, view: usize) -> Result<Arc<TrainFrame>, TrainError> {
        let frame = self.frames.get(&self.dataset, view)?;
        self.phases.advance();
        self.frames.expect(self.views_of_identities().filter(|later| *later > view));
        Ok(frame)
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
            pose_moments: self.pose_moments.clone(),
            head_tensors: self.head_tensors.clone(),
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
        (self.pose_moments, self.head_tensors) = (kept.pose_moments, kept.head_tensors);
        (self.progress, self.guidance) = (kept.progress, kept.guidance);
        (self.unseen, self.label_pixels) = (kept.unseen, kept.label_pixels);
        self.times = kept.times;
        self.gradients = Gradients::zeros(&self.field);
    }
}
