//! One optimiser step on the device; its twin is `trainer/step.rs`.

use std::sync::Arc;
use std::time::{Duration, Instant};

use cif_geometry::scalar::logit;
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_render::wgpu::{Commands, GpuError, LabelInput, PosedInput, ViewInput};
use cif_render::{InstanceNormalisation, RenderSettings};

use super::super::frames::TrainFrame;
use super::super::optimiser::StepRates;
use super::super::step::{RENORMALISE_EVERY, StepLoss};
use super::super::times::StepTimes;
use super::super::{InstancePass, Trainer};
use super::arriving::{AboutView, ViewNews, ViewRead};
use super::resident::{Resident, Stale};
use super::{DeviceTraining, FETCH_EVERY};
use crate::adam::{Moments, PlaneWeights};
use crate::config::Ablation;
use crate::error::TrainError;
use crate::events::{Stage, TrainEvent};
use crate::schedule::falls_on;
use crate::wgpu::kernels::fault_name;
use crate::wgpu::losses::{GpuTarget, LossWeights, SLOTS};
use crate::wgpu::optimiser::{GaussianStep, GroupStep};

/// A view of a step.
struct StepView {
    /// Position among the training views, and index in the capture.
    view: usize,
    index: usize,
    frame: Arc<TrainFrame>,
}

/// What all views of a step share.
struct StepContext {
    stage: Stage,
    iteration: u32,
    settings: RenderSettings,
    /// Labelled pixels of all views.
    labelled: usize,
    rates: StepRates,
    weights: PlaneWeights,
}

impl Trainer {
    /// Renders the step's views forward and backward and moves the parameters, all on the device. The loss is that
    /// of the last step that has arrived.
    pub(in crate::trainer) fn device_step(
        &mut self,
        events: &mut Vec<TrainEvent>,
    ) -> Result<StepLoss, TrainError> {
        let Some(mut device) = self.device.take() else { return Ok(StepLoss::default()) };
        let result = self.step_on(&mut device);
        // Rare events look at the host's state, and change it.
        let result = match result {
            Ok(()) => {
                let waits = device.waits;
                self.receive(&mut device, waits)
            }
            failed => failed,
        };
        self.device = Some(device);
        result.and_then(|()| self.rare_events(events)).map_err(|error| self.device_failed(error))?;
        Ok(self.last_loss)
    }

