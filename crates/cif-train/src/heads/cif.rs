//! The head of the paper: a calibrated distribution over instances per Gaussian, blended by occupancy.

use cif_render::{InstanceSettings, OccupancySource};

use super::head::{Head, Pass};
use crate::config::{Ablation, TrainConfig};

/// Occupancies and calibrations of identity rows: parameters of the field.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cif;

impl Head for Cif {
    fn name(&self) -> &'static str {
        "cif"
    }

    fn pass(&self, config: &TrainConfig) -> Pass<'_> {
        Pass::Identities(InstanceSettings {
            occupancy: if config.ablates(Ablation::OpacityOccupancy) {
                OccupancySource::Opacity
            } else {
                OccupancySource::Own
            },
            geometry: config.instance.geometry.into(),
            normalisation: config.instance.normalisation.into(),
        })
    }
}
