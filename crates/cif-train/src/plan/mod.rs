//! Which effects a capture calls for, found before anything is trained.
//!
//! | file | answers |
//! |---|---|
//! | this | the plan, and which settings it means |
//! | `effect` | which effects there are |
//! | `decide` | what is decided of each |
//! | `evidence` | what the capture shows |
//! | `choice` | what the user says instead |
//!
//! A new effect needs a kind, its evidence, its decision and its settings; an effect that changes nothing
//! has no place in the list.

mod choice;
mod decide;
mod effect;
mod evidence;

use cif_dataset::Dataset;

pub use choice::{Basis, EffectChoice};
pub use effect::{Decision, Effect, EffectKind};

use self::decide::{decide, determined_degree};
use self::effect::Extent;
use self::evidence::Evidence;
use crate::config::TrainConfig;
use crate::error::TrainError;
use crate::phases::Phases;

/// Steps between tests for Gaussians that stand still.
const STILL_EVERY: u32 = 500;

/// Gain that a degree of spherical harmonics must bring, dB.
const SH_GAIN: f32 = 0.01;

/// Gain that an optional output of the deformation must bring, dB. Little, as it costs little where most stands
/// still, and what moves covers few pixels.
const HEAD_GAIN: f32 = 0.005;

/// Weights of motion guidance where it is switched on.
const GUIDANCE: f32 = 10.0;
const STILLNESS: f32 = 1.0;

/// All effects of a capture.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct EffectPlan {
    /// In the order of [`EffectKind`].
    pub effects: Vec<Effect>,
    /// Labels of the instances that travel by their masks.
    pub travelling: Vec<String>,
    /// Highest degree of spherical harmonics that the places of the training frames determine.
    pub determined_degree: u8,
}

impl EffectPlan {
    /// Looks at a capture; `config` are the settings that it would be trained with.
    ///
    /// # Errors
    /// When a mask or an image that must be looked at cannot be read.
    pub fn new(dataset: &Dataset, config: &TrainConfig, choice: &EffectChoice) -> Result<Self, TrainError> {
        Self::watched(dataset, config, choice, &Phases::default())
    }

    /// The same in the phase [`Phase::Plan`](crate::Phase::Plan) of a run.
    ///
    /// # Errors
    /// As [`Self::new`], and [`TrainError::Stopped`] when a stop is requested.
    pub fn watched(
        dataset: &Dataset,
        config: &TrainConfig,
        choice: &EffectChoice,
        phases: &Phases,
    ) -> Result<Self, TrainError> {
        let evidence = Evidence::of(dataset, phases)?;
        Ok(Self {
            effects: decide(&evidence, config, choice),
            determined_degree: determined_degree(evidence.places),
            travelling: evidence.travelling,
        })
    }

    /// Decision on an effect.
    #[must_use]
    pub fn decision(&self, kind: EffectKind) -> Option<&Decision> {
        self.effects.iter().find(|effect| effect.effect == kind).map(|effect| &effect.decision)
    }

    /// Lays the decisions over settings.
    pub fn apply(&self, config: &mut TrainConfig) {
        for effect in &self.effects {
            let extent = match &effect.decision {
                Decision::Off => Extent::Off,
                Decision::On => Extent::Full,
                Decision::Value(_) => Extent::Needed,
            };
            set(effect.effect, extent, config);
            if (effect.effect, extent) == (EffectKind::ViewDependence, Extent::Needed) {
                config.model.sh_degree = config.model.sh_degree.min(self.determined_degree);
            }
        }
    }
}

/// The settings that an effect means.
fn set(kind: EffectKind, extent: Extent, config: &mut TrainConfig) {
    let only_if = |condition: bool, value: f32| if condition { value } else { 0.0 };
    let needed = extent == Extent::Needed;
    match kind {
        EffectKind::Motion => {
            config.effects.motion = extent != Extent::Off;
            config.effects.still_every = if needed { STILL_EVERY } else { 0 };
        }
        EffectKind::Shape => {
            config.effects.head_gain = only_if(needed, HEAD_GAIN);
            if extent == Extent::Off {
                let heads = &mut config.model.heads;
                (heads.scale, heads.rotation, heads.opacity, heads.sh) = (false, false, false, false);
            }
        }
        EffectKind::ViewDependence => {
            config.effects.sh_gain = only_if(needed, SH_GAIN);
            if extent == Extent::Off {
                config.model.sh_degree = 0;
            }
        }
        EffectKind::Instances => config.effects.instances = extent != Extent::Off,
        EffectKind::Guidance => {
            if extent == Extent::Off {
                (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
            } else if (config.motion.guidance, config.motion.stillness) == (0.0, 0.0) {
                (config.motion.guidance, config.motion.stillness) = (GUIDANCE, STILLNESS);
            }
        }
        EffectKind::Objects => {
            config.motion.rigid = extent != Extent::Off;
            config.motion.parts &= config.motion.rigid;
        }
        // Off, it leaves a preset that moves opacities as it is; `shape` judges these.
        EffectKind::Appearing => config.model.heads.opacity |= extent != Extent::Off,
        EffectKind::Exposure => config.effects.exposure = extent != Extent::Off,
        EffectKind::ExposureInTime => config.effects.exposure_in_time = extent != Extent::Off,
        EffectKind::Physics => config.effects.physics = extent != Extent::Off,
        EffectKind::Antialiasing => config.antialiased = extent != Extent::Off,
        // Set elsewhere: by the number of times, the size of images, the capture, the background.
        EffectKind::TimePlanes | EffectKind::ImageSize | EffectKind::Lens | EffectKind::Background => {}
    }
}

#[cfg(test)]
mod tests;
