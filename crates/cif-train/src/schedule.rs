//! What changes with the step count. Source: methods reference 1.1 and 1.3.

use crate::config::TrainConfig;

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

/// Whether an event that happens `every` steps (0: never) falls on `step`.
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
    fn events_fall_on_multiples_and_never_on_zero() {
        assert!(!falls_on(0, 100) && falls_on(100, 100) && !falls_on(150, 100) && !falls_on(100, 0));
    }
}
