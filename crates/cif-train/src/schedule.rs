//! Schedules of settings over the step count. Source: methods reference 1.1 and 1.3.

use crate::config::{Ablation, TrainConfig};
use crate::stage::Stage;

/// `exp((1 - r) ln first + r ln last)` with `r = step / steps`, clamped to [0, 1].
#[must_use]
pub fn log_linear([first, last]: [f32; 2], step: u32, steps: u32) -> f32 {
    if first <= 0.0 || last <= 0.0 {
        return 0.0;
    }
    let r = if steps == 0 { 1.0 } else { (f64::from(step) / f64::from(steps)).min(1.0) };
    ((1.0 - r) * f64::from(first).ln() + r * f64::from(last).ln()).exp() as f32
}

/// Spherical-harmonics degree after `step` steps of a stage that began with `start`: one more at every
/// multiple of the interval, capped.
#[must_use]
pub fn sh_degree(config: &TrainConfig, start: u8, step: u32) -> u8 {
    let highest = config.model.sh_degree;
    match step.checked_div(config.model.sh_interval) {
        None => highest,
        Some(increases) => highest.min(start.saturating_add(u8::try_from(increases).unwrap_or(u8::MAX))),
    }
}

/// Steps over which scheduled rates run.
#[must_use]
pub fn schedule_steps(config: &TrainConfig) -> u32 {
    match config.rates.schedule_steps {
        0 => config.fine_iterations() + config.stages.instance,
        steps => steps,
    }
}

/// Changes of the set of Gaussians, and of whose they are, that fall behind a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Due {
    /// Removes what is transparent or too large.
    pub prunes: bool,
    /// Clones and splits.
    pub adds: bool,
    /// Caps all opacities.
    pub resets_opacities: bool,
    /// Estimates identity rows anew.
    pub estimates_identities: bool,
    /// Relocates Gaussians to instances that need them.
    pub resamples: bool,
}

impl Due {
    /// Behind step `iteration` (from 1) of the `last` of a stage. Source: methods reference 1.5 and 6.
    #[must_use]
    pub fn after(config: &TrainConfig, stage: Stage, iteration: u32, last: u32) -> Self {
        match stage {
            Stage::Coarse | Stage::Fine if iteration < config.densify.until => {
                let densify = &config.densify;
                let warm = iteration > densify.from;
                Self {
                    prunes: warm && falls_on(iteration, densify.prune_every),
                    adds: warm && falls_on(iteration, densify.every),
                    resets_opacities: falls_on(iteration, densify.opacity_reset_every),
                    ..Self::default()
                }
            }
            // The last step has none behind it to make good for them.
            Stage::Instance if iteration < last => {
                let resample = &config.resample;
                Self {
                    estimates_identities: falls_on(iteration, config.identity.refresh_every),
                    resamples: falls_on(iteration, resample.every)
                        && (resample.from..=resample.until).contains(&iteration)
                        && !config.ablates(Ablation::NoResampling),
                    ..Self::default()
                }
            }
            _ => Self::default(),
        }
    }

    /// True when anything falls there.
    #[must_use]
    pub fn changes_gaussians(&self) -> bool {
        *self != Self::default()
    }
}

/// True when an event that happens `every` steps (0: never) falls on `step`.
#[must_use]
pub fn falls_on(step: u32, every: u32) -> bool {
    step > 0 && step.checked_rem(every) == Some(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_run_log_linearly_and_stay_at_the_end() {
        let rate = |step| log_linear([1.6e-4, 1.6e-6], step, 20_000);
        assert!((rate(0) / 1.6e-4 - 1.0).abs() < 1e-6);
        assert!((rate(10_000) / 1.6e-5 - 1.0).abs() < 1e-6);
        assert!((rate(20_000) / 1.6e-6 - 1.0).abs() < 1e-6);
        assert_eq!(rate(20_000), rate(90_000));
        assert_eq!(log_linear([0.0; 2], 5, 10), 0.0);
    }

    #[test]
    fn the_degree_grows_by_one_per_interval() {
        let mut config = TrainConfig::default();
        config.model.sh_interval = 1_000;
        let degrees: Vec<u8> = [0, 999, 1_000, 2_999, 3_000, 9_000].map(|s| sh_degree(&config, 0, s)).into();
        assert_eq!(degrees, [0, 0, 1, 2, 3, 3]);
        assert_eq!(sh_degree(&config, 2, 1_500), 3);
        config.model.sh_interval = 0;
        assert_eq!(sh_degree(&config, 0, 0), 3);
        config.model.sh_degree = 1;
        assert_eq!(sh_degree(&config, 0, 9_000), 1);
    }

    #[test]
    fn changes_of_the_set_fall_where_settings_and_ablations_say() {
        let mut config = TrainConfig::default();
        let densify = &mut config.densify;
        (densify.from, densify.until, densify.every, densify.prune_every) = (100, 401, 50, 100);
        densify.opacity_reset_every = 300;
        let resample = &mut config.resample;
        (resample.from, resample.until, resample.every) = (50, 200, 50);
        config.identity.refresh_every = 100;
        let falling = |config: &TrainConfig, stage, of: fn(&Due) -> bool| -> Vec<u32> {
            (1..=500).filter(|step| of(&Due::after(config, stage, *step, 200))).collect()
        };
        assert_eq!(falling(&config, Stage::Fine, |due| due.adds), [150, 200, 250, 300, 350, 400]);
        assert_eq!(falling(&config, Stage::Coarse, |due| due.prunes), [200, 300, 400]);
        assert_eq!(falling(&config, Stage::Fine, |due| due.resets_opacities), [300]);
        assert_eq!(falling(&config, Stage::Instance, |due| due.resamples), [50, 100, 150], "not on the last");
        assert_eq!(falling(&config, Stage::Instance, |due| due.estimates_identities), [100]);
        assert!(falling(&config, Stage::Identity, Due::changes_gaussians).is_empty());
        config.instance.ablate.insert(Ablation::NoResampling);
        assert_eq!(falling(&config, Stage::Instance, Due::changes_gaussians), [100]);
    }

    #[test]
    fn events_fall_on_multiples_and_never_on_zero() {
        assert!(!falls_on(0, 100) && falls_on(100, 100) && !falls_on(150, 100) && !falls_on(100, 0));
    }
}
