//! Cloning, splitting, pruning and opacity resets. Source: methods reference 1.5.

use cif_field::Gaussians;
use cif_geometry::quaternion;
use cif_geometry::scalar::{logit, sigmoid};
use cif_render::Gradients;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::config::DensifyConfig;

/// Children are smaller than the Gaussian they replace by this factor (0.8 x 2 children).
const SPLIT_SHRINK: f32 = 1.6;

/// Densification statistics of every Gaussian since the last change of the set.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DensifyStatistics {
    /// Summed norms of the screen gradient.
    pub gradient: Vec<f32>,
    /// Steps in which the Gaussian was visible.
    pub count: Vec<u32>,
    /// Largest screen radius, pixels.
    pub radius: Vec<f32>,
}

impl DensifyStatistics {
    /// Nothing seen of `n` Gaussians.
    #[must_use]
    pub fn zeros(n: usize) -> Self {
        Self { gradient: vec![0.0; n], count: vec![0; n], radius: vec![0.0; n] }
    }

    /// Adds a step: the screen gradients are summed over the views of the batch already.
    pub fn add(&mut self, gradients: &Gradients) {
        for row in 0..self.gradient.len() {
            let radius = gradients.radii[row];
            if radius > 0.0 {
                let [x, y] = gradients.screen[row];
                self.gradient[row] += x.hypot(y);
                self.count[row] += 1;
                self.radius[row] = self.radius[row].max(radius);
            }
        }
    }

    /// Follows a change of the set: rows that stay keep what was seen of them.
    pub fn gather(&mut self, origins: &[Option<u32>]) {
        fn pick<T: Copy + Default>(values: &[T], origins: &[Option<u32>]) -> Vec<T> {
            origins.iter().map(|origin| origin.map_or(T::default(), |row| values[row as usize])).collect()
        }
        self.gradient = pick(&self.gradient, origins);
        self.count = pick(&self.count, origins);
        self.radius = pick(&self.radius, origins);
    }

    fn mean_gradient(&self, row: usize) -> f32 {
        if self.count[row] == 0 { 0.0 } else { self.gradient[row] / self.count[row] as f32 }
    }
}

/// A new set of Gaussians, and where its rows come from.
#[derive(Clone, Debug, PartialEq)]
pub struct Rearrangement {
    /// The new set.
    pub gaussians: Gaussians,
    /// Per new row, the old row whose optimiser state it keeps; `None` for fresh ones.
    pub origins: Vec<Option<u32>>,
    /// Per new row, the old row that it stays, or is a copy or a child of.
    pub parents: Vec<u32>,
    /// Old rows duplicated.
    pub cloned: usize,
    /// Old rows replaced by two.
    pub split: usize,
    /// Old rows removed.
    pub pruned: usize,
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

/// Duplicates some Gaussians, and replaces others by two smaller ones drawn from them.
pub(crate) fn with_copies(
    gaussians: &Gaussians,
    clones: &[u32],
    splits: &[u32],
    rng: &mut impl Rng,
) -> Rearrangement {
    let n = gaussians.len();
    let mut is_split = vec![false; n];
    for row in splits {
        is_split[*row as usize] = true;
    }
    let mut parents: Vec<u32> = (0..n as u32).filter(|row| !is_split[*row as usize]).collect();
    let mut origins: Vec<Option<u32>> = parents.iter().copied().map(Some).collect();
    parents.extend(clones);
    let first_child = parents.len();
    parents.extend(splits.iter().flat_map(|row| [*row, *row]));
    origins.resize(parents.len(), None);
    let mut set = gaussians.gather(&parents);
    for row in first_child..set.len() {
        let xi = std::array::from_fn(|_| StandardNormal.sample(rng));
        let offset = in_world(&set, row, xi);
        for axis in 0..3 {
            set.means[row][axis] += offset[axis];
            set.log_scales[row][axis] -= SPLIT_SHRINK.ln();
        }
    }
    Rearrangement { gaussians: set, origins, parents, cloned: clones.len(), split: splits.len(), pruned: 0 }
}

/// Removes all but some Gaussians; `None` where all stay.
pub(crate) fn keep(gaussians: &Gaussians, kept: Vec<u32>) -> Option<Rearrangement> {
    let n = gaussians.len();
    (kept.len() < n).then(|| Rearrangement {
        gaussians: gaussians.gather(&kept),
        pruned: n - kept.len(),
        origins: kept.iter().copied().map(Some).collect(),
        parents: kept,
        cloned: 0,
        split: 0,
    })
}

/// Removes transparent Gaussians and, once opacities were reset, those too large on screen or in space.
/// `None` when nothing changes.
#[must_use]
pub fn prune(
    gaussians: &Gaussians,
    statistics: &DensifyStatistics,
    config: &DensifyConfig,
    extent: f32,
    opacities_were_reset: bool,
) -> Option<Rearrangement> {
    let n = gaussians.len();
    if n <= config.prune_min_n as usize {
        return None;
    }
    let goes = |row: usize| {
        sigmoid(gaussians.opacity_logits[row]) < config.prune_opacity
            || (opacities_were_reset
                && (statistics.radius[row] > config.prune_radius_px
                    || largest_scale(gaussians, row) > config.prune_scale * extent))
    };
    keep(gaussians, (0..n as u32).filter(|row| !goes(*row as usize)).collect())
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

/// `R(q) diag(exp s) xi` of a row; zero when its quaternion carries no rotation.
pub(crate) fn in_world(gaussians: &Gaussians, row: usize, xi: [f32; 3]) -> [f32; 3] {
    let Some(unit) = quaternion::try_normalize(gaussians.quaternions[row]) else { return [0.0; 3] };
    let rotation = quaternion::to_rotation(unit);
    let scaled: [f32; 3] = std::array::from_fn(|k| gaussians.log_scales[row][k].exp() * xi[k]);
    std::array::from_fn(|r| (0..3).map(|c| rotation[r][c] * scaled[c]).sum())
}

#[cfg(test)]
mod tests;
