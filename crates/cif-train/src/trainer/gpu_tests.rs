//! Steps on a GPU that go wrong, or that have no room, on a real capture. `CIF_TEST_GPU=off|auto|require`.

use std::sync::Arc;

use cif_field::Field;
use cif_field::parameters::OPACITY_LOGITS;
use cif_render::wgpu::{Gpu, GpuError, testing};
use cif_render::{Channels, RenderSettings, RenderedImage};
use tempfile::TempDir;

use super::Trainer;
use super::guard_tests::support::{Scene, capture, small_config};
use crate::clock::{Clock, Seconds};
use crate::config::TrainConfig;
use crate::density::DensifyStatistics;
use crate::density::adaptive::Adaptive;
use crate::density::error_guided::ErrorGuided;
use crate::engine::Views;
use crate::engine::gpu::GpuEngine;
use crate::engine::processor::Processor;
use crate::error::TrainError;
use crate::events::{Control, Outcome, TrainEvent};
use crate::exposure::Exposures;
use crate::guard::MAX_ROLLBACKS_IN_A_ROW;
use crate::optimiser::Optimiser;
use crate::stage::Stage;
use crate::step::InstancePass;

pub(super) fn trainer(gpu: Option<&Gpu>) -> (Trainer, TempDir) {
    trainer_with(gpu, |_| {})
}

pub(super) fn trainer_with(gpu: Option<&Gpu>, edit: impl FnOnce(&mut TrainConfig)) -> (Trainer, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (6, 12, 6);
    config.stages.batch = 2;
    config.report.step_every = 1;
    config.effects.exposure = true;
    edit(&mut config);
    let mut trainer = Trainer::new(dataset, config).unwrap();
    assert!(trainer.state.progress.exposures.is_some());
    if let Some(gpu) = gpu {
        trainer.use_gpu(gpu).unwrap();
    }
    (trainer, folder)
}

/// Field, optimiser, statistics and exposures, after fetching them to the host.
pub(super) fn state(trainer: &mut Trainer) -> (Field, Optimiser, DensifyStatistics, Exposures) {
    trainer.fetch().unwrap();
    host(trainer)
}

/// The same as the host holds them, without fetching.
fn host(trainer: &Trainer) -> (Field, Optimiser, DensifyStatistics, Exposures) {
    let exposures = trainer.state.progress.exposures.clone().unwrap();
    (
        trainer.state.field.clone(),
        trainer.state.optimiser.clone(),
        trainer.state.statistics.clone(),
        exposures,
    )
}

/// One step, and what it reported.
pub(super) fn step(trainer: &mut Trainer) -> (Result<(), TrainError>, Vec<TrainEvent>) {
    if trainer.stage() == Stage::Search {
        trainer.enter(Stage::Coarse).unwrap();
    }
    let mut events = Vec::new();
    let result = trainer.step(&mut events).map(drop);
    (result, events)
}

pub(super) fn device(trainer: &mut Trainer) -> &mut GpuEngine {
    GpuEngine::of(&mut *trainer.engine)
}

