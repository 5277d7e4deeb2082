//! The part of a picture in which runs differ most from the truth and from one another.

use cif_geometry::PixelGrid;

/// Shares of width and height that a crop has: one in so many.
const PARTS: u32 = 3;

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Crop {
    pub(super) x: u32,
    pub(super) y: u32,
    pub(super) width: u32,
    pub(super) height: u32,
}

impl Crop {
    /// The window in which most pixels of `pictures` differ from `truth` where that is not `empty`, the first of equals.
    /// `None` for pictures of other sizes than the truth, or without pixels.
    pub(super) fn of_differences(
        truth: &PixelGrid<[u8; 3]>,
        pictures: &[&PixelGrid<[u8; 3]>],
        empty: [u8; 3],
    ) -> Option<Self> {
        let (columns, rows) = (truth.width, truth.height);
        if columns == 0 || rows == 0 || pictures.iter().any(|p| (p.width, p.height) != (columns, rows)) {
            return None;
        }
        let (width, height) = (columns.div_ceil(PARTS), rows.div_ceil(PARTS));
        // Sums over everything above and to the left.
        let stride = columns as usize + 1;
        let mut sums = vec![0_u64; stride * (rows as usize + 1)];
        for y in 0..rows as usize {
            for x in 0..columns as usize {
                let pixel = y * columns as usize + x;
                let expected = truth.pixels[pixel];
                let differs = |picture: &&&PixelGrid<[u8; 3]>| picture.pixels[pixel] != expected;
                let here = if expected == empty { 0 } else { pictures.iter().filter(differs).count() };
                let at = (y + 1) * stride + x + 1;
                sums[at] = here as u64 + sums[at - 1] + sums[at - stride] - sums[at - stride - 1];
            }
        }
        let inside = |x: u32, y: u32| {
            let at = |x: u32, y: u32| sums[y as usize * stride + x as usize];
            at(x + width, y + height) + at(x, y) - at(x, y + height) - at(x + width, y)
        };
        let places = (0..=rows - height).flat_map(|y| (0..=columns - width).map(move |x| (x, y)));
        let best = places.reduce(|a, b| if inside(b.0, b.1) > inside(a.0, a.1) { b } else { a })?;
        Some(Self { x: best.0, y: best.1, width, height })
    }

    /// The pixels of a picture inside it.
    pub(super) fn of(&self, picture: &PixelGrid<[u8; 3]>) -> PixelGrid<[u8; 3]> {
        let row = |y: u32| {
            let first = (y * picture.width + self.x) as usize;
            &picture.pixels[first..first + self.width as usize]
        };
        let pixels = (self.y..self.y + self.height).flat_map(row).copied().collect();
        PixelGrid::from_pixels(self.width, self.height, pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_with_most_differences_is_found() {
        let truth = PixelGrid::from_pixels(9, 6, vec![[1; 3]; 54]);
        let mut one = truth.clone();
        for (x, y) in [(0, 0), (6, 3), (7, 3), (8, 4)] {
            one.pixels[y * 9 + x] = [2; 3];
        }
        let crop = Crop::of_differences(&truth, &[&one, &truth], [0; 3]).unwrap();
        assert_eq!(crop, Crop { x: 6, y: 3, width: 3, height: 2 });
        assert_eq!(crop.of(&one).pixels.iter().filter(|pixel| **pixel == [2; 3]).count(), 3);
        // Nothing is expected where there is no label.
        assert_eq!(Crop::of_differences(&truth, &[&one], [1; 3]).map(|c| (c.x, c.y)), Some((0, 0)));
        let other = PixelGrid::from_pixels(2, 2, vec![[1; 3]; 4]);
        assert_eq!(Crop::of_differences(&truth, &[&other], [0; 3]), None);
    }
}
