//! Densification rules that are declared here alone.

use std::sync::Arc;

use crate::effects::score;
use crate::support::{Scene, capture, small_config, train};
use cif_train::config::DensifyRule;
use cif_train::density::{Change, Rows, Strategy, keep, with_copies};
use cif_train::schedule::Moment;
use cif_train::{Control, Outcome, Stage, TrainConfig, TrainEvent, Trainer};
use rand_pcg::Pcg64;

/// Step of the fine stage behind which the set changes.
const STEP: u32 = 7;

/// Doubles all Gaussians behind one step, then keeps every fourth of them, and caps opacities.
struct DoubleThenThin;

impl Strategy for DoubleThenThin {
    fn counts_statistics(&self, _step: &Moment<'_>) -> bool {
        false
    }

    fn changes(&self, step: &Moment<'_>) -> usize {
        if step.stage == Stage::Fine && step.iteration == STEP { 2 } else { 0 }
    }

    fn change(&self, k: usize, _step: &Moment<'_>, rows: &Rows<'_>, rng: &mut Pcg64) -> Change {
        let all: Vec<u32> = (0..rows.gaussians.len() as u32).collect();
        assert_eq!(rows.statistics.count, vec![0; all.len()], "nothing was counted");
        match k {
            0 => Change {
                rearrangement: Some(with_copies(rows.gaussians, &all, &[], rng)),
                ..Change::default()
            },
            _ => Change {
                rearrangement: keep(rows.gaussians, all.into_iter().step_by(4).collect()),
                opacity_cap: Some(0.01),
                ..Change::default()
            },
        }
    }
}

/// Settings of a run of a few steps.
fn config() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (10, 20, 10);
    config.stages.fine_includes_coarse = false;
    (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
    config
}

/// Changes of the set in the coarse and fine stage: step, cloned, pruned and Gaussians left.
fn run(trainer: &mut Trainer, stop_behind: Option<u64>) -> Vec<(Stage, u32, usize, usize, usize)> {
    let mut found = Vec::new();
    let outcome = trainer
        .run(&mut |event, _view| {
            if let TrainEvent::Densified { stage, iteration, cloned, pruned, gaussians, .. } = *event {
                found.push((stage, iteration, cloned, pruned, gaussians));
            }
            match event {
                TrainEvent::Step { stage: Stage::Fine, iteration, .. }
                    if Some(u64::from(*iteration)) == stop_behind =>
                {
                    Control::Stop
                }
                _ => Control::Continue,
            }
        })
        .unwrap();
    assert_eq!(outcome == Outcome::Interrupted, stop_behind.is_some());
    found
}

#[test]
fn a_strategy_that_is_declared_here_changes_the_set_on_its_steps_alone() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene::default());
    let mut trainer = Trainer::new(dataset.clone(), config()).unwrap();
    trainer.set_density(Arc::new(DoubleThenThin));
    let before = trainer.field().len();
    let found = run(&mut trainer, None);
    let left = (2 * before).div_ceil(4);
    assert_eq!(found, [(Stage::Fine, STEP, before, 2 * before - left, left)]);
    assert_eq!(trainer.field().len(), left);
    trainer.field().validate().unwrap();

    // Today's rules do something else.
    let mut current = Trainer::new(dataset.clone(), config()).unwrap();
    run(&mut current, None);
    assert_ne!(current.field().len(), left);

    // A resumed run that is given the strategy again ends where the other did.
    let mut config = config();
    config.report.step_every = 1;
    let mut interrupted = Trainer::new(dataset.clone(), config).unwrap();
    interrupted.set_density(Arc::new(DoubleThenThin));
    assert!(run(&mut interrupted, Some(u64::from(STEP) - 2)).is_empty());
    let mut resumed = Trainer::resume(dataset, interrupted.checkpoint(true)).unwrap();
    resumed.set_density(Arc::new(DoubleThenThin));
    run(&mut resumed, None);
    assert_eq!(resumed.field().gaussians, trainer.field().gaussians);
}

