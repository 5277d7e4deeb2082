//! A changed set of Gaussians as data: everything that has a row per Gaussian follows it (parameters, moments,
//! statistics, rows of heads, groups).

use cif_field::Gaussians;
use cif_geometry::quaternion;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

/// Children are smaller than the Gaussian they replace by this factor (0.8 x 2 children).
const SPLIT_SHRINK: f32 = 1.6;

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

/// Duplicates some Gaussians, and replaces others by two smaller ones drawn from them.
#[must_use]
pub fn with_copies(
    gaussians: &Gaussians,
    clones: &[u32],
    splits: &[u32],
    rng: &mut impl Rng,
) -> Rearrangement {
    let (mut change, first_child) = twice(gaussians, clones, splits);
    let set = &mut change.gaussians;
    for row in first_child..set.len() {
        let xi = std::array::from_fn(|_| StandardNormal.sample(rng));
        let offset = in_world(set, row, xi);
        for axis in 0..3 {
            set.means[row][axis] += offset[axis];
            set.log_scales[row][axis] -= SPLIT_SHRINK.ln();
        }
    }
    change
}

/// Duplicates some Gaussians, and replaces others by two copies side by side, which come last: from the row that is
/// returned on.
pub(super) fn twice(gaussians: &Gaussians, clones: &[u32], splits: &[u32]) -> (Rearrangement, usize) {
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
    let change = Rearrangement {
        gaussians: gaussians.gather(&parents),
        origins,
        parents,
        cloned: clones.len(),
        split: splits.len(),
        pruned: 0,
    };
    (change, first_child)
}

/// Removes all but some Gaussians; `None` where all stay.
#[must_use]
pub fn keep(gaussians: &Gaussians, kept: Vec<u32>) -> Option<Rearrangement> {
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

/// `R(q) diag(exp s) xi` of a row; zero when its quaternion carries no rotation.
pub(crate) fn in_world(gaussians: &Gaussians, row: usize, xi: [f32; 3]) -> [f32; 3] {
    let Some(unit) = quaternion::try_normalize(gaussians.quaternions[row]) else { return [0.0; 3] };
    let rotation = quaternion::to_rotation(unit);
    let scaled: [f32; 3] = std::array::from_fn(|k| gaussians.log_scales[row][k].exp() * xi[k]);
    std::array::from_fn(|r| (0..3).map(|c| rotation[r][c] * scaled[c]).sum())
}
