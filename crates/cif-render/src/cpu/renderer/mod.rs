//! Strings the stages together.
//!
//! | module | direction |
//! |---|---|
//! | this | forward |
//! | `backward` | gradients of the last forward pass |
//! | `images` | pictures of a view, instance images |
//! | `blend` | values per Gaussian, in both directions |
//! | `banded` | the same band by band, within a budget of memory |
//! | `count` | label mass for identity estimation |
//! | `pose` | Gaussians at the time of the view |
//! | `displace` | motion without pictures |
//! | `inspect` | the first value that is not finite |

mod backward;
mod banded;
mod blend;
mod count;
mod displace;
mod images;
mod inspect;
mod pose;

use cif_field::{Field, Gaussians, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

pub use self::banded::{BandRequest, RenderedBand};
pub use self::blend::BlendWeightGradients;
pub use self::inspect::NotFinite;
use self::pose::pose;
use super::bin::{TileLists, TileRegion, sort_by_depth};
use super::deform::DeformScratch;
use super::labels::{IdentityRows, TileLabels};
use super::level::SimdLevel;
use super::posed::PosedView;
use super::project::{Splat, ViewConstants, project_rows};
use super::project_backward::SplatGradient;
use super::rasterize::{TileImage, rasterize_tile};
use super::tile::{GROUPS, TilePlace};
use super::timing::{StageTimes, timed};
use crate::constants::MIN_LABEL_PROBABILITY;
use crate::{InstanceNormalisation, RenderSettings};

/// Gaussians handled by one task.
const CHUNK: usize = 512;

/// Rank of Gaussians that are not visible.
const NOT_VISIBLE: u32 = u32::MAX;

/// Counts of one view, for cost tables.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewStatistics {
    /// Gaussians with a non-empty footprint in the view.
    pub visible: usize,
    /// (tile, Gaussian) pairs.
    pub tile_pairs: usize,
    /// (pixel, Gaussian) pairs whose footprint was evaluated in the forward pass.
    pub evaluated_pairs: u64,
    /// Gaussians that went through the deformation network: none without one, and none that stand still.
    pub deformed: usize,
    /// Gaussians whose deformation was differentiated in the last backward pass.
    pub deformed_backward: usize,
    /// Tiles that blended identities, because a pixel of theirs carries a label.
    pub labelled_tiles: usize,
    /// Gaussians whose identity row was evaluated: the visible ones of a view with labels.
    pub identity_rows: usize,
    /// (pixel, Gaussian) pairs whose footprint was evaluated for identities in the forward pass; part of
    /// [`Self::evaluated_pairs`].
    pub instance_pairs: u64,
}

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

/// State of the last forward pass that the backward pass needs.
#[derive(Default)]
struct Tape {
    view: Option<(ViewConstants, RenderSettings, f64)>,
    posed: Gaussians,
    splats: Vec<Splat>,
    lists: TileLists,
    tiles: Vec<TileImage>,
    labels: Vec<Option<TileLabels>>,
    probabilities: Vec<f32>,
    color: Vec<[f32; 3]>,
    labelled_pixels: usize,
}

/// Renders views; keeps scratch memory between calls. Threads come from the current rayon pool.
pub struct Renderer {
    level: Level,
    times: StageTimes,
    statistics: ViewStatistics,
    tape: Tape,
    inspection: inspect::Inspection,
    deform_scratch: DeformScratch,
    /// Memory of the gradients of (tile, splat) pairs, which would be cleared by the system in every step.
    pair_gradients: Vec<SplatGradient>,
    band_memory: u64,
}

impl std::fmt::Debug for Renderer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Renderer")
            .field("level", &self.level)
            .field("times", &self.times)
            .finish_non_exhaustive()
    }
}

