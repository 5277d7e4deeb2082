//! Steps on a GPU: parameters, moments and gradients stay there from step to step.
//!
//! The host's field and optimiser are what every other part of the trainer works on: rare events (densification,
//! resampling, identities, evaluation, saving) fetch them from the device, and what they change is sent again before
//! the next step. Losses and counts of a step are read when they arrive, some steps later; no step waits for them.
//!
//! | file | holds |
//! |---|---|
//! | `resident` | what lies on the device, fetching and sending |
//! | `step`, `view` | one step, and one view of it |
//! | `head` | the pass of a head that blends values of its own |
//! | `flight` | steps on their way: what is read of them later, room for pairs, bad steps |
//! | `diagnose` | where a bad step went wrong |
//! | `rearrange` | changes of the set of Gaussians, with their rows staying there |
//! | `draw` | views between steps |
//! | `identities` | label mass for the identity stage |

mod diagnose;
mod draw;
mod flight;
mod head;
mod identities;
mod rearrange;
mod resident;
mod step;
#[cfg(test)]
mod testing;
mod view;

use std::collections::BTreeMap;
use std::time::Duration;

use cif_dataset::Dataset;
use cif_field::Field;
use cif_field::gaussians::SH_FLOATS;
use cif_render::RenderedImage;
use cif_render::cpu::{IdentityCounts, SimdLevel};
use cif_render::wgpu::deform::Shape;
use cif_render::wgpu::{Gpu, GpuError, GpuVec, Rasterizer, Readback, Timestamps, faults};

use self::flight::{Flights, VIEW_WORDS};
use self::resident::{Resident, Stale};
use self::step::Recording;
use super::processor::Processor;
use super::{Changed, Engine, Views};
use crate::config::TrainConfig;
use crate::density::relocate::{Pair, Relocated};
use crate::density::{DensifyStatistics, Rearrangement};
use crate::error::TrainError;
use crate::progress::Progress;
use crate::state::{Kept, State};
use crate::step::{StepPlan, StepReport};
use crate::wgpu::exposure::GpuExposure;
use crate::wgpu::judge::GpuJudge;
use crate::wgpu::kernels::{FRESH, RESTARTED};
use crate::wgpu::losses::{GpuLosses, GpuTarget};
use crate::wgpu::motion::GpuMotion;
use crate::wgpu::optimiser::GpuOptimiser;
use crate::wgpu::rearrange::{GpuRearranger, compose};

/// Steps after which the host's state is fetched at the latest, so that a lost device costs no more.
const FETCH_EVERY: u32 = 500;

/// Pairs and label slots that there is room for from the start, so that small scenes never meet the limit.
const SMALLEST_ROOM: usize = 1 << 17;

