//! Steps that go wrong, on a real capture.

#[path = "../../tests/support/mod.rs"]
pub(crate) mod support;

use cif_field::Field;
use cif_field::parameters::OPACITY_LOGITS;
use tempfile::TempDir;

use self::support::{Scene, capture, small_config};
use super::Trainer;
use crate::error::TrainError;
use crate::events::{Control, Outcome, TrainEvent};
use crate::guard::{MAX_ROLLBACKS_IN_A_ROW, loss_fault};
use crate::optimiser::Optimiser;
use crate::stage::Stage;

fn trainer(times: usize) -> (Trainer, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times, views: 2, ..Scene::default() });
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (6, 12, 6);
    config.report.step_every = 1;
    (Trainer::new(dataset, config).unwrap(), folder)
}

fn state(trainer: &Trainer) -> (Field, Optimiser) {
    (trainer.state.field.clone(), trainer.state.optimiser.clone())
}

/// One step, and what it reported.
fn step(trainer: &mut Trainer) -> (Result<(), TrainError>, Vec<TrainEvent>) {
    if trainer.stage() == Stage::Search {
        trainer.enter(Stage::Coarse).unwrap();
    }
    let mut events = Vec::new();
    let result = trainer.step(&mut events).map(drop);
    (result, events)
}

#[test]
fn a_bad_gradient_of_an_exposure_moves_neither_exposures_nor_field() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let mut config = small_config();
    config.effects.exposure = true;
    let mut trainer = Trainer::new(dataset, config).unwrap();
    step(&mut trainer).0.unwrap();
    let arrays = |trainer: &Trainer| {
        let exposures = serde_json::to_value(trainer.state.progress.exposures.as_ref().unwrap()).unwrap();
        (state(trainer), exposures)
    };
    let before = arrays(&trainer);
    trainer.state.progress.exposures.as_mut().unwrap().add(
        "cam1",
        0.0,
        &[0.0, 0.0, f32::INFINITY, 0.0, 0.0, 0.0],
    );
    let (result, events) = step(&mut trainer);
    result.unwrap();
    let [TrainEvent::RolledBack { fault, .. }] = &events[..] else { panic!("{events:?}") };
    assert_eq!((fault.part, fault.tensor.as_str(), fault.index), ("gradients", "gradient of exposures", 8));
    assert!(arrays(&trainer) == before);
    step(&mut trainer).0.unwrap();
    assert!(arrays(&trainer) != before, "the next step moves them");
}

#[test]
fn a_bad_gradient_is_rolled_back_reported_and_counted() {
    let (mut trainer, _folder) = trainer(3);
    for debug in [false, true] {
        trainer.set_debug_validation(debug);
        step(&mut trainer).0.unwrap();
        let (before, psnr) = (state(&trainer), trainer.state.progress.psnr);
        let (iteration, total) = (trainer.iteration(), trainer.rolled_back());
        trainer.state.gradients.gaussians.means[3][1] = f32::NAN;
        let (result, events) = step(&mut trainer);
        result.unwrap();
        assert!(state(&trainer) == before, "parameters and moments are those before the step");
        assert_eq!(trainer.state.progress.psnr, psnr);
        assert_eq!((trainer.iteration(), trainer.rolled_back()), (iteration + 1, total + 1));
        let [TrainEvent::RolledBack { stage: Stage::Coarse, iteration: at, fault, in_a_row: 1, .. }] =
            &events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!((*at, fault.tensor.as_str(), fault.index), (iteration + 1, "gradient of means", 10));
        assert_eq!(fault.value, "NaN");
        // The next step is as good as any.
        let (result, events) = step(&mut trainer);
        result.unwrap();
        assert!(events.is_empty() && state(&trainer) != before, "{events:?}");
        assert_eq!(trainer.state.progress.rollbacks.in_a_row, 0);
    }
    let record = trainer.provenance().to_json();
    assert_eq!(record["train"]["rolled_back"]["steps"], 2);
    assert!(
        record["train"]["rolled_back"]["last"].as_str().unwrap().contains("gradient of means[10] is NaN")
    );
}

#[test]
fn a_gradient_whose_square_overflows_is_rolled_back_too() {
    let (mut trainer, _folder) = trainer(3);
    trainer.state.gradients.gaussians.opacity_logits[0] = 1e25;
    let before = state(&trainer);
    let (result, events) = step(&mut trainer);
    result.unwrap();
    assert!(
        matches!(&events[..], [TrainEvent::RolledBack { fault, .. }] if fault.tensor == "gradient of opacity_logits")
    );
    assert!(state(&trainer) == before);
}

