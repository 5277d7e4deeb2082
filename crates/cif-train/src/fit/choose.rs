//! Which settings fit a budget: steps, Gaussians and, where nothing else helps, resolution.

use super::Calibration;
use super::expected::{Workload, steps_s};
use crate::budget::FITS;
use crate::config::TrainConfig;

/// Exponent by which Gaussians follow the budget: `draft` has 0.6 of `standard` in 0.3 of its time, and in a tenth of it
/// 0.2 to 0.4 of them were best on two captures.
const GAUSSIANS_EXPONENT: f64 = 0.5;

/// Exponent by which steps of the instance stage follow the fine ones where these are fewer: `draft` has half as many as
/// `standard`, and 0.29 of the fine ones.
const INSTANCE_EXPONENT: f64 = 0.55;

/// Least and most Gaussians relative to the settings to start from.
const GAUSSIANS_RANGE: (f64, f64) = (0.125, 2.0);

/// Most steps relative to the settings to start from; more bring next to nothing.
const MOST_STEPS: f64 = 4.0;

/// Rounds in which steps are fitted to the time.
const ROUNDS: usize = 4;

/// Fine steps below which images are reduced.
const FEWEST_FINE_STEPS: f64 = 700.0;

/// Shorter side that images keep at least, pixels.
const SMALLEST_IMAGE: u32 = 64;

/// A setting that differs from where the choice started.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Change {
    /// In words.
    pub setting: &'static str,
    /// There.
    pub from: String,
    /// Chosen.
    pub to: String,
}

/// Chosen settings.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// Settings.
    pub config: TrainConfig,
    /// Expected time of the settings to start from, seconds.
    pub base_s: f64,
    /// Expected time of the choice, seconds; less than the budget where more time would bring next to nothing.
    pub expected_s: f64,
    /// Settings that differ from those to start from.
    pub changes: Vec<Change>,
}

/// Part of a budget that fits of objects may take before and between the stages; 0 where there are none.
#[must_use]
pub fn share_of_fits(config: &TrainConfig, work: Workload) -> f64 {
    if work.has_fits(config) { FITS } else { 0.0 }
}

/// Settings like `base` that take about `seconds`.
#[must_use]
pub fn choose(base: &TrainConfig, calibration: &Calibration, work: Workload, seconds: f64) -> Choice {
    let base_s = steps_s(base, calibration, work, 1).max(1e-6);
    let share = (seconds / base_s).max(1e-6);
    let mut config = base.clone();
    if work.may_change_gaussians {
        let (least, most) = GAUSSIANS_RANGE;
        let factor = share.powf(GAUSSIANS_EXPONENT).clamp(least, most);
        let gaussians = (f64::from(base.densify.max_gaussians) * factor / 100.0).round() * 100.0;
        config.densify.max_gaussians = (gaussians as u32).max(100);
        let points = f64::from(base.model.max_initial_points) * factor;
        config.model.max_initial_points = (points as u32).clamp(1, config.densify.max_gaussians);
        if factor >= 1.0 {
            config.model.max_initial_points = base.model.max_initial_points;
        }
    }
    let side = calibration.image_size[0].min(calibration.image_size[1]);
    let mut reduction = 1;
    loop {
        // Costs are nearly in proportion to steps.
        let mut factor = 1.0;
        for _ in 0..ROUNDS {
            set_schedule(&mut config, base, factor, of_instances(factor));
            let whole = steps_s(&config, calibration, work, reduction).max(1e-6);
            factor = (factor * seconds / whole).min(MOST_STEPS);
        }
        let fine = f64::from(base.fine_iterations()) * factor;
        if fine >= FEWEST_FINE_STEPS || !work.may_reduce || side / (2 * reduction) < SMALLEST_IMAGE {
            set_schedule(&mut config, base, factor, of_instances(factor));
            break;
        }
        reduction *= 2;
    }
    if reduction > 1 {
        config.downscale = Some(base.downscale.unwrap_or(1) * reduction);
    }
    let expected_s = steps_s(&config, calibration, work, reduction);
    let changes = changes(base, &config, work, calibration.image_size, reduction);
    Choice { config, base_s, expected_s, changes }
}