#[test]
fn a_set_grows_step_by_step_and_is_renewed_once_it_is_full() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 3, ..Scene::default() });
    let mut config = config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (1, 101, 0);
    let densify = &mut config.densify;
    (densify.from, densify.every, densify.prune_every, densify.until) = (0, 10, 0, 100);
    let before = Trainer::new(dataset.clone(), config.clone()).unwrap().field().len();
    let most = 2 * before;
    config.densify.max_gaussians = most as u32;
    let mut trainer = Trainer::new(dataset, config).unwrap();
    let mut found = Vec::new();
    trainer
        .run(&mut |event, _| {
            if let TrainEvent::Densified { iteration, cloned, split, pruned, gaussians, .. } = *event {
                assert_eq!(cloned, 0);
                found.push((iteration, split, pruned, gaussians));
            }
            Control::Continue
        })
        .unwrap();
    let sizes: Vec<usize> = found.iter().map(|(.., gaussians)| *gaussians).collect();
    // Full behind half of the steps with additions, by equal factors.
    let grown: Vec<usize> =
        (1..=5).map(|k| (before as f64 * 2_f64.powf(f64::from(k) / 5.0)).ceil() as usize).collect();
    for (size, expected) in sizes.iter().zip(&grown) {
        assert!(size.abs_diff(*expected) <= 5, "{sizes:?}, expected {grown:?}");
    }
    assert_eq!(sizes[4..], [most; 5], "{found:?}");
    // A tenth of a full set makes room each time, and is made anew.
    for (iteration, split, pruned, _) in &found[5..] {
        assert_eq!((*split, *pruned), (most / 10, most / 10), "{iteration}: {found:?}");
    }
    trainer.field().validate().unwrap();
}

#[test]
fn splitting_by_error_shows_more_with_as_many_gaussians() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
    let psnr = |rule: DensifyRule| {
        let of_seed = |seed: u64| {
            let mut config = small_config();
            config.seed = seed;
            (config.stages.coarse, config.stages.fine, config.stages.instance) = (50, 400, 0);
            config.densify.rule = rule;
            (config.densify.every, config.densify.until) = (20, 300);
            let trainer = train(dataset.clone(), config.clone());
            assert!(trainer.field().len() <= config.densify.max_gaussians as usize);
            score(&trainer)
        };
        (0..3).map(of_seed).sum::<f64>() / 3.0
    };
    let [error, gradient] = [DensifyRule::Error, DensifyRule::Gradient].map(psnr);
    assert!(error > gradient, "{error} dB by error, {gradient} dB by gradient");
}

/// Images that show more than a full set can get a larger one, of at most twice the size, and a run that is resumed keeps
/// it.
#[test]
fn images_with_much_detail_get_more_gaussians() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let of = |detail: f32, most: u32| {
        let mut config = config();
        (config.densify.detail, config.densify.max_gaussians) = (detail, most);
        Trainer::new(dataset.clone(), config).unwrap()
    };
    let most = |trainer: &Trainer| trainer.config().densify.max_gaussians;
    // Outlines and floors of the balls: some pixels, far fewer than the image has.
    let (all, few) = (most(&of(1.0, 50)), most(&of(1.0, 40_000)));
    assert_eq!((all, few), (100, 40_000), "twice as many at most, and never fewer");
    assert_eq!(most(&of(0.0, 50)), 50);
    let mut trainer = of(1.0, 50);
    let outcome = trainer.run(&mut |event, _| match event {
        TrainEvent::Warning { message } => panic!("{message}"),
        TrainEvent::Step { stage: Stage::Fine, .. } => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    let resumed = Trainer::resume(dataset.clone(), trainer.checkpoint(true)).unwrap();
    assert_eq!((most(&resumed), resumed.config().densify.detail), (100, 0.0));
}
