//! Opacities that change over time.
//!
//! A Gaussian keeps one opacity in the graph: its mean over the times at which its node is visible, which is
//! while any of its Gaussians can be drawn.

use crate::VisibilitySample;
use crate::build::sigmoid;
use crate::frames::Frames;
use crate::graph::is_visible_at;

/// Opacities over time.
#[derive(Clone, Debug, Default)]
pub struct Opacities {
    /// Largest opacity of every row over the sampled times.
    pub peak: Vec<f32>,
    /// Whether any opacity changes.
    pub change: bool,
}

impl Opacities {
    /// Looks at all sampled times, if anything moves.
    #[must_use]
    pub fn of(frames: &mut Frames<'_>) -> Self {
        let first = frames.at(0);
        let mut peak = first.opacity_logits.clone();
        let mut change = false;
        if frames.moves() {
            for step in 1..frames.len() {
                let frame = frames.at(step);
                if frame.opacity_logits != first.opacity_logits {
                    change = true;
                    for (peak, logit) in peak.iter_mut().zip(&frame.opacity_logits) {
                        *peak = peak.max(*logit);
                    }
                }
            }
        }
        Self { peak: peak.into_iter().map(sigmoid).collect(), change }
    }
}

/// Visibility and opacities of a group of rows whose opacities change. A time at which no row reaches
/// `min_opacity` is invisible.
#[must_use]
pub fn over_time(
    frames: &mut Frames<'_>,
    rows: &[u32],
    min_opacity: f32,
    time_codes: &[f64],
) -> (Vec<VisibilitySample>, Vec<f32>) {
    let mut samples: Vec<VisibilitySample> = Vec::new();
    let mut sums = vec![0.0_f64; rows.len()];
    let mut visible_times = 0;
    for (step, &time_code) in time_codes.iter().enumerate() {
        let frame = frames.at(step);
        let opacities: Vec<f32> =
            rows.iter().map(|&row| sigmoid(frame.opacity_logits[row as usize])).collect();
        let visible = opacities.iter().any(|opacity| *opacity >= min_opacity);
        if samples.last().is_none_or(|sample| sample.visible != visible) {
            samples.push(VisibilitySample { time_code, visible });
        }
        if visible {
            visible_times += 1;
            for (sum, opacity) in sums.iter_mut().zip(&opacities) {
                *sum += f64::from(*opacity);
            }
        }
    }
    if samples.len() == 1 {
        samples.clear();
    }
    let opacities = sums.iter().map(|sum| (sum / f64::from(visible_times.max(1))) as f32).collect();
    (samples, opacities)
}

/// Changes of visibility of what is visible only while both are.
#[must_use]
pub fn both(a: &[VisibilitySample], b: &[VisibilitySample]) -> Vec<VisibilitySample> {
    let mut codes: Vec<f64> = a.iter().chain(b).map(|sample| sample.time_code).collect();
    codes.sort_by(f64::total_cmp);
    codes.dedup();
    let mut samples: Vec<VisibilitySample> = Vec::new();
    for time_code in codes {
        let visible = is_visible_at(a, time_code) && is_visible_at(b, time_code);
        if samples.last().is_none_or(|last| last.visible != visible) {
            samples.push(VisibilitySample { time_code, visible });
        }
    }
    if samples.iter().all(|sample| sample.visible) { Vec::new() } else { samples }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_must_be_visible() {
        let sample = |time_code, visible| VisibilitySample { time_code, visible };
        let (a, b) = (
            [sample(0.0, false), sample(2.0, true), sample(6.0, false)],
            [sample(3.0, true), sample(5.0, false)],
        );
        assert_eq!(both(&a, &b), [sample(0.0, false), sample(2.0, true), sample(5.0, false)]);
        assert_eq!(both(&a, &[]), a);
        assert!(both(&[], &[]).is_empty());
    }
}
