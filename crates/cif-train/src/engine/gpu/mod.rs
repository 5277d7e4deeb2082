//! Steps on a GPU: parameters, moments and gradients stay there from step to step.
//!
//! The host's field and optimiser are what every other part of the trainer works on: rare events (densification,
//! resampling, identities, evaluation, saving) fetch them from the device, and what they change is sent again before
//! the next step. Losses and counts of a step are read when they arrive, some steps later; no step waits for them.
//!
//! | file | holds |
//! |---|---|
//! | `resident` | what lies on the device, fetching and sending |
//! | `gpu_engine` | a GPU and everything of a run that lies on it |
//! | `recording` | a step as it is recorded, with the rates and step counts of the parameters |
//! | `step`, `view` | one step, and one view of it |
//! | `head` | the pass of a head that blends values of its own |
//! | `flight` | steps on their way, and what is read of them later |
//! | `receive` | steps as they arrive: room for pairs, bad steps |
//! | `diagnose` | where a bad step went wrong |
//! | `rearrange` | changes of the set of Gaussians, with their rows staying there |
//! | `contributions` | what Gaussians contribute to a view, for densification |
//! | `draw` | views between steps |
//! | `identities` | label mass for the identity stage |

mod contributions;
mod diagnose;
mod draw;
mod flight;
mod gpu_engine;
mod head;
mod identities;
mod rearrange;
mod receive;
mod recording;
mod resident;
mod step;
#[cfg(test)]
mod testing;
mod view;

use std::time::Duration;

use cif_field::Field;
use cif_render::RenderedImage;
use cif_render::cpu::{IdentityCounts, SimdLevel};
use cif_render::wgpu::{GpuError, Timestamps};

pub(crate) use self::gpu_engine::GpuEngine;
use self::gpu_engine::{FETCH_EVERY, Fetched};
use self::resident::Stale;
use super::processor::Processor;
use super::{Changed, Engine, Views};
use crate::density::Rearrangement;
use crate::density::relocate::{Pair, Relocated};
use crate::error::TrainError;
use crate::state::State;
use crate::step::{StepPlan, StepReport};
use crate::wgpu::kernels::{FRESH, RESTARTED};
use crate::wgpu::rearrange::compose;

impl Engine for GpuEngine {
    fn gpu_name(&self) -> Option<&str> {
        Some(&self.gpu.facts().name)
    }

    fn step(&mut self, state: &mut State, plan: StepPlan) -> Result<(), TrainError> {
        self.record_again(state)?;
        if !self.ahead {
            self.fetched = Some(Fetched::of(state));
        }
        self.send(state)?;
        if plan.trains_head {
            self.of_head = Some(self.head_step(state, plan)?);
            return Ok(());
        }
        let recording = recording::count(state, plan);
        self.record(state, recording)?;
        self.ahead = true;
        self.since_fetch += 1;
        Ok(())
    }

    fn receive(&mut self, state: &mut State, all: bool) -> Result<Option<StepReport>, TrainError> {
        if let Some(of_head) = self.of_head.take() {
            return Ok(Some(of_head));
        }
        self.receive_step(state, all || self.waits)
    }

    fn give_up(&mut self, state: &mut State) -> u32 {
        let later = std::mem::take(&mut self.again);
        for recording in &later {
            recording::uncount(state, recording.moving);
        }
        later.len() as u32
    }

    fn fetch(&mut self, state: &mut State) -> Result<(), TrainError> {
        if let Some(resident) = &self.resident
            && self.ahead
        {
            resident.fetch(&self.gpu, state)?;
            // From here on the host goes on from what it has.
            self.fetched = Some(Fetched::of(state));
        }
        self.ahead = false;
        self.since_fetch = 0;
        Ok(())
    }

    fn is_far_ahead(&self) -> bool {
        self.since_fetch >= FETCH_EVERY
    }

    fn changed(&mut self, what: Changed) {
        self.stale = match what {
            Changed::Gaussians => Stale { gaussians: true, ..self.stale },
            Changed::Identities => Stale { gaussians: true, identities: true, ..self.stale },
            Changed::Everything => Stale::EVERYTHING,
        };
    }

    fn begin_changes(&mut self, state: &mut State, relocates: bool) -> Result<(), TrainError> {
        self.take_basis(state, relocates)
    }

    fn sums_of_view(&mut self, state: &State, view: usize) -> Result<Vec<f32>, TrainError> {
        self.contributions_to(state, view)
    }

    fn rearrange(&mut self, state: &mut State, change: &Rearrangement) {
        match &mut self.origins {
            Some(origins) => {
                *origins = compose(origins, &change.origins, &change.parents);
                resident::resize_moments(&mut state.optimiser, change.origins.len());
            }
            None => state.optimiser.gather(&change.origins),
        }
    }

    fn relocate(&mut self, state: &mut State, pairs: &[Pair], relocated: &Relocated) {
        if let Some(origins) = &mut self.origins {
            for pair in pairs {
                origins[pair.weak as usize] = pair.source | FRESH;
                origins[pair.source as usize] = pair.source | RESTARTED;
            }
        }
        state.optimiser.relocate(&relocated.weak, &relocated.sources, &relocated.entry_origins);
    }

    fn end_changes(&mut self, state: &mut State, resets_opacities: Option<bool>) -> Result<(), TrainError> {
        match (self.origins.take(), resets_opacities) {
            (Some(origins), Some(resets)) => self.rearrange_rows(state, &origins, resets),
            (Some(_), None) => Ok(()),
            (None, _) => {
                self.changed(Changed::Identities);
                Ok(())
            }
        }
    }

    fn draw(
        &mut self,
        state: &State,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        if views.channels.instances && state.started_head().is_some() {
            // A head decodes what is blended on the host.
            return Processor::new(SimdLevel::Auto).draw(state, trial, views, each);
        }
        self.draw_views(state, trial, views, each)
    }

    fn count_labels(&mut self, state: &mut State) -> Result<(IdentityCounts, usize), TrainError> {
        match self.count_on_device(state)? {
            Some(counted) => Ok(counted),
            None => Processor::new(SimdLevel::Auto).count_labels(state),
        }
    }

    fn inspect(&mut self, _on: bool) {
        // A step that the device refuses is repeated on the processor, which looks.
    }

    fn withdraw(&mut self, state: &mut State) {
        let Some(fetched) = self.fetched.take() else { return };
        if let Some(kept) = fetched.kept {
            state.put_back(kept);
        }
        state.progress = fetched.progress;
        state.field.sh_degree = fetched.sh_degree;
        state.statistics = fetched.statistics;
        for ((_, moments), steps) in state.optimiser.groups_mut().iter_mut().zip(fetched.adam_steps) {
            moments.steps = steps;
        }
    }

    fn time_stages(&mut self) {
        self.waits = true;
        self.timestamps = Timestamps::new(&self.gpu);
    }

    fn take_stage_times(&mut self) -> Vec<(&'static str, Duration)> {
        std::mem::take(&mut self.stage_times)
    }
}

impl From<GpuError> for TrainError {
    fn from(error: GpuError) -> Self {
        Self::Device(Box::new(error))
    }
}
