//! Tensors of a head, with their gradients and moments.

use std::collections::BTreeMap;

use cif_field::checkpoint::StateTensor;
use cif_field::parameters::{Activation, OnCopy, Parameter, Rows};

use crate::adam::{Moments, RowRates};
use crate::guard::{Fault, MAX_GRADIENT, fault};

/// Numbers of a head for every Gaussian, of any value, which clones inherit.
pub(super) const fn per_gaussian(
    part: &'static str,
    name: &'static str,
    shape: &'static [usize],
) -> Parameter {
    Parameter {
        name,
        part,
        rate: name,
        rows: Rows::Gaussians,
        shape,
        activation: Activation::Identity,
        on_copy: OnCopy::Same,
    }
}

/// Numbers of a head that belong to no Gaussian, in rows of `shape`.
pub(super) const fn shared(part: &'static str, name: &'static str, shape: &'static [usize]) -> Parameter {
    Parameter { rows: Rows::Fixed, ..per_gaussian(part, name, shape) }
}

/// A tensor of a head.
#[derive(Clone, Debug, PartialEq)]
struct HeadTensor {
    parameter: Parameter,
    values: Vec<f32>,
    gradients: Vec<f32>,
    moments: Moments,
}

/// The tensors of a head, in the order in which it declares them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HeadTensors(Vec<HeadTensor>);

impl HeadTensors {
    /// Tensors with these values, whole rows, and no moments yet.
    pub(super) fn new(declared: impl IntoIterator<Item = (Parameter, Vec<f32>)>) -> Self {
        let tensor = |(parameter, values): (Parameter, Vec<f32>)| HeadTensor {
            gradients: vec![0.0; values.len()],
            moments: Moments::zeros(values.len() / parameter.width(), parameter.width()),
            values,
            parameter,
        };
        Self(declared.into_iter().map(tensor).collect())
    }

