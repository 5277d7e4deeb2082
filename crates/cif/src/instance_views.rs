//! The views that show an instance best, and what they show of it alone.

use cif_geometry::PixelGrid;

use crate::pictures::Picture;

/// Least pixels of a view that counts, as a share of those of the best one.
const WORTHY: f64 = 0.25;

/// Pixels of every instance in every view.
#[derive(Clone, Debug)]
pub struct Coverage {
    /// By instance, pairs of view and pixels.
    views: Vec<Vec<(usize, u64)>>,
}

impl Coverage {
    /// Nothing yet, of so many instances.
    #[must_use]
    pub fn new(instances: usize) -> Self {
        Self { views: vec![Vec::new(); instances] }
    }

    /// Counts the labels of a view: dense index + 1, 0 for nobody's.
    pub fn add(&mut self, view: usize, labels: &PixelGrid<u16>) {
        let mut counts = vec![0_u64; self.views.len()];
        for label in &labels.pixels {
            if let Some(count) = usize::from(*label).checked_sub(1).and_then(|index| counts.get_mut(index)) {
                *count += 1;
            }
        }
        for (views, count) in self.views.iter_mut().zip(counts) {
            if count > 0 {
                views.push((view, count));
            }
        }
    }

    /// At most `most` views of an instance, by its pixels in them; of equal ones the earlier. Those with less than a
    /// quarter of the pixels of the best do not count.
    #[must_use]
    pub fn best(&self, instance: usize, most: usize) -> Vec<usize> {
        let mut views = self.views[instance].clone();
        views.sort_by_key(|(view, count)| (std::cmp::Reverse(*count), *view));
        let least = views.first().map_or(0.0, |(_, count)| *count as f64 * WORTHY);
        views
            .into_iter()
            .take(most)
            .filter(|(_, count)| *count as f64 >= least)
            .map(|(view, _)| view)
            .collect()
    }
}

/// The smallest square around the pixels that have a label, black where they have not; `None` where none has.
#[must_use]
pub fn cut_out(picture: &Picture, labels: &PixelGrid<u16>, label: u16) -> Option<Picture> {
    let width = picture.width as usize;
    let places = || {
        let is_inside = |at: &usize| labels.pixels[*at] == label;
        (0..picture.pixels.len()).filter(is_inside).map(|at| (at % width, at / width))
    };
    let (left, right) = (places().map(|(x, _)| x).min()?, places().map(|(x, _)| x).max()?);
    let (top, bottom) = (places().map(|(_, y)| y).min()?, places().map(|(_, y)| y).max()?);
    let (columns, rows) = (right + 1 - left, bottom + 1 - top);
    let side = columns.max(rows);
    let mut square = Picture::filled(side as u32, side as u32, [0; 3]);
    let (across, down) = ((side - columns) / 2, (side - rows) / 2);
    for (x, y) in places() {
        square.pixels[(y - top + down) * side + x - left + across] = picture.pixels[y * width + x];
    }
    Some(square)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(pixels: &[u16]) -> PixelGrid<u16> {
        PixelGrid::from_pixels(4, pixels.len() as u32 / 4, pixels.to_vec())
    }

    #[test]
    fn the_best_views_show_most() {
        let mut coverage = Coverage::new(3);
        coverage.add(3, &labels(&[1, 1, 1, 2]));
        coverage.add(5, &labels(&[1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 9, 2]));
        coverage.add(8, &labels(&[1, 1, 1, 1]));
        coverage.add(9, &labels(&[2, 1, 1, 1, 1, 0, 0, 0]));
        assert_eq!(coverage.best(0, 8), [5, 8, 9], "three pixels are less than a quarter of thirteen");
        assert_eq!(coverage.best(0, 2), [5, 8]);
        assert_eq!(coverage.best(1, 8), [3, 5, 9]);
        assert!(coverage.best(2, 8).is_empty());
    }

    #[test]
    fn cut_outs_are_square_and_show_nothing_else() {
        let picture = Picture::from_pixels(4, 3, (1..=12).map(|at| [at; 3]).collect());
        let of = labels(&[0, 0, 0, 0, 0, 7, 7, 7, 0, 7, 5, 0]);
        let square = cut_out(&picture, &of, 7).unwrap();
        assert_eq!((square.width, square.height), (3, 3));
        let values: Vec<u8> = square.pixels.iter().map(|pixel| pixel[0]).collect();
        assert_eq!(values, [6, 7, 8, 10, 0, 0, 0, 0, 0]);
        assert_eq!(cut_out(&picture, &of, 3), None);
    }
}
