//! Which tiles of a view are drawn at once, so that memory follows a budget and not the image.

use super::bin::{PAIR_BYTES, TileRegion};
use super::project::Splat;

/// Rows of tiles over the full width of a view, in the parts that are drawn at once, from left to right. More than
/// one part has a band of a single row alone.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Band {
    pub(super) parts: Vec<TileRegion>,
}

impl Band {
    /// First row of tiles, and how many there are.
    pub(super) fn rows(&self) -> (u32, u32) {
        self.parts.first().map_or((0, 0), |part| (part.first_row, part.rows))
    }
}

/// Bands of a view from top to bottom, each as high as fits into a budget in bytes: `tile_bytes` for every tile, and
/// those of the (tile, splat) pairs of the rectangles around the drawn ellipses, of which real pairs are a part. A
/// row of tiles that does not fit is drawn in parts; a part has at least one tile.
pub(super) fn bands(splats: &[Splat], whole: TileRegion, tile_bytes: u64, budget: u64) -> Vec<Band> {
    let row_bytes = u64::from(whole.columns) * tile_bytes;
    let pairs = pairs_along(1, splats, &whole);
    let mut bands: Vec<Band> = Vec::new();
    let mut room = 0;
    for row in 0..whole.rows {
        let bytes = row_bytes + pairs[row as usize] * PAIR_BYTES;
        let region = TileRegion { first_row: whole.first_row + row, rows: 1, ..whole };
        if bytes <= room
            && let Some(Band { parts }) = bands.last_mut()
        {
            parts[0].rows += 1;
            room -= bytes;
        } else if bytes <= budget {
            bands.push(Band { parts: vec![region] });
            room = budget - bytes;
        } else {
            // Pictures of the row are kept whole; pairs take what is left, and half of the budget where little is.
            let for_pairs = budget.saturating_sub(row_bytes).max(budget / 2);
            bands.push(Band { parts: parts(splats, region, for_pairs) });
            room = 0;
        }
    }
    if bands.is_empty() {
        bands.push(Band { parts: vec![whole] });
    }
    bands
}

/// Parts of a row of tiles whose pairs fit into so many bytes.
fn parts(splats: &[Splat], row: TileRegion, budget: u64) -> Vec<TileRegion> {
    let pairs = pairs_along(0, splats, &row);
    let mut parts: Vec<TileRegion> = Vec::new();
    let mut room = 0;
    for column in 0..row.columns {
        let bytes = pairs[column as usize] * PAIR_BYTES;
        match parts.last_mut() {
            Some(part) if bytes <= room => {
                part.columns += 1;
                room -= bytes;
            }
            _ => {
                parts.push(TileRegion { first_column: row.first_column + column, columns: 1, ..row });
                room = budget.saturating_sub(bytes);
            }
        }
    }
    parts
}

/// Pairs of every column (axis 0) or row (axis 1) of a region.
fn pairs_along(axis: usize, splats: &[Splat], region: &TileRegion) -> Vec<u64> {
    let (first, count) = match axis {
        0 => (region.first_column, region.columns),
        _ => (region.first_row, region.rows),
    };
    // Where splats begin and end, then the sums.
    let mut changes = vec![0_i64; count as usize + 1];
    for splat in splats {
        let reached = region.reached(splat);
        let (along, across) = (&reached[axis], reached[1 - axis].len() as i64);
        changes[(along.start - first) as usize] += across;
        changes[(along.end - first) as usize] -= across;
    }
    let mut sum = 0;
    changes.pop();
    changes
        .into_iter()
        .map(|change| {
            sum += change;
            sum as u64
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A splat whose drawn ellipse lies in the rectangle `[x, y]` to `[x, y]`, pixels.
    fn splat(low: [f32; 2], high: [f32; 2]) -> Splat {
        Splat {
            mean: [0, 1].map(|axis| 0.5 * (low[axis] + high[axis])),
            factor: [1.0, 0.0, 1.0],
            color: [0.5; 3],
            opacity: 0.5,
            occupancy: 0.5,
            depth: 2.0,
            order: 2.0,
            reach: [4.0; 2],
            extent: [0, 1].map(|axis| 0.5 * (high[axis] - low[axis])),
            radius: 1.0,
            gaussian: 0,
        }
    }

    /// Every tile once, row by row.
    fn assert_partition(bands: &[Band], whole: TileRegion) {
        let mut row = 0;
        for band in bands {
            assert_eq!(band.rows().0, row);
            let mut column = 0;
            for part in &band.parts {
                assert_eq!((part.first_row, part.rows, part.first_column), (row, band.rows().1, column));
                column += part.columns;
            }
            assert_eq!(column, whole.columns);
            assert!(band.parts.len() == 1 || band.rows().1 == 1);
            row += band.rows().1;
        }
        assert_eq!(row, whole.rows);
    }

    #[test]
    fn pairs_are_those_of_the_rectangles() {
        let whole = TileRegion::whole(100, 60);
        // Tiles 1 to 2 by 0 to 2, and one beyond every side.
        let splats = [splat([17.0, 3.0], [40.0, 45.0]), splat([-1e6, 50.0], [1e6, 1e6])];
        assert_eq!(pairs_along(1, &splats, &whole), [2, 2, 2, 7]);
        assert_eq!(pairs_along(0, &splats, &whole), [1, 4, 4, 1, 1, 1, 1]);
        assert_eq!(pairs_along(0, &[splat([-90.0, 0.0], [-20.0, 50.0])], &whole), [0; 7]);
    }

    #[test]
    fn bands_are_as_high_as_the_budget_allows() {
        let whole = TileRegion::whole(100, 90);
        let heights = |splats: &[Splat], budget: u64| -> Vec<u32> {
            let bands = bands(splats, whole, 100, budget);
            assert_partition(&bands, whole);
            assert!(bands.iter().all(|band| band.parts.len() == 1));
            bands.iter().map(|band| band.rows().1).collect()
        };
        // 7 x 6 tiles.
        assert_eq!(heights(&[], 4200), [6]);
        assert_eq!(heights(&[], 4199), [5, 1]);
        assert_eq!(heights(&[], 1400), [2, 2, 2]);
        // One splat on all of the third row.
        let wide = [splat([-10.0, 33.0], [200.0, 40.0])];
        assert_eq!(heights(&wide, 1400), [2, 1, 2, 1]);
        assert_eq!(heights(&wide, 1400 + 7 * PAIR_BYTES), [2, 2, 2]);
    }

    #[test]
    fn rows_that_do_not_fit_are_drawn_in_parts() {
        let whole = TileRegion::whole(100, 90);
        let splats = vec![splat([-10.0, 33.0], [200.0, 40.0]); 50];
        let bands = bands(&splats, whole, 10, 70 + 100 * PAIR_BYTES);
        assert_partition(&bands, whole);
        let parts: Vec<Vec<u32>> =
            bands.iter().map(|band| band.parts.iter().map(|part| part.columns).collect()).collect();
        assert_eq!(parts, [vec![7], vec![2, 2, 2, 1], vec![7]]);
        // Nothing fits: tile by tile where there are pairs.
        let bands = super::bands(&splats, whole, 10, 1);
        assert_partition(&bands, whole);
        assert_eq!(bands[2].parts.len(), 7);
        assert_eq!((bands[0].parts.len(), bands.len()), (1, 6));
    }

    #[test]
    fn an_image_without_tiles_has_one_empty_band() {
        let bands = bands(&[], TileRegion::whole(0, 0), 10, 100);
        assert_eq!(bands.len(), 1);
        assert_eq!(bands[0].parts[0].tiles(), 0);
    }
}
