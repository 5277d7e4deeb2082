//! Splats that move or deform as far as a picture shows, as distinguished from those that stand still.
//!
//! A network trembles a little where nothing moves. An instance whose splats do no more than that is at rest, though
//! the tolerance of motion be tighter by some factor. Most of a background stands still too; but shadows, reflections
//! and things without a mask do move. The two leave as nodes of their own: one constant, and one with a path for
//! every splat, so that a few moving splats neither freeze nor make thousands of others move. Where a format holds
//! bodies alone, a splat can be one: those that travel farthest have a path each, and the others stand still. Splats of
//! an instance at rest that travel farther than they are large show something else that passes over it, its shadow
//! mostly: they leave with what moves of the background.

use cif_geometry::quaternion;
use glam::DVec3;
use rayon::prelude::*;

use crate::field_motion::frames::Frames;
use crate::vectors::{dot, vector};

/// Change below which a splat stands still in a picture: of its place in units of its own standard deviation (the
/// middle one of the three: flat splats are seen from their broad side), of its size in logarithms, and of its
/// direction in radians, as far as it is not round. An image changes by about that share of the splat's contrast at
/// most.
const LEAST_CHANGE: f64 = 0.3;

/// Distance from which a splat travels, in units of its own largest standard deviation.
const TRAVELS: f64 = 1.0;

/// Most splats with a path of their own where formats hold bodies alone: each of them is one.
pub const LOOSE_SPLATS: usize = 200;

/// Ranges of place and size of one splat over time, and its largest turn since the first.
#[derive(Clone, Copy, Default)]
pub(crate) struct Change {
    low: DVec3,
    high: DVec3,
    low_scale: DVec3,
    high_scale: DVec3,
    turn: f64,
}

/// How each of `rows` changes over the sampled times.
pub(crate) fn changes(frames: &mut Frames<'_>, rows: &[u32]) -> Vec<Change> {
    if !frames.move_rows(rows) {
        return vec![Change::default(); rows.len()];
    }
    let first = frames.at(0);
    let mut changes: Vec<Change> = rows
        .iter()
        .map(|&row| {
            let (mean, scale) = (vector(first.means[row as usize]), vector(first.log_scales[row as usize]));
            Change { low: mean, high: mean, low_scale: scale, high_scale: scale, turn: 0.0 }
        })
        .collect();
    for step in 1..frames.len() {
        let frame = frames.at(step);
        changes.par_iter_mut().zip(rows).with_min_len(4096).for_each(|(change, &row)| {
            let row = row as usize;
            let (mean, scale) = (vector(frame.means[row]), vector(frame.log_scales[row]));
            (change.low, change.high) = (change.low.min(mean), change.high.max(mean));
            change.low_scale = change.low_scale.min(scale);
            change.high_scale = change.high_scale.max(scale);
            let unit = |q: [f32; 4]| quaternion::try_normalize(q.map(f64::from));
            if let (Some(a), Some(b)) = (unit(first.quaternions[row]), unit(frame.quaternions[row])) {
                change.turn = change.turn.max(2.0 * dot(a, b).abs().min(1.0).acos());
            }
        });
    }
    changes
}

/// Leaves the splats that travel farthest, at most [`LOOSE_SPLATS`], in the order of their rows, and gives the others.
pub(crate) fn leave_farthest(moving: &mut Vec<(u32, Change)>) -> Vec<(u32, Change)> {
    moving.sort_by(|(a, x), (b, y)| y.travelled().total_cmp(&x.travelled()).then(a.cmp(b)));
    let others = moving.split_off(moving.len().min(LOOSE_SPLATS));
    moving.sort_unstable_by_key(|(row, _)| *row);
    others
}

impl Change {
    /// True where it moves or deforms as far as a picture shows.
    pub(crate) fn shows(&self) -> bool {
        let mut scales = ((self.low_scale + self.high_scale) / 2.0).exp().to_array();
        scales.sort_by(f64::total_cmp);
        let [least, middle, most] = scales;
        self.travelled() > LEAST_CHANGE * middle
            || (self.high_scale - self.low_scale).max_element() > LEAST_CHANGE
            || self.turn * (1.0 - least / most) > LEAST_CHANGE
    }

    /// True where it goes farther than it is large.
    pub(crate) fn travels(&self) -> bool {
        let largest = ((self.low_scale + self.high_scale) / 2.0).exp().max_element();
        self.travelled() > TRAVELS * largest
    }

    /// Diagonal of the box of its centres.
    fn travelled(&self) -> f64 {
        (self.high - self.low).length()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_farthest_are_left_and_no_splat_is_lost() {
        let travelled = |row: u32| Change { high: DVec3::X * f64::from(row % 7), ..Change::default() };
        let mut moving: Vec<(u32, Change)> =
            (0..LOOSE_SPLATS as u32 + 30).map(|row| (row, travelled(row))).collect();
        let others = leave_farthest(&mut moving);
        assert_eq!((moving.len(), others.len()), (LOOSE_SPLATS, 30));
        assert!(moving.is_sorted_by_key(|(row, _)| *row));
        assert!(others.iter().all(|(row, _)| row % 7 == 0), "of those that travel least");
        assert!(leave_farthest(&mut moving).is_empty());
    }
}
