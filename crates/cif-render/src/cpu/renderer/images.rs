//! Pictures from blended tiles.

use cif_field::{Field, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bin::TileLists;
use super::super::dense::{InstanceTile, instance_tile};
use super::super::labels::IdentityRows;
use super::super::pixels::LANES;
use super::super::rasterize::TileImage;
use super::super::tile::{GROUPS, pixel_in_tile};
use super::Renderer;
use crate::constants::{MIN_COVERAGE, TILE};
use crate::image::InstanceImage;
use crate::{Channels, RenderSettings, RenderedImage};

impl Renderer {
    /// Renders a view for looking at or measuring.
    pub fn render(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        channels: Channels,
    ) -> RenderedImage {
        let wants_instances = channels.instances && field.identities.is_some();
        let settings = RenderSettings {
            instances: if wants_instances { settings.instances.or(Some(Default::default())) } else { None },
            ..*settings
        };
        self.prepare(field, camera, time, &settings);
        self.rasterize(None, channels.depth);
        let (width, height) = (camera.width, camera.height);
        let alpha =
            self.gather_image(width, height, |tile, group, lane| 1.0 - tile.transmittance[group][lane]);
        let depth = channels.depth.then(|| {
            self.gather_image(width, height, |tile, group, lane| {
                let coverage = 1.0 - tile.transmittance[group][lane];
                if coverage > MIN_COVERAGE { tile.depth[group][lane] / coverage } else { 0.0 }
            })
        });
        let instances = match (&field.identities, wants_instances) {
            (Some(identities), true) => Some(self.render_instances(identities, width, height)),
            _ => None,
        };
        let color = PixelGrid::from_pixels(width, height, std::mem::take(&mut self.tape.color));
        RenderedImage { color, alpha, depth, instances }
    }

    /// A row-major image from the blended tiles.
    pub(super) fn gather_image<T: Copy + Default + Send>(
        &self,
        width: u32,
        height: u32,
        value: impl Fn(&TileImage, usize, usize) -> T + Sync,
    ) -> PixelGrid<T> {
        gather_tiles(&self.tape.lists, width, height, |tile, group, lane| {
            value(&self.tape.tiles[tile], group, lane)
        })
    }

    fn render_instances(&self, identities: &Identities, width: u32, height: u32) -> InstanceImage {
        let probabilities = identities.probabilities();
        let rows = IdentityRows::new(identities, &probabilities);
        let labelled_shares = identities.labelled_shares();
        let lists = &self.tape.lists;
        let level = self.level;
        let tiles: Vec<InstanceTile> = (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let mut image = InstanceTile::default();
                let place = self.place(tile);
                dispatch!(level, simd => instance_tile(
                    simd, &self.tape.splats, lists.tile(tile), &place, rows, &labelled_shares, &mut image));
                image
            })
            .collect();
        InstanceImage {
            label: gather_tiles(lists, width, height, |tile, group, lane| tiles[tile].label[group][lane]),
            probability: gather_tiles(lists, width, height, |tile, group, lane| {
                tiles[tile].probability[group][lane]
            }),
            coverage: gather_tiles(lists, width, height, |tile, group, lane| {
                tiles[tile].coverage[group][lane]
            }),
            foreground: gather_tiles(lists, width, height, |tile, group, lane| {
                tiles[tile].foreground[group][lane]
            }),
            entropy: gather_tiles(lists, width, height, |tile, group, lane| tiles[tile].entropy[group][lane]),
        }
    }
}

/// A row-major image from per-tile values.
fn gather_tiles<T: Copy + Default + Send>(
    lists: &TileLists,
    width: u32,
    height: u32,
    value: impl Fn(usize, usize, usize) -> T + Sync,
) -> PixelGrid<T> {
    let mut image = PixelGrid::filled(width, height, T::default());
    let band = TILE as usize * width as usize;
    if band > 0 {
        image.pixels.par_chunks_mut(band).enumerate().for_each(|(tile_row, band)| {
            for tile_column in 0..lists.columns as usize {
                let tile = tile_row * lists.columns as usize + tile_column;
                let (x0, _) = lists.origin(tile);
                for group in 0..GROUPS {
                    for lane in 0..LANES {
                        let (column, row) = pixel_in_tile(group, lane);
                        let x = (x0 + column) as usize;
                        let pixel = row as usize * width as usize + x;
                        if x < width as usize && pixel < band.len() {
                            band[pixel] = value(tile, group, lane);
                        }
                    }
                }
            }
        });
    }
    image
}