/// Settings with so many times the steps, and with everything that counts in steps stretched or shortened
/// alike, down to a least number of steps between events; what only makes long runs longer stays where it is
/// when they are stretched.
#[must_use]
pub fn stretched(base: &TrainConfig, factor: f64) -> TrainConfig {
    let mut config = base.clone();
    set_schedule(&mut config, base, factor, factor);
    config
}

/// Steps of the instance stage, relative to those of the base, where fine steps are so many times those.
fn of_instances(fine: f64) -> f64 {
    if fine < 1.0 { fine.powf(INSTANCE_EXPONENT) } else { fine }
}

/// Schedule of `base`, stretched or shortened, with everything that counts in steps; `of_instances` for the instance stage.
fn set_schedule(config: &mut TrainConfig, base: &TrainConfig, factor: f64, of_instances: f64) {
    let times = |steps: u32, factor: f64, least: u32| {
        if steps == 0 { 0 } else { ((f64::from(steps) * factor).round() as u32).max(least) }
    };
    let scaled = |steps: u32, least: u32| times(steps, factor, least);
    config.stages.coarse = scaled(base.stages.coarse, 1);
    config.stages.fine = scaled(base.fine_iterations(), 1);
    config.stages.fine_includes_coarse = false;
    config.stages.instance = times(base.stages.instance, of_instances, 1);
    config.rates.schedule_steps = scaled(base.rates.schedule_steps, 1);
    // Growing later than by default only makes a long run longer.
    let shortened = |steps: u32, least: u32| times(steps, factor.min(1.0), least);
    let of_stage = |steps: u32, least: u32| times(steps, of_instances.min(1.0), least);
    config.model.sh_interval = shortened(base.model.sh_interval, 20);
    config.densify.from = shortened(base.densify.from, 20);
    config.densify.every = shortened(base.densify.every, 20);
    config.densify.prune_every = shortened(base.densify.prune_every, 20);
    config.densify.opacity_reset_every = shortened(base.densify.opacity_reset_every, 1);
    config.densify.until = scaled(base.densify.until, 1);
    config.resample.from = of_stage(base.resample.from, 10);
    config.resample.every = of_stage(base.resample.every, 10);
    config.resample.until = times(base.resample.until, of_instances, 1);
}