    fn step_on(&mut self, device: &mut DeviceTraining) -> Result<(), TrainError> {
        let start = Instant::now();
        if !device.ahead {
            device.fetched = Some(self.counters());
        }
        let stage = self.progress.stage;
        let iteration = self.progress.iteration + 1;
        let batch = self.config.stages.batch;
        if matches!(stage, Stage::Coarse | Stage::Fine) {
            self.field.sh_degree = self.degree_at(iteration);
        }
        let mut views = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let view = self.view_at(stage, u64::from(iteration - 1) * u64::from(batch) + u64::from(k));
            let frame = self.frames.get(&self.dataset, view)?;
            views.push(StepView { view, index: self.frames.index(view), frame });
        }
        if device.resident.is_none() {
            device.resident = Some(Resident::new(&device.gpu)?);
            device.stale = Stale { gaussians: true, identities: true, deformation: true };
        }
        let mut resident = device.resident.take().expect("made above");
        let sent = resident.send(&device.gpu, device.stale, &self.field, &self.optimiser, &self.statistics);
        let sent = sent.and_then(|()| {
            if device.stale.gaussians {
                device.motion.send(&device.gpu, self.guide_of())?;
                device.losses.leave_out(&device.gpu, self.travelling_labels().unwrap_or(&[]))?;
                device.make_room(self.field.gaussians.len())?;
            }
            device.stale = Stale::default();
            Ok(())
        });
        let context = StepContext {
            stage,
            iteration,
            settings: RenderSettings {
                instances: (stage == Stage::Instance && self.instance_pass == InstancePass::On)
                    .then(|| self.instance_settings()),
                ..self.color_settings()
            },
            labelled: views.iter().map(|view| view.frame.labelled).sum(),
            rates: StepRates::at(&self.config, stage, iteration, self.field.extent),
            weights: PlaneWeights {
                smoothness: self.config.loss.plane_smoothness,
                time_smoothness: self.config.loss.time_smoothness,
                time_sparsity: self.config.loss.time_sparsity,
            },
        };
        let step = self.gaussian_step(&context);
        let mut result = sent.map_err(TrainError::from);
        for (k, view) in views.iter().enumerate() {
            let last = (k + 1 == views.len()).then_some(&step);
            result = result
                .and_then(|()| self.view_on(device, &mut resident, &context, (view, k == 0), last))
                .and_then(|()| device.gpu.check().map_err(TrainError::from));
        }
        device.resident = Some(resident);
        result?;
        device.ahead = true;
        device.since_fetch += 1;
        self.progress.iteration = iteration;
        self.progress.total_steps += 1;
        *self.progress.steps.entry(stage.name().to_owned()).or_default() += 1;
        self.times.total += start.elapsed();
        self.times.steps += 1;
        Ok(())
    }

    /// Counts the step of every group that moves, and says how far.
    fn gaussian_step(&mut self, context: &StepContext) -> GaussianStep {
        let rates = &context.rates;
        let optimiser = &mut self.optimiser;
        let count = |moments: &mut Moments, moves: bool| {
            moments.steps += u32::from(moves);
            moments.steps
        };
        let group = |moments: &mut Moments, rate: f32| GroupStep { rate, steps: count(moments, rate > 0.0) };
        let step = GaussianStep {
            means: group(&mut optimiser.means, rates.means),
            log_scales: group(&mut optimiser.log_scales, rates.log_scales),
            quaternions: group(&mut optimiser.quaternions, rates.quaternions),
            opacity: group(&mut optimiser.opacity, rates.opacity),
            occupancy: group(&mut optimiser.occupancy, rates.occupancy),
            sh: GroupStep {
                rate: rates.sh_base,
                steps: group(&mut optimiser.sh, rates.sh_base.max(rates.sh_rest)).steps,
            },
            sh_rest: rates.sh_rest,
            sh_active: 3 * coefficient_count(self.field.sh_degree),
            visible_only: self.config.adam.visible_rows_only,
            renormalise: (self.progress.total_steps + 1).is_multiple_of(RENORMALISE_EVERY),
            occupancy_limits: (context.stage == Stage::Instance
                && !self.config.ablates(Ablation::ConstantOccupancy))
            .then(|| self.config.instance.occupancy_limits.map(logit)),
        };
        if self.field.identities.is_some() {
            group(&mut optimiser.calibration, rates.calibration);
        }
        if self.field.deformation.is_some() {
            group(&mut optimiser.planes, rates.planes);
            group(&mut optimiser.mlp, rates.mlp);
        }
        step
    }

    /// One view, forward and backward; after the last one of a step, the optimiser.
    fn view_on(
        &mut self,
        device: &mut DeviceTraining,
        resident: &mut Resident,
        context: &StepContext,
        (view, first): (&StepView, bool),
        last: Option<&GaussianStep>,
    ) -> Result<(), TrainError> {
        device.keep_target(view, u64::from(self.config.frame_memory_mib) << 20)?;
        let DeviceTraining {
            gpu,
            rasterizer,
            losses,
            optimiser,
            motion,
            targets,
            faults,
            arrivals,
            counted,
            slot,
            timestamps,
            ..
        } = device;
        let fresh;
        let target = match targets.get(&view.view) {
            Some(target) => target,
            None => {
                fresh = GpuTarget::new(gpu, &view.frame.image, view.frame.labels.as_ref())?;
                &fresh
            }
        };
        let frame = &self.dataset.frames[view.index];
        let with_instances =
            context.settings.instances.is_some() && view.frame.labelled > 0 && resident.identities.is_some();
        let settings = RenderSettings {
            instances: context.settings.instances.filter(|_| with_instances),
            ..context.settings
        };
        let weight = 1.0 / self.config.stages.batch as f32;
        let share = view.frame.labelled as f64 / context.labelled.max(1) as f64;
        let labels = with_instances.then(|| LabelInput {
            labels: &target.labels,
            labelled_pixels: view.frame.labelled,
            weight: (share * f64::from(self.config.loss.lambda_instance)) as f32,
        });
        let input = ViewInput { camera: &frame.camera, settings: &settings, labels };

        let mut commands = Commands::new(gpu, timestamps.as_mut());
        if let Some(identities) = resident.identities.as_ref().filter(|_| first && with_instances) {
            optimiser.identities(
                gpu,
                &mut commands,
                &identities.rows.row_offsets,
                (&identities.log_estimates, &identities.log_calibrations),
                &identities.rows.entries,
            );
        }
        let posed = match &resident.deformation {
            Some(deformation) => {
                let moving = &deformation.parameters;
                moving.forward(gpu, &mut commands, frame.time, &resident.canonical, &resident.posed);
                let sh = if moving.moves_sh() { &resident.posed.sh } else { &resident.canonical.sh };
                PosedInput { geometry: &resident.posed.geometry, sh }
            }
            None => (&resident.canonical).into(),
        };
        let rows = resident.identities.as_ref().filter(|_| with_instances).map(|identities| &identities.rows);
        rasterizer.project(gpu, &mut commands, posed, rows, &input)?;
        if !counted[view.view] {
            // The first visit makes room; later ones see in time that more is needed.
            rasterizer.measure(gpu, commands)?;
            counted[view.view] = true;
            if let Some(timestamps) = timestamps.as_ref() {
                add_stage_times(&mut self.times, &timestamps.read(gpu)?);
            }
            commands = Commands::new(gpu, timestamps.as_mut());
        }
        rasterizer.rasterize(gpu, &mut commands, rows, labels)?;
        let weights = LossWeights {
            lambda_dssim: self.config.loss.lambda_dssim,
            view: weight,
            with_instances,
            by_coverage: settings
                .instances
                .is_some_and(|instances| instances.normalisation == InstanceNormalisation::Coverage),
            leaves_out: context.stage == Stage::Coarse && self.travelling_labels().is_some(),
        };
        let images = (rasterizer.colors(), rasterizer.blended());
        losses.record(gpu, &mut commands, images, target, &weights, *slot)?;
        if context.stage == Stage::Instance && !self.config.instance.color_loss {
            commands.clear(&losses.v_colors);
        }
        rasterizer.backward(gpu, &mut commands, posed, rows, labels, &losses.v_colors)?;

        let gradients = rasterizer.gradients();
        if let Some(deformation) = &mut resident.deformation {
            optimiser.add_gaussians(gpu, &mut commands, &gradients.gaussians, &resident.gradients, false);
            let strengths = self.guidance_weight(context.stage, context.iteration);
            if let Some((shifts, pulls)) = self.pulls(frame.time, strengths) {
                motion.record(
                    gpu,
                    &mut commands,
                    (&shifts, pulls, f64::from(self.field.extent)),
                    (&resident.posed, &resident.canonical),
                    (&gradients.gaussians, &resident.gradients),
                )?;
            }
            deformation.gradients.backward(
                gpu,
                &mut commands,
                (&deformation.parameters, frame.time),
                &resident.canonical,
                &gradients.gaussians,
                &resident.gradients,
                faults,
            );
        } else {
            optimiser.add_gaussians(gpu, &mut commands, &gradients.gaussians, &resident.gradients, true);
        }
        optimiser.add_screen(gpu, &mut commands, &gradients.screen, &resident.screen);
        if let (Some(identities), true) =
            (&resident.identities, labels.is_some_and(|labels| labels.weight != 0.0))
        {
            optimiser.add_calibrations(gpu, &mut commands, &gradients.calibrations, &identities.gradients);
        }

        if let Some(step) = last {
            if matches!(context.stage, Stage::Coarse | Stage::Fine)
                && context.iteration < self.config.densify.until
            {
                optimiser.add_statistics(gpu, &mut commands, &resident.screen, &resident.statistics);
            }
            optimiser.step_gaussians(
                gpu,
                &mut commands,
                step,
                (&resident.canonical, &resident.gradients),
                &resident.moments,
                &resident.screen,
                faults,
            );
            commands.clear(&resident.screen);
            if let Some(identities) = &resident.identities {
                let group =
                    GroupStep { rate: context.rates.calibration, steps: self.optimiser.calibration.steps };
                optimiser.step_calibrations(
                    gpu,
                    &mut commands,
                    (group, self.config.instance.calibration_limit),
                    (&identities.log_calibrations, &identities.gradients),
                    &identities.moments,
                    faults,
                );
            }
            if let Some(deformation) = &resident.deformation {
                optimiser.step_deformation(
                    gpu,
                    &mut commands,
                    (
                        GroupStep { rate: context.rates.planes, steps: self.optimiser.planes.steps },
                        GroupStep { rate: context.rates.mlp, steps: self.optimiser.mlp.steps },
                    ),
                    &context.weights,
                    (&deformation.parameters, &deformation.gradients),
                    &deformation.moments,
                    faults,
                )?;
            }
        }

        let results = losses.results().read_later(gpu, commands.encoder(), 2 * *slot, 2);
        let counts = rasterizer.read_statistics(gpu, &mut commands);
        let found = faults.read_later(gpu, commands.encoder(), 0, 1);
        *slot = (*slot + 1) % SLOTS;
        commands.submit();
        if let Some(timestamps) = timestamps {
            add_stage_times(&mut self.times, &timestamps.read(gpu)?);
        }
        let pixels = target.size[0] as usize * target.size[1] as usize;
        let about = AboutView {
            stage: context.stage,
            iteration: context.iteration,
            pixels,
            weight: f64::from(weight),
            labelled: if with_instances { view.frame.labelled } else { 0 },
            labelled_of_step: context.labelled,
            lambda_dssim: weights.lambda_dssim,
            last: last.is_some(),
            gaussians: resident.canonical.len(),
        };
        arrivals.push(ViewRead::new(results.start(), counts.start(), found.start(), about));
        Ok(())
    }

    /// Takes in what has arrived of earlier steps; `all` waits for everything.
    pub(super) fn receive(&mut self, device: &mut DeviceTraining, all: bool) -> Result<(), TrainError> {
        let mut result = Ok(());
        while let Some(news) = device.arrivals.next(&device.gpu, all)? {
            let room = (news.counts.wanted_pairs, news.counts.wanted_slots);
            if !news.counts.fits() {
                self.warnings.push(format!(
                    "step {} of the {} stage left out a view whose {} pairs of tiles and Gaussians had no room; \
                     there is room for them now",
                    news.about.iteration, news.about.stage, room.0
                ));
            }
            let wanted = [room.0, room.1].map(|wanted| wanted as usize);
            device.wanted = [0, 1].map(|k| device.wanted[k].max(wanted[k]));
            device.make_room(news.about.gaussians)?;
            result = result.and(self.take_in(&news));
        }
        result
    }

    /// Losses and counts of a view.
    fn take_in(&mut self, news: &ViewNews) -> Result<(), TrainError> {
        let (about, loss) = (&news.about, &news.loss);
        let not_finite =
            |tensor| TrainError::NotFinite { stage: about.stage, iteration: about.iteration, tensor };
        if !loss.color.loss.is_finite() {
            return Err(not_finite("the colour loss"));
        }
        if !loss.instance_sum.is_finite() {
            return Err(not_finite("the instance loss"));
        }
        if news.faults != 0 {
            return Err(not_finite(fault_name(news.faults)));
        }
        self.progress.add_psnr(loss.color.psnr());
        let arriving = &mut self.arriving_loss;
        arriving.color += loss.color.loss * about.weight;
        if about.stage == Stage::Instance && about.labelled_of_step > 0 {
            let of_step = about.labelled_of_step as f64;
            // The mean over the labelled pixels of all views of the step (A4).
            *arriving.instance.get_or_insert(0.0) +=
                if about.labelled > 0 { loss.instance_sum / of_step } else { 0.0 };
            *arriving.unsupported.get_or_insert(0.0) += loss.unsupported / of_step;
        }
        if about.last {
            let instance = arriving.instance.unwrap_or(0.0);
            arriving.total = arriving.color + f64::from(self.config.loss.lambda_instance) * instance;
            self.last_loss = std::mem::take(arriving);
        }
        self.times.views += 1;
        self.times.gaussians += about.gaussians as u64;
        self.times.visible += u64::from(news.counts.visible);
        self.times.tile_pairs += u64::from(news.counts.pairs);
        Ok(())
    }

    /// Events that fall on the step just done: they run on the host, which is brought up to date first.
    fn rare_events(&mut self, events: &mut Vec<TrainEvent>) -> Result<(), TrainError> {
        let (stage, iteration) = (self.progress.stage, self.progress.iteration);
        let falls = match stage {
            Stage::Instance => {
                let resample = &self.config.resample;
                falls_on(iteration, self.config.identity.refresh_every)
                    || falls_on(iteration, resample.every)
                        && (resample.from..=resample.until).contains(&iteration)
            }
            _ => {
                let densify = &self.config.densify;
                iteration < densify.until
                    && (iteration > densify.from
                        && (falls_on(iteration, densify.prune_every) || falls_on(iteration, densify.every))
                        || falls_on(iteration, densify.opacity_reset_every))
            }
        };
        let is_due = self.device.as_ref().is_some_and(|device| device.since_fetch >= FETCH_EVERY);
        if falls || is_due {
            let start = Instant::now();
            self.fetch_from_device()?;
            if falls && stage == Stage::Instance {
                self.instance_events(iteration, events)?;
                self.identities_changed();
            } else if falls {
                self.densify(stage, iteration, events)?;
                self.gaussians_changed();
            }
            self.times.rearrange += start.elapsed();
            self.times.total += start.elapsed();
        }
        Ok(())
    }
}

