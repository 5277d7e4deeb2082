//! Names and JSON of the file, shared by reader and writer.

use cif_geometry::Bounds;
use serde::{Deserialize, Serialize};

use crate::{DeformationConfig, Field, Instance, RecordedCamera, SortMetric, Timeline};

/// Version of the layout that this crate writes, and the newest that it reads.
pub const FORMAT: u32 = 1;

/// Longest header, bytes; the limit of the safetensors format.
pub(super) const MAX_HEADER: u64 = 100_000_000;

pub(super) const FORMAT_KEY: &str = "cif.format";
pub(super) const VERSION_KEY: &str = "cif.version";
pub(super) const FIELD_KEY: &str = "cif.field";
pub(super) const TRAINING_KEY: &str = "cif.training";

pub(super) const MEANS: &str = "gaussians.means";
pub(super) const LOG_SCALES: &str = "gaussians.log_scales";
pub(super) const QUATERNIONS: &str = "gaussians.quaternions";
pub(super) const OPACITY_LOGITS: &str = "gaussians.opacity_logits";
pub(super) const OCCUPANCY_LOGITS: &str = "gaussians.occupancy_logits";
pub(super) const SH_COEFFICIENTS: &str = "gaussians.sh_coefficients";
pub(super) const PLANES: &str = "deformation.planes";
pub(super) const MLP: &str = "deformation.mlp";
pub(super) const ROW_OFFSETS: &str = "identities.row_offsets";
pub(super) const LABELS: &str = "identities.labels";
pub(super) const LOG_ESTIMATES: &str = "identities.log_estimates";
pub(super) const LOG_CALIBRATIONS: &str = "identities.log_calibrations";
pub(super) const TRAINING_PREFIX: &str = "training.";

/// The part of a field that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FieldJson {
    pub(super) deformation: Option<DeformationJson>,
    pub(super) has_identities: bool,
    pub(super) instances: Vec<Instance>,
    pub(super) timeline: Timeline,
    pub(super) cameras: Vec<RecordedCamera>,
    pub(super) sh_degree: u8,
    pub(super) background: [f32; 3],
    pub(super) sort_metric: SortMetric,
    pub(super) extent: f32,
    pub(super) provenance: serde_json::Value,
}

/// The part of a deformation that is not a tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DeformationJson {
    pub(super) config: DeformationConfig,
    pub(super) bounds: Bounds,
}

impl FieldJson {
    pub(super) fn of(field: &Field) -> Self {
        Self {
            deformation: field.deformation.as_ref().map(|deformation| DeformationJson {
                config: deformation.config.clone(),
                bounds: deformation.bounds,
            }),
            has_identities: field.identities.is_some(),
            instances: field.instances.clone(),
            timeline: field.timeline.clone(),
            cameras: field.cameras.clone(),
            sh_degree: field.sh_degree,
            background: field.background,
            sort_metric: field.sort_metric,
            extent: field.extent,
            provenance: field.provenance.clone(),
        }
    }
}

// Tensors are copied between memory and file as they are.
const _: () = assert!(cfg!(target_endian = "little"), "safetensors files are little-endian");
