//! Values per Gaussian blended over a view, and back.

use std::ops::Range;

use cif_field::Field;
use cif_geometry::PinholeCamera;
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bin::{TileLists, TileRegion};
use super::super::blend::blend_tile;
use super::super::blend_backward::{BlendCotangents, blend_tile_backward};
use super::super::pixels::LANES;
use super::super::project_backward::SplatGradient;
use super::super::tile::{GROUPS, TilePixels, pixel_in_tile};
use super::super::timing::timed;
use super::state::{CHUNK, NOT_VISIBLE, Renderer};
use crate::constants::TILE;
use crate::{BlendRequest, BlendedImage, Blending, GeometryPath, Gradients, RenderSettings};

/// Inputs of gradients through blending weights, in addition to those of the values.
#[derive(Debug)]
pub struct BlendWeightGradients<'a> {
    /// The field of the view.
    pub field: &'a Field,
    /// The same request blended over the view.
    pub blended: &'a BlendedImage,
    /// Geometry that they reach; the opacity logit, or that of the occupancy, they always do.
    pub geometry: GeometryPath,
    /// Where they are added.
    pub gradients: &'a mut Gradients,
}

impl Renderer {
    /// Projects a view and lists its tiles, without drawing colour: all that [`Self::blend`] and
    /// [`Self::blend_backward`] need, for losses that do not look at colour.
    pub fn prepare(&mut self, field: &Field, camera: &PinholeCamera, time: f64, settings: &RenderSettings) {
        self.project(field, camera, time, settings);
        self.bin(TileRegion::whole(camera.width, camera.height), true);
    }