impl DeviceTraining {
    /// Room for what views have wanted, grown with the set, and a quarter more: what is reserved has half as much on
    /// top, so views find room before it is known that they need it.
    fn make_room(&mut self, gaussians: usize) -> Result<(), GpuError> {
        if gaussians > self.wanted_of && self.wanted_of > 0 {
            let grown = |wanted: usize| (wanted as f64 * gaussians as f64 / self.wanted_of as f64) as usize;
            self.wanted = self.wanted.map(grown);
        }
        self.wanted_of = self.wanted_of.max(gaussians);
        let [pairs, slots] = self.wanted.map(|wanted| wanted + wanted / 4);
        self.rasterizer.reserve(&self.gpu, pairs, slots)
    }

    /// Keeps a frame on the device, while `budget` bytes hold them.
    fn keep_target(&mut self, view: &StepView, budget: u64) -> Result<(), GpuError> {
        if !self.targets.contains_key(&view.view) && self.target_bytes < budget {
            let target = GpuTarget::new(&self.gpu, &view.frame.image, view.frame.labels.as_ref())?;
            self.target_bytes += target.bytes();
            self.targets.insert(view.view, target);
        }
        Ok(())
    }
}

/// Adds the times of a submission to the parts of a step.
fn add_stage_times(times: &mut StepTimes, stages: &[(&'static str, Duration)]) {
    let render = &mut times.render;
    for (name, duration) in stages {
        let part = match *name {
            "deform" => &mut render.deform,
            "project" => &mut render.project,
            "sort by depth" | "bin" | "emit" | "sort by tile" | "ranges" => &mut render.bin,
            "rasterize" => &mut render.rasterize,
            "losses" => &mut times.losses,
            "cotangents" | "rasterize backward" => &mut render.rasterize_backward,
            "gather gradients" | "project backward" | "identity backward" | "guidance" => {
                &mut render.project_backward
            }
            "deform backward: network" | "deform backward: planes" | "deform backward: lines" => {
                &mut render.deform_backward
            }
            "optimiser: planes" => &mut times.optimiser_planes,
            "optimiser: network" => &mut times.optimiser_mlp,
            "optimiser: Gaussians" | "accumulate" | "identity" => &mut times.optimiser_gaussians,
            // Counted as other.
            _ => continue,
        };
        *part += *duration;
    }
}
