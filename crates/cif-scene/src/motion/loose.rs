//! Splats that move or deform as far as a picture shows, told from those that stand still.
//!
//! A network trembles a little where nothing moves. An instance whose splats do no more than that is at rest, though
//! the tolerance of motion be tighter by some factor. Most of a background stands still too; but shadows, reflections
//! and things without a mask do move. The two leave as nodes of their own: one constant, and one with a path for
//! every splat, so that a few moving splats neither freeze nor make thousands of others move. Where a format holds
//! bodies alone, the splats that travel farthest are a body each, and the others one together. Splats of an instance at
//! rest that travel farther than they are large show something else that passes over it, its shadow mostly: they leave
//! with what moves of the background.

use cif_geometry::quaternion;
use glam::DVec3;
use rayon::prelude::*;

use crate::build::frames::{Frame, Frames};
use crate::motion::parts::Partition;
use crate::motion::{MovingGroup, dot, vector};

/// Change below which a splat stands still in a picture: of its place in units of its own standard deviation (the
/// middle one of the three: flat splats are seen from their broad side), of its size in logarithms, and of its
/// direction in radians, as far as it is not round. An image changes by about that share of the splat's contrast at
/// most.
const LEAST_CHANGE: f64 = 0.3;

/// Distance from which a splat travels, in units of its own largest standard deviation.
const TRAVELS: f64 = 1.0;

/// Most splats that are a body each.
const ALONE: usize = 200;

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
    if !frames.moves() {
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

/// The splats of a group that travel farthest as a part each, behind the others together; `own` are its splats at the
/// sampled times.
pub(crate) fn alone(group: &MovingGroup, own: &[Frame]) -> Partition {
    let count = group.rows.len();
    let travelled = |k: usize| {
        let still = group.pivot + group.static_shape.means[k];
        own.iter().map(|frame| vector(frame.means[k]).distance(still)).fold(0.0, f64::max)
    };
    let mut order: Vec<(usize, f64)> = (0..count).map(|k| (k, travelled(k))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut labels = vec![0; count];
    let alone = ALONE.min(count.saturating_sub(1));
    order[..alone].iter().enumerate().for_each(|(part, (k, _))| labels[*k] = part + 1);
    Partition { labels, count: alone + 1, decisive: 0.0 }
}

impl Change {
    /// True where it moves or deforms as far as a picture shows.
    pub(crate) fn shows(&self) -> bool {
        let mut scales = ((self.low_scale + self.high_scale) / 2.0).exp().to_array();
        scales.sort_by(f64::total_cmp);
        let [least, middle, most] = scales;
        (self.high - self.low).length() > LEAST_CHANGE * middle
            || (self.high_scale - self.low_scale).max_element() > LEAST_CHANGE
            || self.turn * (1.0 - least / most) > LEAST_CHANGE
    }

    /// True where it goes farther than it is large.
    pub(crate) fn travels(&self) -> bool {
        let largest = ((self.low_scale + self.high_scale) / 2.0).exp().max_element();
        (self.high - self.low).length() > TRAVELS * largest
    }
}
