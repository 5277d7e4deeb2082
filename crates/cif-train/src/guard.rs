//! Steps that leave the finite numbers: found before anything has moved, reported, counted.
//!
//! The gradients of a step are looked at before the optimiser touches anything, so that a bad step leaves
//! parameters and moments exactly as they were. The run then goes on with the next views, since a single view
//! may be at fault; after [`MAX_ROLLBACKS_IN_A_ROW`] bad steps it stops.
//!
//! [`Trainer::set_debug_validation`](crate::Trainer::set_debug_validation) also looks at every array on the way from
//! the field to the gradients and back, which shows where the value first appeared.

use cif_field::Field;
use cif_render::Gradients;
use cif_render::cpu::NotFinite;
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::exposure::Exposures;
use crate::optimiser::{Optimiser, StepRates};

/// Bad steps in a row after which a run stops.
pub(crate) const MAX_ROLLBACKS_IN_A_ROW: u32 = 10;

/// Largest gradient whose square is finite in single precision, with a margin; what is larger counts as not
/// finite, because it would make a moment infinite for ever.
pub(crate) const MAX_GRADIENT: f32 = 1e18;

/// Largest learning rate: a step moves by a few times the rate, so that parameters below stay finite.
pub(crate) const MAX_RATE: f32 = 1e30;

/// Floats that one task looks at.
const CHUNK: usize = 1 << 14;

/// A value that is not finite, where it was first met.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fault {
    /// Part of the step: `deform`, `project`, `rasterize`, `losses`, `rasterize backward`, `project backward`,
    /// `deform backward`, `gradients` (any of the backward parts), `parameters`, `optimiser`.
    pub part: &'static str,
    /// Array, by name.
    pub tensor: String,
    /// Position in the array, all its floats counted in their order.
    pub index: usize,
    /// The value, as text because JSON has no word for it.
    pub value: String,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}[{}] is {}", self.part, self.tensor, self.index, self.value)
    }
}

impl From<NotFinite> for Fault {
    fn from(found: NotFinite) -> Self {
        let NotFinite { part, tensor, index, value } = found;
        Self { part, tensor, index, value: value.to_string() }
    }
}

/// Steps rolled back; saved with the progress of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Rollbacks {
    /// In the whole run.
    pub total: u64,
    /// Since the last good step.
    pub in_a_row: u32,
    /// Description of the fault that was found last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<String>,
}

impl Rollbacks {
    /// True when there were none.
    pub(crate) fn is_empty(&self) -> bool {
        self.total == 0
    }
}

/// The first value above a limit or not a number.
fn first_beyond(values: &[f32], limit: f32) -> Option<usize> {
    let level = Level::new();
    values.par_chunks(CHUNK).enumerate().find_map_first(|(chunk, values)| {
        if dispatch!(level, _simd => are_within(values, limit)) {
            return None;
        }
        let position = values.iter().position(|value| !are_within(std::slice::from_ref(value), limit))?;
        Some(chunk * CHUNK + position)
    })
}

#[inline(always)]
fn are_within(values: &[f32], limit: f32) -> bool {
    let mut all = true;
    for value in values {
        all &= value.abs() <= limit;
    }
    all
}

pub(crate) fn fault(part: &'static str, tensor: &str, values: &[f32], limit: f32) -> Option<Fault> {
    let index = first_beyond(values, limit)?;
    Some(Fault { part, tensor: tensor.to_owned(), index, value: values[index].to_string() })
}

/// A loss that is not finite.
pub(crate) fn loss_fault(name: &str, loss: f64) -> Option<Fault> {
    let (tensor, value) = (name.to_owned(), loss.to_string());
    (!loss.is_finite()).then_some(Fault { part: "losses", tensor, index: 0, value })
}

/// The first value that is not finite.
pub(crate) fn value_fault(part: &'static str, tensor: &str, values: &[f32]) -> Option<Fault> {
    fault(part, tensor, values, f32::MAX)
}

/// The first gradient that a group which moves cannot take, or rate that would leave the finite numbers.
pub(crate) fn gradient_fault(gradients: &Gradients, rates: &StepRates) -> Option<Fault> {
    gradients.tensors().into_iter().find_map(|(parameter, values)| {
        let rate = rates.of(&parameter).fastest();
        if rate == 0.0 {
            return None;
        }
        if rate.is_nan() || rate.abs() > MAX_RATE {
            let tensor = format!("learning rate of {}", parameter.name);
            return Some(Fault { part: "optimiser", tensor, index: 0, value: rate.to_string() });
        }
        fault("gradients", &format!("gradient of {}", parameter.name), values, MAX_GRADIENT)
    })
}

/// The first gradient of an exposure that no optimiser may take.
pub(crate) fn exposure_fault(exposures: Option<&Exposures>) -> Option<Fault> {
    let (index, value) = exposures?.gradient_beyond(MAX_GRADIENT)?;
    Some(Fault {
        part: "gradients",
        tensor: "gradient of exposures".to_owned(),
        index,
        value: value.to_string(),
    })
}

/// The first parameter that is not finite.
pub(crate) fn parameter_fault(part: &'static str, field: &Field) -> Option<Fault> {
    let mut tensors = field.tensors().into_iter();
    tensors.find_map(|(parameter, values)| fault(part, parameter.name, values, f32::MAX))
}

/// The first moment that is not finite.
pub(crate) fn moment_fault(optimiser: &Optimiser) -> Option<Fault> {
    optimiser.groups().iter().find_map(|(_, moments)| {
        fault("optimiser", "first moments", &moments.first, f32::MAX)
            .or_else(|| fault("optimiser", "second moments", &moments.second, f32::MAX))
    })
}

/// Advice for a run that diverged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hint {
    /// Look more closely.
    Validate,
    /// The place is known.
    Rates,
}

impl std::fmt::Display for Hint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Validate => {
                "--debug-validation tells in which part it first appears; a smaller learning rate or another \
                 seed may help"
            }
            Self::Rates => "a smaller learning rate or another seed may help",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bad_float_is_found_on_any_number_of_threads() {
        let mut values = vec![0.5_f32; 3 * CHUNK + 7];
        assert_eq!(first_beyond(&values, MAX_GRADIENT), None);
        for (index, value) in [(3 * CHUNK + 6, f32::NAN), (CHUNK + 1, f32::NEG_INFINITY), (5, -2e18)] {
            values[index] = value;
            for threads in [1, 2] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                assert_eq!(pool.install(|| first_beyond(&values, MAX_GRADIENT)), Some(index));
            }
        }
        assert_eq!(first_beyond(&values[..5], MAX_GRADIENT), None);
    }

    #[test]
    fn faults_read_well() {
        let fault =
            Fault { part: "project", tensor: "splats".to_owned(), index: 17, value: f32::NAN.to_string() };
        assert_eq!(fault.to_string(), "project: splats[17] is NaN");
    }
}
