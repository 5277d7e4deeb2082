//! A step of any engine under debug validation: parameters are looked at before it, every array inside it where the
//! engine can, parameters and moments after it.

use super::{Changed, Engine};
use crate::error::TrainError;
use crate::guard::{moment_fault, parameter_fault};
use crate::state::State;
use crate::step::{StepPlan, StepReport};

/// Does a step, and leaves the state as it was before it where a value is not finite. The state is up to date, and is
/// so afterwards.
///
/// # Errors
/// Those of the engine.
pub(crate) fn step(
    engine: &mut dyn Engine,
    state: &mut State,
    plan: StepPlan,
) -> Result<StepReport, TrainError> {
    if let Some(fault) = parameter_fault("parameters", &state.field) {
        return Ok(StepReport { plan, views: Vec::new(), fault: Some(fault) });
    }
    let before = (state.field.clone(), state.optimiser.clone(), state.statistics.clone());
    let own = (state.pose_moments.clone(), state.head_tensors.clone(), state.progress.exposures.clone());
    engine.inspect(true);
    let report = inspected(engine, state, plan);
    engine.inspect(false);
    let mut report = report?;
    if report.fault.is_none() {
        report.fault = parameter_fault("optimiser", &state.field).or_else(|| moment_fault(&state.optimiser));
    }
    if report.fault.is_some() {
        (state.field, state.optimiser, state.statistics) = before;
        (state.pose_moments, state.head_tensors, state.progress.exposures) = own;
        engine.changed(Changed::Everything);
    }
    Ok(report)
}

fn inspected(engine: &mut dyn Engine, state: &mut State, plan: StepPlan) -> Result<StepReport, TrainError> {
    engine.step(state, plan)?;
    loop {
        if let Some(report) = engine.receive(state, true)? {
            engine.fetch(state)?;
            return Ok(report);
        }
    }
}
