//! Depth order and tile lists. Source: methods reference 3.1 (sorting, exact tile test).

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use super::project::Splat;
use super::tile::Groups;
use crate::Blending;
use crate::constants::TILE;

/// A splat of a tile: its rank (index into the depth-sorted splats) and which passes draw it there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct TileEntry(u32);

impl TileEntry {
    /// Bits of a rank.
    const RANK_BITS: u32 = 30;

    fn new(rank: u32, passes: u8) -> Self {
        Self(u32::from(passes) << Self::RANK_BITS | rank)
    }

    /// Index into the depth-sorted splats.
    #[inline(always)]
    pub(super) fn rank(self) -> usize {
        (self.0 & ((1 << Self::RANK_BITS) - 1)) as usize
    }

    #[inline(always)]
    fn draws(self, blending: Blending) -> bool {
        self.0 >> Self::RANK_BITS >> blending as u32 & 1 == 1
    }

    /// The groups that each pass needs of the splat, of those that are live in it.
    #[inline(always)]
    pub(super) fn needed<const INSTANCES: bool>(self, color: Groups, instances: Groups) -> [Groups; 2] {
        let none = Groups::default();
        [
            if self.draws(Blending::Color) { color } else { none },
            if INSTANCES && self.draws(Blending::Own) { instances } else { none },
        ]
    }
}

/// A rectangle of an image's tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct TileRegion {
    pub(super) first_column: u32,
    pub(super) first_row: u32,
    pub(super) columns: u32,
    pub(super) rows: u32,
}

impl TileRegion {
    /// All tiles of an image of so many pixels.
    pub(super) fn whole(width: u32, height: u32) -> Self {
        Self { first_column: 0, first_row: 0, columns: width.div_ceil(TILE), rows: height.div_ceil(TILE) }
    }

    pub(super) fn tiles(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Columns and rows of the tiles that the rectangle around a splat's drawn ellipse reaches.
    pub(super) fn reached(&self, splat: &Splat) -> [Range<u32>; 2] {
        let range = |axis: usize, first: u32, count: u32| {
            let tile = TILE as f32;
            let low = (splat.mean[axis] - splat.extent[axis]) / tile;
            let high = (splat.mean[axis] + splat.extent[axis]) / tile;
            let end = first + count;
            // Nothing is below 0 here, so that what is cut off is what `floor` takes away, which may be a call.
            let low = low.max(first as f32).min(end as f32) as u32;
            let high = if high < first as f32 { first } else { (high.min(end as f32) as u32 + 1).min(end) };
            low..high.max(low)
        };
        [range(0, self.first_column, self.columns), range(1, self.first_row, self.rows)]
    }
}

/// Which splats each tile of a region draws, front to back. Tiles are counted row by row within the region.
///
/// Pairs are stored by tile. Where asked for, every splat also knows where its own pairs went, so that sums over a
/// splat's pairs run in a fixed order whatever the number of threads.
#[derive(Debug, Default)]
pub(super) struct TileLists {
    pub(super) region: TileRegion,
    /// `[tiles + 1]` first pair of each tile.
    pub(super) tile_offsets: Vec<u32>,
    /// `[pairs]` the splats of the tiles.
    pub(super) entries: Vec<TileEntry>,
    /// `[splats + 1]` first entry of each splat in `splat_pairs`; empty where not asked for.
    pub(super) splat_offsets: Vec<u32>,
    /// `[pairs]` position in `entries` of each of a splat's pairs; empty where not asked for.
    pub(super) splat_pairs: Vec<u32>,
}

/// Bytes of a (tile, splat) pair while lists without the pairs of each splat are built.
pub(super) const PAIR_BYTES: u64 = (size_of::<(u32, u8)>() + size_of::<TileEntry>()) as u64;

/// Sorts splats front to back; ties keep the order that they come in, which is that of the Gaussians.
pub(super) fn sort_by_depth(splats: &mut Vec<Splat>) {
    // Keys are moved around instead of splats. Positive floats order like their bits; the position breaks ties.
    let key = |(position, splat): (usize, &Splat)| u64::from(splat.order.to_bits()) << 32 | position as u64;
    let mut keys: Vec<u64> = splats.iter().enumerate().map(key).collect();
    keys.par_sort_unstable();
    *splats = keys.into_iter().map(|key| splats[(key & u64::from(u32::MAX)) as usize]).collect();
}

/// Most (tile, splat) pairs of a view: positions are 32-bit.
const MAX_PAIRS: u64 = u32::MAX as u64;

/// The conic of a splat, with what finds its smallest value on the edges of rectangles.
#[derive(Clone, Copy)]
struct Conic {
    factor: [f32; 3],
    /// Of the best point on a vertical line: y / x; on a horizontal one: x / y.
    slopes: [f32; 2],
}

impl Conic {
    fn new(factor: [f32; 3]) -> Self {
        let [l00, l01, l11] = factor;
        Self { factor, slopes: [-l00 * l01 / (l01 * l01 + l11 * l11), -l01 / l00] }
    }

