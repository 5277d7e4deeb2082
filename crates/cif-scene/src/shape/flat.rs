//! Flat splats: those without thickness along an axis, as 2D Gaussian Splatting trains them.
//!
//! Graphs and files hold a scale of 0 for it. A field holds logarithms, of which that of 0 is not finite; there it is
//! one below [`FLAT_LOG_SCALE`].

use cif_field::gaussians::FLAT_LOG_SCALE;

/// Standard deviation of a raw log-scale; 0 where it has no thickness.
pub(crate) fn scale(log: f64) -> f32 {
    if log < f64::from(FLAT_LOG_SCALE) { 0.0 } else { (log.exp() as f32).min(f32::MAX) }
}

/// Raw log-scale of a standard deviation, finite also for 0.
pub(crate) fn log_scale(scale: f32) -> f32 {
    f64::from(scale.max(f32::MIN_POSITIVE)).ln() as f32
}

/// Geometric mean of the raw log-scales of the axes that have a thickness, as a scale; 0 where none has.
pub(crate) fn size(log_scales: [f64; 3]) -> f64 {
    let thick = || log_scales.into_iter().filter(|log| *log >= f64::from(FLAT_LOG_SCALE));
    match thick().count() {
        0 => 0.0,
        count => (thick().sum::<f64>() / count as f64).exp(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_stays_nothing_and_all_else_itself() {
        assert_eq!((scale(log_scale(0.0).into()), scale(f64::NEG_INFINITY)), (0.0, 0.0));
        assert!((scale(log_scale(1e-30).into()) / 1e-30 - 1.0).abs() < 1e-5);
        assert!((size([0.5_f64.ln(), f64::NEG_INFINITY, 2.0_f64.ln()]) - 1.0).abs() < 1e-12);
        assert_eq!(size([f64::NEG_INFINITY; 3]), 0.0);
    }
}
