//! Steps on images of half the size. `CIF_TEST_GPU=off|auto|require`.

#[cfg(feature = "wgpu")]
use cif_render::wgpu::testing;
use tempfile::TempDir;

use super::Trainer;
use super::guard_tests::support::{HEIGHT, Scene, WIDTH, capture, small_config};
use crate::effects::is_judged;
use crate::stage::Stage;

/// A run at the start of a fine stage of 10 steps, of which 6 see smaller images where these are large.
fn trainer(larger: u32) -> (Trainer, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { times: 3, views: 4, larger, ..Scene::default() };
    let dataset = capture(folder.path(), scene);
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.half_size) = (4, 10, 0.6);
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

#[cfg(feature = "wgpu")]
#[test]
fn a_gpu_takes_the_same_steps_on_both_sizes() {
    let Some(gpu) = testing::gpu() else { return };
    let [(mut on_gpu, _one), (mut expected, _two)] = [trainer(4), trainer(4)];
    on_gpu.use_gpu(&gpu).unwrap();
    let start = expected.state.field.gaussians.means.clone();
    for steps in 1..=8 {
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
