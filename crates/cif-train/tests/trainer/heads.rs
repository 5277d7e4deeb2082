//! A head that is declared here alone, with tensors of its own, trained by every engine.

use std::sync::Arc;

use crate::support::{Scene, capture, small_config};
use cif_field::parameters::{Activation, OnCopy, Parameter, Rows};
use cif_field::{Checkpoint, Field};
use cif_render::Blending;
use cif_train::{
    Control, Head, HeadLoss, HeadTensors, HeadValues, HeadView, Outcome, Pass, TrainConfig, TrainEvent,
    Trainer, ValueHead,
};

/// Instances of the capture, and the rest.
const CLASSES: usize = 4;

/// Scores of every Gaussian.
const SCORES: Parameter = Parameter {
    name: "scores",
    part: "scored",
    rate: "scores",
    rows: Rows::Gaussians,
    shape: &[CLASSES],
    activation: Activation::Identity,
    on_copy: OnCopy::Same,
};

/// Biases that every pixel adds to the blended scores.
const BIAS: Parameter = Parameter { name: "bias", rate: "bias", rows: Rows::Fixed, shape: &[], ..SCORES };

/// Scores of classes, blended like colour, and a softmax over them.
struct Scored(Blending);

fn softmax(scores: &[f32], bias: &[f32]) -> [f32; CLASSES] {
    let sums: [f32; CLASSES] = std::array::from_fn(|class| scores[class] + bias[class]);
    let most = sums.iter().copied().fold(f32::MIN, f32::max);
    let powers = sums.map(|sum| (sum - most).exp());
    let total: f32 = powers.iter().sum();
    powers.map(|power| power / total)
}

impl Head for Scored {
    fn name(&self) -> &'static str {
        "scored"
    }

    fn pass(&self, _config: &TrainConfig) -> Pass<'_> {
        Pass::Values(self)
    }
}

impl ValueHead for Scored {
    fn parameters(&self) -> Vec<Parameter> {
        vec![SCORES, BIAS]
    }

    fn start(&self, parameter: &Parameter, field: &Field, _seed: u64) -> Vec<f32> {
        vec![0.0; if *parameter == SCORES { field.len() * CLASSES } else { CLASSES }]
    }

    fn rate(&self, parameter: &Parameter, step: u32, steps: u32) -> f32 {
        assert!((1..=steps).contains(&step));
        if *parameter == SCORES { 0.2 } else { 0.05 }
    }

    fn channels(&self, _field: &Field) -> usize {
        CLASSES
    }

    fn blending(&self) -> Blending {
        self.0
    }

    fn values(&self, tensors: &HeadTensors, _field: &Field, _time: f64) -> Vec<f32> {
        tensors.values(&SCORES).to_vec()
    }

    fn values_backward(&self, tensors: &mut HeadTensors, _: &Field, _: &HeadValues, v_values: &[f32]) {
        let (_, gradients) = tensors.values_and_gradients(&SCORES);
        gradients.iter_mut().zip(v_values).for_each(|(sum, v)| *sum += v);
    }

    fn loss(
        &self,
        tensors: &mut HeadTensors,
        HeadView { blended, labels, .. }: &HeadView<'_>,
        weight: f32,
        v_blended: &mut [f32],
    ) -> HeadLoss {
        let (bias, v_bias) = tensors.values_and_gradients(&BIAS);
        let mut sum = 0.0;
        let share = weight / labels.pixels.len() as f32;
        let pixels = blended.pixels().zip(&labels.pixels).zip(v_blended.chunks_exact_mut(CLASSES));
        for ((scores, label), v) in pixels {
            let mut probabilities = softmax(scores, bias);
            sum -= f64::from(probabilities[usize::from(*label)].max(1e-30).ln());
            probabilities[usize::from(*label)] -= 1.0;
            for class in 0..CLASSES {
                v[class] = share * probabilities[class];
                v_bias[class] += v[class];
            }
        }
        HeadLoss { loss: sum / labels.pixels.len() as f64, unsupported: 0.0 }
    }

    fn decode(&self, tensors: &HeadTensors, blended: &[f32]) -> (u16, f32) {
        let probabilities = softmax(blended, tensors.values(&BIAS));
        let best = (0..CLASSES).max_by(|a, b| probabilities[*a].total_cmp(&probabilities[*b])).unwrap();
        (best as u16, probabilities[best])
    }
}

fn config() -> TrainConfig {
    let mut config = small_config();
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (40, 40, 80);
    // So few steps do not teach where the third ball goes.
    config.motion.rehearsal = 300;
    config.report.step_every = 1;
    config.report.evaluate_every = 160;
    config
}