#[test]
fn too_many_bad_steps_in_a_row_stop_the_run_which_can_be_resumed() {
    let (mut trainer, folder) = trainer(3);
    step(&mut trainer).0.unwrap();
    // A colour that overflows in every view.
    let sound = trainer.state.field.gaussians.sh_coefficients[0];
    for row in &mut trainer.state.field.gaussians.sh_coefficients {
        row[0] = 3e38;
    }
    let before = state(&trainer);
    let mut reported = 0;
    let error = loop {
        let (result, events) = step(&mut trainer);
        reported += events.len() as u32;
        if let Err(error) = result {
            break error;
        }
    };
    assert!(state(&trainer) == before);
    assert_eq!(reported, MAX_ROLLBACKS_IN_A_ROW - 1);
    let TrainError::Diverged { in_a_row, ref fault, .. } = error else { panic!("{error}") };
    assert_eq!((in_a_row, u64::from(in_a_row)), (MAX_ROLLBACKS_IN_A_ROW, trainer.rolled_back()));
    assert!(!fault.value.is_empty());
    assert!(error.to_string().contains("--debug-validation"), "{error}");
    // What is saved goes on once the cause is gone.
    let path = folder.path().join("stopped.cif");
    trainer.checkpoint(true).save(&path).unwrap();
    let mut checkpoint = cif_field::Checkpoint::load(&path).unwrap();
    checkpoint.field.gaussians.sh_coefficients.fill(sound);
    let mut resumed = Trainer::resume(trainer.dataset().clone(), checkpoint).unwrap();
    let mut finished = None;
    let outcome = resumed.run(&mut |event, _| {
        if let TrainEvent::Finished { rolled_back, .. } = event {
            finished = Some(*rolled_back);
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    assert_eq!(finished, Some(u64::from(MAX_ROLLBACKS_IN_A_ROW)), "the count survives the interruption");
}

#[test]
fn debug_validation_names_the_part_where_it_begins() {
    let (mut sound, _folder) = trainer(3);
    while sound.stage() != Stage::Instance {
        let outcome = sound.run(&mut |event, _| match event {
            TrainEvent::StageStarted { stage: Stage::Instance, .. } => Control::Stop,
            _ => Control::Continue,
        });
        assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    }
    let checkpoint = sound.checkpoint(true);
    let dataset = sound.dataset().clone();
    let fault_of = |damage: &dyn Fn(&mut Trainer)| {
        let mut trainer = Trainer::resume(dataset.clone(), checkpoint.clone()).unwrap();
        trainer.set_debug_validation(true);
        damage(&mut trainer);
        let (result, events) = step(&mut trainer);
        result.unwrap();
        match events.into_iter().next() {
            Some(TrainEvent::RolledBack { fault, .. }) => fault.to_string(),
            other => panic!("{other:?}"),
        }
    };
    let planes = fault_of(&|trainer| {
        trainer.state.field.deformation.as_mut().unwrap().planes[5] = f32::NAN;
    });
    assert_eq!(planes, "parameters: planes[5] is NaN");
    let deform = fault_of(&|trainer| {
        let deformation = trainer.state.field.deformation.as_mut().unwrap();
        let layout = deformation.config.mlp_layout();
        deformation.mlp[layout.heads[0].output.biases.start] = f32::MAX;
        trainer.state.field.gaussians.means[2][0] = f32::MAX;
    });
    assert_eq!(deform, "deform: posed means[6] is inf");
    let overflow = fault_of(&|trainer| {
        // Squares of such colours are infinite.
        trainer.state.config.loss.lambda_dssim = 0.0;
        for row in &mut trainer.state.field.gaussians.sh_coefficients {
            row[0] = 3e38;
        }
    });
    assert!(overflow.starts_with("gradients: gradient of means["), "{overflow}");
    let losses = loss_fault("colour loss", f64::NAN).unwrap().to_string();
    assert_eq!(losses, "losses: colour loss[0] is NaN");
    let moments = fault_of(&|trainer| trainer.state.optimiser.of(&OPACITY_LOGITS).second[1] = f32::INFINITY);
    assert_eq!(moments, "optimiser: second moments[1] is inf");
    let gradients =
        fault_of(&|trainer| trainer.state.gradients.gaussians.sh_coefficients[1][2] = f32::INFINITY);
    assert_eq!(gradients, "project backward: gradient of sh_coefficients[50] is inf");
    let network = fault_of(&|trainer| trainer.state.gradients.mlp[7] = f32::NAN);
    assert_eq!(network, "deform backward: gradient of mlp[7] is NaN");
}

#[test]
fn looking_at_every_array_changes_no_bit() {
    let (mut plain, _one) = trainer(3);
    let (mut looked_at, _two) = trainer(3);
    looked_at.set_debug_validation(true);
    for trainer in [&mut plain, &mut looked_at] {
        assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    }
    let (mut a, mut b) = (state(&plain), state(&looked_at));
    // The record of a run holds wall times.
    (a.0.record, b.0.record) = Default::default();
    assert!(a == b);
    assert_eq!(looked_at.rolled_back(), 0);
}
