//! The parameter groups of a field and their steps. Source: methods reference 1.1.

use std::time::Instant;

use cif_field::Field;
use cif_field::gaussians::SH_FLOATS;
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_render::Gradients;

use super::times::{StepTimes, lap};
use crate::adam::{Moments, PlaneWeights, RowRates, step_planes};
use crate::config::{Ablation, TrainConfig};
use crate::events::Stage;
use crate::schedule::{log_linear, schedule_steps};

/// Learning rates of one step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct StepRates {
    pub means: f32,
    pub log_scales: f32,
    pub quaternions: f32,
    pub opacity: f32,
    pub sh_base: f32,
    pub sh_rest: f32,
    pub occupancy: f32,
    pub calibration: f32,
    pub planes: f32,
    pub mlp: f32,
}

impl StepRates {
    /// Rates of step `iteration` (from 1) of a stage; `extent` in metres.
    pub(super) fn at(config: &TrainConfig, stage: Stage, iteration: u32, extent: f32) -> Self {
        let rates = &config.rates;
        let in_instance_stage = stage == Stage::Instance;
        let step = if in_instance_stage && !rates.restart_in_instance_stage {
            config.fine_iterations() + iteration
        } else {
            iteration
        };
        let scheduled = |pair| log_linear(pair, step, schedule_steps(config)) * extent;
        let network = |pair| {
            if rates.network_follows_extent {
                scheduled(pair)
            } else {
                log_linear(pair, step, schedule_steps(config))
            }
        };
        let only_if = |condition: bool, rate: f32| if condition { rate } else { 0.0 };
        let own_occupancy =
            !config.ablates(Ablation::ConstantOccupancy) && !config.ablates(Ablation::OpacityOccupancy);
        Self {
            means: scheduled(rates.means),
            log_scales: rates.log_scales,
            quaternions: rates.quaternions,
            opacity: rates.opacity,
            sh_base: rates.sh_base,
            sh_rest: rates.sh_rest,
            occupancy: only_if(in_instance_stage && own_occupancy, rates.occupancy),
            calibration: only_if(
                in_instance_stage && !config.ablates(Ablation::NoCalibration),
                rates.calibration,
            ),
            planes: network(rates.planes),
            mlp: network(rates.mlp),
        }
    }
}

/// Moments of all parameters.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Optimiser {
    pub means: Moments,
    pub log_scales: Moments,
    pub quaternions: Moments,
    pub opacity: Moments,
    pub occupancy: Moments,
    pub sh: Moments,
    pub planes: Moments,
    pub mlp: Moments,
    pub calibration: Moments,
    /// Scratch of the planes' sweep.
    halo: Vec<f32>,
}

impl Optimiser {
    /// Zero moments in the shape of a field.
    pub(super) fn new(field: &Field, own_bias_correction: bool) -> Self {
        let n = field.gaussians.len();
        let rows = |width| Moments::zeros(n, width, own_bias_correction);
        let (planes, mlp) = field.deformation.as_ref().map_or((0, 0), |d| (d.planes.len(), d.mlp.len()));
        Self {
            means: rows(3),
            log_scales: rows(3),
            quaternions: rows(4),
            opacity: rows(1),
            occupancy: rows(1),
            sh: rows(SH_FLOATS),
            planes: Moments::zeros(planes, 1, false),
            mlp: Moments::zeros(mlp, 1, false),
            calibration: Moments::zeros(calibrations(field), 1, own_bias_correction),
            halo: Vec::new(),
        }
    }