/// Runs to the end, or so many steps of the instance stage; the losses of these steps, and the score at the end.
fn run(trainer: &mut Trainer, most: usize) -> (Vec<f64>, Option<f64>) {
    let (mut losses, mut miou) = (Vec::new(), None);
    let outcome = trainer.run(&mut |event, _| {
        match event {
            TrainEvent::Step { instance_loss: Some(loss), .. } => losses.push(*loss),
            TrainEvent::Evaluated { miou: of, .. } => miou = *of,
            _ => {}
        }
        if losses.len() == most { Control::Stop } else { Control::Continue }
    });
    assert_eq!(outcome.unwrap(), if most < 80 { Outcome::Interrupted } else { Outcome::Finished });
    (losses, miou)
}

fn labels(field: &Field) -> Vec<Option<u16>> {
    field.identities.as_ref().unwrap().argmax()
}

#[test]
fn heads_with_tensors_of_their_own_learn_on_every_engine_and_leave_as_identities() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, ..Scene::default() });
    let trained = |blending, left: f64, prepare: &dyn Fn(&mut Trainer)| {
        let mut trainer = Trainer::new(dataset.clone(), config()).unwrap();
        trainer.set_head(Arc::new(Scored(blending))).unwrap();
        prepare(&mut trainer);
        let (losses, miou) = run(&mut trainer, usize::MAX);
        assert_eq!(losses.len(), 80);
        assert!(losses[79] < left * losses[0], "{} to {}", losses[0], losses[79]);
        assert!(miou.unwrap() > 80.0, "{miou:?}");
        let field = trainer.field();
        let of = labels(field);
        assert_eq!(of.len(), field.len());
        for instance in 0..3 {
            assert!(of.iter().filter(|of| **of == Some(instance)).count() > 10, "instance {instance}");
        }
        (of, losses)
    };
    let (on_processor, losses) = trained(Blending::Color, 0.25, &|_| {});
    #[cfg(feature = "wgpu")]
    if let Some(gpu) = cif_render::wgpu::testing::gpu() {
        let (on_gpu, gpu_losses) = trained(Blending::Color, 0.25, &|trainer| trainer.use_gpu(&gpu).unwrap());
        assert!((losses[0] / gpu_losses[0] - 1.0).abs() < 0.02, "{} {}", losses[0], gpu_losses[0]);
        assert!((losses[79] / gpu_losses[79] - 1.0).abs() < 0.2, "{} {}", losses[79], gpu_losses[79]);
        assert!(on_gpu.len().abs_diff(on_processor.len()) < on_processor.len() / 10);
    }
    // Weights of their own, by the occupancy, which is low where the stage begins.
    let (_, own) = trained(Blending::Own, 0.6, &|_| {});
    #[cfg(feature = "wgpu")]
    if let Some(gpu) = cif_render::wgpu::testing::gpu() {
        let (_, on_gpu) = trained(Blending::Own, 0.6, &|trainer| trainer.use_gpu(&gpu).unwrap());
        assert!((own[0] / on_gpu[0] - 1.0).abs() < 0.02, "{} {}", own[0], on_gpu[0]);
    }
    let _ = (on_processor, losses, own);
}

#[test]
fn heads_go_on_bit_for_bit_where_they_were_saved() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = capture(folder.path(), Scene { times: 2, views: 2, ..Scene::default() });
    let fresh = || {
        let mut trainer = Trainer::new(dataset.clone(), config()).unwrap();
        trainer.set_head(Arc::new(Scored(Blending::Color))).unwrap();
        trainer
    };
    let mut whole = fresh();
    let (losses, _) = run(&mut whole, usize::MAX);
    let mut stopped = fresh();
    let (first, _) = run(&mut stopped, 30);
    let path = folder.path().join("stopped.cif");
    stopped.checkpoint(true).save(&path).unwrap();
    let resume = || Trainer::resume(dataset.clone(), Checkpoint::load(&path).unwrap()).unwrap();
    let mut resumed = resume();
    resumed.set_head(Arc::new(Scored(Blending::Color))).unwrap();
    let (rest, _) = run(&mut resumed, usize::MAX);
    assert_eq!([&first[..], &rest[..]].concat(), losses);
    assert_eq!(labels(whole.field()), labels(resumed.field()));
    let error = resume().run(&mut |_, _| Control::Continue).unwrap_err().to_string();
    assert!(error.contains("trains the head scored"), "{error}");
    let error = resume().set_head(Arc::new(cif_train::heads::Cif)).unwrap_err().to_string();
    assert!(error.contains("its head is scored, not cif"), "{error}");
}
