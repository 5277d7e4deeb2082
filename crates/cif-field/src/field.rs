//! A trained scene.

use serde::{Deserialize, Serialize};

use crate::{Deformation, Gaussians, Identities, Instance, RecordedCamera, Timeline};

/// Order in which a view sorts its Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SortMetric {
    /// Camera-space depth z, as every trainer sorts.
    #[default]
    Z,
    /// Distance to the camera centre, as the interchange formats default to.
    Distance,
}

/// A dynamic Gaussian field with instances.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Canonical Gaussians.
    pub gaussians: Gaussians,
    /// Motion; `None` for a static scene.
    pub deformation: Option<Deformation>,
    /// Identity rows, one per Gaussian; `None` before identity estimation or without masks.
    pub identities: Option<Identities>,
    /// Instance table; identity labels index it.
    pub instances: Vec<Instance>,
    /// Captured times.
    pub timeline: Timeline,
    /// Captured cameras, all splits.
    pub cameras: Vec<RecordedCamera>,
    /// Active spherical-harmonics degree, 0 to 3.
    pub sh_degree: u8,
    /// Colour behind everything, display-referred RGB in [0, 1].
    pub background: [f32; 3],
    /// Order the field was trained with.
    pub sort_metric: SortMetric,
    /// Scene extent: 1.1 x the largest distance of a training camera centre from their mean, metres.
    pub extent: f32,
    /// How the field came about (settings, dataset, seed, times, versions); free-form JSON object.
    pub provenance: serde_json::Value,
}
