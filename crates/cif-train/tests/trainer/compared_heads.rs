//! Heads of other systems on one reconstruction: what they learn, that nothing but them changes, and that a finished
//! scene decodes as the run did.

use std::sync::LazyLock;

use crate::support::{Scene, capture, small_config, without_record};
use cif_dataset::Dataset;
use cif_field::{Checkpoint, Field};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_train::config::HeadConfig;
use cif_train::heads::Decoder;
use cif_train::heads::lang_splat::relevance::Question;
use cif_train::metrics::{Evaluation, EvaluationError, EvaluationOptions, evaluate};
use cif_train::{Control, HeadName, Outcome, Stage, TrainConfig, TrainEvent, Trainer};

fn config() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine) = (60, 160);
    config.report.curve_frames = 0;
    config
}

/// The capture, and a run that stands where its reconstruction ended.
static RECONSTRUCTION: LazyLock<(tempfile::TempDir, Dataset, Checkpoint)> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 3, ..Scene::default() });
    let mut trainer = Trainer::new(dataset.clone(), config()).unwrap();
    let outcome = trainer.run(&mut |event, _| match event {
        TrainEvent::StageStarted { stage: Stage::Identity, .. } => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(outcome.unwrap(), Outcome::Interrupted);
    let checkpoint = trainer.checkpoint(true);
    (folder, dataset, checkpoint)
});

fn start(head: HeadConfig, steps: u32) -> Trainer {
    let (_, dataset, reconstruction) = &*RECONSTRUCTION;
    let mut config = TrainConfig { head, ..config() };
    config.stages.instance = steps;
    Trainer::from_scene(dataset.clone(), config, reconstruction.clone(), "base.cif").unwrap()
}

fn named(name: HeadName) -> HeadConfig {
    let maps = match name {
        HeadName::LangSplat => MAPS.path().display().to_string(),
        _ => String::new(),
    };
    HeadConfig { name, maps, ..HeadConfig::default() }
}

/// Code of an instance in feature maps, by its place among the ids; 0 for none.
fn code(place: usize) -> [f32; 3] {
    [[0.2, 0.2, 0.2], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]][place]
}

/// Feature maps of the training frames: a code per instance, and one for the rest.
static MAPS: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
    let (folder, (_, dataset, _)) = (tempfile::tempdir().unwrap(), &*RECONSTRUCTION);
    for index in dataset.train_frames() {
        let mask = dataset.load_mask(index).unwrap().unwrap();
        let place = |id: &u16| dataset.instances.iter().position(|one| one.id == *id).map_or(0, |k| k + 1);
        let values = mask.pixels.iter().flat_map(|id| code(place(id))).flat_map(f32::to_le_bytes);
        let shape = format!("({}, {}, 3)", mask.height, mask.width);
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(values);
        let path = folder.path().join(format!("{}.npy", dataset.frames[index].name));
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    folder
});

fn finish(mut trainer: Trainer) -> Checkpoint {
    assert_eq!(trainer.run(&mut |_, _| Control::Continue).unwrap(), Outcome::Finished);
    trainer.checkpoint(false)
}

fn scored(field: &Field, decoder: Option<&Decoder>) -> Evaluation {
    let options = EvaluationOptions { decoder, ..EvaluationOptions::held_out(field) };
    evaluate::<EvaluationError>(field, &RECONSTRUCTION.1, &options, |_| Ok(())).unwrap()
}

/// Trains a head; its scene, checked for what all heads have in common.
fn trained(head: HeadConfig, steps: u32) -> Checkpoint {
    let name = head.name;
    let scene = finish(start(head, steps));
    let path = RECONSTRUCTION.0.path().join(format!("{}.cif", name.name()));
    scene.save(&path).unwrap();
    let read = Checkpoint::load(&path).unwrap();
    let decoder = Decoder::of_scene(&read.field, read.head.as_ref().unwrap()).unwrap();
    assert_eq!(decoder.name(), name.name());
    let scores = scored(&read.field, Some(&decoder));
    let accuracy = scores.overall.instance.macc_pix.unwrap();
    assert!(accuracy > 90.0, "{}: {accuracy}", name.name());
    let rows = scored(&read.field, None).overall.instance.macc_pix.unwrap();
    println!("{}: {accuracy:.2} per pixel, {rows:.2} by rows", name.name());
    assert!(rows > 80.0, "{} by its rows: {rows}", name.name());
    scene
}

/// Some steps on one thread and on three give the same, and another seed something else.
fn repeats(head: &HeadConfig, steps: u32) {
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let scene = pool.install(|| finish(start(head.clone(), steps)));
        (without_record(&scene.field), scene.head)
    };
    assert!(on(1) == on(3), "{} on one thread and on three", head.name.name());
}

