//! Adaptive density control: cloning, splitting, pruning and opacity resets. Source: methods reference 1.5.

use std::collections::{BTreeMap, BTreeSet};

use cif_field::Gaussians;
use cif_geometry::scalar::{logit, sigmoid};
use rand::Rng;
use rand_pcg::Pcg64;

use super::rearrangement::{Rearrangement, keep, with_copies};
use super::statistics::DensifyStatistics;
use super::strategy::{Change, Rows, Strategy};
use crate::config::DensifyConfig;
use crate::schedule::{Due, Moment};

/// The rules of 3DGS, on the steps that the settings `densify` name.
#[derive(Clone, Copy, Debug, Default)]
pub struct Adaptive;

/// Its changes, in order.
const CHANGES: [Due; 3] = [Due::Prune, Due::Add, Due::ResetOpacities];

impl Strategy for Adaptive {
    fn counts_statistics(&self, step: &Moment<'_>) -> bool {
        step.has(Due::CountStatistics)
    }

    fn changes(&self, step: &Moment<'_>) -> usize {
        CHANGES.into_iter().filter(|due| step.has(*due)).count()
    }

    fn change(&self, k: usize, step: &Moment<'_>, rows: &Rows<'_>, rng: &mut Pcg64) -> Change {
        let Rows { gaussians, statistics, extent, .. } = *rows;
        let config = &step.config.densify;
        match CHANGES.into_iter().filter(|due| step.has(*due)).nth(k) {
            Some(Due::Prune) => Change { rearrangement: prune(rows, config), ..Change::default() },
            Some(Due::Add) => Change {
                rearrangement: add_gaussians(gaussians, statistics, config, extent, rng),
                restarts_statistics: true,
                ..Change::default()
            },
            Some(Due::ResetOpacities) => {
                Change { opacity_cap: Some(config.opacity_reset_to), ..Change::default() }
            }
            _ => Change::default(),
        }
    }
}

/// Clones small and splits large Gaussians whose mean screen gradient reaches the threshold, strongest first
/// while the set stays within `max_gaussians`. `None` when nothing changes.
pub fn add_gaussians(
    gaussians: &Gaussians,
    statistics: &DensifyStatistics,
    config: &DensifyConfig,
    extent: f32,
    rng: &mut impl Rng,
) -> Option<Rearrangement> {
    let n = gaussians.len();
    let mut chosen: Vec<u32> = (0..n as u32)
        .filter(|row| {
            let row = *row as usize;
            statistics.count[row] > 0 && statistics.mean_gradient(row) >= config.gradient_threshold
        })
        .collect();
    let budget = (config.max_gaussians as usize).saturating_sub(n);
    if chosen.len() > budget {
        chosen.sort_by(|a, b| {
            let gradient = |row: u32| statistics.mean_gradient(row as usize);
            gradient(*b).total_cmp(&gradient(*a)).then(a.cmp(b))
        });
        chosen.truncate(budget);
        chosen.sort_unstable();
    }
    if chosen.is_empty() {
        return None;
    }
    let is_large = |row: u32| largest_scale(gaussians, row as usize) > config.split_scale * extent;
    let (splits, clones): (Vec<u32>, Vec<u32>) = chosen.into_iter().partition(|row| is_large(*row));
    Some(with_copies(gaussians, &clones, &splits, rng))
}

/// Gaussians of an object that no rule removes, the most opaque: as few as have a box and a rotation, four points in no
/// plane.
pub(crate) const FEWEST_OF_OBJECT: usize = 4;

/// Removes what [`is_useless`], but not the last ones of an object. `None` when none goes.
#[must_use]
pub fn prune(rows: &Rows<'_>, config: &DensifyConfig) -> Option<Rearrangement> {
    remove(rows, config, &|row| is_useless(rows, config, row))
}

/// True of transparent Gaussians and, once opacities were reset, of those too large on screen or in space; of none in
/// a set of `prune_min_n` or fewer.
pub(super) fn is_useless(rows: &Rows<'_>, config: &DensifyConfig, row: usize) -> bool {
    let Rows { gaussians, statistics, extent, opacities_were_reset, .. } = *rows;
    let is_transparent = || sigmoid(gaussians.opacity_logits[row]) < config.prune_opacity;
    let is_too_large = || {
        statistics.radius[row] > config.prune_radius_px
            || largest_scale(gaussians, row) > config.prune_scale * extent
    };
    gaussians.len() > config.prune_min_n as usize
        && (is_transparent() || (opacities_were_reset && is_too_large()))
}

/// Removes rows, but not the last ones of an object. `None` when none goes.
pub(super) fn remove(
    rows: &Rows<'_>,
    config: &DensifyConfig,
    goes: &impl Fn(usize) -> bool,
) -> Option<Rearrangement> {
    let (gaussians, n) = (rows.gaussians, rows.gaussians.len());
    let last = last_of_objects(rows, goes);
    let kept: Vec<u32> = (0..n as u32).filter(|row| !goes(*row as usize) || last.contains(row)).collect();
    let mut change = keep(gaussians, kept)?;
    // Drawn as faintly as anything may be.
    let least = logit(config.prune_opacity);
    for (row, logit) in change.parents.iter().zip(&mut change.gaussians.opacity_logits) {
        if last.contains(row) {
            *logit = logit.max(least);
        }
    }
    Some(change)
}

/// Rows to keep of those that go, so that every object has a few.
fn last_of_objects(rows: &Rows<'_>, goes: &impl Fn(usize) -> bool) -> BTreeSet<u32> {
    let mut of_objects: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for (row, object) in rows.made_for.iter().enumerate().filter(|(_, object)| **object > 0) {
        of_objects.entry(*object).or_default().push(row);
    }
    let mut last = BTreeSet::new();
    for (_, of_object) in of_objects {
        let (mut going, staying): (Vec<usize>, Vec<usize>) =
            of_object.into_iter().partition(|row| goes(*row));
        let opacity = |row: &usize| rows.gaussians.opacity_logits[*row];
        going.sort_by(|a, b| opacity(b).total_cmp(&opacity(a)));
        let kept = FEWEST_OF_OBJECT.saturating_sub(staying.len());
        last.extend(going.into_iter().take(kept).map(|row| row as u32));
    }
    last
}

/// Caps every opacity; the caller zeroes the opacity moments (methods reference 7, row 24).
pub fn reset_opacities(gaussians: &mut Gaussians, opacity: f32) {
    let cap = logit(opacity);
    for value in &mut gaussians.opacity_logits {
        *value = value.min(cap);
    }
}

fn largest_scale(gaussians: &Gaussians, row: usize) -> f32 {
    gaussians.log_scales[row].iter().fold(f32::NEG_INFINITY, |a, b| a.max(*b)).exp()
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
