//! Growth of the set of Gaussians where they are added by errors: by equal factors from step to step, until it is full.

/// Gaussians behind a share of the steps from one number to a larger one.
pub(crate) fn grown(from: f64, to: f64, share: f64) -> f64 {
    from * (to / from.max(1.0)).powf(share)
}

/// Mean of the Gaussians on the way from one number to a larger one.
pub(crate) fn mean(from: f64, to: f64) -> f64 {
    let first = (from / to.max(1.0)).clamp(1e-6, 1.0);
    if first < 1.0 { to * (1.0 - first) / -first.ln() } else { to }
}
