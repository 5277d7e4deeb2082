//! Pixels of tiles as rows of pictures, and instance images.

use cif_field::Identities;
use cif_geometry::PixelGrid;
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bands::bands;
use super::super::bin::{TileLists, TileRegion};
use super::super::dense::{InstanceTile, instance_tile};
use super::super::labels::IdentityRows;
use super::super::pixels::LANES;
use super::super::tile::{GROUPS, pixel_in_tile};
use super::state::Renderer;
use crate::constants::TILE;
use crate::image::InstanceRanks;

/// Identities, with the probabilities and labelled shares that the instance pass reads.
pub(super) struct DrawnIdentities<'a> {
    identities: &'a Identities,
    probabilities: Vec<f32>,
    labelled_shares: Vec<f32>,
}

impl<'a> DrawnIdentities<'a> {
    pub(super) fn new(identities: &'a Identities) -> Self {
        let (probabilities, labelled_shares) = (identities.probabilities(), identities.labelled_shares());
        Self { identities, probabilities, labelled_shares }
    }
}

impl Renderer {
    /// Coverage of the pixels in the last forward pass, 1 minus what light they still let through.
    ///
    /// # Panics
    /// Without a forward pass.
    #[must_use]
    pub fn alpha(&self) -> PixelGrid<f32> {
        let (view, ..) = self.tape.view.expect("a view was rendered");
        let mut alpha = PixelGrid::filled(view.width, view.height, 0.0);
        self.gather_alpha(view.width, &mut alpha.pixels);
        alpha
    }

    /// Writes the coverage of the tiles that were blended last to rows of pixels.
    pub(super) fn gather_alpha(&self, width: u32, rows: &mut [f32]) {
        let tiles = &self.tape.tiles;
        gather_tiles(&self.tape.lists, width, rows, |tile, group, lane| {
            1.0 - tiles[tile].transmittance[group][lane]
        });
    }

    /// Blended identities of every tile, and so many of the most probable instances per pixel.
    pub(super) fn instance_tiles(
        &self,
        lists: &TileLists,
        drawn: &DrawnIdentities<'_>,
        ranks: usize,
    ) -> Vec<InstanceTile> {
        let rows = IdentityRows::new(drawn.identities, &drawn.probabilities);
        let level = self.level;
        (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let mut image = InstanceTile {
                    ranks: vec![[[(0, 0.0); LANES]; GROUPS]; ranks],
                    ..InstanceTile::default()
                };
                let place = self.place_in(lists, tile);
                dispatch!(level, simd => instance_tile(
                    simd, &self.tape.splats, lists.tile(tile), &place, rows, &drawn.labelled_shares, &mut image));
                image
            })
            .collect()
    }

    /// Calls `each` with the tile lists of the view that was rendered last, all at once where they are still there,
    /// else region by region.
    pub(super) fn each_region(&self, tile_bytes: usize, mut each: impl FnMut(&TileLists)) {
        let (view, ..) = self.tape.view.expect("a view was rendered");
        let whole = TileRegion::whole(view.width, view.height);
        if self.tape.lists.region == whole {
            return each(&self.tape.lists);
        }
        let mut lists = TileLists::default();
        for band in bands(&self.tape.splats, whole, tile_bytes as u64, self.band_memory) {
            for part in band.parts {
                lists.build(&self.tape.splats, part, false);
                each(&lists);
            }
        }
    }

    /// The most probable instances of every pixel of the view that was rendered last, with instances.
    ///
    /// # Panics
    /// Without such a view.
    #[must_use]
    pub fn instance_ranks(&self, identities: &Identities, ranks: usize) -> InstanceRanks {
        let (view, settings, _) = self.tape.view.expect("a view was rendered");
        assert!(settings.instances.is_some(), "the view was rendered with instances");
        let drawn = DrawnIdentities::new(identities);
        let mut found = InstanceRanks::none(ranks, view.width, view.height);
        self.each_region(instance_tile_bytes(ranks), |lists| {
            let tiles = self.instance_tiles(lists, &drawn, ranks);
            let start = (lists.region.first_row * TILE) as usize * view.width as usize;
            gather_ranks(lists, &tiles, start, &mut found);
        });
        found
    }

    /// Colours on the background of the tiles that were blended last, into the rows of the image that hold them.
    pub(super) fn gather_color(&self, rows: &mut [[f32; 3]]) {
        let (view, settings, _) = self.tape.view.expect("a view was rendered");
        let background = settings.background;
        gather_tiles(&self.tape.lists, view.width, rows, |tile, group, lane| {
            let tile = &self.tape.tiles[tile];
            let t = tile.transmittance[group][lane];
            [0, 1, 2].map(|channel| tile.color[channel][group][lane] + t * background[channel])
        });
    }
}

/// Bytes of a tile's blended identities.
pub(super) fn instance_tile_bytes(ranks: usize) -> usize {
    size_of::<InstanceTile>() + ranks * size_of::<[[(u16, f32); LANES]; GROUPS]>()
}

/// Writes the ranks of a region's tiles to rows of pixels that begin at `start` with those of the region.
pub(super) fn gather_ranks(
    lists: &TileLists,
    tiles: &[InstanceTile],
    start: usize,
    found: &mut InstanceRanks,
) {
    for (rank, (labels, probabilities)) in found.ranks.iter_mut().enumerate() {
        let width = labels.width;
        gather_tiles(lists, width, &mut labels.pixels[start..], |tile, group, lane| {
            tiles[tile].ranks[rank][group][lane].0
        });
        gather_tiles(lists, width, &mut probabilities.pixels[start..], |tile, group, lane| {
            tiles[tile].ranks[rank][group][lane].1
        });
    }
}

/// Writes per-tile values of a region to rows of pixels, so many wide, of which the first is the region's first.
pub(super) fn gather_tiles<T: Send>(
    lists: &TileLists,
    width: u32,
    rows: &mut [T],
    value: impl Fn(usize, usize, usize) -> T + Sync,
) {
    let (width, columns) = (width as usize, lists.region.columns as usize);
    let of_tile_row = TILE as usize * width;
    if of_tile_row == 0 {
        return;
    }
    let tile_rows = rows.par_chunks_mut(of_tile_row).take(lists.region.rows as usize);
    tile_rows.enumerate().for_each(|(tile_row, rows)| {
        for tile in tile_row * columns..(tile_row + 1) * columns {
            let (x0, _) = lists.origin(tile);
            for group in 0..GROUPS {
                for lane in 0..LANES {
                    let (column, row) = pixel_in_tile(group, lane);
                    let x = (x0 + column) as usize;
                    let pixel = row as usize * width + x;
                    if x < width && pixel < rows.len() {
                        rows[pixel] = value(tile, group, lane);
                    }
                }
            }
        }
    });
}
