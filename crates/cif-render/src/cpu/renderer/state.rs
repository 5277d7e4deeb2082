//! The renderer, and what it keeps from stage to stage and view to view.

use cif_field::Gaussians;
use fearless_simd::Level;

use super::super::bin::{TileLists, TileRegion};
use super::super::deform::DeformScratch;
use super::super::labels::TileLabels;
use super::super::level::SimdLevel;
use super::super::project::{Splat, ViewConstants};
use super::super::project_backward::SplatGradient;
use super::super::rasterize::TileImage;
use super::super::tile::TilePlace;
use super::super::timing::{StageTimes, timed};
use super::inspect::{Inspection, NotFinite};
use crate::RenderSettings;

/// Gaussians handled by one task.
pub(super) const CHUNK: usize = 512;

/// Rank of Gaussians that are not visible.
pub(super) const NOT_VISIBLE: u32 = u32::MAX;

/// Bytes of a band, unless said otherwise: a view of 1920 x 1080 pixels with all channels fits.
const BAND_MEMORY: u64 = 256 << 20;

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

/// State of the last forward pass that the backward pass needs.
#[derive(Default)]
pub(super) struct Tape {
    pub(super) view: Option<(ViewConstants, RenderSettings, f64)>,
    pub(super) posed: Gaussians,
    pub(super) splats: Vec<Splat>,
    pub(super) lists: TileLists,
    pub(super) tiles: Vec<TileImage>,
    pub(super) labels: Vec<Option<TileLabels>>,
    pub(super) probabilities: Vec<f32>,
    pub(super) color: Vec<[f32; 3]>,
    pub(super) labelled_pixels: usize,
}

/// Renders views; keeps scratch memory between calls. Threads come from the current rayon pool.
pub struct Renderer {
    pub(super) level: Level,
    pub(super) times: StageTimes,
    pub(super) statistics: ViewStatistics,
    pub(super) tape: Tape,
    pub(super) inspection: Inspection,
    pub(super) deform_scratch: DeformScratch,
    /// Memory of the gradients of (tile, splat) pairs, which would be cleared by the system in every step.
    pub(super) pair_gradients: Vec<SplatGradient>,
    /// The same of gradients by posed parameters.
    pub(super) v_posed: Gaussians,
    pub(super) band_memory: u64,
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
            inspection: Inspection::default(),
            deform_scratch: DeformScratch::default(),
            pair_gradients: Vec::new(),
            v_posed: Gaussians::default(),
            band_memory: BAND_MEMORY,
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

    /// Sets the memory that a band may take, in bytes, which decides how many rows are drawn at once. Pictures do not
    /// depend on it. The memory of the field and its projected Gaussians, and of a single tile of 16 x 16 pixels with
    /// all Gaussians that reach it, comes on top.
    pub fn set_band_memory(&mut self, bytes: u64) {
        self.band_memory = bytes;
    }

    /// Looks at every array between field and gradients from now on, which costs time; results do not change.
    pub fn set_inspection(&mut self, on: bool) {
        self.inspection = Inspection::new(on);
    }

    /// The first value since the last call that was not finite; always `None` without
    /// [`Self::set_inspection`].
    pub fn take_not_finite(&mut self) -> Option<NotFinite> {
        self.inspection.take()
    }

    /// Tile lists of a region of the projected view, with the pairs of each splat where they are asked for, as
    /// gradients and counts read them.
    pub(super) fn bin(&mut self, region: TileRegion, by_splat: bool) {
        let tape = &mut self.tape;
        timed(&mut self.times.bin, || tape.lists.build(&tape.splats, region, by_splat));
        self.statistics.tile_pairs += tape.lists.entries.len();
    }

    /// A tile of the region that was drawn last.
    pub(super) fn place(&self, tile: usize) -> TilePlace {
        self.place_in(&self.tape.lists, tile)
    }

    pub(super) fn place_in(&self, lists: &TileLists, tile: usize) -> TilePlace {
        let (view, ..) = self.tape.view.as_ref().expect("a view was projected");
        let (x, y) = lists.origin(tile);
        TilePlace { x, y, width: view.width, height: view.height }
    }

    /// Depth rank of every Gaussian, or [`NOT_VISIBLE`].
    pub(super) fn ranks(&self, gaussians: usize) -> Vec<u32> {
        let mut rank_of = vec![NOT_VISIBLE; gaussians];
        for (rank, splat) in self.tape.splats.iter().enumerate() {
            rank_of[splat.gaussian as usize] = rank as u32;
        }
        rank_of
    }
}
