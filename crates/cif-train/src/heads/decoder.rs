//! The head of a finished scene, which labels pixels where its identity rows would label them otherwise.

use std::sync::Arc;

use cif_field::Field;
use cif_field::checkpoint::TrainingState;
use cif_geometry::PinholeCamera;
use cif_render::cpu::Renderer;
use cif_render::{BlendedImage, InstanceImage, RenderSettings, RenderedImage};
use serde::{Deserialize, Serialize};

use super::head::{Head, Target, ValueHead, tensors_at_start, value_head};
use super::labels::{blended, instance_image};
use super::registry::configured;
use super::tensors::HeadTensors;
use crate::config::{HeadConfig, TrainConfig};
use crate::error::TrainError;

/// The JSON of a head in a file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Saved {
    head: HeadConfig,
}

/// A trained head with its scene.
#[derive(Clone)]
pub struct Decoder {
    head: Arc<dyn Head>,
    tensors: HeadTensors,
    config: TrainConfig,
}

impl Decoder {
    /// Tensors that a finished scene keeps of a head.
    pub(crate) fn save(config: &HeadConfig, tensors: &HeadTensors) -> TrainingState {
        let json = serde_json::to_value(Saved { head: config.clone() }).expect("names and numbers");
        TrainingState { json, tensors: tensors.learnt() }
    }

    /// The head that was saved with a scene.
    ///
    /// # Errors
    /// When it is not known, or does not fit the scene.
    pub fn of_scene(field: &Field, saved: &TrainingState) -> Result<Self, TrainError> {
        let unusable = |reason: String| TrainError::BadHead { reason };
        let Saved { head: of } =
            serde_json::from_value(saved.json.clone()).map_err(|error| unusable(error.to_string()))?;
        let head = configured(&of);
        let name = head.name();
        let config = TrainConfig { head: of, ..TrainConfig::default() };
        let values = value_head(&head, &config)
            .ok_or_else(|| unusable(format!("{name} tells labels by identity rows")))?;
        let mut tensors = tensors_at_start(values, field, 0);
        if field.instances.is_empty() || tensors.take_learnt(&saved.tensors).is_none() {
            return Err(unusable(format!("what {name} learnt does not fit the Gaussians of the scene")));
        }
        Ok(Self { head, tensors, config })
    }

    /// Name of the head.
    #[must_use]
    pub fn name(&self) -> &'static str {
        self.head.name()
    }

    /// True when it labels pixels; false when it only answers questions.
    #[must_use]
    pub fn tells_labels(&self) -> bool {
        self.values().target() == Target::Labels
    }

    /// What the head blends over a view, `[height, width, C]`.
    #[must_use]
    pub fn blended(
        &self,
        renderer: &mut Renderer,
        field: &Field,
        view: (&PinholeCamera, f64),
        settings: &RenderSettings,
    ) -> BlendedImage {
        blended(renderer, self.values(), &self.tensors, field, view, settings)
    }

    fn values(&self) -> &dyn ValueHead {
        value_head(&self.head, &self.config).expect("a head with values of its own")
    }

    /// Instance outputs of a view that `renderer` has just rendered as `rendered`.
    #[must_use]
    pub fn instances(
        &self,
        renderer: &mut Renderer,
        field: &Field,
        view: (&PinholeCamera, f64),
        settings: &RenderSettings,
        rendered: &RenderedImage,
    ) -> InstanceImage {
        let blended = self.blended(renderer, field, view, settings);
        instance_image(self.values(), &self.tensors, &blended, &rendered.alpha)
    }
}
