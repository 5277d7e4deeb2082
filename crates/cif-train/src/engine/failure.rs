//! Failures of engines.

use cif_field::Field;
use cif_render::RenderedImage;
use cif_render::cpu::SimdLevel;

use super::processor::Processor;
use super::{Engine, Views};
use crate::error::TrainError;
use crate::state::State;

/// After a failure of its engine a run goes on on the processor, from what was fetched last.
pub(crate) fn replace_failed(
    engine: &mut Box<dyn Engine>,
    state: &mut State,
    simd: SimdLevel,
    error: TrainError,
) -> TrainError {
    if matches!(error, TrainError::Device(_)) {
        engine.withdraw(state);
        *engine = Box::new(Processor::new(simd));
    }
    error
}

/// Renders views between steps, see [`Engine::draw`]; an engine that fails is replaced.
///
/// # Errors
/// As [`Engine::draw`].
pub(crate) fn draw(
    engine: &mut Box<dyn Engine>,
    state: &mut State,
    simd: SimdLevel,
    trial: Option<&Field>,
    views: Views<'_>,
    each: &mut dyn FnMut(RenderedImage),
) -> Result<(), TrainError> {
    let drawn = engine.draw(state, trial, views, each);
    drawn.map_err(|error| replace_failed(engine, state, simd, error))
}