    /// Gaussians with a pixel of the view that was prepared last in their reach, ascending: no other is drawn.
    #[must_use]
    pub fn listed_rows(&self) -> Vec<u32> {
        let (splats, lists) = (&self.tape.splats, &self.tape.lists);
        let listed = splats.iter().enumerate().filter(|(rank, _)| !lists.pairs_of(*rank).is_empty());
        let mut rows: Vec<u32> = listed.map(|(_, splat)| splat.gaussian).collect();
        rows.sort_unstable();
        rows
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

    /// Adds the gradients of values that were blended over the view that [`Self::forward`] or [`Self::prepare`] saw
    /// last: `v_blended` is dL/dblended, `[height, width, C]`, and `v_values` gets dL/dvalues, `[N, C]`. Gradients go
    /// through the blending weights only with `weights`, and cost nothing without.
    ///
    /// # Panics
    /// Without such a view, when sizes differ from it, or, with `weights`, when the field has recorded motion.
    pub fn blend_backward(
        &mut self,
        request: &BlendRequest<'_>,
        v_blended: &[f32],
        v_values: &mut [f32],
        weights: Option<BlendWeightGradients<'_>>,
    ) {
        let (view, ..) = self.tape.view.expect("a view was prepared");
        let whole = TileRegion::whole(view.width, view.height);
        let lists = &self.tape.lists;
        assert!(
            lists.region == whole && !lists.splat_offsets.is_empty(),
            "gradients follow a view that was prepared, not a picture"
        );
        let pixels = view.width as usize * view.height as usize;
        assert_eq!(v_blended.len(), pixels * request.channels, "cotangent size");
        assert_eq!(v_values.len(), request.values.len(), "gradient size");
        let through = weights.as_ref().map(|weights| {
            assert_eq!(weights.blended.values.len(), v_blended.len(), "size of the blended image");
            (&weights.blended.values[..], weights.geometry)
        });
        let mut times = self.times;
        let gradients = timed(&mut times.rasterize_backward, || {
            self.blend_pairs_backward(request, v_blended, v_values, through)
        });
        self.times = times;
        if let Some(weights) = weights {
            self.inspection.look_at_pairs(&gradients, &[]);
            self.splats_backward(weights.field, &gradients, &[], weights.gradients);
        }
    }

    /// Adds the gradients of the values; returns those of (tile, splat) pairs where they go `through` the weights of
    /// a blended image to some geometry. The former are kept for as many tiles at a time as the memory of a band
    /// holds, which changes no sum.
    fn blend_pairs_backward(
        &self,
        request: &BlendRequest<'_>,
        v_blended: &[f32],
        v_values: &mut [f32],
        through: Option<(&[f32], GeometryPath)>,
    ) -> Vec<SplatGradient> {
        let (lists, channels) = (&self.tape.lists, request.channels);
        let rank_of = self.ranks(v_values.len() / channels);
        let room = self.band_memory as usize / (channels * size_of::<f32>());
        let mut gradients = vec![SplatGradient::default(); through.map_or(0, |_| lists.entries.len())];
        let mut rest = &mut gradients[..];
        let mut of_pairs = Vec::new();
        let mut first = 0;
        while first < lists.tiles() {
            let start = lists.tile_offsets[first] as usize;
            let fits = |offset: &u32| *offset as usize - start <= room;
            let end = first + lists.tile_offsets[first + 1..].partition_point(fits).max(1);
            let pairs = start..lists.tile_offsets[end] as usize;
            of_pairs.clear();
            of_pairs.resize(pairs.len() * channels, 0.0);
            let mut tasks = Vec::with_capacity(end - first);
            let mut values_rest = &mut of_pairs[..];
            for tile in first..end {
                let count = lists.tile(tile).len();
                let (values, others) = values_rest.split_at_mut(count * channels);
                values_rest = others;
                let (splats, others) = rest.split_at_mut(through.map_or(0, |_| count));
                rest = others;
                tasks.push((tile, values, splats));
            }
            tasks.into_par_iter().for_each(|(tile, values, splats)| {
                self.blend_tile_backward(tile, request, v_blended, through, values, splats);
            });
            self.gather_pairs(&rank_of, pairs, &of_pairs, channels, v_values);
            first = end;
        }
        gradients
    }

    fn blend_tile_backward(
        &self,
        tile: usize,
        request: &BlendRequest<'_>,
        v_blended: &[f32],
        through: Option<(&[f32], GeometryPath)>,
        v_values: &mut [f32],
        gradients: &mut [SplatGradient],
    ) {
        let (splats, entries) = (&self.tape.splats, self.tape.lists.tile(tile));
        if entries.is_empty() {
            return;
        }
        let place = self.place(tile);
        let blended = through.map(|(blended, _)| blended);
        let cotangents = &mut BlendCotangents::new(&place, request.channels, v_blended, blended);
        dispatch!(self.level, simd => match through {
            Some((_, geometry)) => blend_tile_backward::<_, true>(
                simd, splats, entries, &place, request, geometry, cotangents, v_values, gradients),
            None => blend_tile_backward::<_, false>(
                simd, splats, entries, &place, request, GeometryPath::Off, cotangents, v_values, &mut []),
        });
    }

    /// Adds the values of a range of pairs, `[pairs, C]`, to those of their Gaussians, `[N, C]`, in the order of
    /// tiles.
    fn gather_pairs(
        &self,
        rank_of: &[u32],
        pairs: Range<usize>,
        of_pairs: &[f32],
        channels: usize,
        totals: &mut [f32],
    ) {
        let (lists, level) = (&self.tape.lists, self.level);
        let chunks = totals.par_chunks_mut(CHUNK * channels).zip(rank_of.par_chunks(CHUNK));
        chunks.for_each(|(rows, ranks)| {
            dispatch!(level, _simd => for (row, rank) in rows.chunks_exact_mut(channels).zip(ranks) {
                if *rank == NOT_VISIBLE {
                    continue;
                }
                for pair in lists.pairs_of(*rank as usize) {
                    let pair = *pair as usize;
                    if pairs.contains(&pair) {
                        let first = (pair - pairs.start) * channels;
                        for (total, value) in row.iter_mut().zip(&of_pairs[first..first + channels]) {
                            *total += value;
                        }
                    }
                }
            });
        });
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