fn changes(
    base: &TrainConfig,
    config: &TrainConfig,
    work: Workload,
    size: [u32; 2],
    reduction: u32,
) -> Vec<Change> {
    let pixels = |by: u32| format!("{} x {}", size[0] / by, size[1] / by);
    let rows = [
        ("steps without motion", base.stages.coarse.to_string(), config.stages.coarse.to_string()),
        ("steps with motion", base.fine_iterations().to_string(), config.stages.fine.to_string()),
        ("steps with instances", base.stages.instance.to_string(), config.stages.instance.to_string()),
        ("most Gaussians", base.densify.max_gaussians.to_string(), config.densify.max_gaussians.to_string()),
        ("image size", pixels(1), pixels(reduction)),
    ];
    rows.into_iter()
        .filter(|(setting, from, to)| {
            from != to && (work.has_instances || *setting != "steps with instances")
        })
        .map(|(setting, from, to)| Change { setting, from, to })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::times::{StepShares, raster_cost};

    const WORK: Workload = Workload {
        is_dynamic: true,
        has_instances: true,
        frames: 50,
        travelling: 0,
        resting: 0,
        may_reduce: true,
        may_change_gaussians: true,
    };

    /// As measured on a capture of 256 x 192 with one thread.
    const MEASURED: Calibration = Calibration {
        initial: 5_000,
        most: 20_000,
        gaussians: 20_000,
        step_s: 0.025,
        shares: StepShares { pixels: 0.3, moving: 0.3, fixed: 0.1 },
        moving: 0.4,
        image_size: [256, 192],
        steps: 20,
    };

    #[test]
    fn the_choice_fits_and_gives_up_more_the_less_time_there_is() {
        let base = TrainConfig::default();
        let mut last = (0, 0);
        for seconds in [25.0, 40.0, 60.0, 90.0, 150.0] {
            let choice = choose(&base, &MEASURED, WORK, seconds);
            choice.config.validate().unwrap();
            assert!((choice.expected_s / seconds - 1.0).abs() < 0.02, "{seconds}: {}", choice.expected_s);
            let now = (choice.config.stages.fine, choice.config.densify.max_gaussians);
            assert!(now.0 > last.0 && now.1 > last.1, "{seconds}: {now:?} after {last:?}");
            assert!(now.0 < base.stages.fine && now.1 < base.densify.max_gaussians);
            assert!(choice.config.densify.until < choice.config.stages.fine);
            assert!(choice.config.resample.until < choice.config.stages.instance);
            assert!(choice.changes.iter().any(|change| change.setting == "steps with motion"));
            assert_eq!(choice.config.downscale, None, "{seconds}");
            last = now;
        }
    }

    #[test]
    fn images_are_reduced_only_when_there_is_no_other_way() {
        let mut base = TrainConfig::default();
        base.stages.reduction = 1;
        let shares = StepShares { pixels: 0.9, moving: 0.0, fixed: 0.05 };
        let slow = Calibration { step_s: 0.5, image_size: [1352, 1014], shares, ..MEASURED };
        let choice = choose(&base, &slow, WORK, 90.0);
        assert!(choice.config.downscale >= Some(2), "{:?}", choice.config.downscale);
        assert!(choice.changes.iter().any(|change| change.setting == "image size"), "{:?}", choice.changes);
        let kept = choose(&base, &slow, Workload { may_reduce: false, ..WORK }, 90.0);
        assert_eq!(kept.config.downscale, None);
        assert!(kept.config.stages.fine < choice.config.stages.fine);
        // Few Gaussians make do with smaller images but for the last steps.
        base.stages.reduction = 0;
        let worked_on = choose(&base, &slow, Workload { may_reduce: false, ..WORK }, 90.0);
        assert!(worked_on.config.stages.fine > 2 * kept.config.stages.fine, "{:?}", worked_on.config.stages);
        assert!(worked_on.expected_s <= 91.0);
        // The first steps are on images of half the size that is worked on, and the last ones on whole ones; nine tenths of a
        // step on whole images are rasterising.
        let step = |side: f64| 0.9 * raster_cost(side * side, 1.0) + 0.1;
        let [whole, half, quarter] = [1.0, 0.5, 0.25].map(step);
        let [first, last] = [base.stages.half_size, base.stages.whole_size].map(f64::from);
        let ratio = (last * whole + (1.0 - first - last) * half + first * quarter)
            / ((1.0 - first) * whole + first * half);
        assert!((worked_on.base_s / kept.base_s / ratio - 1.0).abs() < 0.05, "{ratio}");
    }

    #[test]
    fn more_time_than_needed_gives_more_than_the_base_up_to_a_limit() {
        let base = TrainConfig::default();
        let choice = choose(&base, &MEASURED, WORK, 1e6);
        assert_eq!(choice.config.stages.fine, 4 * base.stages.fine);
        assert_eq!(choice.config.densify.max_gaussians, 2 * base.densify.max_gaussians);
        assert!(choice.expected_s < 1e5);
        let kept = choose(&base, &MEASURED, Workload { may_change_gaussians: false, ..WORK }, 60.0);
        assert_eq!(kept.config.densify.max_gaussians, base.densify.max_gaussians);
    }
}
