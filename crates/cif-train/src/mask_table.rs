//! Masks as numbers: what every label of a frame covers, read in one pass over its pixels. Whoever asks where masks
//! are, how large, or what they touch asks these tables.

use std::collections::BTreeMap;

use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::UNLABELLED;
use glam::DVec2;

use crate::tracks::Observation;

/// Fewest pixels of a mask that say where an object is.
const FEWEST_PIXELS: u32 = 12;

/// The mask of one label in a frame.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct MaskRow {
    /// Its pixels.
    pub pixels: u32,
    /// First and last column and row of its box.
    pub low: [u32; 2],
    pub high: [u32; 2],
    /// Sum of its pixel centres.
    sum: DVec2,
    /// Sides of its pixels on the border of the image.
    pub border: u32,
    /// Sides of its pixels that touch another label, or [`UNLABELLED`].
    pub touches: BTreeMap<u16, u32>,
}

impl MaskRow {
    fn at(x: u32, y: u32) -> Self {
        Self { pixels: 0, low: [x, y], high: [x, y], sum: DVec2::ZERO, border: 0, touches: BTreeMap::new() }
    }

    fn add(&mut self, x: u32, y: u32) {
        self.pixels += 1;
        self.low = [self.low[0].min(x), self.low[1].min(y)];
        self.high = [self.high[0].max(x), self.high[1].max(y)];
        self.sum += DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
    }

    /// Mean of its pixel centres.
    pub(crate) fn centroid(&self) -> DVec2 {
        self.sum / f64::from(self.pixels)
    }

    /// True where the border of the image cuts it, so that its area says nothing.
    pub(crate) fn is_cut(&self) -> bool {
        self.border > 0
    }

    /// Its area over its border, pixels: half the width of a strip.
    pub(crate) fn half_width_px(&self) -> f64 {
        f64::from(self.pixels) / f64::from(self.border + self.touches.values().sum::<u32>()).max(1.0)
    }

    /// The mask as seen by the camera of a frame; `None` of a few pixels.
    pub(crate) fn observation(&self, camera: &PinholeCamera, time_index: usize) -> Option<Observation> {
        (self.pixels >= FEWEST_PIXELS).then(|| Observation {
            time_index,
            camera: *camera,
            centroid_px: self.centroid(),
            area_px: f64::from(self.pixels),
            cut: [(0, camera.width), (1, camera.height)]
                .map(|(axis, size)| self.low[axis] == 0 || self.high[axis] + 1 >= size),
            contact_depth: None,
        })
    }
}

/// The masks of a frame, by label.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct MaskTable {
    pub rows: BTreeMap<u16, MaskRow>,
}

impl MaskTable {
    /// Reads the masks of a frame.
    pub(crate) fn of(labels: &PixelGrid<u16>) -> Self {
        let (width, height) = (labels.width, labels.height);
        let mut rows: BTreeMap<u16, MaskRow> = BTreeMap::new();
        for y in 0..height {
            for x in 0..width {
                let label = *labels.at(x, y);
                if label == UNLABELLED {
                    continue;
                }
                let row = rows.entry(label).or_insert_with(|| MaskRow::at(x, y));
                row.add(x, y);
                for (x, y) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                    if x >= width || y >= height {
                        row.border += 1;
                        continue;
                    }
                    let other = *labels.at(x, y);
                    if other != label {
                        *row.touches.entry(other).or_default() += 1;
                    }
                }
            }
        }
        Self { rows }
    }

    /// The masks as seen by the camera of the frame, without those of a few pixels.
    pub(crate) fn observations(
        &self,
        camera: &PinholeCamera,
        time_index: usize,
    ) -> BTreeMap<u16, Observation> {
        let seen = |(label, row): (&u16, &MaskRow)| Some((*label, row.observation(camera, time_index)?));
        self.rows.iter().filter_map(seen).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_holds_what_masks_cover_and_touch() {
        // A block of 3 x 2 on the left border, a bar of two pixels next to it.
        let label = |x: u32, y: u32| match (x, y) {
            (0..3, 1..3) => 4,
            (3, 1..3) => 7,
            _ => UNLABELLED,
        };
        let pixels = (0..5).flat_map(|y| (0..6).map(move |x| label(x, y))).collect();
        let table = MaskTable::of(&PixelGrid::from_pixels(6, 5, pixels));
        assert_eq!(table.rows.keys().collect::<Vec<_>>(), [&4, &7]);
        let block = &table.rows[&4];
        assert_eq!((block.pixels, block.low, block.high), (6, [0, 1], [2, 2]));
        assert_eq!((block.centroid(), block.is_cut(), block.border), (DVec2::new(1.5, 2.0), true, 2));
        assert_eq!(block.touches, BTreeMap::from([(UNLABELLED, 6), (7, 2)]));
        assert_eq!(block.half_width_px(), 0.6);
        let bar = &table.rows[&7];
        assert_eq!((bar.pixels, bar.is_cut()), (2, false));
        assert_eq!(bar.touches, BTreeMap::from([(UNLABELLED, 4), (4, 2)]));
    }
}