fn gaussians_stay(field: &Field) {
    let before = &RECONSTRUCTION.2.field;
    assert!(field.gaussians.means == before.gaussians.means, "the reconstruction stays");
    assert!(field.gaussians.sh_coefficients == before.gaussians.sh_coefficients);
    assert!(field.deformation == before.deformation);
}

#[test]
fn dr_splat_registers_labels_without_a_step() {
    let scene = trained(named(HeadName::DrSplat), 50);
    gaussians_stay(&scene.field);
    let of_stage = &scene.field.record.run.as_ref().unwrap().notes["iterations_by_stage"];
    assert!(of_stage.get("instance").is_none(), "{of_stage}");
    // Its pixels blend one-hot rows by opacity, which is what the scene draws too.
    let decoder = Decoder::of_scene(&scene.field, scene.head.as_ref().unwrap()).unwrap();
    let [decoded, by_rows] = [Some(&decoder), None].map(|decoder| scored(&scene.field, decoder));
    let accuracy = |scores: &Evaluation| scores.overall.instance.macc_pix.unwrap();
    assert!((accuracy(&decoded) - accuracy(&by_rows)).abs() < 0.5);
    repeats(&named(HeadName::DrSplat), 0);
    let nearest = finish(start(HeadConfig { contributors: 1, ..named(HeadName::DrSplat) }, 0));
    assert!(nearest.field.identities != scene.field.identities, "contributors count");
}

#[test]
fn gaussian_grouping_learns_codes() {
    let scene = trained(named(HeadName::GaussianGrouping), 400);
    gaussians_stay(&scene.field);
    repeats(&named(HeadName::GaussianGrouping), 12);
}

#[test]
fn sa4d_learns_a_network() {
    let scene = trained(named(HeadName::Sa4d), 60);
    gaussians_stay(&scene.field);
    repeats(&named(HeadName::Sa4d), 3);
    let one = HeadConfig { camera: "cam1".into(), ..named(HeadName::Sa4d) };
    let alone = finish(start(one.clone(), 3));
    assert!(alone.head.unwrap().tensors != finish(start(named(HeadName::Sa4d), 3)).head.unwrap().tensors);
    let none = HeadConfig { camera: "cam16".into(), ..one };
    let error = start(none, 3).run(&mut |_, _| Control::Continue).unwrap_err().to_string();
    assert!(error.contains("head.camera = cam16") && error.contains("cam0, cam1, cam2, cam3"), "{error}");
}

#[test]
fn vlgs_learns_channels_and_an_opacity_of_their_own() {
    let scene = trained(named(HeadName::Vlgs), 300);
    gaussians_stay(&scene.field);
    let occupancies = &scene.field.gaussians.occupancy_logits;
    let learnt =
        |above: bool| occupancies.iter().any(|logit| (*logit > -2.2 + 0.5) == above && *logit != -2.2);
    assert!(learnt(true) && learnt(false), "opacities of its own are learnt");
    assert!(!scene.field.record.drawing.opacity_is_occupancy, "and drawn with");
    repeats(&named(HeadName::Vlgs), 8);
}

