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
//! | `shape` | what steps took by stage, and what they worked on |
//! | `flight` | steps on their way: what is read of them later, room for pairs, bad steps |
//! | `validation` | where a bad step went wrong, and every array of a step looked at |
//! | `probe`, `kept` | whether the GPU is faster: trial steps, and undoing them |
//! | `rearrange` | changes of the set of Gaussians, with their rows staying there |
//! | `draw` | views between steps |
//! | `identities` | label mass for the identity stage |

mod draw;
mod flight;
mod identities;
mod kept;
mod probe;
mod rearrange;
mod resident;
mod shape;
mod step;
#[cfg(test)]
mod tests;
mod validation;
mod view;

use std::collections::BTreeMap;
use std::time::Duration;

use cif_field::gaussians::SH_FLOATS;
use cif_render::wgpu::deform::Shape;
use cif_render::wgpu::{Gpu, GpuError, GpuVec, Rasterizer, Readback, Timestamps, faults};

use self::flight::{Flights, VIEW_WORDS};
use self::kept::Kept;
pub use self::probe::Probe;
use self::resident::{Resident, Stale};
use super::progress::Progress;
use super::{Trainer, initialize};
use crate::densify::DensifyStatistics;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::wgpu::exposure::GpuExposure;
use crate::wgpu::judge::GpuJudge;
use crate::wgpu::losses::{GpuLosses, GpuTarget};
use crate::wgpu::motion::GpuMotion;
use crate::wgpu::optimiser::GpuOptimiser;
use crate::wgpu::rearrange::GpuRearranger;

/// Steps after which the host's state is fetched at the latest, so that a lost device costs no more.
const FETCH_EVERY: u32 = 500;

/// Pairs and label slots that there is room for from the start, so that small scenes never meet the limit.
const SMALLEST_ROOM: usize = 1 << 17;

/// What a step on a GPU needs.
pub(super) struct DeviceTraining {
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
    /// Training frames on the device, by position, and their bytes.
    targets: BTreeMap<usize, GpuTarget>,
    target_bytes: u64,
    /// `None` until the first step.
    resident: Option<Resident>,
    stale: Stale,
    /// See [`cif_render::wgpu::faults`].
    faults: GpuVec<u32>,
    readback: Readback,
    flights: Flights,
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
    /// What they took, until it is asked for.
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

impl Trainer {
    /// Makes the steps of this run run on a GPU. May be called before or between runs.
    ///
    /// # Errors
    /// When the scene may grow beyond what the device holds, with the arithmetic; when the driver rejects a kernel.
    pub fn use_gpu(&mut self, gpu: &Gpu) -> Result<(), TrainError> {
        self.refuse_too_large(gpu)?;
        self.device = Some(Box::new(DeviceTraining {
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
        }));
        Ok(())
    }

    /// What steps run on: the GPU's name, or `None` for the processor.
    #[must_use]
    pub fn gpu_name(&self) -> Option<&str> {
        self.device.as_ref().map(|device| device.gpu.facts().name.as_str())
    }

    /// Times the stages of every step on the device, where it has timestamps; steps then wait for it.
    pub fn time_gpu_stages(&mut self) {
        if let Some(device) = &mut self.device {
            device.waits = true;
            device.timestamps = Timestamps::new(&device.gpu);
        }
    }

    /// Refuses a scene that may not fit, before any time is spent on it.
    fn refuse_too_large(&self, gpu: &Gpu) -> Result<(), TrainError> {
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
        let most = self.field.gaussians.len().max(self.config.densify.max_gaussians as usize) as u64;
        let sh_bytes = (SH_FLOATS * size_of::<f32>()) as u64;
        check("spherical harmonics", most, sh_bytes, "a lower densify.max_gaussians")?;
        let pixels =
            self.dataset.frames.iter().map(|f| u64::from(f.camera.width) * u64::from(f.camera.height));
        // The similarity keeps five images of 16 bytes per pixel, the backward pass two.
        let per_pixel = if self.config.loss.lambda_dssim > 0.0 { 80 } else { 32 };
        check("images of a view", pixels.max().unwrap_or(0), per_pixel, "a larger downscale")?;
        if self.stages.is_dynamic {
            let fresh;
            let deformation = match &self.field.deformation {
                Some(deformation) => deformation,
                None => {
                    fresh = initialize::initial_deformation(&self.dataset, &self.config)?;
                    &fresh
                }
            };
            let shape = Shape::new(deformation, limit)?;
            let sums = deformation.planes.len() + shape.line_sources.len();
            check("gradients of the hexplanes", sums as u64, 8, "a smaller spatial_resolution")?;
        }
        Ok(())
    }

    /// Brings the host's field, moments and statistics up to date, reading every loss that is under way.
    pub(super) fn fetch_from_device(&mut self) -> Result<(), TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(()) };
        let fetched = self.fetch(&mut device);
        self.device = Some(device);
        fetched.map_err(|error| self.device_failed(error))
    }

    fn fetch(&mut self, device: &mut DeviceTraining) -> Result<(), TrainError> {
        let received = self.receive(device, true);
        if matches!(received, Err(TrainError::Gpu(_))) {
            return received;
        }
        if let Some(resident) = &device.resident
            && device.ahead
        {
            let exposures = self.progress.exposures.as_mut();
            let (field, optimiser) = (&mut self.field, &mut self.optimiser);
            resident.fetch(&device.gpu, field, optimiser, &mut self.statistics, exposures)?;
            // From here on the host goes on from what it has.
            device.fetched = Some(self.counters());
        }
        device.ahead = false;
        device.since_fetch = 0;
        // A bad step moved nothing, so the field is good.
        received
    }

    /// What steps told that have arrived since they were last asked.
    pub(super) fn arrived_events(&mut self) -> Vec<TrainEvent> {
        std::mem::take(&mut self.arrived)
    }

    /// Counters that belong to the host's present field and moments.
    fn counters(&self) -> Fetched {
        Fetched {
            progress: self.progress.clone(),
            sh_degree: self.field.sh_degree,
            adam_steps: self.optimiser.groups().iter().map(|(_, moments)| moments.steps).collect(),
            statistics: self.statistics.clone(),
            kept: None,
        }
    }

    /// Says that the host has changed its Gaussians, with their moments and statistics.
    pub(super) fn gaussians_changed(&mut self) {
        if let Some(device) = &mut self.device {
            device.stale.gaussians = true;
        }
    }

    /// Says that the host has changed its identities, too.
    pub(super) fn identities_changed(&mut self) {
        if let Some(device) = &mut self.device {
            device.stale = Stale { gaussians: true, identities: true, ..device.stale };
        }
    }

    /// Says that the host has changed everything.
    pub(super) fn everything_changed(&mut self) {
        if let Some(device) = &mut self.device {
            device.stale = Stale::EVERYTHING;
        }
    }

    /// After a fault of the device the host stands where its state was fetched last.
    pub(super) fn device_failed(&mut self, error: TrainError) -> TrainError {
        if !matches!(error, TrainError::Gpu(_)) {
            return error;
        }
        if let Some(fetched) = self.device.take().and_then(|device| device.fetched) {
            if let Some(kept) = fetched.kept {
                self.put_back(kept);
            }
            self.progress = fetched.progress;
            self.field.sh_degree = fetched.sh_degree;
            self.statistics = fetched.statistics;
            for ((_, moments), steps) in self.optimiser.groups_mut().iter_mut().zip(fetched.adam_steps) {
                moments.steps = steps;
            }
        }
        error
    }
}