    /// All groups by name, for saving.
    pub(super) fn groups(&self) -> [(&'static str, &Moments); 9] {
        [
            ("means", &self.means),
            ("log_scales", &self.log_scales),
            ("quaternions", &self.quaternions),
            ("opacity", &self.opacity),
            ("occupancy", &self.occupancy),
            ("sh", &self.sh),
            ("planes", &self.planes),
            ("mlp", &self.mlp),
            ("calibration", &self.calibration),
        ]
    }

    /// All groups by name, for loading.
    pub(super) fn groups_mut(&mut self) -> [(&'static str, &mut Moments); 9] {
        [
            ("means", &mut self.means),
            ("log_scales", &mut self.log_scales),
            ("quaternions", &mut self.quaternions),
            ("opacity", &mut self.opacity),
            ("occupancy", &mut self.occupancy),
            ("sh", &mut self.sh),
            ("planes", &mut self.planes),
            ("mlp", &mut self.mlp),
            ("calibration", &mut self.calibration),
        ]
    }

    fn gaussian_groups_mut(&mut self) -> [&mut Moments; 6] {
        [
            &mut self.means,
            &mut self.log_scales,
            &mut self.quaternions,
            &mut self.opacity,
            &mut self.occupancy,
            &mut self.sh,
        ]
    }

    /// Moves every parameter; gradients become zero. Groups with rate 0 keep still. Adds to `times`.
    ///
    /// # Errors
    /// The name of a group whose gradient is not finite.
    pub(super) fn step(
        &mut self,
        field: &mut Field,
        gradients: &mut Gradients,
        rates: &StepRates,
        weights: &PlaneWeights,
        visible_rows_only: bool,
        times: &mut StepTimes,
    ) -> Result<(), &'static str> {
        let mut since = Instant::now();
        let visible = visible_rows_only.then_some(&gradients.radii[..]);
        let (p, g) = (&mut field.gaussians, &mut gradients.gaussians);
        let uniform = RowRates::Uniform;
        let sh = RowRates::Split {
            base: rates.sh_base,
            rest: rates.sh_rest,
            split: 3,
            active: 3 * coefficient_count(field.sh_degree),
        };
        let moved = |rate: f32| rate > 0.0;
        let run = |name, moments: &mut Moments, p: &mut [f32], g: &mut [f32], rates, moves: bool| {
            if !moves {
                g.fill(0.0);
                return Ok(());
            }
            moments.step(p, g, rates, visible).map_err(|_| name)
        };
        run(
            "the gradient of means",
            &mut self.means,
            p.means.as_flattened_mut(),
            g.means.as_flattened_mut(),
            uniform(rates.means),
            moved(rates.means),
        )?;
        run(
            "the gradient of log_scales",
            &mut self.log_scales,
            p.log_scales.as_flattened_mut(),
            g.log_scales.as_flattened_mut(),
            uniform(rates.log_scales),
            moved(rates.log_scales),
        )?;
        run(
            "the gradient of quaternions",
            &mut self.quaternions,
            p.quaternions.as_flattened_mut(),
            g.quaternions.as_flattened_mut(),
            uniform(rates.quaternions),
            moved(rates.quaternions),
        )?;
        run(
            "the gradient of opacity_logits",
            &mut self.opacity,
            &mut p.opacity_logits,
            &mut g.opacity_logits,
            uniform(rates.opacity),
            moved(rates.opacity),
        )?;
        run(
            "the gradient of occupancy_logits",
            &mut self.occupancy,
            &mut p.occupancy_logits,
            &mut g.occupancy_logits,
            uniform(rates.occupancy),
            moved(rates.occupancy),
        )?;
        run(
            "the gradient of sh_coefficients",
            &mut self.sh,
            p.sh_coefficients.as_flattened_mut(),
            g.sh_coefficients.as_flattened_mut(),
            sh,
            moved(rates.sh_base) || moved(rates.sh_rest),
        )?;
        if let Some(identities) = &mut field.identities {
            let g = &mut gradients.log_calibrations;
            if moved(rates.calibration) {
                let rates = uniform(rates.calibration);
                self.calibration
                    .step(&mut identities.log_calibrations, g, rates, None)
                    .map_err(|_| "the gradient of log_calibrations")?;
            } else {
                g.fill(0.0);
            }
        }
        lap(&mut times.optimiser_gaussians, &mut since);
        if let Some(deformation) = &mut field.deformation {
            if moved(rates.planes) {
                step_planes(
                    &mut self.planes,
                    &mut deformation.planes,
                    &mut gradients.planes,
                    &deformation.config,
                    weights,
                    rates.planes,
                    &mut self.halo,
                )
                .map_err(|_| "the gradient of planes")?;
            } else {
                gradients.planes.fill(0.0);
            }
            lap(&mut times.optimiser_planes, &mut since);
            if moved(rates.mlp) {
                self.mlp
                    .step(&mut deformation.mlp, &mut gradients.mlp, uniform(rates.mlp), None)
                    .map_err(|_| "the gradient of mlp")?;
            } else {
                gradients.mlp.fill(0.0);
            }
            lap(&mut times.optimiser_mlp, &mut since);
        }
        Ok(())
    }

    /// Follows a change of the set of Gaussians.
    pub(super) fn gather(&mut self, origins: &[Option<u32>]) {
        for moments in self.gaussian_groups_mut() {
            moments.gather(origins);
        }
    }

    /// Follows a change of the set whose moments are elsewhere, which are zero here.
    #[cfg(feature = "wgpu")]
    pub(super) fn gather_births(&mut self, origins: &[Option<u32>]) {
        for moments in self.gaussian_groups_mut() {
            moments.first = vec![0.0; origins.len() * moments.width];
            moments.second = vec![0.0; origins.len() * moments.width];
            moments.gather_births(origins);
        }
    }

    /// Steps after which the rows of Gaussians were made, a row after another; empty where all share the steps of
    /// their group.
    #[cfg(feature = "wgpu")]
    pub(super) fn births(&self) -> Vec<u32> {
        let groups =
            [&self.means, &self.log_scales, &self.quaternions, &self.opacity, &self.occupancy, &self.sh];
        (0..self.means.births.len()).flat_map(|row| groups.map(|moments| moments.births[row])).collect()
    }

    /// Follows a relocation: fresh moments for relocated rows, and for opacity and occupancy of sources.
    pub(super) fn relocate(&mut self, weak: &[u32], sources: &[u32], entry_origins: &[Option<u32>]) {
        for moments in self.gaussian_groups_mut() {
            for row in weak {
                moments.reset_row(*row as usize);
            }
        }
        for row in sources {
            self.opacity.reset_row(*row as usize);
            self.occupancy.reset_row(*row as usize);
        }
        self.calibration.gather(entry_origins);
    }

    /// Starts occupancy and calibration anew, for new identity rows.
    pub(super) fn start_identities(&mut self, field: &Field, own_bias_correction: bool) {
        self.calibration = Moments::zeros(calibrations(field), 1, own_bias_correction);
    }
}

fn calibrations(field: &Field) -> usize {
    field.identities.as_ref().map_or(0, |rows| rows.labels.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_follow_stage_and_ablation() {
        let mut config = TrainConfig::default();
        (config.stages.fine, config.stages.instance, config.rates.schedule_steps) = (100, 50, 0);
        let fine = StepRates::at(&config, Stage::Fine, 100, 2.0);
        assert_eq!((fine.occupancy, fine.calibration), (0.0, 0.0));
        let instance = StepRates::at(&config, Stage::Instance, 50, 2.0);
        assert!((instance.means / (2.0 * config.rates.means[1]) - 1.0).abs() < 1e-5, "A29: continues");
        assert_eq!((instance.occupancy, instance.calibration), (0.01, 0.01));
        config.rates.restart_in_instance_stage = true;
        assert!(StepRates::at(&config, Stage::Instance, 50, 2.0).means > 3.0 * instance.means);
        config.instance.ablate.extend([Ablation::ConstantOccupancy, Ablation::NoCalibration]);
        let ablated = StepRates::at(&config, Stage::Instance, 50, 2.0);
        assert_eq!((ablated.occupancy, ablated.calibration), (0.0, 0.0));
    }
}