    /// Twice the smallest sigma over a rectangle relative to the centre.
    #[inline(always)]
    fn smallest_over(&self, [x_low, y_low]: [f32; 2], [x_high, y_high]: [f32; 2]) -> f32 {
        let [l00, l01, l11] = self.factor;
        let twice_sigma = |x: f32, y: f32| {
            let (u0, u1) = (l00 * x + l01 * y, l11 * y);
            u0 * u0 + u1 * u1
        };
        // The coordinates of the rectangle nearest to the centre: 0 along an axis on which it spans the centre.
        let (x, y) = (0.0_f32.max(x_low).min(x_high), 0.0_f32.max(y_low).min(y_high));
        let beside = twice_sigma(x, (self.slopes[0] * x).max(y_low).min(y_high));
        let above = twice_sigma((self.slopes[1] * y).max(x_low).min(x_high), y);
        // Only edges that face the centre can hold the smallest; where the centre is inside, `above` is 0.
        match (x == 0.0, y == 0.0) {
            (true, _) => above,
            (_, true) => beside,
            _ => beside.min(above),
        }
    }
}

/// Calls `visit` with every tile of the region that the splat reaches, in row order, and
/// the passes that reach it, a bit each.
#[inline(always)]
fn visit_tiles(splat: &Splat, region: &TileRegion, mut visit: impl FnMut(u32, u8)) {
    let tile = TILE as f32;
    let [columns, rows] = region.reached(splat);
    let conic = Conic::new(splat.factor);
    // A hair more than the gate, so that rounding never drops a tile that holds a drawn pixel.
    let reaches = splat.reach.map(|reach| 2.0 * (reach * 1.000_01 + 1e-5));
    for row in rows {
        // Pixel centres lie half a pixel inside the tile.
        let y = row as f32 * tile + 0.5 - splat.mean[1];
        let first = (row - region.first_row) * region.columns;
        for column in columns.clone() {
            let x = column as f32 * tile + 0.5 - splat.mean[0];
            let smallest = conic.smallest_over([x, y], [x + (tile - 1.0), y + (tile - 1.0)]);
            let passes = u8::from(smallest <= reaches[0]) | u8::from(smallest <= reaches[1]) << 1;
            if passes != 0 {
                visit(first + column - region.first_column, passes);
            }
        }
    }
}

/// Fewest splats of a chunk, and most chunks, four for each of sixteen threads: each counts all tiles.
const CHUNK: usize = 1024;
const CHUNKS: usize = 64;

/// Fewest tiles whose entries a task gathers, as many as a row of an image of 256 pixels has.
const TILES: usize = 16;

/// Tiles of a chunk of splats.
#[derive(Default)]
struct ReachedTiles {
    /// Tiles per splat.
    counts: Vec<u32>,
    /// Tiles of all splats in turn, and the passes that draw there, a bit each.
    reached: Vec<(u32, u8)>,
    /// `[tiles]` pairs of each tile.
    tiles: Vec<u32>,
    /// `[tiles]` position of the first of them among the pairs of all chunks; empty before it is known.
    firsts: Vec<u32>,
}

/// The pairs of a chunk, sorted by tile.
struct SortedPairs {
    /// `[tiles + 1]` first entry of each tile.
    offsets: Vec<u32>,
    entries: Vec<TileEntry>,
}

impl ReachedTiles {
    fn new(splats: &[Splat], region: &TileRegion) -> Self {
        let mut counts = Vec::with_capacity(splats.len());
        let mut reached = Vec::with_capacity(splats.len() * 3);
        let mut tiles = vec![0; region.tiles()];
        for splat in splats {
            let before = reached.len();
            visit_tiles(splat, region, |tile, passes| {
                tiles[tile as usize] += 1;
                reached.push((tile, passes));
            });
            counts.push((reached.len() - before) as u32);
        }
        Self { counts, reached, tiles, firsts: Vec::new() }
    }

