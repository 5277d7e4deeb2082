//! Losses and counts of steps, read when they arrive.

use std::collections::VecDeque;

use bytemuck::Pod;
use cif_render::wgpu::{Arriving, Gpu, GpuError, GpuStatistics};

use crate::events::Stage;
use crate::wgpu::losses::ViewLoss;

/// Steps that the host may be ahead of what it knows of the device.
const AHEAD: usize = 8;

/// A read-back, under way or here.
enum Read<T> {
    Waiting(Arriving<T>),
    Here(Vec<T>),
}

impl<T: Pod> Read<T> {
    fn poll(self, gpu: &Gpu) -> Result<Self, GpuError> {
        match self {
            Self::Waiting(arriving) => Ok(match arriving.take(gpu)? {
                Ok(values) => Self::Here(values),
                Err(arriving) => Self::Waiting(arriving),
            }),
            here => Ok(here),
        }
    }
}

/// A view of a step.
pub(super) struct ViewRead {
    losses: Read<[f32; 4]>,
    counts: Read<u32>,
    faults: Read<u32>,
    /// What the host knows of the view.
    pub(super) about: AboutView,
}

/// What the host knows of a view.
#[derive(Clone, Copy)]
pub(super) struct AboutView {
    pub(super) stage: Stage,
    /// Step of the stage, from 1.
    pub(super) iteration: u32,
    pub(super) pixels: usize,
    /// Share of the colour loss of the step.
    pub(super) weight: f64,
    /// Labelled pixels, 0 without the instance pass.
    pub(super) labelled: usize,
    /// Labelled pixels of all views of the step.
    pub(super) labelled_of_step: usize,
    pub(super) lambda_dssim: f32,
    /// Whether it is the last view of its step.
    pub(super) last: bool,
    pub(super) gaussians: usize,
}

/// What arrived of a view.
pub(super) struct ViewNews {
    pub(super) about: AboutView,
    pub(super) loss: ViewLoss,
    pub(super) counts: GpuStatistics,
    pub(super) faults: u32,
}

impl ViewRead {
    pub(super) fn new(
        losses: Arriving<[f32; 4]>,
        counts: Arriving<u32>,
        faults: Arriving<u32>,
        about: AboutView,
    ) -> Self {
        Self {
            losses: Read::Waiting(losses),
            counts: Read::Waiting(counts),
            faults: Read::Waiting(faults),
            about,
        }
    }
}

/// Read-backs in the order of the views.
#[derive(Default)]
pub(super) struct Arrivals {
    waiting: VecDeque<ViewRead>,
}

impl Arrivals {
    pub(super) fn push(&mut self, read: ViewRead) {
        self.waiting.push_back(read);
    }

    /// The next view whose values have all arrived. Waits for the device when `all` are wanted, or when the host
    /// is far ahead.
    pub(super) fn next(&mut self, gpu: &Gpu, all: bool) -> Result<Option<ViewNews>, GpuError> {
        let Some(front) = self.waiting.pop_front() else { return Ok(None) };
        let mut front = poll(front, gpu)?;
        let is_here = |front: &ViewRead| {
            matches!(
                (&front.losses, &front.counts, &front.faults),
                (Read::Here(_), Read::Here(_), Read::Here(_))
            )
        };
        if !is_here(&front) && (all || self.waiting.len() >= AHEAD) {
            gpu.wait()?;
            front = poll(front, gpu)?;
        }
        match front {
            ViewRead {
                losses: Read::Here(losses),
                counts: Read::Here(counts),
                faults: Read::Here(faults),
                about,
            } => Ok(Some(ViewNews {
                loss: ViewLoss::new([losses[0], losses[1]], about.pixels, about.lambda_dssim),
                counts: GpuStatistics::of(&counts),
                faults: faults[0],
                about,
            })),
            waiting => {
                self.waiting.push_front(waiting);
                Ok(None)
            }
        }
    }
}

fn poll(read: ViewRead, gpu: &Gpu) -> Result<ViewRead, GpuError> {
    Ok(ViewRead {
        losses: read.losses.poll(gpu)?,
        counts: read.counts.poll(gpu)?,
        faults: read.faults.poll(gpu)?,
        about: read.about,
    })
}
