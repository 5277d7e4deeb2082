//! Sequence of the stages of a run, and the points at which it may be stopped.

use std::sync::Arc;

use cif_field::tracks::Tracks;
use cif_render::Gradients;

use super::saving::Saving;
use super::{Trainer, TrainerView, initialize, provenance};
use crate::curve::MIN_GAP;
use crate::density::DensifyStatistics;
use crate::engine::Changed;
use crate::error::TrainError;
use crate::events::{Control, Outcome, TrainEvent};
use crate::heads::{self, Target};
use crate::objects::KnownObjects;
use crate::optimiser::Optimiser;
use crate::phase::Phase;
use crate::progress::{AfterStep, Progress};
use crate::schedule::Due;
use crate::stage::Stage;
use crate::step::StepLoss;

/// Observer of a run.
type Observer<'a> = dyn FnMut(&TrainEvent, &TrainerView<'_>) -> Control + 'a;

/// Share of unsupported pixels from which the user is warned (methods reference 4.4).
const MANY_UNSUPPORTED: f64 = 0.01;

/// Requests of the observer that have not been carried out yet.
#[derive(Default)]
struct Requests {
    save: bool,
    stop: bool,
}

impl Requests {
    fn add(&mut self, control: Control) {
        match control {
            Control::Continue => {}
            Control::Save => self.save = true,
            Control::Stop => self.stop = true,
        }
    }
}

impl Trainer {
    /// Runs all stages that are left; `observer` sees every event and may stop the run, as may the
    /// [`Stop`](crate::Stop) that it was begun with, which is asked between events too. Whatever stops it, the run
    /// can be saved and resumed.
    ///
    /// # Errors
    /// When as many Gaussians as the settings allow do not fit into memory, a frame cannot be read, or too many steps in a row leave the finite numbers; the field then still is
    /// finite.
    pub fn run(&mut self, observer: &mut Observer<'_>) -> Result<Outcome, TrainError> {
        let phases = self.state.phases.clone();
        let _run = phases.enter(Phase::Other, 0);
        let result = match self.run_stages(observer) {
            Err(TrainError::Stopped) => Ok(Outcome::Interrupted),
            result => result,
        };
        self.state.field.record = self.provenance();
        result
    }

    fn run_stages(&mut self, observer: &mut Observer<'_>) -> Result<Outcome, TrainError> {
        if let Some(saved) = &self.saved_head {
            let reason = format!("it trains the head {}; set it first", saved.name);
            return Err(TrainError::BadState { reason });
        }
        if !self.has_begun() && self.gpu_name().is_none() {
            // GPUs have limits of their own.
            let most = initialize::memory_of_gaussians(self.state.config.densify.max_gaussians);
            most.check().map_err(TrainError::MemoryOfGaussians)?;
        }
        let mut requests = Requests::default();
        self.saving = Saving::begin(self.state.config.report.checkpoint_seconds, self.now_s());
        self.send_messages(observer, &mut requests);
        if requests.stop {
            return Ok(Outcome::Interrupted);
        }
        if self.lacks_search() {
            self.find_travelling()?;
            self.send_messages(observer, &mut requests);
        }
        while self.state.progress.stage != Stage::Done {
            let stage = self.state.progress.stage;
            self.stage_since = Some((stage, self.now_s()));
            let outcome = self.run_stage(stage, observer, &mut requests);
            self.count_stage_time();
            if outcome? == Outcome::Interrupted {
                return Ok(Outcome::Interrupted);
            }
        }
        if let Some(message) = self.missed_targets() {
            self.emit(observer, &TrainEvent::Warning { message });
        }
        let finished = TrainEvent::Finished {
            wall_s: self.progress().total().wall_s,
            iterations: self.state.progress.total_steps,
            gaussians: self.state.field.gaussians.len(),
            psnr: self.state.progress.psnr.unwrap_or(0.0),
            peak_rss_mb: provenance::peak_rss_mb(),
            rolled_back: self.state.progress.rollbacks.total,
            work: self.state.progress.work,
        };
        self.emit(observer, &finished);
        Ok(Outcome::Finished)
    }

