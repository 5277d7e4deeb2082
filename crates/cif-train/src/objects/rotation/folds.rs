//! Pixels that are left out of a fit, and cells that are fitted.

use super::evidence::Evidence;

/// Folds of left-out pixels, and the times in a row of a block: neighbouring times of one camera show nearly the same.
pub(super) const FOLDS: usize = 6;
const BLOCK: usize = 3;

/// Pixels with a prediction below which nothing is fitted.
pub(super) const FEWEST: usize = 60;

/// Observations of a cell outside the fold, from which it predicts.
pub(super) const OBSERVED: f64 = 2.0;

/// Fold of each view.
pub(super) fn folds(evidence: &Evidence<'_>) -> Vec<usize> {
    let block = if evidence.is_rig { 1 } else { BLOCK };
    evidence.looks.iter().map(|look| look.view.time_index / block % FOLDS).collect()
}

/// Numbers the cells that are seen from 0 up, in the order of their first appearance; returns how many there are.
pub(super) fn numbered<'o>(cells: impl Iterator<Item = &'o mut usize>, all: usize) -> usize {
    let mut numbers = vec![usize::MAX; all];
    let mut count = 0;
    for cell in cells {
        let number = &mut numbers[*cell];
        if *number == usize::MAX {
            *number = count;
            count += 1;
        }
        *cell = *number;
    }
    count
}
