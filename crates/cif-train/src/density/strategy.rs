//! Which Gaussians come and go while colours are learnt.

use cif_field::Gaussians;
use rand_pcg::Pcg64;

use super::contributions::Contributions;
use super::rearrangement::Rearrangement;
use super::statistics::DensifyStatistics;
use crate::schedule::Moment;

/// The rows that a change is decided from.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    /// The set as the change before it left it.
    pub gaussians: &'a Gaussians,
    /// What steps counted of every row since the set last grew.
    pub statistics: &'a DensifyStatistics,
    /// Contributions of every row to the views that the strategy asked for; `None` where it asked for none.
    pub contributions: Option<&'a Contributions>,
    /// Object that every row was made for, from 1 on; 0 for one that was made for none.
    pub made_for: &'a [u32],
    /// Extent of the scene, metres.
    pub extent: f32,
    /// True when opacities were capped in this stage.
    pub opacities_were_reset: bool,
}

/// A change of the set behind a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Change {
    /// The new set; `None` where it stays.
    pub rearrangement: Option<Rearrangement>,
    /// True when statistics begin anew behind it.
    pub restarts_statistics: bool,
    /// Opacity that none exceeds behind it; moments of opacities begin anew then.
    pub opacity_cap: Option<f32>,
}

/// Rules for adding and removing Gaussians in the coarse and the fine stage, one file each;
/// [`Trainer::set_density`](crate::Trainer::set_density) takes them. They keep no state: a resumed run decides as an
/// uninterrupted one would, by the rows and the step.
pub trait Strategy: Send + Sync {
    /// True when a step adds to [`DensifyStatistics`].
    fn counts_statistics(&self, step: &Moment<'_>) -> bool;

    /// Number of training views that changes behind a step look at.
    fn views(&self, _step: &Moment<'_>) -> usize {
        0
    }

    /// Number of changes behind a step; 0 where none falls there.
    fn changes(&self, step: &Moment<'_>) -> usize;

    /// Change `k` of those behind a step. `rng` depends on the seed and the step, and goes on from one change to the
    /// next.
    fn change(&self, k: usize, step: &Moment<'_>, rows: &Rows<'_>, rng: &mut Pcg64) -> Change;
}