#[test]
fn a_bad_step_moves_nothing_and_those_recorded_after_it_are_done_as_if_it_had_not_been() {
    let Some(gpu) = testing::gpu() else { return };
    for (column, value, tensor) in [
        (Some(1), f32::NAN, "gradient of means"),
        (Some(3), 1e25, "gradient of opacity_logits"),
        (Some(9), f32::INFINITY, "gradient of quaternions"),
        (None, f32::NAN, "gradient of exposures"),
    ] {
        let (mut trainer, _folder) = trainer(Some(&gpu));
        step(&mut trainer).0.unwrap();
        let before = state(&mut trainer);
        let (iteration, counters) = (trainer.iteration(), before.1.clone());
        device(&mut trainer).damage(column, value);
        let mut reported = Vec::new();
        for _ in 0..4 {
            let (result, events) = step(&mut trainer);
            result.unwrap();
            reported.extend(events);
        }
        state(&mut trainer);
        reported.extend(std::mem::take(&mut trainer.arrived));
        let [TrainEvent::RolledBack { stage: Stage::Coarse, iteration: at, fault, in_a_row: 1, total: 1 }] =
            &reported[..]
        else {
            panic!("{reported:?}")
        };
        assert_eq!((*at, fault.part, fault.tensor.as_str()), (iteration + 1, "gradients", tensor));
        assert!(fault.value.contains("on the GPU alone"), "{fault}");
        assert_eq!((trainer.iteration(), trainer.rolled_back()), (iteration + 4, 1));
        assert_eq!(trainer.state.progress.rollbacks.in_a_row, 0);
        // Centres, log-scales, quaternions, opacities.
        for ((parameter, now), (_, then)) in
            trainer.state.optimiser.groups().iter().zip(counters.groups()).take(4)
        {
            assert_eq!(now.steps, then.steps + 3, "{}", parameter.name);
            assert!(now.first.iter().all(|v| v.is_finite()));
        }
        let exposures = trainer.state.progress.exposures.clone().unwrap();
        assert_eq!(exposures.steps, before.3.steps + 3);
        assert!(exposures.values.iter().all(|value| value.is_finite() && *value != 0.0));
        // The same steps without the bad one.
        let (mut other, _folder) = self::trainer(Some(&gpu));
        step(&mut other).0.unwrap();
        other.state.progress.iteration += 1;
        other.state.progress.total_steps += 1;
        for _ in 0..3 {
            step(&mut other).0.unwrap();
        }
        assert!(state(&mut trainer) == state(&mut other), "{tensor}");
    }
}

