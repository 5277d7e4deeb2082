//! Lines drawn over pictures.

use std::collections::BTreeMap;

use glam::DVec2;

use super::Picture;

/// A line through points of a picture; the pixel (i, j) has its centre at (i + 0.5, j + 0.5).
#[derive(Clone, Debug, PartialEq)]
pub struct Polyline {
    /// Corners, pixels; one alone is a dot.
    pub points: Vec<DVec2>,
    /// Colour.
    pub color: [u8; 3],
    /// Share of the colour in pixels that the line covers, 0 to 1.
    pub opacity: f64,
    /// Width, pixels.
    pub width: f64,
}

impl Polyline {
    /// Draws the line into rows of a picture, the first of which is `first_row` of the whole. Edges are smooth, and
    /// where the line crosses itself it is drawn once.
    pub fn draw(&self, rows: &mut Picture, first_row: u32) {
        let shift = DVec2::new(0.0, f64::from(first_row));
        let points: Vec<DVec2> = self.points.iter().map(|point| *point - shift).collect();
        let mut covered: BTreeMap<usize, f64> = BTreeMap::new();
        if let [dot] = points[..] {
            self.cover(&mut covered, rows, dot, dot);
        }
        for ends in points.windows(2) {
            self.cover(&mut covered, rows, ends[0], ends[1]);
        }
        for (pixel, coverage) in covered {
            let pixel = &mut rows.pixels[pixel];
            let share = (coverage * self.opacity).clamp(0.0, 1.0);
            for (value, color) in pixel.iter_mut().zip(self.color) {
                *value = (f64::from(*value) * (1.0 - share) + f64::from(color) * share).round() as u8;
            }
        }
    }

    /// Adds the pixels that a segment covers, each with the largest coverage that any segment gives it.
    fn cover(&self, covered: &mut BTreeMap<usize, f64>, rows: &Picture, from: DVec2, to: DVec2) {
        let reach = self.width / 2.0 + 1.0;
        let size = DVec2::new(f64::from(rows.width), f64::from(rows.height));
        let (low, high) = (from.min(to) - reach, from.max(to) + reach);
        if !(low.is_finite() && high.is_finite() && low.cmplt(size).all() && high.cmpge(DVec2::ZERO).all()) {
            return;
        }
        let (low, high) = (low.max(DVec2::ZERO), high.min(size - 1.0));
        let along = to - from;
        for y in low.y as u32..=high.y as u32 {
            for x in low.x as u32..=high.x as u32 {
                let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let share = (centre - from).dot(along) / along.length_squared();
                let nearest = from + along * if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 };
                let coverage = (self.width / 2.0 + 0.5 - centre.distance(nearest)).clamp(0.0, 1.0);
                if coverage > 0.0 {
                    let pixel = y as usize * rows.width as usize + x as usize;
                    let most = covered.entry(pixel).or_default();
                    *most = most.max(coverage);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: &[[f64; 2]]) -> Polyline {
        let points = points.iter().map(|point| DVec2::from_array(*point)).collect();
        Polyline { points, color: [200, 100, 0], opacity: 1.0, width: 1.0 }
    }

    #[test]
    fn lines_cover_the_pixels_that_they_cross() {
        let mut picture = Picture::filled(6, 4, [0; 3]);
        line(&[[1.5, 1.5], [4.5, 1.5]]).draw(&mut picture, 0);
        for x in 0..6 {
            let expected = if (1..5).contains(&x) { [200, 100, 0] } else { [0; 3] };
            assert_eq!(*picture.at(x, 1), expected, "{x}");
            assert_eq!(*picture.at(x, 3), [0; 3]);
        }
        // Between two rows it is shared by them.
        let mut picture = Picture::filled(6, 4, [0; 3]);
        line(&[[1.5, 2.0], [4.5, 2.0]]).draw(&mut picture, 0);
        assert_eq!((*picture.at(2, 1), *picture.at(2, 2)), ([100, 50, 0], [100, 50, 0]));
    }

    #[test]
    fn a_faint_line_is_drawn_once_where_it_turns_back() {
        let mut picture = Picture::filled(6, 3, [0; 3]);
        let faint = Polyline { opacity: 0.5, ..line(&[[1.5, 1.5], [4.5, 1.5], [2.5, 1.5]]) };
        faint.draw(&mut picture, 0);
        assert_eq!([1, 3, 4].map(|x| *picture.at(x, 1)), [[100, 50, 0]; 3]);
    }

    #[test]
    fn bands_show_what_the_whole_shows() {
        let lines = [line(&[[-3.0, -2.0], [4.0, 7.3], [20.0, 2.0], [5.0, 5.0]]), line(&[[3.3, 4.1]])];
        let mut whole = Picture::filled(9, 8, [50; 3]);
        lines.iter().for_each(|line| line.draw(&mut whole, 0));
        assert!(whole.pixels.iter().any(|pixel| pixel[0] > 150));
        for first in [0, 3, 6] {
            let mut band = Picture::filled(9, 2, [50; 3]);
            lines.iter().for_each(|line| line.draw(&mut band, first));
            assert_eq!(band.pixels[..], whole.pixels[9 * first as usize..9 * (first + 2) as usize]);
        }
    }

    #[test]
    fn lines_elsewhere_and_without_place_draw_nothing() {
        let mut picture = Picture::filled(4, 4, [7; 3]);
        for points in [vec![], vec![[9.0, 9.0], [12.0, 9.0]], vec![[f64::NAN, 0.0], [1.0, 1.0]]] {
            line(&points).draw(&mut picture, 0);
        }
        line(&[[f64::INFINITY, 0.0], [1.0, 1.0]]).draw(&mut picture, 0);
        assert_eq!(picture, Picture::filled(4, 4, [7; 3]));
    }
}
