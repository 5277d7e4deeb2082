//! Engines: they compute the steps that a run plans, and draw and count views between them.
//!
//! | file | holds |
//! |---|---|
//! | `processor` | steps on the processor: the definition of each call |
//! | `gpu` | steps recorded ahead on a GPU, behind the feature `wgpu` |
//! | `failure` | what becomes of a run whose engine fails |
//! | `validation` | any engine's step with every array looked at |
//!
//! An engine works on the [`State`] of the run. It may run ahead of it: what steps change is in the state after
//! [`Engine::fetch`], and what the run then changes there is announced by [`Engine::changed`].

pub(crate) mod failure;
#[cfg(feature = "wgpu")]
pub(crate) mod gpu;
pub(crate) mod processor;
pub(crate) mod validation;

use std::any::Any;
use std::time::Duration;

use cif_dataset::Dataset;
use cif_field::Field;
use cif_render::cpu::IdentityCounts;
use cif_render::{Channels, RenderSettings, RenderedImage};

use crate::density::Rearrangement;
use crate::density::relocate::{Pair, Relocated};
use crate::error::TrainError;
use crate::state::State;
use crate::step::{StepPlan, StepReport};

/// Parts of the state that the run has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Changed {
    /// Gaussians, with their moments, statistics and which of them stand still.
    Gaussians,
    /// These, and the identity rows.
    Identities,
    /// All of it.
    Everything,
}

/// Views to render between steps.
#[derive(Clone, Copy)]
pub(crate) struct Views<'a> {
    /// Indices in the capture.
    pub frames: &'a [usize],
    /// At the size of the capture, instead of that which is worked on.
    pub whole: bool,
    pub settings: &'a RenderSettings,
    pub channels: Channels,
}

impl Views<'_> {
    /// The capture that the frames are of, at their size.
    pub(crate) fn dataset<'s>(&self, state: &'s State) -> &'s Dataset {
        if self.whole { state.capture() } else { &state.dataset }
    }
}

/// Computes the steps of a run.
pub(crate) trait Engine: Any + Send {
    /// Name of the GPU; `None` for the processor.
    fn gpu_name(&self) -> Option<&str>;

    /// Computes a step, or records it to be computed.
    ///
    /// # Errors
    /// When the engine fails, or the optimiser meets a gradient that is not finite.
    fn step(&mut self, state: &mut State, plan: StepPlan) -> Result<(), TrainError>;

    /// The oldest step that was not received yet, where it is done; with `all`, waits for it.
    ///
    /// # Errors
    /// When the engine fails.
    fn receive(&mut self, state: &mut State, all: bool) -> Result<Option<StepReport>, TrainError>;

    /// Gives up the steps behind one that was received with a fault, which have moved nothing yet; how many.
    fn give_up(&mut self, state: &mut State) -> u32;

    /// Brings the state up to date; every step was received.
    ///
    /// # Errors
    /// When the engine fails; the state is then as it was.
    fn fetch(&mut self, state: &mut State) -> Result<(), TrainError>;

    /// True when so many steps were computed since the last [`Self::fetch`] that losing them would cost too much.
    fn is_far_ahead(&self) -> bool;

    /// Takes the state as changed by the run.
    fn changed(&mut self, what: Changed);

    /// Brings to the state what changes of the set of Gaussians are decided from; with `relocates`, what relocations
    /// are decided from too. Every step was received.
    ///
    /// # Errors
    /// When the engine fails.
    fn begin_changes(&mut self, state: &mut State, relocates: bool) -> Result<(), TrainError>;

    /// Blending weights of every Gaussian over the pixels of a training view, and the errors of these by the same weights,
    /// `[N, 2]`; see [`crate::density::Contributions`]. Nothing was changed since [`Self::begin_changes`].
    ///
    /// # Errors
    /// When the engine fails, or the frame cannot be read.
    fn sums_of_view(&mut self, state: &State, view: usize) -> Result<Vec<f32>, TrainError>;

    /// Moments of the Gaussians follow a change of their set.
    fn rearrange(&mut self, state: &mut State, change: &Rearrangement);

    /// Moments of the Gaussians follow relocations.
    fn relocate(&mut self, state: &mut State, pairs: &[Pair], relocated: &Relocated);

    /// Takes the changes since [`Self::begin_changes`]; `resets_opacities` says whether opacities were reset among
    /// them. `None` when they failed.
    ///
    /// # Errors
    /// When the engine fails.
    fn end_changes(&mut self, state: &mut State, resets_opacities: Option<bool>) -> Result<(), TrainError>;

    /// Renders views of the field, or of a `trial` in its stead, as their cameras record them; `each` gets them in
    /// order. The state is up to date.
    ///
    /// # Errors
    /// When the engine fails or the run is to stop.
    fn draw(
        &mut self,
        state: &State,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError>;

    /// Label mass of the Gaussians over the training views with labels, and how many there were; counts labelled
    /// pixels in the state, which is up to date.
    ///
    /// # Errors
    /// When the engine fails, a frame cannot be read, or the run is to stop.
    fn count_labels(&mut self, state: &mut State) -> Result<(IdentityCounts, usize), TrainError>;

    /// Looks for values that are not finite inside a step too, where the engine can.
    fn inspect(&mut self, on: bool);

    /// After a failure: the state becomes what was fetched last.
    fn withdraw(&mut self, state: &mut State);

    /// Times the stages of every step, where the engine can; steps then are not computed ahead.
    fn time_stages(&mut self) {}

    /// Times of stages since this was last asked, in the order in which they ran.
    fn take_stage_times(&mut self) -> Vec<(&'static str, Duration)> {
        Vec::new()
    }
}
