//! Depth order and tile lists. Source: methods reference 3.1 (sorting, exact tile test).

use rayon::prelude::*;

use super::project::Splat;
use crate::constants::TILE;

/// Which splats each tile draws, front to back.
///
/// Pairs are stored by tile. Every splat also knows where its own pairs went, so that sums over a splat's
/// pairs run in a fixed order whatever the number of threads.
#[derive(Debug, Default)]
pub(super) struct TileLists {
    pub(super) columns: u32,
    pub(super) rows: u32,
    /// `[tiles + 1]` first pair of each tile.
    pub(super) tile_offsets: Vec<u32>,
    /// `[pairs]` rank of the splat (index into the depth-sorted splats).
    pub(super) ranks: Vec<u32>,
    /// `[splats + 1]` first entry of each splat in `splat_pairs`.
    pub(super) splat_offsets: Vec<u32>,
    /// `[pairs]` position in `ranks` of each of a splat's pairs.
    pub(super) splat_pairs: Vec<u32>,
}

/// Sorts splats front to back; ties keep the order of the Gaussians.
pub(super) fn sort_by_depth(splats: &mut [Splat]) {
    // Positive floats order like their bits; the index breaks ties.
    splats.par_sort_unstable_by_key(|splat| {
        (u64::from(splat.order.to_bits()) << 32) | u64::from(splat.gaussian)
    });
}

/// Smallest sigma of a splat over a tile's pixel centres' bounding rectangle.
fn smallest_sigma(splat: &Splat, low: [f32; 2], high: [f32; 2]) -> f32 {
    let [x00, x01, x11] = splat.conic;
    // Rectangle relative to the mean.
    let (x_low, x_high) = (low[0] - splat.mean[0], high[0] - splat.mean[0]);
    let (y_low, y_high) = (low[1] - splat.mean[1], high[1] - splat.mean[1]);
    let inside_x = x_low <= 0.0 && x_high >= 0.0;
    let inside_y = y_low <= 0.0 && y_high >= 0.0;
    if inside_x && inside_y {
        return 0.0;
    }
    let mut smallest = f32::INFINITY;
    if !inside_x {
        let x = if x_low > 0.0 { x_low } else { x_high };
        let y = (-x01 * x / x11).clamp(y_low, y_high);
        smallest = smallest.min(0.5 * (x00 * x * x + x11 * y * y) + x01 * x * y);
    }
    if !inside_y {
        let y = if y_low > 0.0 { y_low } else { y_high };
        let x = (-x01 * y / x00).clamp(x_low, x_high);
        smallest = smallest.min(0.5 * (x00 * x * x + x11 * y * y) + x01 * x * y);
    }
    smallest
}

/// Calls `visit` with every tile the splat reaches, in row order.
fn visit_tiles(splat: &Splat, columns: u32, rows: u32, mut visit: impl FnMut(u32)) {
    let tile = TILE as f32;
    // Pixel centres lie half a pixel inside the tile.
    let range = |axis: usize, count: u32| {
        let first = ((splat.mean[axis] - splat.extent[axis]) / tile).floor().max(0.0);
        let last = ((splat.mean[axis] + splat.extent[axis]) / tile).floor().min(count as f32 - 1.0);
        (first as u32, last as i64)
    };
    let (first_column, last_column) = range(0, columns);
    let (first_row, last_row) = range(1, rows);
    // A hair more than the gate, so that rounding never drops a tile that holds a drawn pixel.
    let reach = splat.reach[0].max(splat.reach[1]) * 1.000_01 + 1e-5;
    for row in i64::from(first_row)..=last_row {
        for column in i64::from(first_column)..=last_column {
            let low = [column as f32 * tile + 0.5, row as f32 * tile + 0.5];
            let high = [low[0] + tile - 1.0, low[1] + tile - 1.0];
            if smallest_sigma(splat, low, high) <= reach {
                visit((row as u32) * columns + column as u32);
            }
        }
    }
}

impl TileLists {
    /// Builds the lists for depth-sorted splats of an image.
    pub(super) fn build(&mut self, splats: &[Splat], width: u32, height: u32) {
        self.columns = width.div_ceil(TILE);
        self.rows = height.div_ceil(TILE);
        let (columns, rows) = (self.columns, self.rows);
        let tiles = (columns * rows) as usize;

        // Tiles of every splat, in chunks so that threads share the tests.
        const CHUNK: usize = 1024;
        let chunks: Vec<(Vec<u32>, Vec<u32>)> = splats
            .par_chunks(CHUNK)
            .map(|chunk| {
                let (mut counts, mut reached) =
                    (Vec::with_capacity(chunk.len()), Vec::with_capacity(chunk.len() * 3));
                for splat in chunk {
                    let before = reached.len();
                    visit_tiles(splat, columns, rows, |tile| reached.push(tile));
                    counts.push((reached.len() - before) as u32);
                }
                (counts, reached)
            })
            .collect();

        self.splat_offsets.clear();
        self.splat_offsets.push(0);
        self.tile_offsets.clear();
        self.tile_offsets.resize(tiles + 1, 0);
        let mut total = 0_u32;
        for (counts, reached) in &chunks {
            for count in counts {
                total = total.checked_add(*count).expect("more than 2^32 tile pairs: the image is too large");
                self.splat_offsets.push(total);
            }
            for tile in reached {
                self.tile_offsets[*tile as usize + 1] += 1;
            }
        }
        for tile in 0..tiles {
            self.tile_offsets[tile + 1] += self.tile_offsets[tile];
        }
        let mut next: Vec<u32> = self.tile_offsets[..tiles].to_vec();
        self.ranks.clear();
        self.ranks.resize(total as usize, 0);
        self.splat_pairs.clear();
        self.splat_pairs.reserve(total as usize);
        let mut rank = 0;
        for (counts, reached) in &chunks {
            let mut reached = reached.iter();
            for count in counts {
                for tile in reached.by_ref().take(*count as usize) {
                    let position = next[*tile as usize];
                    next[*tile as usize] += 1;
                    self.ranks[position as usize] = rank;
                    self.splat_pairs.push(position);
                }
                rank += 1;
            }
        }
    }

    /// Number of tiles.
    pub(super) fn tiles(&self) -> usize {
        (self.columns * self.rows) as usize
    }

    /// Ranks of a tile's splats, front to back.
    pub(super) fn tile(&self, tile: usize) -> &[u32] {
        &self.ranks[self.tile_offsets[tile] as usize..self.tile_offsets[tile + 1] as usize]
    }

    /// Positions in the tile-sorted pairs of one splat's pairs.
    pub(super) fn pairs_of(&self, rank: usize) -> &[u32] {
        &self.splat_pairs[self.splat_offsets[rank] as usize..self.splat_offsets[rank + 1] as usize]
    }

    /// First pixel (x, y) of a tile.
    pub(super) fn origin(&self, tile: usize) -> (u32, u32) {
        ((tile as u32 % self.columns) * TILE, (tile as u32 / self.columns) * TILE)
    }
}
