//! Places of masks in their image, kept small.

/// Columns to which larger images are reduced.
const COLUMNS: u32 = 512;

/// Pixels of a mask: runs of indices, ascending, first and one past the last.
#[derive(Clone, Debug, Default)]
pub(super) struct Place {
    runs: Vec<[u32; 2]>,
    area: u32,
}

impl Place {
    /// The place of pixels, by their indices in an image of this width.
    pub(super) fn of(pixels: impl Iterator<Item = u32>, width: u32) -> Self {
        let step = width.div_ceil(COLUMNS).max(1);
        // A run ends with its row.
        let row = width.div_ceil(step) + 1;
        let kept = pixels.map(|index| (index % width, index / width));
        let kept = kept.filter(|(x, y)| x % step == 0 && y % step == 0);
        let mut indices: Vec<u32> = kept.map(|(x, y)| y / step * row + x / step).collect();
        indices.sort_unstable();
        let mut place = Self::default();
        indices.into_iter().for_each(|index| place.push(index));
        place
    }

    fn push(&mut self, index: u32) {
        self.area += 1;
        match self.runs.last_mut() {
            Some([_, end]) if *end == index => *end += 1,
            _ => self.runs.push([index, index + 1]),
        }
    }

    /// The place of both.
    pub(super) fn with(&self, other: &Self) -> Self {
        let mut runs = [&self.runs[..], &other.runs].concat();
        runs.sort_unstable();
        Self { runs, area: self.area + other.area }
    }

    /// Pixels of the reduced image.
    pub(super) fn area(&self) -> f64 {
        f64::from(self.area)
    }

    /// Intersection over union with a mask of another image of the same size.
    pub(super) fn overlap(&self, other: &Self) -> f64 {
        let both = self.common(other);
        f64::from(both) / f64::from((self.area + other.area - both).max(1))
    }

    /// Share of it that a mask of another image of the same size has.
    pub(super) fn share_in(&self, other: &Self) -> f64 {
        f64::from(self.common(other)) / f64::from(self.area.max(1))
    }

    fn common(&self, other: &Self) -> u32 {
        let (mut both, mut i, mut j) = (0, 0, 0);
        while let (Some([a, a_end]), Some([b, b_end])) = (self.runs.get(i), other.runs.get(j)) {
            both += (*a_end).min(*b_end).saturating_sub(*a.max(b));
            if a_end <= b_end {
                i += 1;
            } else {
                j += 1;
            }
        }
        both
    }
}