    /// Sorts the pairs by tile; `first_rank` is that of the first splat. The position of every pair among all goes to
    /// `positions`, splat by splat, unless that is empty.
    fn sorted(self, first_rank: u32, positions: &mut [u32]) -> SortedPairs {
        let mut offsets = Vec::with_capacity(self.tiles.len() + 1);
        offsets.push(0);
        for (tile, count) in self.tiles.iter().enumerate() {
            offsets.push(offsets[tile] + count);
        }
        let mut entries = vec![TileEntry::default(); self.reached.len()];
        let mut next = offsets.clone();
        let ranks = (first_rank..).zip(&self.counts);
        let ranks = ranks.flat_map(|(rank, count)| std::iter::repeat_n(rank, *count as usize));
        for (pair, ((tile, passes), rank)) in self.reached.iter().zip(ranks).enumerate() {
            let tile = *tile as usize;
            let own = &mut next[tile];
            entries[*own as usize] = TileEntry::new(rank, *passes);
            if let Some(position) = positions.get_mut(pair) {
                *position = self.firsts[tile] + (*own - offsets[tile]);
            }
            *own += 1;
        }
        SortedPairs { offsets, entries }
    }
}

impl TileLists {
    /// Builds the lists of a region for depth-sorted splats. The
    /// pairs of each splat are listed `by_splat`.
    ///
    /// # Panics
    /// When there are too many pairs, before memory is.
    pub(super) fn build(&mut self, splats: &[Splat], region: TileRegion, by_splat: bool) {
        self.build_within(MAX_PAIRS, splats, region, by_splat);
    }

    fn build_within(&mut self, limit: u64, splats: &[Splat], region: TileRegion, by_splat: bool) {
        self.region = region;
        let tiles = region.tiles();

        assert!(splats.len() < 1 << TileEntry::RANK_BITS, "more than 2^30 Gaussians are visible in one view");

        // Tiles of every splat, in chunks so that threads share the tests.
        let chunk_len = splats.len().div_ceil(CHUNKS).max(CHUNK);
        let pairs = AtomicU64::new(0);
        let mut chunks: Vec<ReachedTiles> = splats
            .par_chunks(chunk_len)
            .map(|splats| {
                if pairs.load(Ordering::Relaxed) > limit {
                    return ReachedTiles::default();
                }
                let chunk = ReachedTiles::new(splats, &region);
                pairs.fetch_add(chunk.reached.len() as u64, Ordering::Relaxed);
                chunk
            })
            .collect();
        let pairs = pairs.into_inner();
        assert!(
            pairs <= limit,
            "{} visible Gaussians reach {pairs} (tile, Gaussian) pairs of {} x {} tiles of {TILE} x {TILE} pixels, \
             more than {limit}: render a smaller image, or fewer and smaller Gaussians",
            splats.len(),
            region.columns,
            region.rows
        );

        self.tile_offsets.clear();
        self.tile_offsets.reserve(tiles + 1);
        let mut first = 0;
        for tile in 0..tiles {
            self.tile_offsets.push(first);
            for chunk in &mut chunks {
                chunk.firsts.push(first);
                first += chunk.tiles[tile];
            }
        }
        self.tile_offsets.push(first);
        self.splat_offsets.clear();
        self.splat_pairs.clear();
        if by_splat {
            let mut first = 0;
            self.splat_offsets.reserve(splats.len() + 1);
            self.splat_offsets.push(0);
            self.splat_offsets.extend(chunks.iter().flat_map(|chunk| &chunk.counts).map(|count| {
                first += count;
                first
            }));
            self.splat_pairs.resize(pairs as usize, 0);
        }
        let mut rest = &mut self.splat_pairs[..];
        let mut tasks = Vec::with_capacity(chunks.len());
        for (index, chunk) in chunks.into_iter().enumerate() {
            let (positions, others) = rest.split_at_mut(if by_splat { chunk.reached.len() } else { 0 });
            rest = others;
            tasks.push(((index * chunk_len) as u32, chunk, positions));
        }
        let sorted =
            tasks.into_par_iter().map(|(first_rank, chunk, positions)| chunk.sorted(first_rank, positions));
        let sorted: Vec<SortedPairs> = sorted.collect();
        self.entries.resize(pairs as usize, TileEntry::default());
        let mut rest = &mut self.entries[..];
        let mut tasks = Vec::with_capacity(tiles);
        for tile in 0..tiles {
            let len = self.tile_offsets[tile + 1] - self.tile_offsets[tile];
            let (own, others) = rest.split_at_mut(len as usize);
            rest = others;
            tasks.push(own);
        }
        tasks.into_par_iter().enumerate().with_min_len(TILES).for_each(|(tile, mut own)| {
            for chunk in &sorted {
                let range = chunk.offsets[tile] as usize..chunk.offsets[tile + 1] as usize;
                let (target, others) = own.split_at_mut(range.len());
                target.copy_from_slice(&chunk.entries[range]);
                own = others;
            }
        });
    }