impl Renderer {
    /// A renderer with the given instructions.
    ///
    /// # Panics
    /// When the processor lacks them ([`SimdLevel::is_available`]).
    #[must_use]
    pub fn new(simd: SimdLevel) -> Self {
        Self {
            level: simd.level().expect("the processor has the instructions asked for"),
            times: StageTimes::default(),
            statistics: ViewStatistics::default(),
            tape: Tape::default(),
            inspection: inspect::Inspection::default(),
            deform_scratch: DeformScratch::default(),
            pair_gradients: Vec::new(),
            band_memory: banded::BAND_MEMORY,
        }
    }

    /// Name of the vector instructions in use.
    #[must_use]
    pub fn simd_name(&self) -> String {
        let name = format!("{:?}", self.level);
        name.split(['(', ' ']).next().unwrap_or_default().to_owned()
    }

    /// Wall time per stage since the last [`Self::reset_times`].
    #[must_use]
    pub fn times(&self) -> StageTimes {
        self.times
    }

    /// Sets the stage times to zero.
    pub fn reset_times(&mut self) {
        self.times = StageTimes::default();
    }

    /// Counts of the last view.
    #[must_use]
    pub fn statistics(&self) -> ViewStatistics {
        self.statistics
    }

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
    fn project(&mut self, field: &Field, camera: &PinholeCamera, time: f64, settings: &RenderSettings) {
        let mut times = self.times;
        let level = self.level;
        let tape = &mut self.tape;
        let view = ViewConstants::new(camera, settings);
        tape.view = Some((view, *settings, time));
        let mut deformed = 0;
        timed(&mut times.deform, || {
            let deformation = field.deformation.as_ref().filter(|_| settings.deform);
            let tracks = field.tracks.as_ref().map(|tracks| tracks.at(time));
            pose(level, field, deformation, tracks, (time, settings.sh_degree), &mut tape.posed);
            deformed = deformation.map_or(0, |deformation| deformation.moving_rows(field.len()).count());
        });
        timed(&mut times.project, || {
            let posed = PosedView::new(&field.gaussians, &tape.posed);
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
        self.inspect_posed();
        self.inspect_splats();
    }

    /// Tile lists of a region of the projected view, with the pairs of each splat where they are asked for, as
    /// gradients and counts read them.
    fn bin(&mut self, region: TileRegion, by_splat: bool) {
        let tape = &mut self.tape;
        timed(&mut self.times.bin, || tape.lists.build(&tape.splats, region, by_splat));
        self.statistics.tile_pairs += tape.lists.entries.len();
    }

    /// A tile of the region that was drawn last.
    fn place(&self, tile: usize) -> TilePlace {
        self.place_in(&self.tape.lists, tile)
    }

    fn place_in(&self, lists: &TileLists, tile: usize) -> TilePlace {
        let (view, ..) = self.tape.view.as_ref().expect("a view was projected");
        let (x, y) = lists.origin(tile);
        TilePlace { x, y, width: view.width, height: view.height }
    }

    /// Depth rank of every Gaussian, or [`NOT_VISIBLE`].
    fn ranks(&self, gaussians: usize) -> Vec<u32> {
        let mut rank_of = vec![NOT_VISIBLE; gaussians];
        for (rank, splat) in self.tape.splats.iter().enumerate() {
            rank_of[splat.gaussian as usize] = rank as u32;
        }
        rank_of
    }

    /// Blends all tiles of a view into the tape, and takes their colours together.
    fn rasterize(&mut self, labels: Option<(&PixelGrid<u16>, &Identities)>) {
        self.blend_tiles(labels, false);
        let mut times = self.times;
        timed(&mut times.rasterize, || {
            let (view, ..) = self.tape.view.expect("a view was projected");
            let mut color = std::mem::take(&mut self.tape.color);
            color.resize(view.width as usize * view.height as usize, [0.0; 3]);
            self.gather_color(&mut color);
            self.inspect_color(&color, 0);
            self.tape.color = color;
        });
        self.times = times;
        self.inspect_labelled_tiles();
    }

    /// Blends the tiles that are listed into the tape, with instances where there are labels.
    fn blend_tiles(&mut self, labels: Option<(&PixelGrid<u16>, &Identities)>, depth: bool) {
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
