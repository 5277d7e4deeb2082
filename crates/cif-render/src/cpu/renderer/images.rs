//! Pictures from blended tiles.

use cif_field::{Field, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bin::TileLists;
use super::super::blend::blend_tile;
use super::super::dense::{InstanceTile, instance_tile};
use super::super::labels::IdentityRows;
use super::super::pixels::LANES;
use super::super::rasterize::TileImage;
use super::super::tile::{GROUPS, Pass, TilePixels, pixel_in_tile};
use super::Renderer;
use crate::constants::{MIN_COVERAGE, TILE};
use crate::image::{InstanceImage, InstanceRanks};
use crate::{BlendingWeights, Channels, RenderSettings, RenderedImage};

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
        let settings = settings.for_outputs(field, channels);
        self.prepare(field, camera, time, &settings, None);
        self.rasterize(None, None, channels.depth);
        let (width, height) = (camera.width, camera.height);
        let alpha =
            self.gather_image(width, height, |tile, group, lane| 1.0 - tile.transmittance[group][lane]);
        let depth = channels.depth.then(|| {
            self.gather_image(width, height, |tile, group, lane| {
                let coverage = 1.0 - tile.transmittance[group][lane];
                if coverage > MIN_COVERAGE { tile.depth[group][lane] / coverage } else { 0.0 }
            })
        });
        let instances = match (&field.identities, settings.instances.is_some()) {
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

    fn instance_tiles(&self, identities: &Identities, ranks: usize) -> Vec<InstanceTile> {
        let probabilities = identities.probabilities();
        let rows = IdentityRows::new(identities, &probabilities);
        let labelled_shares = identities.labelled_shares();
        let lists = &self.tape.lists;
        let level = self.level;
        (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let mut image = InstanceTile {
                    ranks: vec![[[(0, 0.0); LANES]; GROUPS]; ranks],
                    ..InstanceTile::default()
                };
                let place = self.place(tile);
                dispatch!(level, simd => instance_tile(
                    simd, &self.tape.splats, lists.tile(tile), &place, rows, &labelled_shares, &mut image));
                image
            })
            .collect()
    }

    /// The most probable instances of every pixel of the view that was rendered last, with instances.
    ///
    /// # Panics
    /// Without such a view.
    #[must_use]
    pub fn instance_ranks(&self, identities: &Identities, ranks: usize) -> InstanceRanks {
        let (view, settings, _) = self.tape.view.expect("a view was rendered");
        assert!(settings.instances.is_some(), "the view was rendered with instances");
        let tiles = self.instance_tiles(identities, ranks);
        let gather = |rank: usize| {
            gather_tiles(&self.tape.lists, view.width, view.height, |tile, group, lane| {
                tiles[tile].ranks[rank][group][lane]
            })
        };
        InstanceRanks {
            ranks: (0..ranks)
                .map(|rank| {
                    let image = gather(rank);
                    (image.map(|(label, _)| *label), image.map(|(_, probability)| *probability))
                })
                .collect(),
        }
    }

    /// Values per Gaussian (`[N]`, by row of the field) blended over the view that was rendered last, with the weights
    /// of colour, `sum_i T_i alpha_i v_i`, or of the instance pass; divided by the blended 1 it is the mean over what
    /// the pixel shows.
    ///
    /// # Panics
    /// Without such a view, when there are fewer values than Gaussians, or for weights of the instance pass when
    /// the view was rendered without instances.
    #[must_use]
    pub fn blend<const C: usize>(
        &self,
        values: &[[f32; C]],
        weights: BlendingWeights,
    ) -> PixelGrid<[f32; C]> {
        let (view, settings, _) = self.tape.view.expect("a view was rendered");
        let pass = match weights {
            BlendingWeights::Color => Pass::Color,
            BlendingWeights::Instances => Pass::Instances,
        };
        assert!(pass == Pass::Color || settings.instances.is_some(), "the view was rendered with instances");
        let lists = &self.tape.lists;
        let level = self.level;
        let tiles: Vec<[TilePixels; C]> = (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let mut blended = [[[0.0; LANES]; GROUPS]; C];
                let place = self.place(tile);
                dispatch!(level, simd => blend_tile(
                    simd, &self.tape.splats, lists.tile(tile), &place, pass, values, &mut blended));
                blended
            })
            .collect();
        let mut image = PixelGrid::filled(view.width, view.height, [0.0; C]);
        for channel in 0..C {
            let plane = gather_tiles(lists, view.width, view.height, |tile, group, lane| {
                tiles[tile][channel][group][lane]
            });
            for (pixel, value) in image.pixels.iter_mut().zip(&plane.pixels) {
                pixel[channel] = *value;
            }
        }
        image
    }

    fn render_instances(&self, identities: &Identities, width: u32, height: u32) -> InstanceImage {
        let tiles = self.instance_tiles(identities, 0);
        let lists = &self.tape.lists;
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
