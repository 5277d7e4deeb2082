//! Optional outputs of the deformation network, judged once, at half of the fine stage: sooner they have not learnt
//! what they are worth, and later nothing is left to make good for what is taken back.

use cif_field::deformation::HeadKind;
use cif_field::parameters::MLP;
use cif_field::{Deformation, Field};

use super::bench::gain;
use super::motions::{probe, probe_times};
use super::{Bench, Effect, Standing};
use crate::engine::Changed;
use crate::error::TrainError;
use crate::schedule::{Due, Moment};

/// Outputs that may go, the least needed first.
const OPTIONAL: [HeadKind; 4] = [HeadKind::Sh, HeadKind::Opacity, HeadKind::Scale, HeadKind::Rotation];

/// Outputs other than the centres.
pub(crate) struct Outputs;

impl Effect for Outputs {
    fn name(&self) -> &'static str {
        "shape"
    }

    fn due(&self, step: &Moment<'_>, standing: &Standing<'_>) -> bool {
        standing.field.deformation.is_some() && step.has(Due::JudgeOutputs)
    }

    fn judge(&self, bench: &mut Bench<'_>) -> Result<(), TrainError> {
        let required = f64::from(bench.config().effects.head_gain);
        let times = probe_times(&bench.state.dataset.times);
        for kind in OPTIONAL {
            let Some(trial) = without_output(bench.field(), kind, &times) else { continue };
            let with = bench.error(None)?;
            let without = bench.error(Some(&trial.field))?;
            let gain_db = gain(without, with);
            let kept = gain_db >= required;
            if !kept {
                remove_output(bench, trial);
            }
            bench.report(format!("motion of {}", name(kind)), gain_db, kept);
        }
        Ok(())
    }
}

/// Goes on without an output, and without its moments.
fn remove_output(bench: &mut Bench<'_>, Trial { field, removed }: Trial) {
    let state = &mut *bench.state;
    state.field = field;
    let mlp = state.optimiser.of(&MLP);
    mlp.first.drain(removed.clone());
    mlp.second.drain(removed.clone());
    state.gradients.mlp.drain(removed);
    bench.engine.changed(Changed::Everything);
}

/// A field without an output of its deformation.
struct Trial {
    field: Field,
    /// Range of the removed output in the floats of the full network.
    removed: std::ops::Range<usize>,
}

/// The field with the mean of an output of its deformation in its place; nothing where there is no such output,
/// or no other.
fn without_output(field: &Field, kind: HeadKind, times: &[f64]) -> Option<Trial> {
    let deformation = field.deformation.as_ref()?;
    let layout = deformation.config.mlp_layout();
    let head = layout.heads.iter().find(|head| head.kind == kind).filter(|_| layout.heads.len() > 1)?;
    let removed = head.hidden.weights.start..head.output.biases.end;
    let mut field = field.clone();
    let rows: Vec<u32> = deformation.moving_rows(field.len()).collect();
    let motions = probe(deformation, &field.gaussians, &rows, times);
    let gaussians = &mut field.gaussians;
    for (row, motion) in rows.iter().zip(&motions) {
        let row = *row as usize;
        let width = kind.outputs();
        let values = &mut gaussians.tensor_mut(&kind.parameter())[row * width..(row + 1) * width];
        for (value, delta) in values.iter_mut().zip(motion.mean.output(kind)) {
            *value += delta;
        }
    }
    let mut config = deformation.config.clone();
    let heads = &mut config.heads;
    match kind {
        HeadKind::Position => heads.position = false,
        HeadKind::Scale => heads.scale = false,
        HeadKind::Rotation => heads.rotation = false,
        HeadKind::Opacity => heads.opacity = false,
        HeadKind::Sh => heads.sh = false,
    }
    let mut mlp = deformation.mlp.clone();
    mlp.drain(removed.clone());
    field.deformation = Some(Deformation { config, mlp, ..deformation.clone() });
    Some(Trial { field, removed })
}

fn name(kind: HeadKind) -> &'static str {
    match kind {
        HeadKind::Position => "centres",
        HeadKind::Scale => "scales",
        HeadKind::Rotation => "rotations",
        HeadKind::Opacity => "opacities",
        HeadKind::Sh => "colours",
    }
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic;

    use super::*;

    #[test]
    fn an_output_leaves_its_mean_behind_and_the_others_as_they_were() {
        let field = synthetic::generate(&synthetic::SyntheticConfig {
            gaussians: 40,
            heads: Some(synthetic::ALL_HEADS),
            ..Default::default()
        })
        .field;
        let times = [0.0, 0.5, 1.0];
        let trial = without_output(&field, HeadKind::Scale, &times).unwrap();
        trial.field.validate().unwrap();
        let deformation = trial.field.deformation.as_ref().unwrap();
        assert!(!deformation.config.heads.scale && deformation.config.heads.position);
        let before = field.deformation.as_ref().unwrap();
        assert_eq!(deformation.mlp.len() + trial.removed.len(), before.mlp.len());
        for time in times {
            let (now, then) = (trial.field.deformed(time), field.deformed(time));
            assert_eq!(now.means, then.means);
            assert_eq!(now.quaternions, then.quaternions);
        }
        let mean = |row: usize, axis: usize| {
            times.iter().map(|time| field.deformed(*time).log_scales[row][axis]).sum::<f32>() / 3.0
        };
        for row in 0..40 {
            for axis in 0..3 {
                assert!((trial.field.gaussians.log_scales[row][axis] - mean(row, axis)).abs() < 1e-4);
            }
        }
        assert!(without_output(&trial.field, HeadKind::Scale, &times).is_none(), "it is gone already");
    }
}