    /// True of a run that goes on behind its search without what was found, as states of version 1 do.
    fn lacks_search(&self) -> bool {
        let is_behind = matches!(self.state.progress.stage, Stage::Coarse | Stage::Objects);
        is_behind && self.stages.search(&self.state.config) && !self.state.objects.is_searched
    }

    /// Runs a stage, or what is left of it, and enters the next one.
    fn run_stage(
        &mut self,
        stage: Stage,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<Outcome, TrainError> {
        let iterations = self.stages.iterations(&self.state.config, stage);
        if iterations > 0 || !stage.has_steps() {
            let started = TrainEvent::StageStarted {
                stage,
                iteration: self.state.progress.iteration,
                iterations,
                gaussians: self.state.field.gaussians.len(),
            };
            requests.add(self.emit(observer, &started));
        }
        if !stage.has_steps() && (requests.stop || self.state.phases.is_stopped()) {
            return Ok(Outcome::Interrupted);
        }
        match stage {
            Stage::Search => self.find_travelling()?,
            Stage::Objects => self.prepare_fine()?,
            Stage::Identity => self.identify(observer, requests)?,
            _ => {
                if self.train_stage(stage, observer, requests)? == Outcome::Interrupted {
                    return Ok(Outcome::Interrupted);
                }
            }
        }
        self.send_messages(observer, requests);
        let next = self.stages.after(&self.state.config, stage);
        self.end_stage(stage, next, observer, requests)?;
        if next == Stage::Done {
            self.continue_poses();
        }
        self.enter(next)?;
        self.send_messages(observer, requests);
        if next == Stage::Done {
            return Ok(Outcome::Finished);
        }
        if requests.stop || self.state.phases.is_stopped() {
            return Ok(Outcome::Interrupted);
        }
        // What a long search found is saved with the first step, by time; a short one is as soon done again.
        if self.state.config.report.checkpoint_seconds > 0 && stage != Stage::Search {
            self.count_stage_time();
            self.request_checkpoint(observer, requests);
        }
        Ok(Outcome::Finished)
    }

    /// Estimates identities: the work of the identity stage.
    fn identify(&mut self, observer: &mut Observer<'_>, requests: &mut Requests) -> Result<(), TrainError> {
        let phase = self.state.phases.enter(Phase::Identity, self.state.views_of_identities().count());
        let event = self.estimate_identities(true)?;
        drop(phase);
        requests.add(self.emit(observer, &event));
        if let TrainEvent::IdentityEstimated { empty_instances, .. } = &event {
            for said in self.on_empty_instances(empty_instances) {
                requests.add(self.emit(observer, &said));
            }
        }
        Ok(())
    }

    /// A word on instances without Gaussians: those that no training mask shows, which other windows of time may, and
    /// others.
    fn on_empty_instances(&self, ids: &[u16]) -> Vec<TrainEvent> {
        let (field, pixels) = (&self.state.field, &self.state.label_pixels);
        let indices = ids.iter().filter_map(|id| field.instance_by_id(*id));
        let (masked, absent): (Vec<usize>, Vec<usize>) =
            indices.partition(|index| pixels.get(*index).is_some_and(|pixels| *pixels > 0.0));
        let named = |indices: &[usize]| {
            let names = indices.iter().map(|index| field.instances[*index].label.as_str());
            names.collect::<Vec<_>>().join(", ")
        };
        let mut said = Vec::new();
        if !masked.is_empty() {
            let message = format!(
                "no Gaussian is most probably of {}: too small, or hidden in the frames with masks",
                named(&masked)
            );
            said.push(TrainEvent::warning(message));
        }
        if !absent.is_empty() {
            let message = format!("no training mask shows {}", named(&absent));
            said.push(match self.state.capture().window {
                Some(_) => TrainEvent::note(format!("{message} in this window")),
                None => TrainEvent::warning(message),
            });
        }
        said
    }

    /// Trains a stage that has steps.
    fn train_stage(
        &mut self,
        stage: Stage,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<Outcome, TrainError> {
        let iterations = self.stages.iterations(&self.state.config, stage);
        let phase = self.state.phases.enter(stage.into(), iterations as usize);
        let outcome = self.run_steps(stage, observer, requests);
        // Whatever ended the steps, the field is whole again.
        let fetched = self.fetch();
        drop(phase);
        for event in std::mem::take(&mut self.arrived) {
            requests.add(self.emit(observer, &event));
        }
        let outcome = outcome?;
        fetched?;
        if outcome == Outcome::Finished {
            self.finish_head(stage)?;
        }
        Ok(outcome)
    }

    /// Measures, sharpens and reports behind the work of a stage, before the next one begins.
    fn end_stage(
        &mut self,
        stage: Stage,
        next: Stage,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<(), TrainError> {
        let is_measured =
            stage == Stage::Identity || next == Stage::Done || self.state.progress.iteration >= MIN_GAP;
        if is_measured {
            match self.follow_curve(stage, true, observer, requests) {
                // The rows are there: the run goes on behind them, without this point.
                Err(TrainError::Stopped) if stage == Stage::Identity => {}
                measured => measured?,
            }
        }
        if stage == Stage::Instance {
            // Nothing behind the first change may be stopped: it must not be done twice.
            let contradicted = self.contradicted()?;
            self.sharpen_shares()?;
            self.disown(&contradicted);
            self.occupy_by_shares();
        }
        let wall_s = self.progress().stages_s.get(stage.name()).copied().unwrap_or(0.0);
        let gaussians = self.state.field.gaussians.len();
        requests.add(self.emit(observer, &TrainEvent::StageEnded { stage, wall_s, gaussians }));
        Ok(())
    }

    /// Adds the time of the stage that ran to its progress.
    fn count_stage_time(&mut self) {
        if let Some((stage, since_s)) = self.stage_since.take() {
            let spent = self.now_s() - since_s;
            self.state.progress.add_stage_s(stage, spent);
        }
    }

    /// Steps of the current stage until its end or a stop.
    fn run_steps(
        &mut self,
        stage: Stage,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<Outcome, TrainError> {
        let mut events = Vec::new();
        let phases = self.state.phases.clone();
        let mut steps = 0;
        self.report_steps(stage, steps);
        self.pace_stage(stage);
        // A budget or a target may change how many there are.
        while self.state.progress.after_step.is_some()
            || self.state.progress.iteration < self.stages.iterations(&self.state.config, stage)
        {
            if requests.stop || phases.is_stopped() {
                return Ok(Outcome::Interrupted);
            }
            let resumed = self.state.progress.after_step;
            let done = match resumed {
                None => self.step(&mut events).map(Some),
                Some(_) => self.finish_step(stage, &mut events).map(|()| None),
            };
            steps += u32::from(resumed.is_none());
            events.append(&mut self.messages);
            for event in events.drain(..) {
                requests.add(self.emit(observer, &event));
            }
            let loss = done?;
            let iteration = self.state.progress.iteration;
            let iterations = self.stages.iterations(&self.state.config, stage);
            if let Some(loss) = loss
                && self.done().has(Due::Report)
            {
                phases.advance_to(u64::from(iteration));
                self.report_steps(stage, std::mem::take(&mut steps));
                let event = self.step_event(stage, iterations, &loss);
                requests.add(self.emit(observer, &event));
            }
            if let Some(share) =
                loss.and_then(|loss| loss.unsupported).filter(|share| *share > MANY_UNSUPPORTED)
                && !self.state.progress.warned_of_unsupported
            {
                self.state.progress.warned_of_unsupported = true;
                let message = format!(
                    "{:.1} % of the labelled pixels of step {iteration} are covered by no Gaussian of their \
                     instance; more Gaussians or a longer fine stage may help",
                    100.0 * share
                );
                requests.add(self.emit(observer, &TrainEvent::Warning { message }));
            }
            if resumed != Some(AfterStep::Evaluation) {
                self.state.progress.after_step = Some(AfterStep::Curve);
                self.follow_curve(stage, false, observer, requests)?;
                self.follow_budget(stage);
            }
            self.state.progress.after_step = Some(AfterStep::Evaluation);
            if self.done().has(Due::Evaluate) {
                self.fetch()?;
                let event = self.evaluate(stage)?;
                requests.add(self.emit(observer, &event));
            }
            self.state.progress.after_step = None;
            if self.done().has(Due::Save)
                || self.saving.is_due(self.state.config.report.checkpoint_seconds, self.now_s())
                || requests.save
            {
                requests.save = false;
                self.fetch()?;
                self.request_checkpoint(observer, requests);
            }
        }
        Ok(Outcome::Finished)
    }

    /// Asks the observer to save the run as it stands.
    fn request_checkpoint(&mut self, observer: &mut Observer<'_>, requests: &mut Requests) {
        let start_s = self.now_s();
        let Progress { stage, iteration, .. } = self.state.progress;
        requests.add(self.emit(observer, &TrainEvent::CheckpointDue { stage, iteration }));
        self.saving.saved(self.state.config.report.checkpoint_seconds, start_s, self.now_s());
    }

    /// [`TrainError::Stopped`] once a stop is requested. Work between two steps on a GPU is never left half way.
    pub(super) fn check_stop(&self) -> Result<(), TrainError> {
        if self.engine.gpu_name().is_some() { Ok(()) } else { self.state.phases.check() }
    }

    /// Measures a point of the curve where one is due, and acts on it.
    fn follow_curve(
        &mut self,
        stage: Stage,
        ends: bool,
        observer: &mut Observer<'_>,
        requests: &mut Requests,
    ) -> Result<(), TrainError> {
        let Some(event) = self.measure_curve(stage, ends)? else { return Ok(()) };
        requests.add(self.emit(observer, &event));
        if let TrainEvent::Measured { point, .. } = &event
            && let Some(message) = self.follow_targets(point)
        {
            requests.add(self.emit(observer, &TrainEvent::Warning { message }));
        }
        Ok(())
    }

    /// Event of the last report.
    fn step_event(&self, stage: Stage, iterations: u32, loss: &StepLoss) -> TrainEvent {
        TrainEvent::Step {
            stage,
            iteration: self.state.progress.iteration,
            iterations,
            loss: loss.total,
            color_loss: loss.color,
            instance_loss: loss.instance,
            unsupported_px: loss.unsupported,
            gaussians: self.state.field.gaussians.len(),
            psnr: self.state.progress.psnr.unwrap_or(0.0),
            iterations_per_second: self.reports.rate(),
            eta_s: self.eta_s(stage),
        }
    }

    /// Sends what was found meanwhile.
    fn send_messages(&mut self, observer: &mut Observer<'_>, requests: &mut Requests) {
        for event in std::mem::take(&mut self.messages) {
            requests.add(self.emit(observer, &event));
        }
    }

    fn now_s(&self) -> f64 {
        self.state.phases.now().wall_s
    }

    fn emit(&self, observer: &mut Observer<'_>, event: &TrainEvent) -> Control {
        observer(event, &TrainerView { trainer: self })
    }

    /// Begins a stage. The run stays at the end of the stage before it when that fails or is stopped.
    pub(super) fn enter(&mut self, stage: Stage) -> Result<(), TrainError> {
        // A stage of objects has made the field already.
        if stage == Stage::Fine && self.state.progress.stage != Stage::Objects {
            self.prepare_fine()?;
        }
        self.prepare_head(stage)?;
        self.begin(stage);
        Ok(())
    }

    /// Makes the field that the fine stage begins with, or leaves everything as it was when that fails or is stopped:
    /// the work of the stage of objects. Fits that were complete are kept all the same.
    pub(super) fn prepare_fine(&mut self) -> Result<(), TrainError> {
        let before = self.state.keep();
        if let Err(error) = self.make_fine_field() {
            self.state.put_back(before);
            return Err(error);
        }
        self.state.objects = KnownObjects::default();
        Ok(())
    }

    /// Gives the fine stage its deformation and a new optimiser (methods reference 1.3).
    fn make_fine_field(&mut self) -> Result<(), TrainError> {
        if self.stages.is_dynamic {
            self.state.field.deformation =
                Some(initialize::initial_deformation(&self.state.dataset, &self.state.config)?);
        }
        self.start_guidance()?;
        self.state.optimiser = Optimiser::new(&self.state.field);
        self.state.gradients = Gradients::zeros(&self.state.field);
        Ok(())
    }

    /// Stands at the start of a stage, with the field and the optimiser as they are.
    pub(super) fn begin(&mut self, stage: Stage) {
        self.state.progress.stage = stage;
        self.state.progress.iteration = 0;
        self.state.progress.sh_start = self.state.field.sh_degree;
        self.state.progress.opacities_were_reset = false;
        self.state.statistics = DensifyStatistics::zeros(self.state.field.gaussians.len());
        if let Some(tracks) = &mut self.state.field.tracks {
            // On a device they are held in single precision.
            tracks.hold_joints();
        }
        let head = Arc::clone(&self.state.head);
        if let Some(head) = heads::value_head(&head, &self.state.config)
            && stage == Stage::Done
            && self.state.field.identities.is_some()
        {
            self.state.field.identities = match head.target() {
                Target::Labels => {
                    let labels = head.label_of_rows(&self.state.head_tensors, &self.state.field);
                    Some(heads::identities(&labels))
                }
                // Nobody says whose a Gaussian is.
                Target::Features => None,
            };
            self.state.optimiser.start_identities(&self.state.field);
            // The head says whose Gaussians are, whichever objects poses were fitted to.
            self.state.field.tracks.iter_mut().for_each(Tracks::forget_instances);
        }
        self.engine.changed(Changed::Everything);
    }
}

#[cfg(test)]
mod tests {
    use cif_dataset::{CaptureWindow, TimeWindow};

    use super::super::guard_tests::support::{Scene, capture, small_config};
    use super::*;

    #[test]
    fn instances_that_other_windows_show_are_no_warning() {
        let folder = tempfile::tempdir().unwrap();
        let mut trainer = Trainer::new(capture(folder.path(), Scene::default()), small_config()).unwrap();
        trainer.state.label_pixels = vec![5.0, 0.0, 0.0];
        let said = |trainer: &Trainer| -> Vec<String> {
            let events = trainer.on_empty_instances(&[4, 7, 9]).into_iter();
            events
                .map(|event| match event {
                    TrainEvent::Warning { message } => format!("warning: {message}"),
                    TrainEvent::Note { message } => format!("note: {message}"),
                    other => panic!("{other:?}"),
                })
                .collect()
        };
        let absent = "no training mask shows ball 7, ball 9";
        let masked = "warning: no Gaussian is most probably of ball 4";
        let all = said(&trainer);
        assert!(all.len() == 2 && all[0].starts_with(masked), "{all:?}");
        assert_eq!(all[1], format!("warning: {absent}"));
        let window = TimeWindow::new(1, 2).unwrap();
        trainer.state.dataset.window = Some(CaptureWindow { window, first: 0, times: [0.0, 0.5] });
        assert_eq!(said(&trainer)[1], format!("note: {absent} in this window"));
        assert!(trainer.on_empty_instances(&[]).is_empty());
    }
}
