//! Connected parts of the masks of an image, as runs of pixels.

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

/// Pixels of one label next to each other in a row: columns from the first to one past the last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Run {
    pub row: u32,
    pub from: u32,
    pub to: u32,
}

impl Run {
    /// Number of its pixels.
    pub(super) fn len(self) -> u32 {
        self.to - self.from
    }

    /// Indices of its pixels in an image of this width.
    pub(super) fn indices(self, width: u32) -> impl Iterator<Item = u32> {
        (self.from..self.to).map(move |x| self.row * width + x)
    }
}

/// Pixels of one label that touch each other, also by corners, in the order of rows.
#[derive(Clone, Debug)]
pub(super) struct Part(pub Vec<Run>);

impl Part {
    /// Number of its pixels.
    pub(super) fn area(&self) -> u32 {
        self.0.iter().map(|run| run.len()).sum()
    }

    /// Indices of its pixels in an image of this width, ascending.
    pub(super) fn indices(&self, width: u32) -> impl Iterator<Item = u32> {
        self.0.iter().flat_map(move |run| run.indices(width))
    }

    /// True where pixels of both are no farther from each other.
    pub(super) fn is_within(&self, reach: f64, other: &Self) -> bool {
        let rows = reach as u32;
        self.0.iter().any(|a| {
            let first = other.0.partition_point(|b| b.row + rows < a.row);
            let near = other.0[first..].iter().take_while(|b| b.row <= a.row + rows);
            near.into_iter().any(|b| {
                let across = f64::from(a.from.max(b.from)) - f64::from(a.to.min(b.to)) + 1.0;
                across.max(0.0).hypot(f64::from(a.row.abs_diff(b.row))) <= reach
            })
        })
    }
}

/// The parts of all masks by label, in the order of their first pixels.
pub(super) fn parts(labels: &PixelGrid<u16>) -> BTreeMap<u16, Vec<Part>> {
    let width = labels.width.max(1) as usize;
    let mut runs: Vec<(u16, Run)> = Vec::new();
    // The first run of the part that each belongs to, as far as is known.
    let mut joins: Vec<usize> = Vec::new();
    let mut above = 0..0;
    for (row, pixels) in labels.pixels.chunks(width).enumerate() {
        let first = runs.len();
        let mut from = 0;
        for same in pixels.chunk_by(|a, b| a == b) {
            let to = from + same.len() as u32;
            if same[0] != UNLABELLED {
                let run = Run { row: row as u32, from, to };
                joins.push(runs.len());
                for k in above.clone() {
                    let (label, other): (u16, Run) = runs[k];
                    if label == same[0] && other.from <= to && from <= other.to {
                        join(&mut joins, k, runs.len());
                    }
                }
                runs.push((same[0], run));
            }
            from = to;
        }
        above = first..runs.len();
    }
    let mut places: BTreeMap<usize, usize> = BTreeMap::new();
    let mut found: BTreeMap<u16, Vec<Part>> = BTreeMap::new();
    for (k, (label, run)) in runs.into_iter().enumerate() {
        let of_label = found.entry(label).or_default();
        let place = *places.entry(root(&mut joins, k)).or_insert(of_label.len());
        if place == of_label.len() {
            of_label.push(Part(Vec::new()));
        }
        of_label[place].0.push(run);
    }
    found
}

/// The first run of the part of one.
fn root(joins: &mut [usize], mut run: usize) -> usize {
    while joins[run] != run {
        joins[run] = joins[joins[run]];
        run = joins[run];
    }
    run
}

/// Joins the parts of two runs.
fn join(joins: &mut [usize], a: usize, b: usize) {
    let (a, b) = (root(joins, a), root(joins, b));
    joins[a.max(b)] = a.min(b);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_touch_by_corners_and_join_below() {
        // A cup (1) that closes at its bottom, a pixel at its corner, one apart from it, and another thing (2) inside.
        #[rustfmt::skip]
        let labels = PixelGrid::from_pixels(7, 4, vec![
            1, 0, 0, 1, 0, 0, 0,
            1, 2, 0, 1, 0, 0, 1,
            1, 1, 1, 1, 0, 0, 0,
            0, 0, 0, 0, 1, 0, 0,
        ]);
        let found = parts(&labels);
        let areas = |label: u16| found[&label].iter().map(Part::area).collect::<Vec<_>>();
        assert_eq!((areas(1), areas(2)), (vec![9, 1], vec![1]));
        let [cup, apart] = &found[&1][..] else { unreachable!() };
        assert_eq!(cup.indices(7).collect::<Vec<_>>(), [0, 3, 7, 10, 14, 15, 16, 17, 25]);
        assert!(cup.is_within(2.9, apart) && apart.is_within(2.9, cup));
        assert!(!cup.is_within(2.7, apart) && !apart.is_within(2.7, cup));
        assert!(parts(&PixelGrid::filled(0, 0, 1)).is_empty());
    }
}
