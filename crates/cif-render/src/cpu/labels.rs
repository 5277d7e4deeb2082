//! The labels that a tile's pixels want, and what a Gaussian's identity row says of them.

use cif_field::Identities;
use cif_geometry::PixelGrid;
use fearless_simd::f32x16;
use fearless_simd::prelude::*;

use super::pixels::{LANES, splat};
use super::tile::{GROUPS, TilePlace};

/// Rows longer than this are searched by halving.
const SHORT_ROW: usize = 16;

/// Which slots of the tile's label list each pixel wants.
#[derive(Clone, Debug)]
pub(super) struct TileLabels {
    /// Dense instance indices that occur in the tile, ascending.
    pub(super) labels: Vec<u16>,
    /// Slot per pixel; 0 where unlabelled.
    pub(super) slots: [[u8; LANES]; GROUPS],
    /// The one slot of all labelled pixels of a group, or `None` when they differ.
    pub(super) uniform: [Option<u8>; GROUPS],
    /// Pixels that carry a label.
    pub(super) labelled: [u16; GROUPS],
}

impl TileLabels {
    /// Labels of a tile; `None` when no pixel carries one. The map holds dense index + 1, 0 = unlabelled.
    pub(super) fn new(map: &PixelGrid<u16>, place: &TilePlace) -> Option<Self> {
        let mut of_pixels = [[0_u16; LANES]; GROUPS];
        let mut labels = Vec::new();
        let mut last = 0;
        for group in 0..GROUPS {
            for lane in 0..LANES {
                let label = place.pixel(group, lane).map_or(0, |pixel| map.pixels[pixel]);
                of_pixels[group][lane] = label;
                // Neighbours mostly agree.
                if label != last && label > 0 && !labels.contains(&(label - 1)) {
                    labels.push(label - 1);
                }
                last = label;
            }
        }
        if labels.is_empty() {
            return None;
        }
        labels.sort_unstable();
        let mut tile =
            Self { labels, slots: [[0; LANES]; GROUPS], uniform: [None; GROUPS], labelled: [0; GROUPS] };
        let (mut last, mut slot) = (0, 0);
        for group in 0..GROUPS {
            let (mut first, mut mixed) = (None, false);
            for lane in 0..LANES {
                let label = of_pixels[group][lane];
                if label == 0 {
                    continue;
                }
                if label != last {
                    slot = tile.labels.binary_search(&(label - 1)).expect("collected above") as u8;
                    last = label;
                }
                tile.slots[group][lane] = slot;
                tile.labelled[group] |= 1 << lane;
                mixed |= *first.get_or_insert(slot) != slot;
            }
            tile.uniform[group] = if mixed { None } else { first.or(Some(0)) };
        }
        Some(tile)
    }

    /// Lanes of a group that carry a label.
    pub(super) fn labelled_lanes(&self, group: usize) -> impl Iterator<Item = usize> + use<> {
        let labelled = self.labelled[group];
        (0..LANES).filter(move |lane| labelled >> lane & 1 == 1)
    }

    /// The value of each pixel's own label slot, and whether any is above 0.
    #[inline(always)]
    pub(super) fn gather<S: Simd>(&self, simd: S, group: usize, values: &[f32]) -> (f32x16<S>, bool) {
        match self.uniform[group] {
            Some(slot) => {
                let value = values[slot as usize];
                (splat(simd, value), value > 0.0)
            }
            None => {
                let found = f32x16::load_array(simd, self.slots[group].map(|slot| values[slot as usize]));
                (found, found.simd_gt(splat(simd, 0.0)).to_bitmask() != 0)
            }
        }
    }
}

/// Identity rows as the raster loops read them.
#[derive(Clone, Copy, Debug)]
pub(super) struct IdentityRows<'a> {
    pub(super) row_offsets: &'a [u32],
    pub(super) labels: &'a [u16],
    pub(super) probabilities: &'a [f32],
}

impl<'a> IdentityRows<'a> {
    /// Rows with their probabilities, one per entry.
    pub(super) fn new(identities: &'a Identities, probabilities: &'a [f32]) -> Self {
        Self { row_offsets: &identities.row_offsets, labels: &identities.labels, probabilities }
    }

    /// Entries of a Gaussian.
    #[inline(always)]
    pub(super) fn entries(&self, gaussian: u32) -> std::ops::Range<usize> {
        self.row_offsets[gaussian as usize] as usize..self.row_offsets[gaussian as usize + 1] as usize
    }

    /// Probabilities of a Gaussian at the tile's labels.
    #[inline(always)]
    pub(super) fn at_labels(&self, gaussian: u32, tile_labels: &[u16], out: &mut [f32]) {
        let range = self.entries(gaussian);
        let labels = &self.labels[range.clone()];
        let probabilities = &self.probabilities[range];
        for (requested, out) in tile_labels.iter().zip(out) {
            let entry = if labels.len() <= SHORT_ROW {
                labels.iter().position(|label| label == requested)
            } else {
                labels.binary_search(requested).ok()
            };
            *out = entry.map_or(0.0, |entry| probabilities[entry]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_name_each_pixel_its_own_label() {
        let mut map = PixelGrid::filled(20, 18, 7);
        map.pixels[0] = 0;
        map.pixels[5] = 65_535;
        map.pixels[20 * 17 + 19] = 3;
        let place = TilePlace { x: 0, y: 0, width: 20, height: 18 };
        let tile = TileLabels::new(&map, &place).unwrap();
        assert_eq!(tile.labels, [6, 65_534]);
        assert_eq!((tile.uniform[0], tile.uniform[1]), (None, Some(0)));
        assert_eq!(tile.labelled[0], 0xfffe);
        assert_eq!((tile.slots[0][4], tile.slots[0][5]), (0, 1));
        // The tile at the corner: four columns and two rows lie in the image.
        let corner = TileLabels::new(&map, &TilePlace { x: 16, y: 16, ..place }).unwrap();
        assert_eq!(corner.labels, [2, 6]);
        assert_eq!(corner.labelled.iter().map(|bits| bits.count_ones()).sum::<u32>(), 8);
        map.pixels.fill(0);
        assert!(TileLabels::new(&map, &place).is_none());
    }

    #[test]
    fn every_pixel_of_a_tile_may_have_its_own_label() {
        let mut map = PixelGrid::filled(16, 16, 0);
        for (position, label) in map.pixels.iter_mut().enumerate() {
            *label = 1000 + position as u16;
        }
        let tile = TileLabels::new(&map, &TilePlace { x: 0, y: 0, width: 16, height: 16 }).unwrap();
        assert_eq!(tile.labels.len(), 256);
        assert_eq!((tile.slots[0][0], tile.slots[GROUPS - 1][LANES - 1]), (0, 255));
    }

    #[test]
    fn long_and_short_rows_find_the_same() {
        let labels: Vec<u16> = (0..40).map(|k| 3 * k).collect();
        let probabilities: Vec<f32> = (0..40).map(|k| k as f32).collect();
        for length in [1, SHORT_ROW, SHORT_ROW + 1, 40] {
            let rows = IdentityRows {
                row_offsets: &[0, length as u32],
                labels: &labels[..length],
                probabilities: &probabilities[..length],
            };
            let mut out = [9.0; 3];
            rows.at_labels(0, &[0, 4, 45], &mut out);
            assert_eq!(out, [0.0, 0.0, if length > 15 { 15.0 } else { 0.0 }], "{length}");
        }
    }
}
