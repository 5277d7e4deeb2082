//! One optimiser step, and what changes the field behind it.

use std::sync::Arc;
use std::time::Instant;

use cif_field::Field;
use cif_field::parameters::{MLP, OPACITY_LOGITS};
use cif_render::{Gradients, RenderedImage};

use super::Trainer;
use crate::config::Ablation;
use crate::density::adaptive::reset_opacities;
use crate::density::relocate::{ResampleContext, apply, choose};
use crate::density::{Change, DensifyStatistics, Rearrangement, Rows};
use crate::effects::harmonics::degree_at;
use crate::effects::{Bench, Effect, Place, Standing, Step, copy_still, gather_still};
use crate::engine::failure::{draw, replace_failed};
use crate::engine::{Views, validation};
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::guard::{Hint, MAX_ROLLBACKS_IN_A_ROW};
use crate::progress::AfterStep;
use crate::random::{Purpose, stream};
use crate::schedule::{Due, Moment};
use crate::stage::Stage;
use crate::state::State;
use crate::step::{StepLoss, StepReport};
use crate::times::lap;

impl Trainer {
    /// A step, and what the schedule has behind it. Where steps run ahead on a GPU, the loss is that of the last step
    /// that has arrived.
    pub(super) fn step(&mut self, events: &mut Vec<TrainEvent>) -> Result<StepLoss, TrainError> {
        let result = self.try_step(events);
        events.append(&mut self.arrived);
        result.map_err(|error| self.engine_failed(error))
    }

    fn try_step(&mut self, events: &mut Vec<TrainEvent>) -> Result<StepLoss, TrainError> {
        let start = Instant::now();
        let (stage, iteration) = (self.state.progress.stage, self.state.progress.iteration + 1);
        for (effect, _) in self.effects_at(Place::Before, &self.coming()).into_iter().filter(|(_, due)| *due)
        {
            self.fetch()?;
            self.judge(&*effect, stage, iteration, events)?;
        }
        if matches!(stage, Stage::Coarse | Stage::Fine) {
            let State { field, config, progress, .. } = &mut self.state;
            field.sh_degree = degree_at(config, progress, iteration);
        }
        if self.debug_validation {
            self.fetch()?;
            let plan = self.plan_step(stage, iteration)?;
            let report = validation::step(&mut *self.engine, &mut self.state, plan)?;
            self.state.progress.count_step();
            self.take_in(report)?;
        } else {
            let plan = self.plan_step(stage, iteration)?;
            if plan.trains_head {
                // What a head learns from is on the host.
                self.fetch()?;
            }
            self.engine.step(&mut self.state, plan)?;
            self.state.progress.count_step();
            self.receive(false)?;
        }
        let mut since = Instant::now();
        self.state.progress.after_step = Some(AfterStep::Changes);
        self.finish_step(stage, events)?;
        lap(&mut self.state.times.rearrange, &mut since);
        self.state.times.total += start.elapsed();
        self.state.times.steps += 1;
        Ok(self.last_loss)
    }

    /// Takes in the steps that are done; `all` waits for every one.
    fn receive(&mut self, all: bool) -> Result<(), TrainError> {
        while let Some(report) = self.engine.receive(&mut self.state, all)? {
            self.take_in(report)?;
        }
        Ok(())
    }

    /// Brings the state up to date, with every step taken in.
    pub(super) fn fetch(&mut self) -> Result<(), TrainError> {
        let received = self.receive(true);
        let fetched = match &received {
            Err(TrainError::Device(_)) => Ok(()),
            // A bad step moved nothing, so the field is good.
            _ => self.engine.fetch(&mut self.state),
        };
        received.and(fetched).map_err(|error| self.engine_failed(error))
    }

    /// After a failure of its engine the run goes on on the processor, from what was fetched last.
    fn engine_failed(&mut self, error: TrainError) -> TrainError {
        replace_failed(&mut self.engine, &mut self.state, self.simd, error)
    }

    /// Renders views between steps, see [`draw`].
    pub(super) fn draw(
        &mut self,
        trial: Option<&Field>,
        views: Views<'_>,
        each: &mut dyn FnMut(RenderedImage),
    ) -> Result<(), TrainError> {
        draw(&mut self.engine, &mut self.state, self.simd, trial, views, each)
    }

    /// Effects that have their place around a step, and whether they are judged there.
    fn effects_at(&self, place: Place, step: &Moment<'_>) -> Vec<(Arc<dyn Effect>, bool)> {
        let standing = Standing { field: &self.state.field, progress: &self.state.progress };
        let here = self.effects.iter().filter(|effect| effect.place() == place);
        here.map(|effect| (Arc::clone(effect), effect.due(step, &standing))).collect()
    }

