//! Steps on their way: recorded, not yet known to be done.

use std::collections::VecDeque;

use cif_render::wgpu::{Gpu, GpuError, GpuStatistics, PendingWords, Readback, Submission, faults};

use super::recording::Recording;
use crate::step::ViewReport;
use crate::wgpu::losses::ViewLoss;

/// Steps that the host may be ahead of what it knows of the device.
const AHEAD: usize = 8;

/// Words of the readback of a view: losses, counts, fault words.
pub(super) const VIEW_WORDS: usize = LOSS_WORDS + GpuStatistics::WORDS + faults::WORDS;

/// Words of the losses of a view.
pub(super) const LOSS_WORDS: usize = 8;

/// Properties of a view that the host knows without reading from the device.
#[derive(Clone, Copy)]
pub(super) struct AboutView {
    pub(super) pixels: usize,
    /// Labelled pixels, 0 without the instance pass.
    pub(super) labelled: usize,
    pub(super) lambda_dssim: f32,
    pub(super) gaussians: usize,
}

/// A view of a step.
pub(super) struct ViewRead {
    words: Words,
    about: AboutView,
}

enum Words {
    Waiting(PendingWords),
    Here(Vec<u32>),
}

/// Properties of a view with the losses, counts and faults that the device returned for it.
pub(super) struct ViewResult {
    pub(super) about: AboutView,
    pub(super) loss: ViewLoss,
    pub(super) counts: GpuStatistics,
    /// Bits of the step so far, and whether steps wait.
    pub(super) faults: [u32; 2],
}

impl ViewRead {
    pub(super) fn new(pending: PendingWords, about: AboutView) -> Self {
        Self { words: Words::Waiting(pending), about }
    }

    fn poll(self, gpu: &Gpu, readback: &mut Readback) -> Result<Self, GpuError> {
        let words = match self.words {
            Words::Waiting(pending) => match readback.open(gpu, pending)? {
                Ok(words) => Words::Here(words),
                Err(pending) => Words::Waiting(pending),
            },
            here => here,
        };
        Ok(Self { words, ..self })
    }

    fn result(self) -> Option<ViewResult> {
        let Words::Here(words) = self.words else { return None };
        let about = self.about;
        let (losses, rest) = words.split_at(LOSS_WORDS);
        let (counts, found) = rest.split_at(GpuStatistics::WORDS);
        let number = |k: usize| f32::from_bits(losses[k]);
        let sums = [0, 4].map(|first| [0, 1, 2, 3].map(|k| number(first + k)));
        Some(ViewResult {
            loss: ViewLoss::new(sums, about.pixels, about.lambda_dssim),
            counts: GpuStatistics::of(counts),
            faults: [found[0], found[1]],
            about,
        })
    }
}

/// A step on its way.
pub(super) struct Flight {
    pub(super) recording: Recording,
    pub(super) reads: Vec<ViewRead>,
    /// That of its last view.
    pub(super) submission: Submission,
}

/// Steps on their way, oldest first.
#[derive(Default)]
pub(super) struct Flights {
    waiting: VecDeque<Flight>,
}

impl Flights {
    pub(super) fn push(&mut self, flight: Flight) {
        self.waiting.push_back(flight);
    }

    /// The oldest step, once all of it has arrived. Waits for that step, and no other, when `all` are needed or the
    /// host is far ahead.
    pub(super) fn next(
        &mut self,
        gpu: &Gpu,
        readback: &mut Readback,
        all: bool,
    ) -> Result<Option<(Recording, Vec<ViewResult>)>, GpuError> {
        let Some(mut front) = self.waiting.pop_front() else { return Ok(None) };
        if all || self.waiting.len() >= AHEAD {
            gpu.wait_for(front.submission.clone())?;
        }
        let mut reads = Vec::with_capacity(front.reads.len());
        for read in front.reads {
            reads.push(read.poll(gpu, readback)?);
        }
        if reads.iter().any(|read| matches!(read.words, Words::Waiting(_))) {
            front.reads = reads;
            self.waiting.push_front(front);
            return Ok(None);
        }
        Ok(Some((front.recording, reads.into_iter().filter_map(ViewRead::result).collect())))
    }
}

impl ViewResult {
    pub(super) fn report(&self) -> ViewReport {
        ViewReport {
            psnr: Some(self.loss.color.psnr()),
            color_loss: self.loss.color.loss,
            instance_loss: if self.about.labelled > 0 { self.loss.instance_sum } else { 0.0 },
            unsupported: self.loss.unsupported,
        }
    }
}