/// A GPU, and everything of a run that lies on it.
pub(crate) struct GpuEngine {
    gpu: Gpu,
    rasterizer: Rasterizer,
    losses: GpuLosses,
    exposure: GpuExposure,
    optimiser: GpuOptimiser,
    motion: GpuMotion,
    judge: GpuJudge,
    rearranger: GpuRearranger,
    /// Where the rows of a set that is changing come from.
    origins: Option<Vec<u32>>,
    /// Training images on the device, by index in the capture and width, and their bytes.
    targets: BTreeMap<(usize, u32), GpuTarget>,
    target_bytes: u64,
    /// `None` until the first step.
    resident: Option<Resident>,
    stale: Stale,
    /// See [`cif_render::wgpu::faults`].
    faults: GpuVec<u32>,
    readback: Readback,
    flights: Flights,
    /// A step that trained a head, until it is received.
    of_head: Option<StepReport>,
    /// Steps behind one that must not be taken, to be recorded again.
    again: Vec<Recording>,
    /// Most pairs and label slots that a view wanted so far, and of how many Gaussians.
    wanted: [usize; 2],
    wanted_of: usize,
    /// True when the device is ahead of the host.
    ahead: bool,
    /// Steps since the host's state was fetched.
    since_fetch: u32,
    /// Counters of the run when the host's state was right last.
    fetched: Option<Fetched>,
    /// Slot of the next view's losses.
    slot: usize,
    /// Every step waits for the device; for measuring alone.
    waits: bool,
    /// Times every stage, where the device can.
    timestamps: Option<Timestamps>,
    /// Times of the stages, collected until they are taken.
    stage_times: Vec<(&'static str, Duration)>,
}

/// Counters that belong to the host's field and moments.
struct Fetched {
    progress: Progress,
    sh_degree: u8,
    adam_steps: Vec<u32>,
    statistics: DensifyStatistics,
    /// The host's side, where it no longer is what was fetched.
    kept: Option<Kept>,
}

/// Refuses a scene that may not fit, before any time is spent on it: `gaussians` now, `deformation` that it has or
/// will have.
fn refuse_too_large(
    gpu: &Gpu,
    (dataset, config): (&Dataset, &TrainConfig),
    gaussians: usize,
    deformation: Option<&cif_field::Deformation>,
) -> Result<(), TrainError> {
    let limit = gpu.largest_binding();
    let check = |what: &str, count: u64, item_bytes: u64, advice: &str| {
        let bytes = u128::from(count) * u128::from(item_bytes);
        if bytes <= u128::from(limit) {
            return Ok(());
        }
        Err(TrainError::from(GpuError::TooLarge {
            what: what.to_owned(),
            count,
            item_bytes,
            bytes,
            limit,
            advice: advice.to_owned(),
        }))
    };
    let most = gaussians.max(config.densify.max_gaussians as usize) as u64;
    let sh_bytes = (SH_FLOATS * size_of::<f32>()) as u64;
    check("spherical harmonics", most, sh_bytes, "a lower densify.max_gaussians")?;
    let pixels = dataset.frames.iter().map(|f| u64::from(f.camera.width) * u64::from(f.camera.height));
    // The similarity keeps five images of 16 bytes per pixel, the backward pass two.
    let per_pixel = if config.loss.lambda_dssim > 0.0 { 80 } else { 32 };
    check("images of a view", pixels.max().unwrap_or(0), per_pixel, "a larger downscale")?;
    if let Some(deformation) = deformation {
        let shape = Shape::new(deformation, limit)?;
        let sums = deformation.planes.len() + shape.line_sources.len();
        check("gradients of the hexplanes", sums as u64, 8, "a smaller spatial_resolution")?;
    }
    Ok(())
}

impl GpuEngine {
    /// An engine for a capture, its settings, and a field of as many Gaussians with the `deformation` that it has or
    /// will have.
    ///
    /// # Errors
    /// When the scene may grow beyond what the device holds, with the arithmetic; when the driver rejects a kernel.
    pub(crate) fn new(
        gpu: &Gpu,
        capture: (&Dataset, &TrainConfig),
        gaussians: usize,
        deformation: Option<&cif_field::Deformation>,
    ) -> Result<Self, TrainError> {
        refuse_too_large(gpu, capture, gaussians, deformation)?;
        Ok(Self {
            rasterizer: Rasterizer::new(gpu)?,
            losses: GpuLosses::new(gpu)?,
            exposure: GpuExposure::new(gpu)?,
            optimiser: GpuOptimiser::new(gpu)?,
            motion: GpuMotion::new(gpu)?,
            judge: GpuJudge::new(gpu)?,
            rearranger: GpuRearranger::new(gpu)?,
            origins: None,
            targets: BTreeMap::new(),
            target_bytes: 0,
            resident: None,
            stale: Stale::default(),
            faults: GpuVec::zeros(gpu, "faults", faults::WORDS)?,
            readback: Readback::new(VIEW_WORDS),
            flights: Flights::default(),
            of_head: None,
            again: Vec::new(),
            wanted: [SMALLEST_ROOM; 2],
            wanted_of: 0,
            ahead: false,
            since_fetch: 0,
            fetched: None,
            slot: 0,
            waits: false,
            timestamps: None,
            stage_times: Vec::new(),
            gpu: gpu.clone(),
        })
    }
}

/// Counters that belong to the present field and moments of the state.
fn counters(state: &State) -> Fetched {
    Fetched {
        progress: state.progress.clone(),
        sh_degree: state.field.sh_degree,
        adam_steps: state.optimiser.groups().iter().map(|(_, moments)| moments.steps).collect(),
        statistics: state.statistics.clone(),
        kept: None,
    }
}

impl Engine for GpuEngine {
    fn gpu_name(&self) -> Option<&str> {
        Some(&self.gpu.facts().name)
    }

    fn step(&mut self, state: &mut State, plan: StepPlan) -> Result<(), TrainError> {
        self.record_again(state)?;
        if !self.ahead {
            self.fetched = Some(counters(state));
        }
        self.send(state)?;
        if plan.trains_head {
            self.of_head = Some(self.head_step(state, plan)?);
            return Ok(());
        }
        let recording = step::count(state, plan);
        self.record(state, recording)?;
        self.ahead = true;
        self.since_fetch += 1;
        Ok(())
    }

