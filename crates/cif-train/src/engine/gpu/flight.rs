//! Steps on their way: recorded, not yet known to be done.
//!
//! The host records steps ahead of the device and reads their losses and counts when they arrive. A step that must
//! not be taken, because the pairs of a view had no room or because a loss or gradient is none that an optimiser may
//! take, is found on the device: it and every step recorded after it move nothing (see `judge.wgsl`). Once the host
//! knows, it makes room or leaves the bad step out, and records the others again. Results therefore never depend on
//! how far ahead the host was.

use std::collections::VecDeque;

use cif_render::wgpu::{Gpu, GpuError, GpuStatistics, PendingWords, Readback, Submission, faults};

use super::GpuEngine;
use super::step::{Recording, uncount};
use crate::error::TrainError;
use crate::state::State;
use crate::step::{StepReport, ViewReport};
use crate::wgpu::kernels::fault;
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
    faults: [u32; 2],
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

    /// The oldest step, once all of it has arrived. Waits for that step, and no other, when `all` are wanted or the
    /// host is far ahead.
    fn next(
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

impl GpuEngine {
    /// The oldest step on its way, once it has arrived; `all` waits for it.
    pub(super) fn receive_step(
        &mut self,
        state: &mut State,
        all: bool,
    ) -> Result<Option<StepReport>, TrainError> {
        self.record_again(state)?;
        loop {
            let Some((recording, results)) = self.flights.next(&self.gpu, &mut self.readback, all)? else {
                return Ok(None);
            };
            self.learn(&results);
            let [found, waits] = results.last().map_or([0; 2], |view| view.faults);
            if waits == 0 {
                for view in &results {
                    state.times.views += 1;
                    state.times.gaussians += view.about.gaussians as u64;
                    state.times.visible += u64::from(view.counts.visible);
                    state.times.tile_pairs += u64::from(view.counts.pairs);
                }
                self.make_room(recording.gaussians)?;
                let views: Vec<ViewReport> = results.iter().map(ViewResult::report).collect();
                return Ok(Some(StepReport { plan: recording.plan, views, fault: None }));
            }
            // It and those behind it moved nothing.
            while let Some((later, results)) = self.flights.next(&self.gpu, &mut self.readback, true)? {
                self.learn(&results);
                self.again.push(later);
            }
            // Sums of these steps are empty: their own optimiser took them, and moved nothing.
            self.faults.write(&self.gpu, 0, &[0; faults::WORDS]);
            if found & fault::NO_ROOM != 0 {
                self.make_room(recording.gaussians)?;
                self.again.insert(0, recording);
                self.record_again(state)?;
                continue;
            }
            uncount(state, recording.moving);
            for later in &mut self.again {
                later.uncount(recording.moving);
            }
            let fault = self.diagnose(state, &recording, found)?;
            return Ok(Some(StepReport { plan: recording.plan, views: Vec::new(), fault: Some(fault) }));
        }
    }

    /// Records the steps again that were behind one that must not be taken.
    pub(super) fn record_again(&mut self, state: &mut State) -> Result<(), TrainError> {
        for recording in std::mem::take(&mut self.again) {
            self.record(state, recording)?;
        }
        Ok(())
    }
}

impl ViewResult {
    fn report(&self) -> ViewReport {
        ViewReport {
            psnr: Some(self.loss.color.psnr()),
            color_loss: self.loss.color.loss,
            instance_loss: if self.about.labelled > 0 { self.loss.instance_sum } else { 0.0 },
            unsupported: self.loss.unsupported,
        }
    }
}

impl GpuEngine {
    /// Remembers the most that a view wanted.
    fn learn(&mut self, views: &[ViewResult]) {
        for view in views {
            let wanted = [view.counts.wanted_pairs, view.counts.wanted_slots];
            self.wanted = [0, 1].map(|k| self.wanted[k].max(wanted[k] as usize));
        }
    }

    /// Room for what views have wanted, grown with the set, and a quarter more where the device has it: what is
    /// reserved has half as much on top, so that few views have to be drawn again.
    pub(super) fn make_room(&mut self, gaussians: usize) -> Result<(), GpuError> {
        if gaussians > self.wanted_of && self.wanted_of > 0 {
            let grown = |wanted: usize| (wanted as f64 * gaussians as f64 / self.wanted_of as f64) as usize;
            self.wanted = self.wanted.map(grown);
        }
        self.wanted_of = self.wanted_of.max(gaussians);
        let most = cif_render::wgpu::Rasterizer::most_pairs(&self.gpu);
        let [pairs, slots] = self.wanted;
        let roomy = (pairs + pairs / 4).min(most).max(pairs);
        self.rasterizer.reserve(&self.gpu, roomy, slots + slots / 4)
    }
}