#[test]
fn what_the_processor_would_refuse_too_is_reported_in_its_words() {
    let Some(gpu) = testing::gpu() else { return };
    let fault_on = |gpu: Option<&Gpu>| {
        let (mut trainer, _folder) = trainer(gpu);
        trainer.set_debug_validation(gpu.is_none());
        for row in &mut trainer.state.field.gaussians.sh_coefficients {
            row[0] = 3e38;
        }
        let (result, mut events) = step(&mut trainer);
        result.unwrap();
        trainer.fetch().unwrap();
        events.extend(std::mem::take(&mut trainer.arrived));
        match events.into_iter().next() {
            Some(TrainEvent::RolledBack { fault, .. }) => fault.to_string(),
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(fault_on(Some(&gpu)), fault_on(None));
}

#[test]
fn too_many_bad_steps_in_a_row_stop_the_run_where_the_first_of_them_was() {
    let Some(gpu) = testing::gpu() else { return };
    let (mut trainer, folder) = trainer(Some(&gpu));
    trainer.state.config.stages.coarse = 12;
    // A colour that overflows in every view.
    let sound = trainer.state.field.gaussians.sh_coefficients[0];
    for row in &mut trainer.state.field.gaussians.sh_coefficients {
        row[0] = 3e38;
    }
    let before = trainer.state.field.clone();
    let mut reported = 0;
    let error = trainer
        .run(&mut |event, _| {
            reported += u32::from(matches!(event, TrainEvent::RolledBack { .. }));
            Control::Continue
        })
        .unwrap_err();
    let TrainError::Diverged { in_a_row, iteration, stage, .. } = error else { panic!("{error}") };
    assert_eq!(in_a_row, MAX_ROLLBACKS_IN_A_ROW);
    assert_eq!(reported, MAX_ROLLBACKS_IN_A_ROW - 1);
    assert_eq!((trainer.stage(), trainer.iteration() + 1), (stage, iteration));
    assert_eq!(trainer.steps_done(), trainer.state.progress.steps.values().sum::<u64>());
    assert!(trainer.state.field.gaussians.sh_coefficients == before.gaussians.sh_coefficients);
    // What is saved goes on once the cause is gone.
    let path = folder.path().join("stopped.cif");
    trainer.checkpoint(true).save(&path).unwrap();
    let mut checkpoint = cif_field::Checkpoint::load(&path).unwrap();
    checkpoint.field.gaussians.sh_coefficients.fill(sound);
    let mut resumed = Trainer::resume(trainer.dataset().clone(), checkpoint).unwrap();
    resumed.use_gpu(&gpu).unwrap();
    assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    assert_eq!(resumed.steps_done(), 30);
    assert_eq!(resumed.rolled_back(), u64::from(MAX_ROLLBACKS_IN_A_ROW));
}

#[test]
fn views_without_room_are_drawn_again_and_no_bit_differs() {
    let Some(gpu) = testing::gpu() else { return };
    let run = |room: usize| {
        let (mut trainer, _folder) = trainer(Some(&gpu));
        *device(&mut trainer).needed() = [room; 2];
        let mut losses = Vec::new();
        let outcome = trainer.run(&mut |event, _| {
            if let TrainEvent::Finished { rolled_back, .. } = event {
                losses.push(*rolled_back);
            }
            Control::Continue
        });
        assert_eq!(outcome.unwrap(), Outcome::Finished);
        assert_eq!(losses, [0], "room is no fault");
        let needed = *device(&mut trainer).needed();
        let mut state = state(&mut trainer);
        state.0.record = Default::default();
        (state, needed)
    };
    let (roomy, _) = run(1 << 17);
    let (tight, needed) = run(1);
    assert!(needed[0] > 1 && needed[1] > 1, "views needed room: {needed:?}");
    assert!(roomy == tight);
}

#[test]
fn rows_that_stay_on_the_device_end_as_those_that_the_host_rearranges() {
    let Some(gpu) = testing::gpu() else { return };
    let run = |fetches: bool| {
        let (mut trainer, _folder) = trainer(Some(&gpu));
        trainer.enter(Stage::Coarse).unwrap();
        // Half of them are large; opacities that fall, from 0.1 or where they are reset to, go.
        let mut sizes: Vec<f32> =
            trainer.state.field.gaussians.log_scales.iter().map(|s| s[0].max(s[1]).max(s[2]).exp()).collect();
        sizes.sort_by(f32::total_cmp);
        trainer.set_density(Arc::new(Adaptive));
        let densify = &mut trainer.state.config.densify;
        (densify.from, densify.every, densify.prune_every, densify.opacity_reset_every) = (1, 3, 2, 5);
        (densify.gradient_threshold, densify.prune_min_n, densify.until) = (1e-7, 1, 100);
        (densify.prune_opacity, densify.opacity_reset_to) = (0.095, 0.097);
        densify.split_scale = sizes[sizes.len() / 2] / trainer.state.field.extent;
        let mut kinds = [0; 3];
        let mut result = Vec::new();
        while trainer.stage() != Stage::Instance && result.len() < 40 {
            let stage = trainer.stage();
            if trainer.iteration() == trainer.stages.iterations(&trainer.state.config, stage) {
                break;
            }
            if fetches {
                // Everything goes through the host.
                device(&mut trainer).make_far_ahead();
            }
            let (stepped, events) = step(&mut trainer);
            stepped.unwrap();
            for event in events {
                if let TrainEvent::Densified { cloned, split, pruned, .. } = event {
                    kinds = [kinds[0] + cloned, kinds[1] + split, kinds[2] + pruned];
                }
            }
            result.push(trainer.state.field.gaussians.len());
        }
        (state(&mut trainer), result, kinds)
    };
    let (on_device, on_host) = (run(false), run(true));
    assert!(on_device.2.iter().all(|count| *count > 0), "cloned, split, pruned: {:?}", on_device.2);
    assert_eq!(on_device.1, on_host.1, "Gaussians after every step");
    assert!(on_device.0.0.gaussians == on_host.0.0.gaussians, "parameters");
    assert!(on_device.0.1 == on_host.0.1, "moments");
    assert!(on_device.0.2 == on_host.0.2, "statistics");
}

#[test]
fn sets_that_grow_by_errors_stay_on_the_device() {
    let Some(gpu) = testing::gpu() else { return };
    let run = |fetches: bool| {
        let (mut trainer, _folder) = trainer_with(Some(&gpu), |config| {
            let densify = &mut config.densify;
            (densify.from, densify.every, densify.until, densify.views) = (1, 3, 100, 4);
            densify.max_gaussians *= 2;
        });
        trainer.set_density(Arc::new(ErrorGuided));
        trainer.enter(Stage::Coarse).unwrap();
        let mut split = Vec::new();
        for _ in 0..6 {
            if fetches {
                device(&mut trainer).make_far_ahead();
            }
            let (stepped, events) = step(&mut trainer);
            stepped.unwrap();
            for event in events {
                if let TrainEvent::Densified { split: count, gaussians, .. } = event {
                    split.push((count, gaussians));
                }
            }
            let is_ahead = device(&mut trainer).is_ahead();
            assert_eq!(is_ahead, !fetches, "rows stay on the device unless they are fetched");
        }
        (state(&mut trainer), split)
    };
    let (on_device, on_host) = (run(false), run(true));
    assert!(!on_device.1.is_empty() && on_device.1[0].0 > 0, "{:?}", on_device.1);
    assert_eq!(on_device.1, on_host.1);
    assert!(on_device.0 == on_host.0);
}

#[test]
fn contributions_to_views_are_those_of_the_processor() {
    let Some(gpu) = testing::gpu() else { return };
    let (mut trainer, _folder) = trainer(Some(&gpu));
    trainer.enter(Stage::Fine).unwrap();
    for _ in 0..4 {
        step(&mut trainer).0.unwrap();
    }
    trainer.fetch().unwrap();
    let all = trainer.state.frames.len();
    let of_views = |trainer: &mut Trainer| -> Vec<Vec<f32>> {
        (0..all).map(|view| trainer.engine.sums_of_view(&trainer.state, view).unwrap()).collect()
    };
    let found = of_views(&mut trainer);
    let expected = on_processor(&mut trainer, of_views);
    assert_eq!(found.len(), all);
    for (found, expected) in found.iter().zip(&expected) {
        for channel in 0..2 {
            let of = |sums: &[f32]| -> Vec<f32> { sums.iter().copied().skip(channel).step_by(2).collect() };
            let (found, expected) = (of(found), of(expected));
            let largest = expected.iter().copied().fold(0.0, f32::max);
            let worst = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(largest > 0.0 && worst < 1e-4 * largest, "{channel}: {worst} of {largest}");
        }
    }
}

#[test]
fn rows_relocated_on_the_device_end_as_those_that_the_host_relocates() {
    let Some(gpu) = testing::gpu() else { return };
    let run = |fetches: bool| {
        let (mut trainer, _folder) = trainer_with(Some(&gpu), |config| {
            (config.resample.from, config.resample.every, config.resample.until) = (1, 3, 100);
            config.stages.instance = 12;
        });
        trainer.enter(Stage::Fine).unwrap();
        for _ in 0..4 {
            step(&mut trainer).0.unwrap();
        }
        trainer.fetch().unwrap();
        trainer.estimate_identities(true).unwrap();
        trainer.begin(Stage::Instance);
        let mut relocated = Vec::new();
        for _ in 0..10 {
            if fetches {
                device(&mut trainer).make_far_ahead();
            }
            let (stepped, events) = step(&mut trainer);
            stepped.unwrap();
            for event in events {
                if let TrainEvent::Resampled { iteration, pairs, sources, .. } = event {
                    relocated.push((iteration, pairs, sources));
                }
            }
            let is_ahead = device(&mut trainer).is_ahead();
            assert_eq!(is_ahead, !fetches, "rows stay on the device unless they are fetched");
        }
        (state(&mut trainer), relocated)
    };
    let (on_device, on_host) = (run(false), run(true));
    assert!(on_device.1.len() == 3 && on_device.1[0].1 > 0, "{:?}", on_device.1);
    assert_eq!(on_device.1, on_host.1);
    assert!(on_device.0.0.identities == on_host.0.0.identities, "identities");
    assert!(on_device.0.0 == on_host.0.0, "parameters");
    assert!(on_device.0.1 == on_host.0.1, "moments");
}

#[test]
fn a_device_lost_after_a_change_of_the_set_leaves_what_was_fetched_before_it() {
    let Some(_) = testing::gpu() else { return };
    let gpu = Gpu::open().unwrap();
    let (mut trainer, _folder) = trainer(Some(&gpu));
    trainer.set_density(Arc::new(Adaptive));
    let densify = &mut trainer.state.config.densify;
    (densify.from, densify.every, densify.gradient_threshold, densify.until) = (1, 3, 1e-7, 100);
    step(&mut trainer).0.unwrap();
    let before = state(&mut trainer);
    for _ in 0..3 {
        step(&mut trainer).0.unwrap();
    }
    assert!(trainer.state.field.gaussians.len() > before.0.gaussians.len(), "the set has changed");
    gpu.device().destroy();
    let error = (0..20).find_map(|_| step(&mut trainer).0.err()).expect("the device is lost");
    assert!(matches!(error, TrainError::Device(_)), "{error}");
    assert_eq!((trainer.iteration(), trainer.steps_done()), (1, 1));
    assert!(host(&trainer) == before);
}

#[test]
fn debug_validation_names_the_part_and_changes_no_bit() {
    let Some(gpu) = testing::gpu() else { return };
    let (mut plain, _one) = trainer(Some(&gpu));
    let (mut looked_at, _two) = trainer(Some(&gpu));
    looked_at.set_debug_validation(true);
    for trainer in [&mut plain, &mut looked_at] {
        assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    }
    let (mut a, mut b) = (state(&mut plain), state(&mut looked_at));
    (a.0.record, b.0.record) = Default::default();
    assert!(a == b);

    let fault_of = |damage: &dyn Fn(&mut Trainer)| {
        let (mut trainer, _folder) = trainer(Some(&gpu));
        trainer.set_debug_validation(true);
        damage(&mut trainer);
        let before = trainer.state.field.clone();
        let iteration = trainer.iteration();
        let (result, events) = step(&mut trainer);
        result.unwrap();
        assert_eq!((trainer.iteration(), trainer.rolled_back()), (iteration + 1, 1));
        assert_eq!(format!("{:?}", trainer.state.field.gaussians), format!("{:?}", before.gaussians));
        match events.into_iter().next() {
            Some(TrainEvent::RolledBack { fault, .. }) => fault.to_string(),
            other => panic!("{other:?}"),
        }
    };
    let parameters = fault_of(&|trainer| trainer.state.field.gaussians.means[1][2] = f32::NAN);
    assert_eq!(parameters, "parameters: means[5] is NaN");
    let moments = fault_of(&|trainer| trainer.state.optimiser.of(&OPACITY_LOGITS).second[1] = f32::INFINITY);
    assert_eq!(moments, "optimiser: second moments[1] is inf");
}

/// A clock whose readings are given.
struct Readings(std::sync::Mutex<std::collections::VecDeque<f64>>);

impl Clock for Readings {
    fn now(&self) -> Seconds {
        let wall_s = self.0.lock().unwrap().pop_front().expect("a reading is left");
        Seconds { wall_s, cpu_s: 0.0 }
    }
}

#[test]
fn the_faster_of_both_is_taken_and_the_trial_leaves_no_trace() {
    let Some(gpu) = testing::gpu() else { return };
    // Two steps on the processor in a second; then one on the GPU that takes 0.9 or 0.2 seconds: start, after every
    // step, and once all is done.
    for (on_gpu, taken) in [(0.9, false), (0.2, true)] {
        let (mut trainer, _folder) = trainer(None);
        let before = state(&mut trainer);
        let progress = trainer.state.progress.clone();
        let gpu_steps = if taken { vec![10.2, 10.4, 10.6, 10.6] } else { vec![10.9, 10.9] };
        let mut readings = vec![5.0, 5.4, 6.0, 6.0, 10.0];
        readings.extend(&gpu_steps);
        trainer.set_clock(std::sync::Arc::new(Readings(std::sync::Mutex::new(readings.into()))));
        let probe = trainer.use_faster(&gpu).unwrap();
        assert!((probe.processor_s - 0.5).abs() < 1e-9 && (probe.gpu_s - on_gpu).abs() < 1e-9, "{probe}");
        assert_eq!((probe.gpu_is_faster(), probe.stage), (taken, Stage::Coarse));
        assert!(probe.to_string().contains("500.0 ms on the processor"), "{probe}");
        assert_eq!(trainer.gpu_name().is_some(), taken);
        assert!(state(&mut trainer) == before && trainer.state.progress == progress);
        trainer.set_clock(std::sync::Arc::new(crate::clock::SystemClock::start()));
        assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        // As good as a run that nothing was tried in.
        let (mut other, _folder) = self::trainer(taken.then_some(&gpu));
        assert_eq!(other.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        let (mut a, mut b) = (state(&mut trainer), state(&mut other));
        (a.0.record, b.0.record) = Default::default();
        assert!(a == b, "the trial left a trace");
    }
}

#[test]
fn a_fault_of_the_device_leaves_a_run_that_goes_on_on_the_processor() {
    let Some(_) = testing::gpu() else { return };
    for fault in [GpuError::OutOfMemory("full".to_owned()), GpuError::Lost("unplugged".to_owned())] {
        // A device of its own, for the fault stays.
        let gpu = Gpu::open().unwrap();
        let (mut trainer, folder) = trainer(Some(&gpu));
        let (expected, kind) = (fault.to_string(), fault.clone());
        let mut steps = 0;
        let error = trainer
            .run(&mut |event, _| {
                steps += u32::from(matches!(event, TrainEvent::Step { .. }));
                if steps == 9 {
                    gpu.tell(kind.clone());
                }
                Control::Continue
            })
            .unwrap_err();
        assert_eq!(error.to_string(), expected);
        assert!(trainer.gpu_name().is_none());
        assert!(trainer.steps_done() >= 6, "what was fetched at the end of the coarse stage is there");
        assert_eq!(trainer.steps_done(), trainer.state.progress.steps.values().sum::<u64>());
        trainer.state.field.validate().unwrap();
        let path = folder.path().join("saved.cif");
        trainer.checkpoint(true).save(&path).unwrap();
        let checkpoint = cif_field::Checkpoint::load(&path).unwrap();
        let mut resumed = Trainer::resume(trainer.dataset().clone(), checkpoint).unwrap();
        assert_eq!(resumed.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
        assert_eq!(resumed.steps_done(), 24);
    }
}

#[test]
fn every_stage_of_a_step_has_a_floor() {
    let Some(gpu) = testing::gpu() else { return };
    let mut seen = std::collections::BTreeSet::new();
    for stage in [Stage::Coarse, Stage::Fine, Stage::Instance] {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 2, ..Scene::default() });
        let mut trainer = Trainer::for_measuring(dataset, small_config(), None, stage, 2).unwrap();
        trainer.use_gpu(&gpu).unwrap();
        trainer.time_gpu_stages();
        let steps = [trainer.measure_step(InstancePass::On).unwrap()];
        let shape = trainer.step_shape(&steps);
        assert!(shape.views > 0.0 && shape.visible > 0.0 && shape.pairs > 0.0, "{shape:?}");
        assert_eq!(shape.deformation.is_some(), stage != Stage::Coarse);
        assert_eq!(shape.identity_entries > 0.0, stage == Stage::Instance);
        for (name, _) in trainer.take_gpu_stages() {
            let floor = crate::floors::floor(name, &shape);
            let floor = floor.unwrap_or_else(|| panic!("{name} has no floor"));
            assert!(floor.bytes.is_finite() && floor.flops.is_finite(), "{name}: {floor:?}");
            assert!(floor.bytes > 0.0 || name == "judge", "{stage}, {name}: {floor:?}");
            seen.insert(name);
        }
        assert!(trainer.take_gpu_stages().is_empty(), "they are taken once");
    }
    if gpu.has_timestamps() {
        for name in ["project", "deform backward: planes", "losses", "identity backward", "judge"] {
            assert!(seen.contains(name), "{name} was timed: {seen:?}");
        }
    }
}

pub(super) fn drawn(trainer: &mut Trainer, trial: Option<&Field>) -> Vec<RenderedImage> {
    let settings = RenderSettings {
        instances: trainer.state.field.identities.as_ref().and_then(|_| trainer.state.instance_settings()),
        ..trainer.state.color_settings()
    };
    let views = Views {
        whole: false,
        frames: &[0, 1, 3, 4],
        settings: &settings,
        channels: Channels { depth: true, instances: settings.instances.is_some() },
    };
    let mut images = Vec::new();
    trainer.draw(trial, views, &mut |image| images.push(image)).unwrap();
    images
}

/// The same on the processor, which has what was fetched last.
pub(super) fn on_processor<T>(trainer: &mut Trainer, work: impl FnOnce(&mut Trainer) -> T) -> T {
    let engine = std::mem::replace(&mut trainer.engine, Box::new(Processor::new(trainer.simd)));
    let result = work(trainer);
    trainer.engine = engine;
    result
}

pub(super) fn assert_alike(found: &[RenderedImage], expected: &[RenderedImage], what: &str) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        let (a, b) = (found.color.pixels.as_flattened(), expected.color.pixels.as_flattened());
        let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum();
        assert!(sum / (a.len() as f64) < 1e-5, "{what}: colours differ by {sum} in all");
        assert_eq!(found.instances.is_some(), expected.instances.is_some());
        if let (Some(a), Some(b)) = (&found.instances, &expected.instances) {
            let differ = a.label.pixels.iter().zip(&b.label.pixels).filter(|(a, b)| a != b).count();
            assert!(differ < 5, "{what}: {differ} labels differ");
        }
    }
}

