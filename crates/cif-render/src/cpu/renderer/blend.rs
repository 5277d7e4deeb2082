//! Values per Gaussian blended over a view.

use cif_field::Field;
use cif_geometry::PinholeCamera;
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bin::{TileLists, TileRegion};
use super::super::blend::blend_tile;
use super::super::pixels::LANES;
use super::super::tile::{GROUPS, TilePixels, pixel_in_tile};
use super::Renderer;
use crate::constants::TILE;
use crate::{BlendRequest, BlendedImage, Blending, RenderSettings};

impl Renderer {
    /// Projects a view and lists its tiles, without drawing colour: all that [`Self::blend`] and
    /// [`Self::blend_backward`] need, for losses that do not look at colour.
    pub fn prepare(&mut self, field: &Field, camera: &PinholeCamera, time: f64, settings: &RenderSettings) {
        self.project(field, camera, time, settings);
        self.bin(TileRegion::whole(camera.width, camera.height), true);
    }

    /// Blends values over the view that was rendered or prepared last.
    ///
    /// # Panics
    /// Without such a view, when there are fewer values than Gaussians, or for [`Blending::Own`] when the view has no
    /// instances.
    #[must_use]
    pub fn blend(&self, request: &BlendRequest<'_>) -> BlendedImage {
        let (view, settings, _) = self.tape.view.expect("a view was rendered");
        assert!(request.channels > 0, "at least one channel");
        assert!(
            request.blending == Blending::Color || settings.instances.is_some(),
            "the view was rendered with instances"
        );
        let mut image = BlendedImage::filled(view.width, view.height, request.channels, 0.0);
        let row = view.width as usize * request.channels;
        self.each_region(request.channels * size_of::<TilePixels>(), |lists| {
            let first_row = (lists.region.first_row * TILE) as usize;
            self.blend_region(lists, request, &mut image.values[first_row * row..]);
        });
        image
    }

    /// Blends values over the tiles of a region, into rows of pixels that begin with those of the region.
    pub(super) fn blend_region(&self, lists: &TileLists, request: &BlendRequest<'_>, rows: &mut [f32]) {
        let (view, ..) = self.tape.view.as_ref().expect("a view was rendered");
        let (width, columns) = (view.width as usize, lists.region.columns as usize);
        let (channels, level) = (request.channels, self.level);
        let of_tile_row = TILE as usize * width * channels;
        if of_tile_row == 0 {
            return;
        }
        let tile_rows = rows.par_chunks_mut(of_tile_row).take(lists.region.rows as usize);
        tile_rows.enumerate().for_each(|(tile_row, rows)| {
            let tiles: Vec<_> = (tile_row * columns..(tile_row + 1) * columns)
                .into_par_iter()
                .map(|tile| {
                    let mut blended = vec![[0.0; LANES]; GROUPS * channels];
                    let place = self.place_in(lists, tile);
                    dispatch!(level, simd => blend_tile(
                        simd, &self.tape.splats, lists.tile(tile), &place, request, &mut blended));
                    (lists.origin(tile).0 as usize, blended)
                })
                .collect();
            for (x, blended) in tiles {
                for (group, sums) in blended.chunks_exact(channels).enumerate() {
                    for lane in 0..LANES {
                        let (column, row) = pixel_in_tile(group, lane);
                        let x = x + column as usize;
                        let first = (row as usize * width + x) * channels;
                        if x < width && first < rows.len() {
                            for (value, sum) in rows[first..first + channels].iter_mut().zip(sums) {
                                *value = sum[lane];
                            }
                        }
                    }
                }
            }
        });
    }
}
