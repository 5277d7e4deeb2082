//! A GPU with everything of a run that lies on it, and what the host remembers of the device.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use cif_dataset::Dataset;
use cif_field::gaussians::SH_FLOATS;
use cif_render::wgpu::deform::Shape;
use cif_render::wgpu::{Gpu, GpuError, GpuVec, Rasterizer, Readback, Timestamps, faults};

use super::flight::{Flights, VIEW_WORDS};
use super::recording::Recording;
use super::resident::{Resident, Stale};
use crate::config::TrainConfig;
use crate::density::DensifyStatistics;
use crate::error::TrainError;
use crate::progress::Progress;
use crate::state::{Kept, State};
use crate::step::StepReport;
use crate::wgpu::exposure::GpuExposure;
use crate::wgpu::judge::GpuJudge;
use crate::wgpu::losses::{GpuLosses, GpuTarget};
use crate::wgpu::motion::GpuMotion;
use crate::wgpu::optimiser::GpuOptimiser;
use crate::wgpu::rearrange::GpuRearranger;

/// Steps after which the host's state is fetched at the latest, so that a lost device costs no more.
pub(super) const FETCH_EVERY: u32 = 500;

/// Pairs and label slots that there is room for from the start, so that small scenes never meet the limit.
const SMALLEST_ROOM: usize = 1 << 17;

/// A GPU, and everything of a run that lies on it.
pub(crate) struct GpuEngine {
    pub(super) gpu: Gpu,
    pub(super) rasterizer: Rasterizer,
    pub(super) losses: GpuLosses,
    pub(super) exposure: GpuExposure,
    pub(super) optimiser: GpuOptimiser,
    pub(super) motion: GpuMotion,
    pub(super) judge: GpuJudge,
    pub(super) rearranger: GpuRearranger,
    /// Where the rows of a set that is changing come from.
    pub(super) origins: Option<Vec<u32>>,
    /// Training images on the device, by index in the capture and width, and their bytes.
    pub(super) targets: BTreeMap<(usize, u32), Arc<GpuTarget>>,
    pub(super) target_bytes: u64,
    /// `None` until the first step.
    pub(super) resident: Option<Resident>,
    pub(super) stale: Stale,
    /// See [`cif_render::wgpu::faults`].
    pub(super) faults: GpuVec<u32>,
    pub(super) readback: Readback,
    pub(super) flights: Flights,
    /// A step that trained a head, until it is received.
    pub(super) of_head: Option<StepReport>,
    /// Steps behind one that must not be taken, to be recorded again.
    pub(super) again: Vec<Recording>,
    /// Most pairs and label slots that a view needed so far, and of how many Gaussians.
    pub(super) needed: [usize; 2],
    pub(super) needed_of: usize,
    /// True when the device is ahead of the host.
    pub(super) ahead: bool,
    /// Steps since the host's state was fetched.
    pub(super) since_fetch: u32,
    /// Counters of the run when the host's state was right last.
    pub(super) fetched: Option<Fetched>,
    /// Slot of the next view's losses.
    pub(super) slot: usize,
    /// Every step waits for the device; for measuring alone.
    pub(super) waits: bool,
    /// Times every stage, where the device can.
    pub(super) timestamps: Option<Timestamps>,
    /// Times of the stages, collected until they are taken.
    pub(super) stage_times: Vec<(&'static str, Duration)>,
}

/// Counters that belong to the host's field and moments.
pub(super) struct Fetched {
    pub(super) progress: Progress,
    pub(super) sh_degree: u8,
    pub(super) adam_steps: Vec<u32>,
    pub(super) statistics: DensifyStatistics,
    /// The host's side, where it no longer is what was fetched.
    pub(super) kept: Option<Kept>,
}

impl Fetched {
    /// Counters that belong to the present field and moments of the state.
    pub(super) fn of(state: &State) -> Self {
        Self {
            progress: state.progress.clone(),
            sh_degree: state.field.sh_degree,
            adam_steps: state.optimiser.groups().iter().map(|(_, moments)| moments.steps).collect(),
            statistics: state.statistics.clone(),
            kept: None,
        }
    }
}

/// Refuses a scene that may not fit, before any time is spent on it: `gaussians` now, `deformation` that it has or
/// will have.
fn refuse_too_large(
    gpu: &Gpu,
    dataset: &Dataset,
    config: &TrainConfig,
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
        dataset: &Dataset,
        config: &TrainConfig,
        gaussians: usize,
        deformation: Option<&cif_field::Deformation>,
    ) -> Result<Self, TrainError> {
        refuse_too_large(gpu, dataset, config, gaussians, deformation)?;
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
            needed: [SMALLEST_ROOM; 2],
            needed_of: 0,
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
