//! Label mass of views.

use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bin::TileRegion;
use super::super::contributors::{ContributorRule, contributors_of_tile};
use super::super::counts::{IdentityCounts, add_to};
use super::super::identity::label_mass_tile;
use super::super::labels::TileLabels;
use super::state::{CHUNK, NOT_VISIBLE, Renderer};
use crate::RenderSettings;

impl Renderer {
    /// Adds a view's colour-weighted label mass to `counts`. `labels` hold dense index + 1, 0 = unlabelled.
    ///
    /// # Panics
    /// When `labels` and camera differ in size, or the counts are of another number of Gaussians.
    pub fn count_identities(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        labels: &PixelGrid<u16>,
        counts: &mut IdentityCounts,
    ) {
        assert_eq!((labels.width, labels.height), (camera.width, camera.height), "label map size");
        assert_eq!(counts.gaussians(), field.gaussians.len(), "counts of other Gaussians");
        let settings = RenderSettings { instances: None, ..*settings };
        self.project(field, camera, time, &settings);
        self.bin(TileRegion::whole(camera.width, camera.height), true);
        self.rasterize(None);
        let (tape, level) = (&self.tape, self.level);
        let lists = &tape.lists;
        let tiles: Vec<(Vec<u16>, Vec<f32>)> = (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let place = self.place(tile);
                let labels = TileLabels::new(labels, &place);
                let columns = labels.as_ref().map_or(0, |labels| labels.labels.len()) + 1;
                let entries = lists.tile(tile);
                let mut mass = vec![0.0; entries.len() * columns];
                dispatch!(level, simd => label_mass_tile(
                    simd, &tape.splats, entries, &place, labels.as_ref(), &tape.tiles[tile], &mut mass));
                (labels.map(|labels| labels.labels).unwrap_or_default(), mass)
            })
            .collect();
        self.add_tiles(&tiles, counts);
    }

    /// Adds the mass that contributors of the labelled pixels of the view that was prepared last ([`Self::prepare`]) have
    /// by a rule to `counts`; of unlabelled pixels nothing counts. Source: methods reference 8.4 and 8.5.
    ///
    /// # Panics
    /// Without such a view, when `labels` and it differ in size, or the counts are of fewer Gaussians.
    pub fn count_contributors(
        &self,
        labels: &PixelGrid<u16>,
        rule: &ContributorRule,
        counts: &mut IdentityCounts,
    ) {
        let (view, ..) = self.tape.view.expect("a view was prepared");
        assert_eq!((labels.width, labels.height), (view.width, view.height), "label map size");
        let (tape, level) = (&self.tape, self.level);
        let lists = &tape.lists;
        let tiles: Vec<(Vec<u16>, Vec<f32>)> = (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let place = self.place(tile);
                let Some(labels) = TileLabels::new(labels, &place) else { return Default::default() };
                let entries = lists.tile(tile);
                let columns = labels.labels.len() + 1;
                let mut mass = vec![0.0; entries.len() * columns];
                dispatch!(level, simd => contributors_of_tile(
                    simd, &tape.splats, entries, &place, &labels, rule, &mut mass));
                (labels.labels, mass)
            })
            .collect();
        self.add_tiles(&tiles, counts);
    }

    /// Adds the mass of the pairs of every tile, `[entries, labels + 1]` with the total last, to `counts`.
    fn add_tiles(&self, tiles: &[(Vec<u16>, Vec<f32>)], counts: &mut IdentityCounts) {
        let lists = &self.tape.lists;
        let tile_of_pair = lists.tile_of_pair();
        let rank_of = self.ranks(counts.gaussians());
        let instances = counts.instances();
        let (rows, total_mass) = counts.parts_mut();
        // Each Gaussian adds up its own tiles, in their order.
        rows.par_chunks_mut(CHUNK)
            .zip(total_mass.par_chunks_mut(CHUNK))
            .zip(rank_of.par_chunks(CHUNK))
            .for_each(|((rows, totals), ranks)| {
                for ((row, total), rank) in rows.iter_mut().zip(totals).zip(ranks) {
                    if *rank == NOT_VISIBLE {
                        continue;
                    }
                    for &pair in lists.pairs_of(*rank as usize) {
                        let tile = tile_of_pair[pair as usize] as usize;
                        let (labels, mass) = &tiles[tile];
                        if mass.is_empty() {
                            continue;
                        }
                        let columns = labels.len() + 1;
                        let local = pair as usize - lists.tile_offsets[tile] as usize;
                        let mass = &mass[local * columns..(local + 1) * columns];
                        *total += f64::from(mass[labels.len()]);
                        for (label, mass) in labels.iter().zip(mass) {
                            if *mass != 0.0 && usize::from(*label) < instances {
                                add_to(row, *label, f64::from(*mass));
                            }
                        }
                    }
                }
            });
    }
}
