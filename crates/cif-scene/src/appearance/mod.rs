//! Opacities and colours that change over time.
//!
//! A node keeps one opacity and one colour per splat, which stand wherever only one time is read: the mean opacity
//! over the times at which the node is visible (while any of its Gaussians can be drawn), and the colour at the first
//! time. Where the trained ones leave them by more than [`crate::SceneOptions::appearance_tolerance`], samples are
//! added to them, no more than linear interpolation needs to stay inside the tolerance.

pub(crate) mod blur;
pub(crate) mod visibility;

use cif_field::gaussians::SH_FLOATS;
use cif_geometry::scalar::direct_sigmoid;
use cif_geometry::spherical_harmonics::{HarmonicsRotation, coefficient_count};
use glam::DQuat;
use rayon::prelude::*;

use crate::field_motion::frames::Frames;
use crate::graph::{Appearance, AppearanceSample, Motion, is_visible_at, pose_at};
use crate::motion::keys;
use crate::{Node, VisibilitySample};

/// Opacities over time.
#[derive(Clone, Debug, Default)]
pub struct Opacities {
    /// Largest opacity of every row over the sampled times.
    pub peak: Vec<f32>,
    /// True where any opacity changes.
    pub change: bool,
}

impl Opacities {
    /// Looks at all sampled times, if opacities can change.
    #[must_use]
    pub fn of(frames: &mut Frames<'_>) -> Self {
        let first = frames.at(0);
        let mut peak = first.opacity_logits.clone();
        let mut change = false;
        if frames.fade() {
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
        Self { peak: peak.into_iter().map(direct_sigmoid).collect(), change }
    }
}

/// Parameters for thinning samples of opacities and colours.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Thinning<'a> {
    pub(crate) time_codes: &'a [f64],
    /// Weights of the splats, in the order of the node.
    pub(crate) weights: &'a [f64],
    /// Largest RMS error, in units of opacity and colour.
    pub(crate) tolerance: f64,
    /// False where every sampled time stays.
    pub(crate) reduce: bool,
}

/// Gives a node its opacities over time, and hides it where no row reaches `min_opacity`.
pub(crate) fn fade(node: &mut Node, frames: &mut Frames<'_>, min_opacity: f32, thinning: &Thinning<'_>) {
    let samples: Vec<AppearanceSample> = thinning
        .time_codes
        .iter()
        .enumerate()
        .map(|(step, &time_code)| {
            let frame = frames.at(step);
            let rows = &node.splats.rows;
            let values = rows.iter().map(|&row| direct_sigmoid(frame.opacity_logits[row as usize])).collect();
            AppearanceSample { time_code, values }
        })
        .collect();
    let is_shown = |sample: &AppearanceSample| sample.values.iter().any(|opacity| *opacity >= min_opacity);
    let mut shown: Vec<VisibilitySample> = Vec::new();
    for sample in &samples {
        let visible = is_shown(sample);
        if shown.last().is_none_or(|last| last.visible != visible) {
            shown.push(VisibilitySample { time_code: sample.time_code, visible });
        }
    }
    if shown.len() > 1 {
        node.visibility = both(&node.visibility, &shown);
    }
    let mut mean = vec![0.0_f64; node.splats.len()];
    let visible: Vec<&AppearanceSample> = samples.iter().filter(|sample| is_shown(sample)).collect();
    for sample in &visible {
        mean.iter_mut().zip(&sample.values).for_each(|(sum, opacity)| *sum += f64::from(*opacity));
    }
    let count = visible.len().max(1) as f64;
    node.splats.opacities = mean.into_iter().map(|sum| (sum / count) as f32).collect();
    node.appearance.opacities = thinned(samples, &node.splats.opacities, 1, thinning);
}

/// Gives a node its colours over time, in its local frame or that of its parts.
pub(crate) fn recolor(node: &mut Node, frames: &mut Frames<'_>, thinning: &Thinning<'_>) {
    let degree = (1..=3).rev().find(|degree| {
        let band = 3 * coefficient_count(degree - 1)..3 * coefficient_count(*degree);
        (0..frames.len()).any(|step| {
            let frame = frames.at(step);
            let mut rows = node.splats.rows.iter();
            rows.any(|row| frame.sh_coefficients[*row as usize][band.clone()].iter().any(|v| *v != 0.0))
        })
    });
    let floats = 3 * coefficient_count(degree.unwrap_or(0));
    let samples: Vec<AppearanceSample> = thinning
        .time_codes
        .iter()
        .enumerate()
        .map(|(step, &time_code)| {
            let frame = frames.at(step);
            let mut values = vec![0.0; floats * node.splats.len()];
            for (range, rotation) in turns(node, time_code) {
                let back = (rotation.xyz().length() > 1e-9)
                    .then(|| HarmonicsRotation::<f32>::new(crate::vectors::rows_of(rotation.conjugate())));
                let rows = &node.splats.rows[range.clone()];
                let values = &mut values[range.start * floats..range.end * floats];
                values.par_chunks_exact_mut(floats).zip(rows).for_each(|(values, row)| {
                    let mut sh: [f32; SH_FLOATS] = frame.sh_coefficients[*row as usize];
                    if let Some(back) = &back {
                        back.rotate(&mut sh);
                    }
                    values.copy_from_slice(&sh[..floats]);
                });
            }
            AppearanceSample { time_code, values }
        })
        .collect();
    let Some(first) = samples.first() else { return };
    node.splats.sh_degree = degree.unwrap_or(0);
    node.splats.sh_coefficients.clone_from(&first.values);
    node.appearance.colors = thinned(samples, &node.splats.sh_coefficients, floats, thinning);
}