#[test]
fn views_between_steps_are_those_of_the_processor() {
    let Some(gpu) = testing::gpu() else { return };
    let (mut trainer, _folder) = trainer(Some(&gpu));
    // A fine stage with a little motion.
    while trainer.stage() != Stage::Fine || trainer.iteration() < 4 {
        if trainer.iteration() == 6 {
            trainer.fetch().unwrap();
            trainer.enter(Stage::Fine).unwrap();
        }
        step(&mut trainer).0.unwrap();
    }
    trainer.fetch().unwrap();
    let of_field = drawn(&mut trainer, None);
    let expected = on_processor(&mut trainer, |trainer| drawn(trainer, None));
    assert_alike(&of_field, &expected, "the field");

    let mut still = trainer.state.field.clone();
    let n = still.len();
    let deformation = still.deformation.as_mut().unwrap();
    deformation.still = (0..n).map(|row| row % 3 != 0).collect();
    let mut headless = trainer.state.field.clone();
    let deformation = headless.deformation.as_mut().unwrap();
    let layout = deformation.config.mlp_layout();
    let last = layout.heads.last().unwrap();
    assert_eq!(last.output.biases.end, deformation.mlp.len());
    deformation.mlp.truncate(last.hidden.weights.start);
    deformation.config.heads.rotation = false;
    headless.validate().unwrap();
    let mut shrunk = trainer.state.field.clone();
    shrunk.deformation = None;
    for scales in &mut shrunk.gaussians.log_scales {
        scales[0] -= 1.0;
    }
    for (what, trial) in [("still", &still), ("without a head", &headless), ("without motion", &shrunk)] {
        let found = drawn(&mut trainer, Some(trial));
        let expected = on_processor(&mut trainer, |trainer| drawn(trainer, Some(trial)));
        assert_alike(&found, &expected, what);
        // The field is as it was, and so are the steps after it.
        assert!(drawn(&mut trainer, None) == of_field, "{what} leaves a trace");
    }
    trainer.estimate_identities(true).unwrap();
    trainer.begin(Stage::Instance);
    step(&mut trainer).0.unwrap();
    trainer.fetch().unwrap();
    let found = drawn(&mut trainer, None);
    assert!(found[0].instances.is_some() && found[0].depth.is_some());
    let expected = on_processor(&mut trainer, |trainer| drawn(trainer, None));
    assert_alike(&found, &expected, "with instances");
    let scores = [false, true].map(|processor| {
        let score = |trainer: &mut Trainer| match trainer.evaluate(Stage::Instance).unwrap() {
            TrainEvent::Evaluated { frames, psnr, ssim, miou, .. } => (frames, psnr, ssim, miou),
            other => panic!("{other:?}"),
        };
        if processor { on_processor(&mut trainer, score) } else { score(&mut trainer) }
    });
    let [(frames, psnr, ssim, miou), (_, other_psnr, other_ssim, other_miou)] = scores;
    let close = |a: Option<f64>, b: Option<f64>| (a.unwrap() - b.unwrap()).abs() < 1e-2;
    assert!(frames > 0 && close(psnr, other_psnr) && close(ssim, other_ssim), "{scores:?}");
    assert!((miou.unwrap() - other_miou.unwrap()).abs() < 1.0, "{scores:?}");
}
