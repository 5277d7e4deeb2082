//! Steps on images of other sizes. `CIF_TEST_GPU=off|auto|require`.

use cif_dataset::Split;
use cif_render::Channels;
use cif_render::cpu::{Renderer, SimdLevel};
#[cfg(feature = "wgpu")]
use cif_render::wgpu::testing;
use tempfile::TempDir;

use super::Trainer;
use super::guard_tests::support::{HEIGHT, Scene, WIDTH, capture, small_config};
use crate::effects::is_judged;
use crate::events::TrainEvent;
use crate::metrics::image::{psnr, unit_color};
use crate::stage::Stage;

/// A run at the start of a fine stage of 10 steps, of which 6 see smaller images where these are large.
fn trainer(larger: u32) -> (Trainer, TempDir) {
    trainer_on(larger, 1)
}

/// The same where images are worked on reduced, but for the last 2 steps.
fn trainer_on(larger: u32, reduction: u32) -> (Trainer, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { times: 3, views: 4, larger, ..Scene::default() };
    let dataset = capture(folder.path(), scene);
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.half_size) = (4, 10, 0.6);
    (config.stages.reduction, config.stages.whole_size) = (reduction, 0.2);
    (config.effects.sh_gain, config.effects.exposure) = (0.1, true);
    let mut trainer = Trainer::new(dataset, config).unwrap();
    trainer.enter(Stage::Fine).unwrap();
    (trainer, folder)
}

#[test]
fn first_fine_steps_see_half_of_images_but_of_those_that_effects_are_judged_by() {
    for (larger, can) in [(4, true), (3, false)] {
        let (mut trainer, _folder) = trainer(larger);
        let whole = [WIDTH * larger, HEIGHT * larger];
        let mut halves = 0;
        for step in 1..=10 {
            let plan = trainer.plan_step(Stage::Fine, step).unwrap();
            let view = &plan.views[0];
            let judged = step <= 5 && is_judged(&trainer.state.frames, view.index);
            let halved = can && step <= 6 && !judged;
            halves += u32::from(halved);
            let size = [view.frame.image.width, view.frame.image.height];
            assert_eq!(size, if halved { whole.map(|side| side / 2) } else { whole }, "step {step}");
            assert_eq!(size, [view.camera.width, view.camera.height], "step {step}");
            assert_eq!(view.leaves_judged, judged, "step {step}");
        }
        assert!(halves >= u32::from(can), "no step is of the kind");
        let plan = trainer.plan_step(Stage::Coarse, 1).unwrap();
        assert_eq!(plan.views[0].frame.image.width, whole[0], "what fits measure is learnt on whole images");
    }
}

#[test]
fn such_steps_learn_what_whole_images_show() {
    let (mut trainer, _folder) = trainer(4);
    let mut losses = Vec::new();
    for _ in 0..10 {
        losses.push(trainer.step(&mut Vec::new()).unwrap().color);
    }
    // Not brighter, darker or shifted: the loss goes on where the sizes change.
    let (halved, whole) = (losses[5], losses[6]);
    assert!((whole / halved - 1.0).abs() < 0.15, "{losses:?}");
    assert!(losses[9] < 0.85 * losses[0], "{losses:?}");
}

#[test]
fn last_fine_steps_of_reduced_images_see_whole_ones() {
    for judged_too in [false, true] {
        let (mut trainer, _folder) = trainer_on(8, 2);
        if judged_too {
            // Up to the instance stage, so that the views stay as they are worked on.
            (trainer.state.config.effects.still_every, trainer.state.config.effects.still_from) = (3, 0.3);
        }
        let whole = [WIDTH * 8, HEIGHT * 8];
        let (mut seen, mut judged) = ([0; 3], 0);
        for step in 1..=10 {
            let plan = trainer.plan_step(Stage::Fine, step).unwrap();
            let view = &plan.views[0];
            let by = match (step, view.leaves_judged) {
                (1..=6, false) => 4,
                (9.., false) => 1,
                _ => 2,
            };
            seen[by / 2] += 1; // by 1, 2, 4
            judged += u32::from(step > 8 && view.leaves_judged);
            let size = [view.frame.image.width, view.frame.image.height];
            assert_eq!(size, whole.map(|side| side / by as u32), "step {step}");
            assert_eq!(size, [view.camera.width, view.camera.height], "step {step}");
        }
        assert!(judged_too || seen.iter().all(|steps| *steps > 0), "{seen:?}");
        assert_eq!(judged > 0, judged_too);
        let plan = trainer.plan_step(Stage::Instance, 1).unwrap();
        assert_eq!(plan.views[0].frame.image.width, whole[0] / 2);
    }
}

