//! Steps on their way: recorded, not yet known to be done.
//!
//! The host records steps ahead of the device and reads their losses and counts when they arrive. A step that must
//! not be taken, because the pairs of a view had no room or because a loss or gradient is none that an optimiser may
//! take, is found on the device: it and every step recorded after it move nothing (see `judge.wgsl`). Once the host
//! knows, it makes room or leaves the bad step out, and records the others again. Results therefore never depend on
//! how far ahead the host was.

use std::collections::VecDeque;

use cif_render::wgpu::{Gpu, GpuError, GpuStatistics, PendingWords, Readback, Submission, faults};

use super::super::step::{StepLoss, ViewReport};
use super::super::step_plan::StepPlan;
use super::DeviceTraining;
use super::step::Recording;
use crate::error::TrainError;
use crate::trainer::Trainer;
use crate::wgpu::kernels::fault;
use crate::wgpu::losses::ViewLoss;

/// Steps that the host may be ahead of what it knows of the device.
const AHEAD: usize = 8;

/// Words of the readback of a view: losses, counts, fault words.
pub(super) const VIEW_WORDS: usize = LOSS_WORDS + GpuStatistics::WORDS + faults::WORDS;

/// Words of the losses of a view.
pub(super) const LOSS_WORDS: usize = 8;

/// What the host knows of a view.
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

/// What arrived of a view.
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

impl Trainer {
    /// Takes in the steps that have arrived; `all` waits for every one that was recorded.
    pub(super) fn receive(&mut self, device: &mut DeviceTraining, all: bool) -> Result<(), TrainError> {
        while let Some((recording, results)) = device.flights.next(&device.gpu, &mut device.readback, all)? {
            for view in &results {
                device.learn(&view.counts);
            }
            let [found, waits] = results.last().map_or([0; 2], |view| view.faults);
            if waits == 0 {
                self.take_in_results(&recording.plan, &results);
                device.make_room(recording.plan.gaussians)?;
                continue;
            }
            self.redo(device, recording, found)?;
        }
        Ok(())
    }

    /// Leaves out a step that must not be taken, or makes room for it, and records it and those after it again.
    fn redo(
        &mut self,
        device: &mut DeviceTraining,
        recording: Recording,
        found: u32,
    ) -> Result<(), TrainError> {
        let mut again = Vec::new();
        while let Some((later, results)) = device.flights.next(&device.gpu, &mut device.readback, true)? {
            for view in &results {
                device.learn(&view.counts);
            }
            again.push(later);
        }
        // Sums of these steps are empty: their own optimiser took them, and moved nothing.
        device.faults.write(&device.gpu, 0, &[0; faults::WORDS]);
        if found & fault::NO_ROOM != 0 {
            device.make_room(recording.plan.gaussians)?;
            again.insert(0, recording);
        } else {
            let fault = self.diagnose(device, &recording, found)?;
            self.uncount(recording.moving);
            for later in &mut again {
                later.uncount(recording.moving);
            }
            match self.count_bad_step(recording.plan.stage, recording.plan.iteration, fault) {
                Ok(event) => self.arrived.push(event),
                Err(error) => {
                    self.forget(&again);
                    return Err(error);
                }
            }
        }
        for later in again {
            self.record(device, later)?;
        }
        Ok(())
    }

    /// Stands before a step again that ended the run; those after it have moved nothing either.
    fn forget(&mut self, later: &[Recording]) {
        for step in later {
            self.uncount(step.moving);
        }
        self.progress.uncount_steps(1 + later.len() as u32);
    }

    /// Losses and counts of a step that was taken.
    fn take_in_results(&mut self, plan: &StepPlan, results: &[ViewResult]) {
        let reports: Vec<ViewReport> = results.iter().map(ViewResult::report).collect();
        for view in results {
            self.times.views += 1;
            self.times.gaussians += view.about.gaussians as u64;
            self.times.visible += u64::from(view.counts.visible);
            self.times.tile_pairs += u64::from(view.counts.pairs);
        }
        self.last_loss = StepLoss::new(plan, &reports, self.config.loss.lambda_instance);
        self.take_in(&reports);
    }
}

impl ViewResult {
    fn report(&self) -> ViewReport {
        ViewReport {
            psnr: self.loss.color.psnr(),
            color_loss: self.loss.color.loss,
            instance_loss: if self.about.labelled > 0 { self.loss.instance_sum } else { 0.0 },
            unsupported: self.loss.unsupported,
        }
    }
}

impl DeviceTraining {
    /// Remembers the most that a view wanted.
    fn learn(&mut self, counts: &GpuStatistics) {
        let wanted = [counts.wanted_pairs, counts.wanted_slots];
        self.wanted = [0, 1].map(|k| self.wanted[k].max(wanted[k] as usize));
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