/// Ranges of splats with the rotation of the frame that they are in, at a time code.
fn turns(node: &Node, time_code: f64) -> Vec<(std::ops::Range<usize>, DQuat)> {
    let whole = pose_at(node.track(), node.pivot, time_code).rotation;
    match &node.motion {
        Motion::Parts(motion) => motion
            .parts
            .iter()
            .map(|part| {
                let own = pose_at(&part.track, part.pivot, time_code).rotation;
                (part.splats.clone(), (whole * own).normalize())
            })
            .collect(),
        _ => vec![(0..node.splats.len(), whole)],
    }
}

/// The samples that are needed; none where `constant` is inside the tolerance at all times. `stride` is the number of
/// values per splat.
fn thinned(
    samples: Vec<AppearanceSample>,
    constant: &[f32],
    stride: usize,
    thinning: &Thinning<'_>,
) -> Vec<AppearanceSample> {
    let allowed =
        thinning.tolerance * thinning.tolerance * thinning.weights.iter().sum::<f64>() * stride as f64;
    // Sum of the weighted squares between a sample and the interpolation of two others.
    let inside = |sample: &AppearanceSample, a: &[f32], b: &[f32], fraction: f64| {
        let mut sum = 0.0;
        for (k, value) in sample.values.iter().enumerate() {
            let (a, b) = (f64::from(a[k]), f64::from(b[k]));
            let off = a + fraction * (b - a) - f64::from(*value);
            sum += thinning.weights[k / stride] * off * off;
        }
        sum <= allowed
    };
    if samples.iter().all(|sample| inside(sample, constant, constant, 0.0)) {
        return Vec::new();
    }
    if !thinning.reduce {
        return samples;
    }
    let kept = keys::kept(samples.len(), |first, last| {
        let (a, b) = (&samples[first], &samples[last]);
        samples[first + 1..last].iter().all(|sample| {
            let fraction = (sample.time_code - a.time_code) / (b.time_code - a.time_code);
            inside(sample, &a.values, &b.values, fraction)
        })
    });
    let mut kept = kept.into_iter().peekable();
    let samples = samples.into_iter().enumerate();
    samples.filter_map(|(index, sample)| kept.next_if_eq(&index).map(|_| sample)).collect()
}

impl Appearance {
    /// Opacities at a time code; `None` where they stay as in [`crate::Splats::opacities`].
    #[must_use]
    pub fn opacities_at(&self, time_code: f64) -> Option<Vec<f32>> {
        at(&self.opacities, time_code)
    }

    /// Coefficients at a time code; `None` where they stay as in [`crate::Splats::sh_coefficients`].
    #[must_use]
    pub fn colors_at(&self, time_code: f64) -> Option<Vec<f32>> {
        at(&self.colors, time_code)
    }
}

/// Values at a time code: linear between samples, held outside; `None` without samples.
pub(crate) fn at(samples: &[AppearanceSample], time_code: f64) -> Option<Vec<f32>> {
    let (first, last) = samples.first().zip(samples.last())?;
    let after = samples.partition_point(|sample| sample.time_code <= time_code);
    if after == 0 || after == samples.len() {
        return Some(if after == 0 { first } else { last }.values.clone());
    }
    let (a, b) = (&samples[after - 1], &samples[after]);
    let fraction = ((time_code - a.time_code) / (b.time_code - a.time_code)) as f32;
    Some(a.values.iter().zip(&b.values).map(|(a, b)| a + fraction * (b - a)).collect())
}

/// Loss of a node in a format that holds one opacity and one colour per splat: one sentence for each that changes
/// over time, with the RMS difference over splats (by opacity) and time, and the largest one; empty where nothing
/// changes.
#[must_use]
pub fn lost_without_samples(node: &Node) -> Vec<String> {
    let splats = &node.splats;
    let kinds = [
        ("opacities", "their mean", &node.appearance.opacities, &splats.opacities),
        ("colours", "those of the first frame", &node.appearance.colors, &splats.sh_coefficients),
    ];
    let changing = kinds.into_iter().filter(|(_, _, samples, _)| !samples.is_empty());
    changing.map(|(what, instead, samples, constant)| {
        let stride = (constant.len() / splats.len().max(1)).max(1);
        let (mut squares, mut weights, mut largest) = (0.0_f64, 0.0_f64, 0.0_f32);
        for sample in samples {
            for (k, (value, constant)) in sample.values.iter().zip(constant).enumerate() {
                let weight = f64::from(splats.opacities[k / stride]);
                squares += weight * f64::from(value - constant).powi(2);
                weights += weight;
                largest = largest.max((value - constant).abs());
            }
        }
        let rms = if weights > 0.0 { (squares / weights).sqrt() } else { 0.0 };
        format!(
            "{}: {what} change over time and leave as {instead} (off by {rms:.2} RMS, at most {largest:.2})",
            node.name
        )
    })
    .collect()
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
