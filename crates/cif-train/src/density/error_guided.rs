//! Density control by the errors of training views: Gaussians are split where most is wrong, up to a number that is
//! reached gradually, and in a full set those that contribute least make room. Sources: errors by blending weights and
//! growth within a budget, Rota Bulo et al. 2024 ("Revising Densification in Gaussian Splatting"); splits along the
//! longest axis, Deng et al. 2024 ("Efficient Density Control for 3D Gaussian Splatting").

use std::collections::BTreeMap;

use cif_field::Gaussians;
use cif_geometry::scalar::{logit, sigmoid};
use rand_pcg::Pcg64;

use super::adaptive::{is_useless, remove};
use super::contributions::Contributions;
use super::rearrangement::{Rearrangement, in_world, twice};
use super::strategy::{Change, Rows, Strategy};
use crate::config::DensifyConfig;
use crate::schedule::{Due, Moment};

/// Splits by error, on the steps and within the limits that the settings `densify` name.
#[derive(Clone, Copy, Debug, Default)]
pub struct ErrorGuided;

/// Parts of a change behind a step, in order.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Part {
    Remove,
    Split,
    ResetOpacities,
}

impl Part {
    fn falls(self, step: &Moment<'_>) -> bool {
        match self {
            Self::Remove => step.has(Due::Prune) || step.has(Due::Add),
            Self::Split => step.has(Due::Add),
            Self::ResetOpacities => step.has(Due::ResetOpacities),
        }
    }

    fn behind(step: &Moment<'_>) -> impl Iterator<Item = Self> {
        [Self::Remove, Self::Split, Self::ResetOpacities].into_iter().filter(|part| part.falls(step))
    }
}

impl Strategy for ErrorGuided {
    fn counts_statistics(&self, step: &Moment<'_>) -> bool {
        // Sizes on screen, which opacity resets are followed by.
        step.has(Due::CountStatistics) && step.config.densify.opacity_reset_every > 0
    }

    fn views(&self, step: &Moment<'_>) -> usize {
        if step.has(Due::Add) { step.config.densify.views as usize } else { 0 }
    }

    fn changes(&self, step: &Moment<'_>) -> usize {
        Part::behind(step).count()
    }

    fn change(&self, k: usize, step: &Moment<'_>, rows: &Rows<'_>, _rng: &mut Pcg64) -> Change {
        let config = &step.config.densify;
        match (Part::behind(step).nth(k), rows.contributions) {
            (Some(Part::Remove), contributions) => {
                let rearrangement = make_room(rows, contributions, config, step.has(Due::Prune));
                Change { rearrangement, ..Change::default() }
            }
            (Some(Part::Split), Some(contributions)) => Change {
                rearrangement: split(rows.gaussians, contributions, config, step.additions_left()),
                restarts_statistics: true,
                ..Change::default()
            },
            (Some(Part::ResetOpacities), _) => {
                Change { opacity_cap: Some(config.opacity_reset_to), ..Change::default() }
            }
            _ => Change::default(),
        }
    }
}

/// Share of the Gaussians of an object that may make room at once: where the views happen to show a sliver of it, all of
/// them have little weight.
const AT_ONCE: f64 = 0.5;

/// Removes what is useless, where pruning is due, and, with contributions, so many of those with the least weight that
/// `densify.turnover` of a full set is free. What no view showed is not judged, and of an object goes no more than
/// [`AT_ONCE`].
fn make_room(
    rows: &Rows<'_>,
    contributions: Option<&Contributions>,
    config: &DensifyConfig,
    prunes: bool,
) -> Option<Rearrangement> {
    let n = rows.gaussians.len();
    let mut goes: Vec<bool> = (0..n).map(|row| prunes && is_useless(rows, config, row)).collect();
    if let Some(Contributions { weight, .. }) = contributions {
        let most = config.max_gaussians as usize;
        let free = most.saturating_sub(n) + goes.iter().filter(|goes| **goes).count();
        let turnover = (f64::from(config.turnover) * most as f64) as usize;
        let mut shown: Vec<usize> = (0..n).filter(|row| !goes[*row] && weight[*row] > 0.0).collect();
        shown.sort_by(|a, b| weight[*a].total_cmp(&weight[*b]).then(a.cmp(b)));
        let mut of_objects: BTreeMap<u32, f64> = BTreeMap::new();
        for object in rows.made_for.iter().filter(|object| **object > 0) {
            *of_objects.entry(*object).or_default() += AT_ONCE;
        }
        let mut may_go = |row: &usize| {
            let Some(left) = of_objects.get_mut(&rows.made_for[*row]) else { return true };
            *left -= 1.0;
            *left >= 0.0
        };
        let gone = shown.into_iter().filter(|row| may_go(row)).take(turnover.saturating_sub(free));
        gone.for_each(|row| goes[row] = true);
    }
    remove(rows, config, &|row| goes[row])
}

/// Splits the Gaussians with the largest errors: as many as there is room for, and no more than make the set full by
/// equal factors in the additions that are left for it.
fn split(
    gaussians: &Gaussians,
    contributions: &Contributions,
    config: &DensifyConfig,
    additions_left: u32,
) -> Option<Rearrangement> {
    let (n, most) = (gaussians.len(), config.max_gaussians as usize);
    let factor = (most as f64 / n as f64).powf(1.0 / f64::from(additions_left.max(1)));
    let added = ((n as f64 * factor).ceil() as usize).min(most).saturating_sub(n);
    let error: Vec<f32> = (0..n).map(|row| contributions.error_where_shown(row)).collect();
    let mut worst: Vec<u32> = (0..n as u32).filter(|row| error[*row as usize] > 0.0).collect();
    worst.sort_by(|a, b| error[*b as usize].total_cmp(&error[*a as usize]).then(a.cmp(b)));
    worst.truncate(added);
    worst.sort_unstable();
    (!worst.is_empty()).then(|| halved(gaussians, &worst))
}

/// Replaces Gaussians by their halves, which come last.
fn halved(gaussians: &Gaussians, rows: &[u32]) -> Rearrangement {
    let (mut change, first) = twice(gaussians, &[], rows);
    for (row, side) in (first..change.gaussians.len()).zip([1.0, -1.0].into_iter().cycle()) {
        make_half(&mut change.gaussians, row, side);
    }
    change
}

/// Standard deviation of a half along the longest axis, and distance of its centre, in standard deviations of the
/// whole: the squares add up to 1, so that both halves together have the variance of the whole.
const HALF: [f32; 2] = [0.6, 0.8];

/// Makes a row one of its two halves along its longest axis, which together have its mean, its variance and its mass
/// (opacity times volume).
fn make_half(set: &mut Gaussians, row: usize, side: f32) {
    let scales = set.log_scales[row];
    let longest = (1..3).fold(0, |best, axis| if scales[axis] > scales[best] { axis } else { best });
    let mut along = [0.0; 3];
    along[longest] = side * HALF[1];
    let offset = in_world(set, row, along);
    for (value, offset) in set.means[row].iter_mut().zip(offset) {
        *value += offset;
    }
    set.log_scales[row][longest] += HALF[0].ln();
    set.opacity_logits[row] = logit(sigmoid(set.opacity_logits[row]) / (2.0 * HALF[0]));
}

#[cfg(test)]
#[path = "error_guided_tests.rs"]
mod tests;
