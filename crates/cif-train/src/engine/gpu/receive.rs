//! Steps as they arrive.
//!
//! The host records steps ahead of the device and reads their losses and counts when they arrive. A step that must
//! not be taken, because the pairs of a view had no room or because a loss or gradient is none that an optimiser may
//! take, is found on the device: it and every step recorded after it move nothing (see `judge.wgsl`). Once the host
//! knows, it makes room or leaves the bad step out, and records the others again. Results therefore never depend on
//! how far ahead the host was.

use cif_render::wgpu::{GpuError, Rasterizer, faults};

use super::flight::ViewResult;
use super::gpu_engine::GpuEngine;
use super::recording::uncount;
use crate::error::TrainError;
use crate::state::State;
use crate::step::{StepReport, ViewReport};
use crate::wgpu::kernels::fault;

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

    /// Remembers the most that a view needed.
    fn learn(&mut self, views: &[ViewResult]) {
        for view in views {
            let needed = [view.counts.wanted_pairs, view.counts.wanted_slots];
            self.needed = [0, 1].map(|k| self.needed[k].max(needed[k] as usize));
        }
    }

    /// Room for what views have needed, grown with the set, and a quarter more where the device has it: what is
    /// reserved has half as much on top, so that few views have to be drawn again.
    pub(super) fn make_room(&mut self, gaussians: usize) -> Result<(), GpuError> {
        if gaussians > self.needed_of && self.needed_of > 0 {
            let grown = |needed: usize| (needed as f64 * gaussians as f64 / self.needed_of as f64) as usize;
            self.needed = self.needed.map(grown);
        }
        self.needed_of = self.needed_of.max(gaussians);
        let most = Rasterizer::most_pairs(&self.gpu);
        let [pairs, slots] = self.needed;
        let roomy = (pairs + pairs / 4).min(most).max(pairs);
        self.rasterizer.reserve(&self.gpu, roomy, slots + slots / 4)
    }
}