    fn receive(&mut self, state: &mut State, all: bool) -> Result<Option<StepReport>, TrainError> {
        if let Some(of_head) = self.of_head.take() {
            return Ok(Some(of_head));
        }
        self.receive_step(state, all || self.waits)
    }

    fn give_up(&mut self, state: &mut State) -> u32 {
        let later = std::mem::take(&mut self.again);
        for recording in &later {
            step::uncount(state, recording.moving);
        }
        later.len() as u32
    }

    fn fetch(&mut self, state: &mut State) -> Result<(), TrainError> {
        if let Some(resident) = &self.resident
            && self.ahead
        {
            resident.fetch(&self.gpu, state)?;
            // From here on the host goes on from what it has.
            self.fetched = Some(counters(state));
        }
        self.ahead = false;
        self.since_fetch = 0;
        Ok(())
    }

    fn is_far_ahead(&self) -> bool {
        self.since_fetch >= FETCH_EVERY
    }

    fn changed(&mut self, what: Changed) {
        self.stale = match what {
            Changed::Gaussians => Stale { gaussians: true, ..self.stale },
            Changed::Identities => Stale { gaussians: true, identities: true, ..self.stale },
            Changed::Everything => Stale::EVERYTHING,
        };
    }

    fn begin_changes(&mut self, state: &mut State, relocates: bool) -> Result<(), TrainError> {
        self.take_basis(state, relocates)
    }

    fn rearrange(&mut self, state: &mut State, change: &Rearrangement) {
        match &mut self.origins {
            Some(origins) => {
                *origins = compose(origins, &change.origins, &change.parents);
                resident::resize_moments(&mut state.optimiser, change.origins.len());
            }
            None => state.optimiser.gather(&change.origins),
        }
    }

    fn relocate(&mut self, state: &mut State, pairs: &[Pair], relocated: &Relocated) {
        if let Some(origins) = &mut self.origins {
            for pair in pairs {
                origins[pair.weak as usize] = pair.source | FRESH;
                origins[pair.source as usize] = pair.source | RESTARTED;
            }
        }
        state.optimiser.relocate(&relocated.weak, &relocated.sources, &relocated.entry_origins);
    }

    fn end_changes(&mut self, state: &mut State, resets_opacities: Option<bool>) -> Result<(), TrainError> {
        match (self.origins.take(), resets_opacities) {
            (Some(origins), Some(resets)) => self.rearrange_rows(state, &origins, resets),
            (Some(_), None) => Ok(()),
            (None, _) => {
                self.changed(Changed::Identities);
                Ok(())
            }
        }
    }

    fn draw(
        &mut self,
        state: &State,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        if views.channels.instances && state.started_head().is_some() {
            // A head decodes what is blended on the host.
            return Processor::new(SimdLevel::Auto).draw(state, trial, views, each);
        }
        self.draw_views(state, trial, views, each)
    }

    fn count_labels(&mut self, state: &mut State) -> Result<(IdentityCounts, usize), TrainError> {
        match self.count_on_device(state)? {
            Some(counted) => Ok(counted),
            None => Processor::new(SimdLevel::Auto).count_labels(state),
        }
    }

    fn inspect(&mut self, _on: bool) {
        // A step that the device refuses is repeated on the processor, which looks.
    }

    fn withdraw(&mut self, state: &mut State) {
        let Some(fetched) = self.fetched.take() else { return };
        if let Some(kept) = fetched.kept {
            state.put_back(kept);
        }
        state.progress = fetched.progress;
        state.field.sh_degree = fetched.sh_degree;
        state.statistics = fetched.statistics;
        for ((_, moments), steps) in state.optimiser.groups_mut().iter_mut().zip(fetched.adam_steps) {
            moments.steps = steps;
        }
    }

    fn time_stages(&mut self) {
        self.waits = true;
        self.timestamps = Timestamps::new(&self.gpu);
    }

    fn take_stage_times(&mut self) -> Vec<(&'static str, Duration)> {
        std::mem::take(&mut self.stage_times)
    }
}

impl From<GpuError> for TrainError {
    fn from(error: GpuError) -> Self {
        Self::Device(Box::new(error))
    }
}
