//! Options of motion models and colliders that `cif export` and `cif bench export` share.

use cif_field::Field;
use cif_scene::{MotionModel, SceneOptions};
use cif_train::metrics::training_config;
use clap::{Args, ValueEnum};

/// Simplification of motion, and physics for simulators.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Motion and colliders")]
pub(in crate::commands) struct ModelOptions {
    /// Most expensive motion model that may be chosen; the loss against richer models is reported
    #[arg(long, default_value = "dense", value_name = "MODEL")]
    motion: Motion,
    /// Most rigid parts of an object, 2 to 64
    #[arg(long, default_value_t = 8, value_name = "N", value_parser = clap::value_parser!(u8).range(2..=64))]
    max_parts: u8,
    /// Write a sample at every frame, also where interpolation would do
    #[arg(long)]
    no_reduce_keys: bool,
    /// Most convex hulls of an object, 0 for no colliders; more than one for concave objects [default: 1, or 0
    /// where the plan that the scene was trained with leaves physics out, see `cif plan`]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=1024))]
    hulls: Option<u16>,
    /// Most convex hulls of the background, for simulators in which objects fall on it; 16 to 64 are enough
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=1024))]
    background_hulls: u16,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Motion {
    Static,
    Rigid,
    Parts,
    Dense,
}

impl ModelOptions {
    /// Options of the scene graph of a field with these.
    /// `hulls` is what is preferred where nobody says how many.
    pub(in crate::commands) fn apply(
        &self,
        field: &Field,
        hulls: Option<u16>,
        options: SceneOptions,
    ) -> SceneOptions {
        let has_physics = training_config(field).is_none_or(|config| config.effects.physics);
        SceneOptions {
            most_expensive_motion: match self.motion {
                Motion::Static => MotionModel::Static,
                Motion::Rigid => MotionModel::Rigid,
                Motion::Parts => MotionModel::Parts,
                Motion::Dense => MotionModel::Dense,
            },
            max_parts: usize::from(self.max_parts),
            reduce_keys: !self.no_reduce_keys,
            hulls_per_instance: self.hulls.or(hulls).map_or(usize::from(has_physics), usize::from),
            background_hulls: usize::from(self.background_hulls),
            ..options
        }
    }
}
