//! The optimiser state of a field and its steps: one group of moments per parameter of the table. Source: methods
//! reference 1.1.

use std::time::Instant;

use cif_field::Field;
use cif_field::parameters::{self, OnCopy, Parameter, Rows};
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_render::Gradients;

use crate::adam::{Moments, PlaneWeights, RowRates, step_planes};
use crate::config::{Ablation, TrainConfig};
use crate::schedule::{log_linear, schedule_steps};
use crate::stage::Stage;
use crate::times::{StepTimes, lap};

/// Learning rates of one step, by parameter; those that are not listed keep still.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct StepRates(Vec<(Parameter, RowRates)>);

impl StepRates {
    /// Rates of step `iteration` (from 1) of a stage.
    pub(crate) fn at(config: &TrainConfig, stage: Stage, iteration: u32, field: &Field) -> Self {
        let rates = &config.rates;
        let in_instance_stage = stage == Stage::Instance;
        let step = if in_instance_stage && !rates.restart_in_instance_stage {
            config.fine_iterations() + iteration
        } else {
            iteration
        };
        let scheduled = |pair| log_linear(pair, step, schedule_steps(config));
        let network = |pair| scheduled(pair) * if rates.network_follows_extent { field.extent } else { 1.0 };
        let only_if = |condition: bool, rate: f32| if condition { rate } else { 0.0 };
        let calibrates = !config.ablates(Ablation::NoCalibration);
        let of = |parameter: &Parameter| match parameter.rate {
            "means" => scheduled(rates.means) * field.extent,
            "log_scales" => rates.log_scales,
            "quaternions" => rates.quaternions,
            "opacity" => rates.opacity,
            "occupancy" => only_if(in_instance_stage && config.trains_occupancy(), rates.occupancy),
            "planes" => network(rates.planes),
            "mlp" => network(rates.mlp),
            "calibration" => only_if(in_instance_stage && calibrates, rates.calibration),
            _ => 0.0,
        };
        let sh = RowRates::Split {
            base: rates.sh_base,
            rest: rates.sh_rest,
            split: 3,
            active: 3 * coefficient_count(field.sh_degree),
        };
        let by_parameter = parameters::TABLE.into_iter().map(|parameter| {
            let is_sh = parameter == parameters::SH_COEFFICIENTS;
            (parameter, if is_sh { sh } else { RowRates::Uniform(of(&parameter)) })
        });
        Self(by_parameter.collect())
    }

    /// One rate for some parameters; the others keep still.
    pub(crate) fn uniform(rates: impl IntoIterator<Item = (Parameter, f32)>) -> Self {
        Self(rates.into_iter().map(|(parameter, rate)| (parameter, RowRates::Uniform(rate))).collect())
    }

    /// The same for some parameters; the others keep still.
    pub(crate) fn only(mut self, chosen: &[Parameter]) -> Self {
        self.0.retain(|(parameter, _)| chosen.contains(parameter));
        self
    }

    /// Rate of a parameter.
    pub(crate) fn of(&self, parameter: &Parameter) -> RowRates {
        let listed = self.0.iter().find(|(other, _)| other == parameter);
        listed.map_or(RowRates::Uniform(0.0), |(_, rates)| *rates)
    }
}

/// Moments of all parameters, in the order of [`Field::tensors`].
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Optimiser {
    groups: Vec<(Parameter, Moments)>,
    /// Scratch of the planes' sweep.
    halo: Vec<f32>,
}

impl Optimiser {
    /// Zero moments in the shape of a field.
    pub(crate) fn new(field: &Field) -> Self {
        let group = |(parameter, values): (Parameter, &[f32])| {
            (parameter, Moments::zeros(values.len() / parameter.width(), parameter.width()))
        };
        Self { groups: field.tensors().into_iter().map(group).collect(), halo: Vec::new() }
    }

    /// All groups.
    pub(crate) fn groups(&self) -> &[(Parameter, Moments)] {
        &self.groups
    }

    /// All groups, to be changed.
    pub(crate) fn groups_mut(&mut self) -> &mut [(Parameter, Moments)] {
        &mut self.groups
    }

    /// Moments of a parameter.
    ///
    /// # Panics
    /// When it is not in the table.
    pub(crate) fn of(&mut self, parameter: &Parameter) -> &mut Moments {
        let mut groups = self.groups.iter_mut();
        &mut groups.find(|(other, _)| other == parameter).expect("a parameter of the table").1
    }

    fn rows_of_gaussians(&mut self) -> impl Iterator<Item = (&Parameter, &mut Moments)> {
        let groups = self.groups.iter_mut().map(|(parameter, moments)| (&*parameter, moments));
        groups.filter(|(parameter, _)| parameter.rows == Rows::Gaussians)
    }

