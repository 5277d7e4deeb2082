//! Which labelled things lie behind an object, so that they cannot hide it: what carries it, or what it passes before.

use std::sync::Arc;

use cif_dataset::Dataset;
use cif_render::UNLABELLED;

use super::view::{ObjectLabel, median};
use crate::error::TrainError;
use crate::frames::FrameStore;
use crate::mask_table::MaskTable;
use crate::phases::Phases;

/// Share of the outline that one label has where it surrounds an object, and that counts as touching it.
const SURROUNDS: f64 = 0.9;
const TOUCHES: f64 = 0.05;

/// Fewest images in which a label surrounds an object that it lies behind, and their share of those in which both
/// touch.
const FEWEST: usize = 3;
const SHARE: f64 = 0.3;

/// Area, of that where it is surrounded, below which an object is hidden, and the share of the images in which a
/// label touches it from one side that make it one that hides.
const HIDDEN: f64 = 0.6;
const HIDES: f64 = 0.25;

/// Labels behind each label.
pub(crate) struct Order {
    behind: Vec<Arc<[bool]>>,
}

/// Mask of an object in an image.
pub(super) struct Mask {
    label: u16,
    /// Pixels.
    area: f64,
    /// Labels adjacent to it, by their shares of its outline.
    adjacent: Vec<(u16, f64)>,
}

impl Order {
    /// Order of the labels of all frames: what surrounds the mask of an object is behind it, for masks have no holes
    /// but those that something in front makes; unless it hides the object at other times.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(crate) fn of(dataset: &Dataset, frames: &FrameStore, phases: &Phases) -> Result<Self, TrainError> {
        let labels = dataset.instances.len() + 1;
        let tables = frames.masks(dataset, phases)?;
        let found: Vec<Mask> = tables.iter().flatten().flat_map(masks).collect();
        Ok(Self::among(&found, labels))
    }

    pub(super) fn among(masks: &[Mask], labels: usize) -> Self {
        let behind = |label: usize| {
            let of = || masks.iter().filter(move |mask| usize::from(mask.label) == label);
            let is_behind = |other: usize| other > 0 && other != label && lies_behind(of(), other as u16);
            (0..labels).map(is_behind).collect()
        };
        Self { behind: (0..labels).map(behind).collect() }
    }

    /// A label (dense index + 1) with those behind it.
    pub(super) fn of_label(&self, label: u16) -> ObjectLabel {
        ObjectLabel { label, behind: Arc::clone(&self.behind[usize::from(label)]) }
    }
}

/// True where a label lies behind the object of some masks.
fn lies_behind<'a>(masks: impl Iterator<Item = &'a Mask>, other: u16) -> bool {
    let (mut surrounded, mut touched) = (Vec::new(), Vec::new());
    for mask in masks {
        match mask.adjacent.iter().find(|(label, _)| *label == other) {
            Some((_, share)) if *share >= SURROUNDS => surrounded.push(mask.area),
            Some((_, share)) if *share > TOUCHES && !touches_more(mask, other) => touched.push(mask.area),
            _ => {}
        }
    }
    let all = (surrounded.len() + touched.len()) as f64;
    if surrounded.len() < FEWEST || (surrounded.len() as f64) < SHARE * all {
        return false;
    }
    let whole = median(&mut surrounded);
    let hidden = touched.iter().filter(|area| **area < HIDDEN * whole).count();
    hidden as f64 <= HIDES * touched.len() as f64
}

/// True where a mask touches further labels, any of which may hide its object.
fn touches_more(mask: &Mask, other: u16) -> bool {
    mask.adjacent.iter().any(|(label, share)| ![UNLABELLED, other].contains(label) && *share > TOUCHES)
}

/// Masks of an image.
fn masks(table: &MaskTable) -> impl Iterator<Item = Mask> {
    table.rows.iter().map(|(label, row)| {
        let mut outline = row.touches.clone();
        if row.border > 0 {
            // The border of the image surrounds nothing.
            *outline.entry(UNLABELLED).or_default() += row.border;
        }
        let whole = f64::from(outline.values().sum::<u32>());
        let adjacent = outline.into_iter().map(|(other, pixels)| (other, f64::from(pixels) / whole));
        Mask { label: *label, area: f64::from(row.pixels), adjacent: adjacent.collect() }
    })
}

#[cfg(test)]
mod tests {
    use cif_geometry::PixelGrid;

    use super::*;

    /// Images of a block (1), which passes a screen (3) before or behind it, on a board (2) if there is one.
    fn images(hides: bool, board: [u32; 4]) -> Vec<Mask> {
        let image = |k: u32| {
            let mut grid = PixelGrid::filled(40, 40, UNLABELLED);
            let screen = [17, 5, 33, 39];
            let block = [4 + 2 * k, 10, 10 + 2 * k, 20];
            let parts = if hides { [(1, block), (3, screen)] } else { [(3, screen), (1, block)] };
            for (label, [x0, y0, x1, y1]) in [(2, board)].into_iter().chain(parts) {
                for (x, y) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))) {
                    grid.pixels[(y * 40 + x) as usize] = label;
                }
            }
            grid
        };
        (0..13).flat_map(|k| masks(&MaskTable::of(&image(k))).collect::<Vec<_>>()).collect()
    }

    #[test]
    fn what_surrounds_an_object_is_behind_it_unless_it_hides_it() {
        for hides in [true, false] {
            let order = Order::among(&images(hides, [2, 2, 38, 30]), 4);
            assert_eq!(order.of_label(1).behind[..], [false, false, true, !hides], "{hides}");
            assert_eq!(order.of_label(2).behind[..], [false; 4]);
            assert_eq!(order.of_label(3).behind[..], [false; 4]);
        }
    }

    #[test]
    fn what_hides_an_object_now_and_then_is_not_behind_it() {
        let (before, after) = (images(false, [0; 4]), images(true, [0; 4]));
        let order = Order::among(&before.into_iter().chain(after).collect::<Vec<_>>(), 4);
        assert!(!order.of_label(1).behind[3]);
    }
}
