//! Pictures of a view: whole, and in bands of rows, each within a budget of memory.

use std::convert::Infallible;

use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};

use super::super::bands::{Band, bands};
use super::super::bin::TileRegion;
use super::super::labels::TileLabels;
use super::super::rasterize::TileImage;
use super::super::tile::TilePixels;
use super::super::timing::timed;
use super::images::{DrawnIdentities, gather_ranks, gather_tiles, instance_tile_bytes};
use super::state::Renderer;
use crate::constants::{MIN_COVERAGE, TILE};
use crate::image::{InstanceImage, InstanceRanks};
use crate::{BlendRequest, Blending, Channels, RenderSettings, RenderedImage};

/// Outputs to render of a view in bands.
#[derive(Clone, Copy, Debug, Default)]
pub struct BandRequest<'a> {
    /// Outputs of the image.
    pub channels: Channels,
    /// So many of the most probable instances of every pixel, where instances are drawn.
    pub ranks: usize,
    /// Two values per Gaussian, `[N]` by row of the field, blended with the weights of colour.
    pub values: Option<&'a [[f32; 2]]>,
}

/// Rows of a view, over its full width.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedBand {
    /// Row of the view that is the first here; a multiple of [`TILE`].
    pub first_row: u32,
    /// The rows.
    pub image: RenderedImage,
    /// Most probable instances of every pixel; `None` where none were asked for or no instances drawn.
    pub ranks: Option<InstanceRanks>,
    /// Blended values, `sum_i T_i alpha_i v_i`.
    pub blended: Option<PixelGrid<[f32; 2]>>,
}

impl BandRequest<'_> {
    /// Bytes of a tile while its band is drawn, without its pairs: what is blended, and the pixels that come out.
    fn tile_bytes(&self, instances: bool) -> u64 {
        let if_drawn = |is_drawn: bool, bytes: usize| if is_drawn { bytes } else { 0 };
        let ranks = if_drawn(instances, self.ranks);
        let blended = size_of::<TileImage>()
            + size_of::<Option<TileLabels>>()
            + if_drawn(instances, instance_tile_bytes(ranks))
            + if_drawn(self.values.is_some(), size_of::<[TilePixels; 2]>());
        let pixel = size_of::<[f32; 4]>()
            + if_drawn(self.channels.depth, size_of::<f32>())
            + if_drawn(instances, size_of::<u16>() + size_of::<[f32; 4]>())
            + ranks * (size_of::<u16>() + size_of::<f32>())
            + if_drawn(self.values.is_some(), size_of::<[f32; 2]>());
        (blended + pixel * (TILE * TILE) as usize) as u64
    }
}

impl RenderedBand {
    /// Rows that are still to be drawn.
    fn blank(
        first_row: u32,
        (width, height): (u32, u32),
        request: &BandRequest<'_>,
        instances: bool,
    ) -> Self {
        let zeros = || PixelGrid::filled(width, height, 0.0);
        let image = RenderedImage {
            color: PixelGrid::filled(width, height, [0.0; 3]),
            alpha: zeros(),
            depth: request.channels.depth.then(zeros),
            instances: instances.then(|| InstanceImage {
                label: PixelGrid::filled(width, height, 0),
                probability: zeros(),
                coverage: zeros(),
                foreground: zeros(),
                entropy: zeros(),
            }),
        };
        let ranks =
            (instances && request.ranks > 0).then(|| InstanceRanks::none(request.ranks, width, height));
        let blended = request.values.map(|_| PixelGrid::filled(width, height, [0.0; 2]));
        Self { first_row, image, ranks, blended }
    }
}

impl Renderer {
    /// Renders a view for looking at or measuring. Beside the image, memory is that of [`Self::render_bands`].
    pub fn render(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        channels: Channels,
    ) -> RenderedImage {
        let mut image: Option<RenderedImage> = None;
        let request = BandRequest { channels, ..BandRequest::default() };
        let Ok(()) = self.render_bands(field, camera, time, settings, &request, |band| {
            match &mut image {
                None => image = Some(band.image),
                Some(image) => image.append(band.image),
            }
            Ok::<(), Infallible>(())
        });
        image.expect("a view has a band")
    }