    /// True when every splat knows its pairs, as gradients ask for.
    pub(super) fn is_by_splat(&self) -> bool {
        !self.splat_offsets.is_empty()
    }

    /// Number of tiles.
    pub(super) fn tiles(&self) -> usize {
        self.region.tiles()
    }

    /// A tile's splats, front to back.
    pub(super) fn tile(&self, tile: usize) -> &[TileEntry] {
        &self.entries[self.tile_offsets[tile] as usize..self.tile_offsets[tile + 1] as usize]
    }

    /// The tile of every pair.
    pub(super) fn tile_of_pair(&self) -> Vec<u32> {
        let mut tiles = vec![0_u32; self.entries.len()];
        for tile in 0..self.tiles() {
            tiles[self.tile_offsets[tile] as usize..self.tile_offsets[tile + 1] as usize].fill(tile as u32);
        }
        tiles
    }

    /// Positions in the tile-sorted pairs of one splat's pairs.
    pub(super) fn pairs_of(&self, rank: usize) -> &[u32] {
        &self.splat_pairs[self.splat_offsets[rank] as usize..self.splat_offsets[rank + 1] as usize]
    }

    /// First pixel (x, y) of a tile, in the image.
    pub(super) fn origin(&self, tile: usize) -> (u32, u32) {
        let TileRegion { first_column, first_row, columns, .. } = self.region;
        let (column, row) = (first_column + tile as u32 % columns, first_row + tile as u32 / columns);
        (column * TILE, row * TILE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A splat that fills any image.
    fn filling(gaussian: u32) -> Splat {
        Splat {
            mean: [40.0, 40.0],
            factor: [1e-4, 0.0, 1e-4],
            color: [0.5; 3],
            opacity: 0.5,
            occupancy: 0.5,
            depth: 2.0,
            order: 2.0,
            reach: [4.0; 2],
            extent: [1e5; 2],
            radius: 1e5,
            gaussian,
        }
    }

    #[test]
    fn row_34_pairs_are_counted_before_they_overflow() {
        let splats: Vec<Splat> = (0..3000).map(filling).collect();
        let mut lists = TileLists::default();
        // 5 x 5 tiles.
        let region = TileRegion::whole(80, 80);
        lists.build_within(75_000, &splats, region, true);
        assert_eq!(lists.entries.len(), 75_000);
        let refused = std::panic::catch_unwind(|| {
            TileLists::default().build_within(74_999, &splats, region, true);
        });
        let message = *refused.unwrap_err().downcast::<String>().unwrap();
        assert!(message.contains("3000 visible Gaussians") && message.contains("5 x 5 tiles"), "{message}");
    }
}
