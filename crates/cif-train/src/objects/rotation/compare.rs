//! Hypotheses held against each other on pixels that both predict, with standard errors.

use rayon::prelude::*;

use super::evidence::{Evidence, Look};

/// Blocks of time of the jackknife, and the fewest with which a standard error is one.
const JACKKNIFE: usize = 12;
const FEWEST_BLOCKS: usize = 5;

/// Pixels that two hypotheses must predict in a view to be compared there.
const COMMON: u32 = 15;

/// Standard errors by which every hypothesis beats every other (positive: it is better); NaN where they cannot be
/// compared, 0 where they differ by less than `least`. Differences are means over the pixels of a view that both predict, then
/// over views; their standard error is that of a jackknife over blocks of time.
pub(super) fn compared(evidence: &Evidence<'_>, fields: &[&[f32]], least: f64) -> Vec<Vec<f64>> {
    let pair = |a: usize, b: usize| {
        let gains = gains(evidence, fields[a], fields[b]);
        if mean(&gains).abs() < least { 0.0 } else { standard_errors(&gains) }
    };
    let count = fields.len();
    let rows: Vec<Vec<f64>> =
        (0..count).into_par_iter().map(|a| (0..a).map(|b| pair(a, b)).collect()).collect();
    let at = |a: usize, b: usize| match a.cmp(&b) {
        std::cmp::Ordering::Greater => rows[a][b],
        std::cmp::Ordering::Less => -rows[b][a],
        std::cmp::Ordering::Equal => 0.0,
    };
    (0..count).map(|a| (0..count).map(|b| at(a, b)).collect()).collect()
}

/// Mean difference of the residuals of two hypotheses by view, with its time: positive where the first is better; of
/// views with enough pixels that both predict.
pub(super) fn gains(evidence: &Evidence<'_>, better: &[f32], than: &[f32]) -> Vec<(usize, f64)> {
    let mut first = 0;
    let of_view = |look: &Look<'_>| {
        let range = first..first + look.pixels.len();
        first = range.end;
        let (mut sum, mut count) = (0.0_f64, 0_u32);
        for (a, b) in better[range.clone()].iter().zip(&than[range]) {
            if !a.is_nan() && !b.is_nan() {
                sum += f64::from(b - a);
                count += 1;
            }
        }
        (count >= COMMON).then(|| (look.view.time_index, sum / f64::from(count)))
    };
    evidence.looks.iter().filter_map(of_view).collect()
}

/// Mean of differences by time; 0 of none.
pub(super) fn mean(differences: &[(usize, f64)]) -> f64 {
    differences.iter().map(|(_, difference)| difference).sum::<f64>() / differences.len().max(1) as f64
}

/// Mean of differences by time over its standard error, by a jackknife over blocks of time; NaN where these are few.
pub(super) fn standard_errors(differences: &[(usize, f64)]) -> f64 {
    let mut times: Vec<usize> = differences.iter().map(|(time, _)| *time).collect();
    times.sort_unstable();
    times.dedup();
    let blocks = JACKKNIFE.min(times.len());
    if blocks < FEWEST_BLOCKS {
        return f64::NAN;
    }
    let (mut sums, mut counts) = (vec![0.0; blocks], vec![0.0; blocks]);
    for (time, difference) in differences {
        let block = times.partition_point(|other| other < time) * blocks / times.len();
        sums[block] += difference;
        counts[block] += 1.0;
    }
    let (sum, count): (f64, f64) = (sums.iter().sum(), counts.iter().sum());
    let without: Vec<f64> = sums.iter().zip(&counts).map(|(s, c)| (sum - s) / (count - c)).collect();
    let mean = without.iter().sum::<f64>() / blocks as f64;
    let spread: f64 = without.iter().map(|value| (value - mean).powi(2)).sum();
    let error = ((blocks as f64 - 1.0) / blocks as f64 * spread).sqrt();
    sum / count / (error + 1e-12)
}