#[test]
fn trace3d_splits_deletes_and_lifts() {
    let mut splits = 0;
    let mut run = start(named(HeadName::Trace3d), 240);
    let outcome = run.run(&mut |event, _| {
        if let TrainEvent::Densified { split, .. } = event {
            splits += split;
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    assert!(splits > 0, "some Gaussians are of two labels");
    let scene = trained(named(HeadName::Trace3d), 240);
    assert_ne!(scene.field.len(), RECONSTRUCTION.2.field.len());
    repeats(&named(HeadName::Trace3d), 12);
}

#[test]
fn lang_splat_learns_maps_and_answers_questions() {
    let scene = finish(start(named(HeadName::LangSplat), 150));
    gaussians_stay(&scene.field);
    assert!(scene.field.identities.is_none(), "it says of no Gaussian whose it is");
    let path = RECONSTRUCTION.0.path().join("4d-langsplat.cif");
    scene.save(&path).unwrap();
    let read = Checkpoint::load(&path).unwrap();
    let decoder = Decoder::of_scene(&read.field, read.head.as_ref().unwrap()).unwrap();
    assert!(!decoder.tells_labels());
    let scores = scored(&read.field, Some(&decoder)).overall;
    assert!(scores.instance.macc_pix.is_none() && scores.psnr.is_some(), "{scores:?}");
    let dataset = &RECONSTRUCTION.1;
    let settings = EvaluationOptions::held_out(&read.field).settings;
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let (mut agreeing, mut pixels, mut overlaps) = (0, 0, Vec::new());
    for index in dataset.val_frames() {
        let (frame, mask) = (&dataset.frames[index], dataset.load_mask(index).unwrap().unwrap());
        let features = decoder.blended(&mut renderer, &read.field, (&frame.camera, frame.time), &settings);
        for (k, instance) in dataset.instances.iter().enumerate() {
            let question = Question { code: code(k + 1), anything: vec![code(0)] };
            let answer = question.answer(&features);
            let of = |counts: &dyn Fn(bool, bool) -> bool| {
                let pairs = answer.pixels.iter().zip(&mask.pixels);
                pairs.filter(|(answer, id)| counts(**answer, **id == instance.id)).count()
            };
            agreeing += of(&|a, b| a == b);
            pixels += mask.pixels.len();
            overlaps.push(of(&|a, b| a && b) as f64 / of(&|a, b| a || b).max(1) as f64);
        }
    }
    let accuracy = 100.0 * agreeing as f64 / pixels as f64;
    let overlap = 100.0 * overlaps.iter().sum::<f64>() / overlaps.len() as f64;
    println!("4d-langsplat: {accuracy:.2} of pixels, {overlap:.2} mIoU");
    assert!(accuracy > 90.0 && overlap > 50.0, "{accuracy} {overlap}");
    repeats(&named(HeadName::LangSplat), 8);
    let nowhere = HeadConfig { maps: "nowhere".into(), ..named(HeadName::LangSplat) };
    let (_, dataset, reconstruction) = &*RECONSTRUCTION;
    let config = TrainConfig { head: nowhere, ..config() };
    let refused = Trainer::from_scene(dataset.clone(), config, reconstruction.clone(), "base.cif");
    assert!(refused.err().unwrap().to_string().contains("nowhere"));
}

#[test]
fn runs_of_heads_go_on_where_they_were_stopped() {
    for name in [HeadName::GaussianGrouping, HeadName::Trace3d, HeadName::LangSplat] {
        let whole = finish(start(named(name), 29));
        let mut stopped = start(named(name), 29);
        let outcome = stopped.run(&mut |event, _| match event {
            TrainEvent::Step { stage: Stage::Instance, iteration, .. } if *iteration >= 10 => Control::Stop,
            _ => Control::Continue,
        });
        assert_eq!(outcome.unwrap(), Outcome::Interrupted);
        let resumed = Trainer::resume(RECONSTRUCTION.1.clone(), stopped.checkpoint(true)).unwrap();
        let resumed = finish(resumed);
        assert!(without_record(&resumed.field) == without_record(&whole.field), "{}", name.name());
        assert_eq!(resumed.head, whole.head);
    }
}

/// Losses of the steps that train the head of a run, and the field in the end.
#[cfg(feature = "wgpu")]
fn losses(mut trainer: Trainer) -> (Vec<f64>, Field) {
    let mut losses = Vec::new();
    let outcome = trainer.run(&mut |event, _| {
        if let TrainEvent::Step { stage: Stage::Instance, instance_loss: Some(loss), .. } = event {
            losses.push(*loss);
        }
        Control::Continue
    });
    assert_eq!(outcome.unwrap(), Outcome::Finished);
    (losses, trainer.into_field())
}

#[cfg(feature = "wgpu")]
#[test]
#[ignore = "long: make test-long"]
fn heads_learn_the_same_on_a_gpu() {
    let Some(gpu) = cif_render::wgpu::testing::gpu() else { return };
    let heads =
        [HeadName::GaussianGrouping, HeadName::Sa4d, HeadName::Vlgs, HeadName::Trace3d, HeadName::LangSplat];
    for name in heads {
        let started = || {
            let (_, dataset, reconstruction) = &*RECONSTRUCTION;
            let mut config = TrainConfig { head: named(name), ..config() };
            (config.stages.instance, config.report.step_every) = (12, 1);
            Trainer::from_scene(dataset.clone(), config, reconstruction.clone(), "base.cif").unwrap()
        };
        let (on_processor, field) = losses(started());
        let mut trainer = started();
        trainer.use_gpu(&gpu).unwrap();
        let (on_gpu, of_gpu) = losses(trainer);
        assert!(on_processor.len() >= 8 && on_processor.len() == on_gpu.len(), "{}", name.name());
        for (a, b) in on_processor.iter().zip(&on_gpu) {
            assert!((a / b - 1.0).abs() < 0.03, "{}: {on_processor:?} and {on_gpu:?}", name.name());
        }
        let lengths = [field.len(), of_gpu.len()];
        assert!(lengths[0].abs_diff(lengths[1]) <= lengths[0] / 50, "{}: {lengths:?}", name.name());
        let occupancies = field.gaussians.occupancy_logits.iter().zip(&of_gpu.gaussians.occupancy_logits);
        let apart = occupancies.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(name != HeadName::Vlgs || apart < 0.05, "opacities of its own differ by {apart}");
    }
}
