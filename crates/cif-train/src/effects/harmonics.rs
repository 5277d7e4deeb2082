//! View-dependent colour: a degree of spherical harmonics is used only where the one below it helps, and at half of the
//! fine stage those that do not help enough are taken back, for good.

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_render::RenderSettings;

use super::bench::gain;
use super::{Bench, Effect, Place, Standing};
use crate::config::TrainConfig;
use crate::engine::Changed;
use crate::error::TrainError;
use crate::progress::Progress;
use crate::schedule::{Due, Moment, sh_degree};

/// Degree of spherical harmonics at a step: as the schedule says, but not two above one that helps, and not above what
/// was taken back.
pub(crate) fn degree_at(config: &TrainConfig, progress: &Progress, iteration: u32) -> u8 {
    let scheduled = sh_degree(config, progress.sh_start, iteration);
    if config.effects.sh_gain <= 0.0 {
        return scheduled;
    }
    scheduled.min(progress.sh_judged + 1).min(progress.sh_cap.unwrap_or(u8::MAX))
}

/// Degrees of spherical harmonics.
pub(crate) struct Harmonics;

impl Effect for Harmonics {
    fn name(&self) -> &'static str {
        "view-dependence"
    }

    fn place(&self) -> Place {
        Place::Before
    }

    fn due(&self, step: &Moment<'_>, standing: &Standing<'_>) -> bool {
        let progress = standing.progress;
        let is_open = progress.sh_cap.is_none() && standing.field.sh_degree > progress.sh_judged;
        step.has(Due::TakeBackHarmonics) || (is_open && step.has(Due::TryHarmonics))
    }

    fn judge(&self, bench: &mut Bench<'_>) -> Result<(), TrainError> {
        if bench.moment().has(Due::TakeBackHarmonics) {
            let required = f64::from(bench.config().effects.sh_gain);
            while bench.state.field.sh_degree > 0 && !degree_gains(bench, required)? {
                take_back_degree(bench);
            }
        } else if degree_gains(bench, 0.0)? {
            bench.state.progress.sh_judged = bench.state.field.sh_degree;
        }
        Ok(())
    }
}

/// True when the highest degree of spherical harmonics gains as much on the held-out pixels, dB.
fn degree_gains(bench: &mut Bench<'_>, required: f64) -> Result<bool, TrainError> {
    let degree = bench.state.field.sh_degree;
    let settings = bench.state.color_settings();
    let lower = RenderSettings { sh_degree: degree - 1, ..settings };
    let with = bench.error_with(None, &settings)?;
    let without = bench.error_with(None, &lower)?;
    let gain_db = gain(without, with);
    let kept = gain_db >= required;
    bench.report(format!("view-dependent colour of degree {degree}"), gain_db, kept);
    Ok(kept)
}

/// Takes back the highest degree.
fn take_back_degree(bench: &mut Bench<'_>) {
    let degree = bench.state.field.sh_degree;
    let first = 3 * coefficient_count(degree - 1);
    for coefficients in &mut bench.state.field.gaussians.sh_coefficients {
        coefficients[first..].fill(0.0);
    }
    bench.engine.changed(Changed::Gaussians);
    bench.state.field.sh_degree = degree - 1;
    bench.state.progress.sh_cap = Some(degree - 1);
}
