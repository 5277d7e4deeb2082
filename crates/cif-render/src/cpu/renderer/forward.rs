//! Forward pass of a view, up to its blended tiles.

use cif_field::{Field, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::bin::{TileRegion, sort_by_depth};
use super::super::deform::DeformationAtTime;
use super::super::labels::{IdentityRows, TileLabels};
use super::super::posed::PosedView;
use super::super::project::{Splat, ViewConstants, project_rows};
use super::super::rasterize::{TileImage, rasterize_tile};
use super::super::tile::GROUPS;
use super::super::timing::timed;
use super::pose::pose;
use super::state::{CHUNK, Renderer, ViewStatistics};
use crate::constants::MIN_LABEL_PROBABILITY;
use crate::{InstanceNormalisation, RenderSettings};

/// Results of the forward pass of a training view.
#[derive(Clone, Debug)]
pub struct ForwardPass {
    /// Rendered colour on the background.
    pub color: PixelGrid<[f32; 3]>,
    /// Mean over labelled pixels of the instance loss; 0 without labelled pixels.
    pub instance_loss: f64,
    /// Labelled pixels of the view.
    pub labelled_pixels: usize,
    /// Labelled pixels whose label no covering Gaussian supports (methods reference 4.4).
    pub unsupported_pixels: usize,
    /// Counts.
    pub statistics: ViewStatistics,
}

impl Renderer {
    /// Forward pass of a training view; keeps on the renderer what [`Self::backward`] needs. `labels` hold
    /// dense index + 1, 0 = unlabelled; they are read only when `settings.instances` is set.
    ///
    /// # Panics
    /// When `labels` and camera differ in size, or instances are asked of a field without identities.
    pub fn forward(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        labels: Option<&PixelGrid<u16>>,
    ) -> ForwardPass {
        let labels = labels.filter(|_| settings.instances.is_some());
        if let Some(labels) = labels {
            assert_eq!((labels.width, labels.height), (camera.width, camera.height), "label map size");
        }
        self.project(field, camera, time, settings);
        self.bin(TileRegion::whole(camera.width, camera.height), true);
        let identities = labels.map(|labels| {
            (labels, field.identities.as_ref().expect("the instance pass needs estimated identities"))
        });
        self.rasterize(identities);
        let (instance_loss, unsupported_pixels) = self.instance_loss(settings);
        ForwardPass {
            color: PixelGrid::from_pixels(camera.width, camera.height, self.tape.color.clone()),
            instance_loss,
            labelled_pixels: self.tape.labelled_pixels,
            unsupported_pixels,
            statistics: self.statistics,
        }
    }

    /// Deformation, projection and depth order of a view.
    pub(super) fn project(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
    ) {
        let mut times = self.times;
        let level = self.level;
        let tape = &mut self.tape;
        let view = ViewConstants::new(camera, settings);
        tape.view = Some((view, *settings, time));
        let mut deformed = 0;
        timed(&mut times.deform, || {
            let deformation = field.deformation.as_ref().filter(|_| settings.deform);
            let at_time = deformation.map(|deformation| DeformationAtTime::new(deformation, time));
            let tracks = field.tracks.as_ref().map(|tracks| tracks.at(time));
            pose(level, field, at_time, tracks, settings.sh_degree, &mut tape.posed);
            deformed = deformation.map_or(0, |deformation| deformation.moving_rows(field.len()).count());
        });
        timed(&mut times.project, || {
            let posed = PosedView::new(field, &tape.posed);
            let n = field.gaussians.len();
            let chunks: Vec<Vec<Splat>> = (0..n.div_ceil(CHUNK))
                .into_par_iter()
                .map(|chunk| {
                    let rows = chunk * CHUNK..n.min((chunk + 1) * CHUNK);
                    let mut splats = Vec::with_capacity(rows.len());
                    dispatch!(level, simd => project_rows(simd, &view, &posed, rows, &mut splats));
                    splats
                })
                .collect();
            tape.splats.clear();
            for chunk in &chunks {
                tape.splats.extend_from_slice(chunk);
            }
        });
        timed(&mut times.bin, || sort_by_depth(&mut tape.splats));
        // Of another view: nothing is differentiated before this one is drawn.
        tape.color.clear();
        self.statistics =
            ViewStatistics { visible: tape.splats.len(), deformed, ..ViewStatistics::default() };
        self.times = times;
        self.inspection.look_at_posed(&tape.posed);
        self.inspection.look_at_splats(&tape.splats);
    }

    /// Blends all tiles of a view into the tape, and takes their colours together.
    pub(super) fn rasterize(&mut self, labels: Option<(&PixelGrid<u16>, &Identities)>) {
        self.blend_tiles(labels, false);
        let mut times = self.times;
        timed(&mut times.rasterize, || {
            let (view, ..) = self.tape.view.expect("a view was projected");
            let mut color = std::mem::take(&mut self.tape.color);
            color.resize(view.width as usize * view.height as usize, [0.0; 3]);
            self.gather_color(&mut color);
            self.inspection.look_at_color(&color, 0);
            self.tape.color = color;
        });
        self.times = times;
        self.inspection.look_at_labelled_tiles(&self.tape.tiles, &self.tape.labels);
    }

    /// Blends the tiles that are listed into the tape, with instances where there are labels.
    pub(super) fn blend_tiles(&mut self, labels: Option<(&PixelGrid<u16>, &Identities)>, depth: bool) {
        let mut times = self.times;
        timed(&mut times.rasterize, || {
            let level = self.level;
            let tiles = self.tape.lists.tiles();
            self.tape.probabilities.clear();
            if let Some((_, rows)) = labels {
                // Only what is seen is asked for below.
                self.tape.probabilities.resize(rows.labels.len(), 0.0);
                for splat in &self.tape.splats {
                    let range = rows.range(splat.gaussian as usize);
                    rows.row_probabilities(splat.gaussian as usize, &mut self.tape.probabilities[range]);
                }
                self.statistics.identity_rows = self.tape.splats.len();
            }
            self.tape.labels = match labels {
                Some((map, _)) => {
                    (0..tiles).into_par_iter().map(|tile| TileLabels::new(map, &self.place(tile))).collect()
                }
                None => vec![None; tiles],
            };
            self.tape.labelled_pixels =
                labels.map_or(0, |(map, _)| map.pixels.iter().filter(|label| **label != 0).count());
            let mut images = std::mem::take(&mut self.tape.tiles);
            images.resize_with(tiles, TileImage::default);
            let rows = labels.map(|(_, rows)| IdentityRows::new(rows, &self.tape.probabilities));
            let (splats, lists) = (&self.tape.splats, &self.tape.lists);
            let keeps_met = lists.is_by_splat();
            images.par_iter_mut().enumerate().for_each(|(tile, image)| {
                let place = self.place(tile);
                let entries = lists.tile(tile);
                let labels = self.tape.labels[tile].as_ref().zip(rows);
                dispatch!(level, simd => match (labels.is_some(), depth) {
                    (true, _) => rasterize_tile::<_, true, false>(simd, splats, entries, &place, labels, keeps_met, image),
                    (false, true) => rasterize_tile::<_, false, true>(simd, splats, entries, &place, None, keeps_met, image),
                    (false, false) => rasterize_tile::<_, false, false>(simd, splats, entries, &place, None, keeps_met, image),
                });
            });
            self.tape.tiles = images;
            let (statistics, tape) = (&mut self.statistics, &self.tape);
            statistics.evaluated_pairs += tape.tiles.iter().map(|tile| tile.evaluated).sum::<u64>();
            statistics.instance_pairs += tape.tiles.iter().map(|tile| tile.evaluated_instances).sum::<u64>();
            statistics.labelled_tiles += tape.labels.iter().flatten().count();
        });
        self.times = times;
    }

    /// Mean loss over labelled pixels, and how many of them no covering Gaussian supports.
    fn instance_loss(&self, settings: &RenderSettings) -> (f64, usize) {
        let Some(instances) = settings.instances else { return (0.0, 0) };
        let (mut loss, mut unsupported) = (0.0_f64, 0);
        for (tile, labels) in self.tape.tiles.iter().zip(&self.tape.labels) {
            let Some(labels) = labels else { continue };
            for group in 0..GROUPS {
                for lane in labels.labelled_lanes(group) {
                    let probability = tile.label_probability[group][lane];
                    let shown = f64::from(probability.max(MIN_LABEL_PROBABILITY));
                    loss -= shown.ln();
                    if probability < MIN_LABEL_PROBABILITY {
                        unsupported += 1;
                    } else if instances.normalisation == InstanceNormalisation::Coverage {
                        loss += f64::from(1.0 - tile.instance_transmittance[group][lane]).ln();
                    }
                }
            }
        }
        (loss / self.tape.labelled_pixels.max(1) as f64, unsupported)
    }
}
