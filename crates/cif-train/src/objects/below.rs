//! Points that lie just below objects in the images of a capture: of what they stand on, mostly.

use cif_dataset::Dataset;
use cif_geometry::PixelGrid;
use cif_render::UNLABELLED;
use glam::DVec3;
use rayon::prelude::*;

use crate::error::TrainError;
use crate::frames::FrameStore;
use crate::mask_table::MaskTable;
use crate::phases::Phases;

/// Frames that are looked at.
const LOOKED: usize = 30;

/// Height of the band below an object, of that of its mask, and its limits of the height of the image.
const BAND: f64 = 0.4;
const LIMITS: [f64; 2] = [0.015, 0.1];

/// Points in the bands below the objects of training frames; one that several frames show is given once.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop.
pub(super) fn below(
    points: &[DVec3],
    dataset: &Dataset,
    frames: &FrameStore,
    phases: &Phases,
) -> Result<Vec<DVec3>, TrainError> {
    let tables = frames.masks(dataset, phases)?;
    let looked: Vec<usize> = (0..frames.len()).step_by(frames.len().div_ceil(LOOKED).max(1)).collect();
    let seen = |k: &usize| {
        phases.check()?;
        let frame = frames.get(dataset, *k)?;
        let camera = &dataset.frames[frames.index(*k)].camera;
        let Some((labels, table)) = frame.labels.as_ref().zip(tables[*k].as_ref()) else {
            return Ok(Vec::new());
        };
        let bands = bands(labels, table);
        let is_below = |point: &DVec3| camera.pixel_of(*point).is_some_and(|[x, y]| *bands.at(x, y));
        Ok((0..points.len()).filter(|k| is_below(&points[*k])).collect())
    };
    let seen: Vec<Vec<usize>> = looked.par_iter().map(seen).collect::<Result<_, TrainError>>()?;
    let mut seen: Vec<usize> = seen.into_iter().flatten().collect();
    seen.sort_unstable();
    seen.dedup();
    Ok(seen.into_iter().map(|k| points[k]).collect())
}

/// True of unlabelled pixels in the bands below masks, column by column.
fn bands(labels: &PixelGrid<u16>, table: &MaskTable) -> PixelGrid<bool> {
    let (width, height) = (labels.width as usize, labels.height as usize);
    // The rows that a label has in the whole image: a column may cut off a corner.
    let band = |label: u16| {
        let rows = table.rows.get(&label).map_or(0, |row| row.high[1] + 1 - row.low[1]);
        let [least, most] = LIMITS.map(|share| share * height as f64);
        (BAND * f64::from(rows)).clamp(least, most).ceil() as usize
    };
    let mut bands = PixelGrid::filled(labels.width, labels.height, false);
    for x in 0..width {
        let (mut above, mut left) = (UNLABELLED, 0);
        for y in 0..height {
            let label = labels.pixels[y * width + x];
            if label != UNLABELLED {
                (above, left) = (label, band(label));
            } else if above != UNLABELLED && left > 0 {
                bands.pixels[y * width + x] = true;
                left -= 1;
            }
        }
    }
    bands
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_lie_below_masks_and_are_as_high_as_these_allow() {
        // A mask of 20 rows, of which a corner is cut off, above one of 2 rows, in 100 rows.
        let label = |x: usize, y: usize| match (x, y) {
            (10..20, 30..50) if !(x < 12 && y >= 45) => 1,
            (10..20, 52..54) => 2,
            _ => 0,
        };
        let pixels = (0..100).flat_map(|y| (0..40).map(move |x| label(x, y))).collect();
        let labels = PixelGrid::from_pixels(40, 100, pixels);
        let bands = bands(&labels, &MaskTable::of(&labels));
        let rows = |x: usize| (0..100).filter(|y| bands.pixels[y * 40 + x]).collect::<Vec<_>>();
        assert_eq!(rows(15), [50, 51, 54, 55]);
        assert_eq!(rows(11), [45, 46, 47, 48, 49, 50, 51, 54, 55]);
        assert!(rows(9).is_empty() && rows(20).is_empty());
    }
}
