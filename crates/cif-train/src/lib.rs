//! Trains a field: from a capture to deformable Gaussians with occupancy and identity.
//!
//! | module | answers |
//! |---|---|
//! | [`config`] | every setting, and the presets |
//! | [`plan`] | which effects a capture calls for |
//! | [`trainer`] | how a run goes through its stages, stops and resumes |
//! | [`events`] | what a run reports |
//! | [`phase`], [`phases`] | where the time of a run goes, how far it is, and whether it may go on |
//! | [`start`] | what a run starts from |
//! | [`stop`] | how a run is asked to stop |
//! | [`schedule`] | the stages, what falls on which step (one table), rates over the steps |
//! | [`losses`] | colour losses and their gradients |
//! | [`fit`] | settings that fit a time budget |
//! | `floors` | the least that the stages of a step move and compute |
//! | [`budget`] | how a run fits into the time there is |
//! | [`curve`] | what a run had reached when |
//! | [`clock`] | where it reads time |
//! | [`adam`] | the optimiser, and the regularisers of the planes |
//! | [`density`] | which Gaussians come and go: densification strategies, relocation to instances with volume conservation |
//! | [`effects`] | what has to show while it trains that it is worth its cost, one file each |
//! | `background` | which colour shows where no Gaussian is |
//! | [`estimate`] | whose each Gaussian is, from masks |
//! | `engine` | what computes the steps of a run: the processor, or a GPU |
//! | `objects` | how rigid objects get poses, before the scene is trained |
//! | [`heads`] | what the instance stage learns, and how pixels decode to labels |
//! | `switches` | which masks show another object than theirs |
//! | `mask_table` | where masks are, how large, and what they touch, read in one pass |
//! | `mask_edges` | where the outlines of rough masks belong |
//! | `sightings` | where masks show objects, and which appear or vanish |
//! | [`tracks`] | where objects travel, from masks alone |
//! | [`metrics`] | how good a field is |
//! | `wgpu` | losses and optimiser on the GPU, behind the feature of that name |
//!
//! ```no_run
//! use cif_train::{Control, Preset, TrainConfig, Trainer};
//!
//! let dataset = cif_dataset::Dataset::open("captures/kitchen", &cif_dataset::OpenOptions::default())?;
//! let config = TrainConfig::preset(Preset::Standard, dataset.layout);
//! let mut trainer = Trainer::new(dataset, config)?;
//! trainer.run(&mut |event, _view| {
//!     println!("{event:?}");
//!     Control::Continue
//! })?;
//! trainer.checkpoint(false).save("kitchen.cif")?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

// So that unit tests can use the capture of the integration tests.
#[cfg(test)]
extern crate self as cif_train;

pub mod adam;
mod background;
pub mod budget;
pub mod clock;
pub mod config;
pub mod curve;
pub mod density;
mod detail;
pub mod effects;
mod engine;
pub mod error;
pub mod estimate;
pub mod events;
pub mod exposure;
pub mod fit;
#[cfg(feature = "wgpu")]
pub mod floors;
mod frames;
mod guard;
mod guidance;
mod half_size;
pub mod heads;
pub mod losses;
mod mask_edges;
mod mask_table;
#[cfg(test)]
mod measured;
pub mod metrics;
mod objects;
mod optimiser;
pub mod phase;
pub mod phases;
pub mod plan;
mod poses;
mod progress;
mod random;
pub mod schedule;
mod sightings;
pub mod stage;
pub mod start;
mod state;
mod step;
pub mod stop;
mod switches;
mod times;
pub mod tracks;
pub mod trainer;
#[cfg(feature = "wgpu")]
pub mod wgpu;
mod working_size;

pub use clock::{Clock, Seconds, SystemClock};
pub use config::{Ablation, HeadName, ObjectMotion, Preset, TrainConfig};
pub use curve::{Curve, CurveFrames, CurvePoint};
pub use error::TrainError;
pub use events::{Control, Outcome, TrainEvent};
pub use guard::{Fault, Hint};
pub use heads::{Head, HeadLoss, HeadTensors, HeadValues, HeadView, Pass, ValueHead};
pub use phase::Phase;
pub use phases::Phases;
pub use plan::{EffectChoice, EffectPlan};
pub use stage::Stage;
pub use start::Start;
pub use step::InstancePass;
pub use stop::Stop;
pub use times::{StepTimes, Work};
#[cfg(feature = "wgpu")]
pub use trainer::Probe;
pub use trainer::{Trainer, TrainerView, accept_changes};