    /// Renders a view in bands of rows from top to bottom, and hands each to `take`: memory follows the band, not the
    /// view.
    ///
    /// # Errors
    /// The first of `take`, which is not called again then.
    ///
    /// # Panics
    /// When there are fewer values than Gaussians.
    pub fn render_bands<E>(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        request: &BandRequest<'_>,
        mut take: impl FnMut(RenderedBand) -> Result<(), E>,
    ) -> Result<(), E> {
        let settings = settings.for_outputs(field, request.channels);
        self.project(field, camera, time, &settings);
        let identities = field.identities.as_ref().filter(|_| settings.instances.is_some());
        let identities = identities.map(DrawnIdentities::new);
        let whole = TileRegion::whole(camera.width, camera.height);
        let tile_bytes = request.tile_bytes(identities.is_some());
        for band in bands(&self.tape.splats, whole, tile_bytes, self.band_memory) {
            let band = self.draw_band(&band, (camera.width, camera.height), request, identities.as_ref());
            let above = band.first_row as usize * camera.width as usize;
            self.inspection.look_at_color(&band.image.color.pixels, above);
            take(band)?;
        }
        Ok(())
    }

    fn draw_band(
        &mut self,
        band: &Band,
        (width, height): (u32, u32),
        request: &BandRequest<'_>,
        identities: Option<&DrawnIdentities<'_>>,
    ) -> RenderedBand {
        let (first, rows) = band.rows();
        let first_row = first * TILE;
        let size = (width, (rows * TILE).min(height - first_row));
        let mut drawn = RenderedBand::blank(first_row, size, request, identities.is_some());
        for part in &band.parts {
            self.bin(*part, false);
            self.blend_tiles(None, request.channels.depth);
            let mut times = self.times;
            timed(&mut times.rasterize, || self.gather_part(request, identities, &mut drawn));
            self.times = times;
        }
        drawn
    }

    /// Takes the tiles that were blended last into their band.
    fn gather_part(
        &self,
        request: &BandRequest<'_>,
        identities: Option<&DrawnIdentities<'_>>,
        band: &mut RenderedBand,
    ) {
        let (lists, tiles) = (&self.tape.lists, &self.tape.tiles);
        let width = band.image.color.width;
        self.gather_color(&mut band.image.color.pixels);
        self.gather_alpha(width, &mut band.image.alpha.pixels);
        if let Some(depth) = &mut band.image.depth {
            gather_tiles(lists, width, &mut depth.pixels, |tile, group, lane| {
                let tile = &tiles[tile];
                let coverage = 1.0 - tile.transmittance[group][lane];
                if coverage > MIN_COVERAGE { tile.depth[group][lane] / coverage } else { 0.0 }
            });
        }
        if let (Some(image), Some(identities)) = (&mut band.image.instances, identities) {
            let ranks = band.ranks.as_ref().map_or(0, |ranks| ranks.ranks.len());
            let tiles = self.instance_tiles(lists, identities, ranks);
            gather_tiles(lists, width, &mut image.label.pixels, |tile, group, lane| {
                tiles[tile].label[group][lane]
            });
            gather_tiles(lists, width, &mut image.probability.pixels, |tile, group, lane| {
                tiles[tile].probability[group][lane]
            });
            gather_tiles(lists, width, &mut image.coverage.pixels, |tile, group, lane| {
                tiles[tile].coverage[group][lane]
            });
            gather_tiles(lists, width, &mut image.foreground.pixels, |tile, group, lane| {
                tiles[tile].foreground[group][lane]
            });
            gather_tiles(lists, width, &mut image.entropy.pixels, |tile, group, lane| {
                tiles[tile].entropy[group][lane]
            });
            if let Some(found) = &mut band.ranks {
                gather_ranks(lists, &tiles, 0, found);
            }
        }
        if let (Some(blended), Some(values)) = (&mut band.blended, request.values) {
            let request =
                BlendRequest { values: values.as_flattened(), channels: 2, blending: Blending::Color };
            self.blend_region(lists, &request, blended.pixels.as_flattened_mut());
        }
    }
}