    /// The run at the judgement of effects that falls on a step of a stage.
    pub(crate) fn at_judgement<'a>(
        &'a mut self,
        stage: Stage,
        iteration: u32,
        events: &'a mut Vec<TrainEvent>,
    ) -> Bench<'a> {
        let is_before = iteration > self.state.progress.iteration;
        let total = self.state.progress.total_steps + u64::from(is_before);
        let facts = self.moment(stage, iteration, total).facts;
        Bench {
            step: Step { stage, iteration, total, facts },
            state: &mut self.state,
            engine: &mut self.engine,
            simd: self.simd,
            changes: &mut self.changes,
            events,
        }
    }

    /// Judges an effect, and counts the time that it takes.
    fn judge(
        &mut self,
        effect: &dyn Effect,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let start = Instant::now();
        let judged = effect.judge(&mut self.at_judgement(stage, iteration, events));
        *self.state.progress.effects_s.entry(effect.name().to_owned()).or_default() +=
            start.elapsed().as_secs_f64();
        judged
    }

    /// Takes in a step: its losses, or its fault. Too many bad steps in a row end the run, which then stands before
    /// the last of them.
    fn take_in(&mut self, report: StepReport) -> Result<(), TrainError> {
        let StepReport { plan, views, fault } = report;
        let Some(fault) = fault else {
            self.last_loss = StepLoss::new(&plan, &views, self.state.config.loss.lambda_instance);
            let progress = &mut self.state.progress;
            views.iter().filter_map(|view| view.psnr).for_each(|psnr| progress.add_psnr(psnr));
            progress.rollbacks.in_a_row = 0;
            return Ok(());
        };
        let (stage, iteration) = (plan.stage, plan.iteration);
        let rollbacks = &mut self.state.progress.rollbacks;
        rollbacks.total += 1;
        rollbacks.in_a_row += 1;
        rollbacks.last = Some(format!("{stage} stage, step {iteration}: {fault}"));
        let (in_a_row, total) = (rollbacks.in_a_row, rollbacks.total);
        if in_a_row < MAX_ROLLBACKS_IN_A_ROW {
            self.arrived.push(TrainEvent::RolledBack { stage, iteration, fault, in_a_row, total });
            return Ok(());
        }
        // A resumed run gets as many attempts again.
        rollbacks.in_a_row = 0;
        let later = self.engine.give_up(&mut self.state);
        self.state.progress.uncount_steps(1 + later);
        let hint = if self.debug_validation { Hint::Rates } else { Hint::Validate };
        Err(TrainError::Diverged { stage, iteration, in_a_row, fault, hint })
    }

    /// Makes the changes of the field that follow a step; goes on where a stop interrupted them.
    pub(super) fn finish_step(
        &mut self,
        stage: Stage,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let iteration = self.state.progress.iteration;
        let due = self.done().all();
        let falls = |what: Due| due.contains(&what);
        let effects = self.effects_at(Place::Behind, &self.done());
        let judges = effects.iter().any(|(_, due)| *due);
        if judges || falls(Due::EstimateIdentities) || self.engine.is_far_ahead() {
            self.fetch()?;
        }
        if self.state.progress.after_step == Some(AfterStep::Changes) {
            self.rearrange_by_head(stage, iteration, events)?;
            let done = self.done();
            let densifies = done.is_of_colors() && self.density.changes(&done) > 0;
            if densifies || falls(Due::EstimateIdentities) || falls(Due::Resample) {
                self.change_gaussians(stage, iteration, &due, events)?;
            }
            self.state.progress.after_step = Some(AfterStep::effect(0));
        }
        for (k, (effect, due)) in effects.into_iter().enumerate() {
            if self.state.progress.after_step == Some(AfterStep::effect(k)) {
                if due {
                    self.judge_wholly(&*effect, stage, iteration, events)?;
                }
                self.state.progress.after_step = Some(AfterStep::effect(k + 1));
            }
        }
        self.state.progress.after_step = None;
        Ok(())
    }

    /// Changes of the set of Gaussians, or of whose they are, behind a step.
    fn change_gaussians(
        &mut self,
        stage: Stage,
        iteration: u32,
        due: &[Due],
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        self.receive(true)?;
        self.engine.begin_changes(&mut self.state, stage == Stage::Instance)?;
        let changed = match stage {
            Stage::Instance => self.instance_events(iteration, due, events).map(|()| false),
            _ => self.densify(stage, iteration, events),
        };
        let taken = self.engine.end_changes(&mut self.state, changed.as_ref().ok().copied());
        changed.and(taken)
    }

    /// Judges an effect behind a step, or leaves everything as it was when that fails or is stopped.
    fn judge_wholly(
        &mut self,
        effect: &dyn Effect,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let reported = events.len();
        let before =
            (self.state.field.clone(), self.state.optimiser.of(&MLP).clone(), self.state.progress.still_rung);
        let result = self.judge(effect, stage, iteration, events);
        if result.is_err() {
            (self.state.field, *self.state.optimiser.of(&MLP), self.state.progress.still_rung) = before;
            self.state.gradients = Gradients::zeros(&self.state.field);
            events.truncate(reported);
        }
        result
    }

    /// Makes the changes that the densification strategy has behind this step; true when opacities were capped.
    fn densify(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<bool, TrainError> {
        let strategy = Arc::clone(&self.density);
        let mut rng = stream(self.state.config.seed, Purpose::Split, self.state.progress.total_steps);
        let (mut cloned, mut split, mut pruned, mut capped) = (0, 0, 0, false);
        let views = strategy.views(&self.done());
        let mut contributions = if views > 0 { Some(self.contributions(views)?) } else { None };
        for k in 0..strategy.changes(&self.done()) {
            let state = &self.state;
            let rows = Rows {
                gaussians: &state.field.gaussians,
                statistics: &state.statistics,
                contributions: contributions.as_ref(),
                made_for: &state.made_for(),
                extent: state.field.extent,
                opacities_were_reset: state.progress.opacities_were_reset,
            };
            let Change { rearrangement, restarts_statistics, opacity_cap } =
                strategy.change(k, &self.done(), &rows, &mut rng);
            if let Some(change) = rearrangement {
                if change.gaussians.is_empty() {
                    return Err(TrainError::NoGaussians { stage, iteration });
                }
                (cloned, split, pruned) =
                    (cloned + change.cloned, split + change.split, pruned + change.pruned);
                contributions = contributions.map(|before| before.gather(&change.origins));
                self.rearrange(change);
            }
            if restarts_statistics {
                self.state.statistics = DensifyStatistics::zeros(self.state.field.gaussians.len());
            }
            if let Some(opacity) = opacity_cap {
                reset_opacities(&mut self.state.field.gaussians, opacity);
                self.state.optimiser.of(&OPACITY_LOGITS).reset_all();
                self.state.progress.opacities_were_reset = true;
                capped = true;
            }
        }
        if cloned + split + pruned > 0 {
            let gaussians = self.state.field.gaussians.len();
            events.push(TrainEvent::Densified { stage, iteration, cloned, split, pruned, gaussians });
        }
        Ok(capped)
    }

    /// Replaces the set of Gaussians, and everything that has a row per Gaussian.
    pub(super) fn rearrange(&mut self, change: Rearrangement) {
        self.engine.rearrange(&mut self.state, &change);
        self.state.statistics.gather(&change.origins);
        self.state.head_tensors.gather(&change.parents, &change.origins);
        self.state.guidance.gather(&change.parents);
        gather_still(&mut self.state.field, &change.parents);
        if let Some(tracks) = &mut self.state.field.tracks {
            *tracks = tracks.gather(&change.parents);
        }
        self.state.field.gaussians = change.gaussians;
        self.state.gradients = Gradients::zeros(&self.state.field);
    }

    /// Refreshed estimates and relocations that fall on this step.
    fn instance_events(
        &mut self,
        iteration: u32,
        due: &[Due],
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        if due.contains(&Due::EstimateIdentities) {
            let event = self.estimate_identities(false)?;
            events.push(event);
        }
        if !due.contains(&Due::Resample) {
            return Ok(());
        }
        let context = ResampleContext {
            config: &self.state.config.resample,
            unseen: &self.state.unseen,
            label_pixels: &self.state.label_pixels,
            opacity_is_occupancy: self.state.config.ablates(Ablation::OpacityOccupancy),
            occupancy_is_constant: self.state.config.ablates(Ablation::ConstantOccupancy),
            occupancy_floor: self.state.config.instance.occupancy_limits[0],
        };
        let mut rng = stream(self.state.config.seed, Purpose::Resample, u64::from(iteration));
        let relocations = choose(&self.state.field, &context, &mut rng);
        if relocations.pairs.is_empty() {
            return Ok(());
        }
        let relocated = apply(&mut self.state.field, &relocations, &context, &mut rng);
        self.engine.relocate(&mut self.state, &relocations.pairs, &relocated);
        for pair in &relocations.pairs {
            self.state.guidance.copy(pair.weak, pair.source);
            self.state.head_tensors.relocate(pair.weak, pair.source);
            copy_still(&mut self.state.field, pair.weak, pair.source);
            if let Some(tracks) = &mut self.state.field.tracks {
                tracks.group_of[pair.weak as usize] = tracks.group_of[pair.source as usize];
            }
            self.state.unseen[pair.weak as usize] = self.state.unseen[pair.source as usize];
        }
        self.state.gradients = Gradients::zeros(&self.state.field);
        events.push(TrainEvent::Resampled {
            iteration,
            pairs: relocations.pairs.len(),
            labels: relocations.labels,
            sources: relocated.sources.len(),
            floored: relocated.floored,
        });
        Ok(())
    }
}