    /// True before the instance stage.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn at(&self, parameter: &Parameter) -> &HeadTensor {
        self.0.iter().find(|tensor| tensor.parameter == *parameter).expect("a parameter of the head")
    }

    /// Values of a parameter of the head.
    ///
    /// # Panics
    /// When it is none of the head's.
    #[must_use]
    pub fn values(&self, parameter: &Parameter) -> &[f32] {
        &self.at(parameter).values
    }

    /// Its values, and its gradients to add to.
    ///
    /// # Panics
    /// When it is none of the head's.
    pub fn values_and_gradients(&mut self, parameter: &Parameter) -> (&[f32], &mut [f32]) {
        let mut tensors = self.0.iter_mut();
        let tensor = tensors.find(|tensor| tensor.parameter == *parameter).expect("a parameter of the head");
        (&tensor.values, &mut tensor.gradients)
    }

    /// Adds to its gradients.
    ///
    /// # Panics
    /// When it is none of the head's.
    pub fn add_gradients(&mut self, parameter: &Parameter, v_values: &[f32]) {
        let (_, gradients) = self.values_and_gradients(parameter);
        gradients.iter_mut().zip(v_values).for_each(|(sum, v)| *sum += v);
    }

    /// Its values, to be set where they are not learnt by steps.
    ///
    /// # Panics
    /// When it is none of the head's.
    pub fn values_mut(&mut self, parameter: &Parameter) -> &mut [f32] {
        let mut tensors = self.0.iter_mut();
        &mut tensors.find(|tensor| tensor.parameter == *parameter).expect("a parameter of the head").values
    }

    fn rows_of_gaussians(&mut self) -> impl Iterator<Item = &mut HeadTensor> {
        self.0.iter_mut().filter(|tensor| tensor.parameter.rows == Rows::Gaussians)
    }

    /// Follows a change of the set of Gaussians: values are those of the parents, moments those of the origins.
    pub(crate) fn gather(&mut self, parents: &[u32], origins: &[Option<u32>]) {
        for tensor in self.rows_of_gaussians() {
            let width = tensor.parameter.width();
            let row = |row: &u32| &tensor.values[*row as usize * width..(*row as usize + 1) * width];
            tensor.values = parents.iter().flat_map(row).copied().collect();
            tensor.gradients = vec![0.0; tensor.values.len()];
            tensor.moments.gather(origins);
        }
    }

    /// Follows the relocation of one Gaussian to another.
    pub(crate) fn relocate(&mut self, weak: u32, source: u32) {
        for tensor in self.rows_of_gaussians() {
            let width = tensor.parameter.width();
            let from = source as usize * width;
            tensor.values.copy_within(from..from + width, weak as usize * width);
            tensor.moments.reset_row(weak as usize);
            if tensor.parameter.on_copy == OnCopy::Divided {
                tensor.moments.reset_row(source as usize);
            }
        }
    }

    /// The first gradient that no optimiser may take.
    pub(crate) fn fault(&self) -> Option<Fault> {
        self.0.iter().find_map(|tensor| {
            let name = format!("gradient of {}", tensor.parameter.name);
            fault("head", &name, &tensor.gradients, MAX_GRADIENT)
        })
    }

    /// Forgets gradients.
    pub(crate) fn reset(&mut self) {
        self.0.iter_mut().for_each(|tensor| tensor.gradients.fill(0.0));
    }

    /// Moves every tensor by the learning rate that it has, and the number that Adam adds to the root of its second
    /// moment; gradients become zero.
    pub(crate) fn step(&mut self, rate_and_epsilon: impl Fn(&Parameter) -> (f32, f32)) {
        for HeadTensor { parameter, values, gradients, moments } in &mut self.0 {
            let (rate, epsilon) = rate_and_epsilon(parameter);
            if rate == 0.0 {
                gradients.fill(0.0);
                continue;
            }
            let finite = moments.step_with(values, gradients, RowRates::Uniform(rate), epsilon, None);
            debug_assert!(finite.is_ok(), "gradients were looked at");
        }
    }

    /// Values alone, by name: what a finished scene keeps of a head.
    pub(crate) fn learnt(&self) -> BTreeMap<String, StateTensor> {
        let value =
            |tensor: &HeadTensor| (tensor.parameter.file_name(), StateTensor::F32(tensor.values.clone()));
        self.0.iter().map(value).collect()
    }

    /// Takes the values of [`Self::learnt`]; `None` when they do not fit.
    pub(crate) fn take_learnt(&mut self, learnt: &BTreeMap<String, StateTensor>) -> Option<()> {
        for tensor in &mut self.0 {
            match learnt.get(&tensor.parameter.file_name())? {
                StateTensor::F32(values) if values.len() == tensor.values.len() => {
                    tensor.values.clone_from(values);
                }
                _ => return None,
            }
        }
        Some(())
    }

    /// Arrays of a saved run, by name.
    pub(crate) fn saved(&self) -> BTreeMap<String, StateTensor> {
        let arrays = self.0.iter().flat_map(|tensor| {
            let name = tensor.parameter.file_name();
            let of = |what: &str, values: &[f32]| {
                (format!("head.{name}.{what}"), StateTensor::F32(values.to_vec()))
            };
            [
                of("values", &tensor.values),
                of("first", &tensor.moments.first),
                of("second", &tensor.moments.second),
                (format!("head.{name}.steps"), StateTensor::U32(vec![tensor.moments.steps])),
            ]
        });
        arrays.collect()
    }

    /// Takes the arrays of [`Self::saved`] out of a saved run; `None` when they do not fit.
    pub(crate) fn restore(&mut self, saved: &mut BTreeMap<String, StateTensor>) -> Option<()> {
        for tensor in &mut self.0 {
            let (name, len) = (tensor.parameter.file_name(), tensor.values.len());
            let mut floats = |what: &str| match saved.remove(&format!("head.{name}.{what}")) {
                Some(StateTensor::F32(values)) if values.len() == len => Some(values),
                _ => None,
            };
            tensor.values = floats("values")?;
            (tensor.moments.first, tensor.moments.second) = (floats("first")?, floats("second")?);
            let Some(StateTensor::U32(steps)) = saved.remove(&format!("head.{name}.steps")) else {
                return None;
            };
            tensor.moments.steps = *steps.first()?;
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use cif_field::parameters::{OPACITY_LOGITS, SH_COEFFICIENTS};

    use super::*;

    fn tensor(parameter: Parameter, rows: usize) -> HeadTensor {
        let values: Vec<f32> = (0..rows * parameter.width()).map(|k| k as f32).collect();
        let mut moments = Moments::zeros(rows, parameter.width());
        moments.first.clone_from(&values);
        HeadTensor { gradients: vec![0.0; values.len()], moments, values, parameter }
    }

    #[test]
    fn rows_follow_clones_prunes_and_relocations() {
        let fixed = Parameter { rows: Rows::Fixed, ..SH_COEFFICIENTS };
        let mut tensors = HeadTensors(vec![tensor(OPACITY_LOGITS, 4), tensor(fixed, 1)]);
        // Row 0 is pruned, row 2 cloned.
        tensors.gather(&[1, 2, 3, 2], &[Some(1), Some(2), Some(3), None]);
        assert_eq!(tensors.values(&OPACITY_LOGITS), [1.0, 2.0, 3.0, 2.0]);
        assert_eq!(tensors.0[0].moments.first, [1.0, 2.0, 3.0, 0.0]);
        assert_eq!(tensors.0[0].gradients.len(), 4);
        tensors.relocate(0, 2);
        assert_eq!(tensors.values(&OPACITY_LOGITS), [3.0, 2.0, 3.0, 2.0]);
        // Opacities are shared with the copy, so both start anew.
        assert_eq!(tensors.0[0].moments.first, [0.0, 2.0, 0.0, 0.0]);
        assert_eq!(tensors.values(&fixed).len(), 48);
    }

    #[test]
    fn saved_arrays_come_back_and_others_are_refused() {
        let tensors = HeadTensors(vec![tensor(OPACITY_LOGITS, 4)]);
        let mut other = HeadTensors(vec![tensor(OPACITY_LOGITS, 4)]);
        other.0[0].values.fill(9.0);
        other.restore(&mut tensors.saved()).unwrap();
        assert_eq!(other, tensors);
        let mut short = HeadTensors(vec![tensor(OPACITY_LOGITS, 3)]);
        assert!(short.restore(&mut tensors.saved()).is_none());
        assert!(other.restore(&mut BTreeMap::new()).is_none());
    }
}