    /// Moves every parameter; gradients become zero. Groups with rate 0 keep still. Adds to `times`.
    ///
    /// # Errors
    /// The parameter whose gradient is not finite.
    pub(crate) fn step(
        &mut self,
        field: &mut Field,
        gradients: &mut Gradients,
        rates: &StepRates,
        weights: &PlaneWeights,
        visible_rows_only: bool,
        times: &mut StepTimes,
    ) -> Result<(), Parameter> {
        let mut since = Instant::now();
        let deformation = field.deformation.as_ref().map(|deformation| deformation.config.clone());
        let radii = std::mem::take(&mut gradients.radii);
        let tensors = field.tensors_mut().into_iter().zip(gradients.tensors_mut());
        for (((parameter, values), (_, gradient)), (_, moments)) in tensors.zip(&mut self.groups) {
            let rates = rates.of(&parameter);
            let stepped = match (&deformation, rates) {
                _ if values.is_empty() || !rates.move_anything() => {
                    gradient.fill(0.0);
                    Ok(())
                }
                (Some(config), RowRates::Uniform(rate)) if parameter == parameters::PLANES => {
                    step_planes(moments, values, gradient, config, weights, rate, &mut self.halo)
                }
                _ => {
                    let follows = visible_rows_only && parameter.rows == Rows::Gaussians;
                    moments.step(values, gradient, rates, follows.then_some(&radii[..]))
                }
            };
            lap(times.optimiser(&parameter), &mut since);
            stepped.map_err(|_| parameter)?;
        }
        gradients.radii = radii;
        Ok(())
    }

    /// Follows a change of the set of Gaussians.
    pub(crate) fn gather(&mut self, origins: &[Option<u32>]) {
        self.rows_of_gaussians().for_each(|(_, moments)| moments.gather(origins));
    }

    /// Follows a relocation: fresh moments for relocated rows, and for what sources share with their copies.
    pub(crate) fn relocate(&mut self, weak: &[u32], sources: &[u32], entry_origins: &[Option<u32>]) {
        for (parameter, moments) in self.rows_of_gaussians() {
            let shared = if parameter.on_copy == OnCopy::Divided { sources } else { &[] };
            for row in weak.iter().chain(shared) {
                moments.reset_row(*row as usize);
            }
        }
        self.of(&parameters::LOG_CALIBRATIONS).gather(entry_origins);
    }

    /// Starts the calibrations of new identity rows.
    pub(crate) fn start_identities(&mut self, field: &Field) {
        let entries = field.identities.as_ref().map_or(0, |rows| rows.labels.len());
        *self.of(&parameters::LOG_CALIBRATIONS) = Moments::zeros(entries, 1);
    }
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic;

    use super::*;

    #[test]
    fn rates_follow_stage_and_ablation() {
        let mut config = TrainConfig::default();
        (config.stages.fine, config.stages.instance, config.rates.schedule_steps) = (100, 50, 0);
        let mut field = synthetic::generate(&synthetic::SyntheticConfig::default()).field;
        field.extent = 2.0;
        let rates = |config: &TrainConfig, stage, iteration| {
            let rates = StepRates::at(config, stage, iteration, &field);
            let of = |parameter: &Parameter| match rates.of(parameter) {
                RowRates::Uniform(rate) => rate,
                RowRates::Split { base, .. } => base,
            };
            [parameters::MEANS, parameters::OCCUPANCY_LOGITS, parameters::LOG_CALIBRATIONS]
                .map(|parameter| of(&parameter))
        };
        assert_eq!(rates(&config, Stage::Fine, 100)[1..], [0.0, 0.0]);
        let instance = rates(&config, Stage::Instance, 50);
        assert!((instance[0] / (2.0 * config.rates.means[1]) - 1.0).abs() < 1e-5, "A29: continues");
        assert_eq!(instance[1..], [0.01, 0.01]);
        config.rates.restart_in_instance_stage = true;
        assert!(rates(&config, Stage::Instance, 50)[0] > 3.0 * instance[0]);
        config.instance.ablate.extend([Ablation::ConstantOccupancy, Ablation::NoCalibration]);
        assert_eq!(rates(&config, Stage::Instance, 50)[1..], [0.0, 0.0]);
    }

    #[test]
    fn every_parameter_of_the_table_has_a_rate_in_every_stage_that_trains_it() {
        let config = TrainConfig::default();
        let field = synthetic::generate(&synthetic::SyntheticConfig::default()).field;
        let rates = StepRates::at(&config, Stage::Instance, 1, &field);
        for parameter in parameters::TABLE {
            assert!(rates.of(&parameter).move_anything(), "{}", parameter.name);
        }
    }
}
