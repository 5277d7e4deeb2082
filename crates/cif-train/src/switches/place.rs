//! Places of masks in their image, kept small.

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;

/// Columns to which larger images are reduced.
const COLUMNS: usize = 512;

/// Pixels of a mask: runs of indices, ascending, first and one past the last.
#[derive(Clone, Debug, Default)]
pub(super) struct Place {
    runs: Vec<[u32; 2]>,
    area: u32,
}

impl Place {
    fn push(&mut self, index: u32) {
        self.area += 1;
        match self.runs.last_mut() {
            Some([_, end]) if *end == index => *end += 1,
            _ => self.runs.push([index, index + 1]),
        }
    }

    /// Pixels of the reduced image.
    pub(super) fn area(&self) -> f64 {
        f64::from(self.area)
    }

    /// Intersection over union with a mask of another image of the same size.
    pub(super) fn overlap(&self, other: &Self) -> f64 {
        let (mut both, mut i, mut j) = (0, 0, 0);
        while let (Some([a, a_end]), Some([b, b_end])) = (self.runs.get(i), other.runs.get(j)) {
            both += (*a_end).min(*b_end).saturating_sub(*a.max(b));
            if a_end <= b_end {
                i += 1;
            } else {
                j += 1;
            }
        }
        f64::from(both) / f64::from((self.area + other.area - both).max(1))
    }
}

/// Places of the masks of an image, by label.
pub(super) fn places(labels: &PixelGrid<u16>) -> BTreeMap<u16, Place> {
    let step = (labels.width as usize).div_ceil(COLUMNS).max(1);
    let mut places: BTreeMap<u16, Place> = BTreeMap::new();
    let mut index = 0;
    for row in labels.pixels.chunks(labels.width.max(1) as usize).step_by(step) {
        for label in row.iter().step_by(step) {
            if *label != UNLABELLED {
                places.entry(*label).or_default().push(index);
            }
            index += 1;
        }
        // A run ends with its row.
        index += 1;
    }
    places
}