#[test]
fn runs_on_reduced_images_are_measured_on_whole_ones() {
    let (mut trainer, _folder) = trainer_on(4, 2);
    for _ in 0..3 {
        trainer.step(&mut Vec::new()).unwrap();
    }
    let TrainEvent::Evaluated { psnr: Some(measured), frames, .. } = trainer.evaluate(Stage::Fine).unwrap()
    else {
        panic!("no PSNR")
    };
    let capture = trainer.state.capture();
    let [mut of_whole, mut of_reduced] = [Vec::new(), Vec::new()];
    for (index, frame) in capture.frames.iter().enumerate().filter(|(_, frame)| frame.split == Split::Val) {
        for (dataset, psnrs) in [(capture, &mut of_whole), (&trainer.state.dataset, &mut of_reduced)] {
            let (settings, camera) = (trainer.state.color_settings(), &dataset.frames[index].camera);
            let mut renderer = Renderer::new(SimdLevel::Auto);
            let drawn = renderer.render(trainer.field(), camera, frame.time, &settings, Channels::default());
            let drawn = trainer.state.recorded(index, drawn);
            let image = dataset.load_image(index, settings.background).unwrap();
            psnrs.push(psnr(&drawn.color, &unit_color(&image)));
        }
    }
    let mean = |psnrs: &[f64]| psnrs.iter().sum::<f64>() / psnrs.len() as f64;
    assert_eq!(of_whole.len(), frames);
    assert!((measured - mean(&of_whole)).abs() < 1e-6, "{measured} {of_whole:?}");
    assert!((measured - mean(&of_reduced)).abs() > 1e-3, "the sizes do not differ: {of_reduced:?}");
    assert_eq!(trainer.dataset().frames[0].camera.width, WIDTH * 4);
}

#[cfg(feature = "wgpu")]
#[test]
fn a_gpu_takes_the_same_steps_on_both_sizes() {
    same_on_a_gpu(|| trainer(4), 8);
}

#[cfg(feature = "wgpu")]
#[test]
fn a_gpu_takes_the_same_steps_on_reduced_and_whole_images() {
    same_on_a_gpu(|| trainer_on(4, 2), 10);
}

#[cfg(feature = "wgpu")]
fn same_on_a_gpu(trainer: impl Fn() -> (Trainer, TempDir), count: u32) {
    let Some(gpu) = testing::gpu() else { return };
    let [(mut on_gpu, _one), (mut expected, _two)] = [trainer(), trainer()];
    on_gpu.use_gpu(&gpu).unwrap();
    let start = expected.state.field.gaussians.means.clone();
    for steps in 1..=count {
        for trainer in [&mut on_gpu, &mut expected] {
            trainer.step(&mut Vec::new()).unwrap();
        }
        on_gpu.fetch().unwrap();
        let means = &expected.state.field.gaussians.means;
        let distance = |from: &[[f32; 3]]| {
            let pairs = from.as_flattened().iter().zip(means.as_flattened());
            pairs.map(|(a, b)| f64::from((a - b).abs())).sum::<f64>()
        };
        let (apart, moved) = (distance(&on_gpu.state.field.gaussians.means), distance(&start));
        assert!(apart < 0.02 * moved && moved > 0.0, "{apart} of {moved} after {steps} steps");
    }
}
