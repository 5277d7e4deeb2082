//! A step as it is recorded, with the rates and step counts of the parameters.

use crate::guard::MAX_RATE;
use crate::state::State;
use crate::step::StepPlan;
use crate::wgpu::kernels::fault;
use crate::wgpu::optimiser::{GroupStep, GroupSteps};

/// A step as it is recorded, and recorded again where it has to be.
pub(super) struct Recording {
    pub(super) plan: StepPlan,
    /// Gaussians N.
    pub(super) gaussians: usize,
    /// Rates and step counts of the parameters.
    pub(super) groups: GroupSteps,
    /// Rate and step count of the exposures.
    pub(super) exposures: GroupStep,
    /// Parameters that move, as bits of the fault word.
    pub(super) moving: u32,
    /// Parameters that cannot move, likewise, as known before the step is recorded.
    pub(super) known: u32,
}

impl Recording {
    /// One step less of some parameters before this one.
    pub(super) fn uncount(&mut self, parameters: u32) {
        self.groups.uncount(parameters);
        self.exposures.steps -= u32::from(parameters & fault::EXPOSURES != 0);
    }
}

/// Counts a step of every parameter that moves.
pub(super) fn count(state: &mut State, plan: StepPlan) -> Recording {
    let (mut moving, mut known) = (0, 0);
    let mut groups = GroupSteps::default();
    let has_values: Vec<bool> = state.field.tensors().iter().map(|(_, values)| !values.is_empty()).collect();
    let groups_of_field = state.optimiser.groups_mut().iter_mut().zip(has_values);
    for ((parameter, moments), _) in groups_of_field.filter(|(_, has_values)| *has_values) {
        let rates = plan.rates.of(parameter);
        let fastest = rates.fastest();
        if fastest.is_nan() || fastest.abs() > MAX_RATE {
            known |= fault::bit(parameter);
        }
        if fastest != 0.0 {
            moments.steps += 1;
            moving |= fault::bit(parameter);
        }
        groups.0.push((*parameter, GroupStep { rates, steps: moments.steps }));
    }
    let mut exposures = GroupStep::default();
    if let (Some(all), Some(rate)) = (&mut state.progress.exposures, plan.exposure_rate) {
        all.steps += 1;
        moving |= fault::EXPOSURES;
        exposures = GroupStep::uniform(rate, all.steps);
    }
    Recording { plan, gaussians: state.field.gaussians.len(), groups, exposures, moving, known }
}

/// Takes back a step of some parameters.
pub(super) fn uncount(state: &mut State, parameters: u32) {
    for (parameter, moments) in state.optimiser.groups_mut() {
        moments.steps -= u32::from(parameters & fault::bit(parameter) != 0);
    }
    if let Some(exposures) = &mut state.progress.exposures {
        exposures.steps -= u32::from(parameters & fault::EXPOSURES != 0);
    }
}
