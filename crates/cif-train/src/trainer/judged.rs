//! Judgement of degrees of spherical harmonics and of the optional outputs of the deformation, which have to show
//! that they help. They are judged on pixels of training views that the colour loss leaves out, at half of the fine
//! stage: sooner they have not learnt what they are worth, and later nothing is left to make good for what is taken
//! back.

use cif_field::deformation::HeadKind;
use cif_field::parameters::MLP;
use cif_field::{Deformation, Field};
use cif_geometry::spherical_harmonics::coefficient_count;
use cif_render::{Channels, RenderSettings};

use super::Trainer;
use super::motions::{probe, probe_times};
use crate::engine::{Changed, Views};
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::losses::held_out::held_out;
use crate::schedule::{Due, sh_degree};
use crate::stage::Stage;

/// Views that are compared.
const VIEWS: usize = 8;

/// Outputs that may go, the least needed first.
const OPTIONAL: [HeadKind; 4] = [HeadKind::Sh, HeadKind::Opacity, HeadKind::Scale, HeadKind::Rotation];

/// Training views that are judged by, evenly spread.
fn judged_views(views: usize) -> impl Iterator<Item = usize> {
    let count = views.min(VIEWS);
    (0..count).map(move |k| k * views / count)
}

impl Trainer {
    /// True where a frame of the capture is one of those that effects are judged by.
    pub(super) fn is_judged_by(&self, frame: usize) -> bool {
        judged_views(self.state.frames.len()).any(|view| self.state.frames.index(view) == frame)
    }

    /// Degree of spherical harmonics at a step: as the schedule says, but not two above one that helps, and not
    /// above what was taken back.
    pub(super) fn degree_at(&self, iteration: u32) -> u8 {
        let scheduled = sh_degree(&self.state.config, self.state.progress.sh_start, iteration);
        if self.state.config.effects.sh_gain <= 0.0 {
            return scheduled;
        }
        scheduled.min(self.state.progress.sh_judged + 1).min(self.state.progress.sh_cap.unwrap_or(u8::MAX))
    }

    /// True when spherical harmonics are judged before the step that comes next.
    pub(super) fn judges_harmonics(&self) -> bool {
        let progress = &self.state.progress;
        let is_open = progress.sh_cap.is_none() && self.state.field.sh_degree > progress.sh_judged;
        let coming = self.coming();
        coming.has(Due::TakeBackHarmonics) || (is_open && coming.has(Due::TryHarmonics))
    }

    /// Looks whether the present degree of spherical harmonics helps where the next one is due, and at half of the
    /// fine stage takes back, for good, those that do not help enough.
    pub(super) fn judge_sh(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        if self.coming().has(Due::TakeBackHarmonics) {
            while self.state.field.sh_degree > 0 {
                let gain_wanted = f64::from(self.state.config.effects.sh_gain);
                let degree = self.state.field.sh_degree;
                if self.degree_gains(stage, iteration, gain_wanted, events)? {
                    break;
                }
                let first = 3 * coefficient_count(degree - 1);
                for coefficients in &mut self.state.field.gaussians.sh_coefficients {
                    coefficients[first..].fill(0.0);
                }
                self.engine.changed(Changed::Gaussians);
                self.state.field.sh_degree = degree - 1;
                self.state.progress.sh_cap = Some(degree - 1);
            }
        } else if self.degree_gains(stage, iteration, 0.0, events)? {
            self.state.progress.sh_judged = self.state.field.sh_degree;
        }
        Ok(())
    }

    /// True when the highest degree of spherical harmonics gains as much on the held-out pixels.
    fn degree_gains(
        &mut self,
        stage: Stage,
        iteration: u32,
        gain_wanted: f64,
        events: &mut Vec<TrainEvent>,
    ) -> Result<bool, TrainError> {
        let degree = self.state.field.sh_degree;
        let settings = self.state.color_settings();
        let lower = RenderSettings { sh_degree: degree - 1, ..settings };
        let with = self.judged_error(None, &settings)?;
        let without = self.judged_error(None, &lower)?;
        let gain_db = gain(without, with);
        let kept = gain_db >= gain_wanted;
        let what = format!("view-dependent colour of degree {degree}");
        events.push(TrainEvent::Judged { stage, iteration, what, gain_db, kept });
        Ok(kept)
    }

    /// Judges the optional outputs of the deformation, once, at half of the fine stage, and removes those that do
    /// not help.
    pub(super) fn judge_heads(
        &mut self,
        stage: Stage,
        iteration: u32,
        events: &mut Vec<TrainEvent>,
    ) -> Result<(), TrainError> {
        let gain_wanted = f64::from(self.state.config.effects.head_gain);
        let settings = self.state.color_settings();
        let times = probe_times(&self.state.dataset.times);
        for kind in OPTIONAL {
            let Some(trial) = without_output(&self.state.field, kind, &times) else { continue };
            let with = self.judged_error(None, &settings)?;
            let without = self.judged_error(Some(&trial.field), &settings)?;
            let gain_db = gain(without, with);
            let kept = gain_db >= gain_wanted;
            if !kept {
                self.state.field = trial.field;
                let mlp = self.state.optimiser.of(&MLP);
                mlp.first.drain(trial.removed.clone());
                mlp.second.drain(trial.removed.clone());
                self.state.gradients.mlp.drain(trial.removed);
                self.engine.changed(Changed::Everything);
            }
            let what = format!("motion of {}", name(kind));
            events.push(TrainEvent::Judged { stage, iteration, what, gain_db, kept });
        }
        Ok(())
    }

    /// Mean squared colour error of the field, or of a `trial` in its stead, over the held-out pixels of evenly
    /// spread training views.
    pub(super) fn judged_error(
        &mut self,
        trial: Option<&Field>,
        settings: &RenderSettings,
    ) -> Result<f64, TrainError> {
        Ok(self.judged_errors(trial, settings)?.all.mean())
    }

    /// The same of all pixels, and of those of each label.
    pub(super) fn judged_errors(
        &mut self,
        trial: Option<&Field>,
        settings: &RenderSettings,
    ) -> Result<JudgedErrors, TrainError> {
        let views: Vec<usize> = judged_views(self.state.frames.len()).collect();
        let frames: Vec<usize> = views.iter().map(|view| self.state.frames.index(*view)).collect();
        let mut truth = Vec::with_capacity(views.len());
        for view in views {
            truth.push(self.state.frames.get(&self.state.dataset, view)?);
        }
        let labels = self.state.field.instances.len() + 1;
        let mut errors =
            JudgedErrors { all: SquaredError::default(), of_labels: vec![SquaredError::default(); labels] };
        let channels = Channels { depth: false, instances: false };
        let mut truth = truth.iter();
        self.draw(trial, Views { frames: &frames, settings, channels }, &mut |rendered| {
            let Some(data) = truth.next() else { return };
            for pixel in held_out(data.image.width, data.image.height) {
                let label = data.labels.as_ref().map_or(0, |labels| labels.pixels[pixel]);
                for channel in 0..3 {
                    let target = f64::from(data.image.pixels[pixel][channel]) / 255.0;
                    let difference = f64::from(rendered.color.pixels[pixel][channel]) - target;
                    errors.all.add(difference);
                    errors.of_labels[usize::from(label)].add(difference);
                }
            }
        })?;
        Ok(errors)
    }
}

/// A mean of squares under way.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SquaredError {
    sum: f64,
    values: u64,
}

impl SquaredError {
    pub(super) fn add(&mut self, difference: f64) {
        self.sum += difference.powi(2);
        self.values += 1;
    }

    pub(super) fn sum(&self) -> f64 {
        self.sum
    }

    /// 0 without values.
    pub(super) fn mean(&self) -> f64 {
        self.sum / self.values.max(1) as f64
    }
}

/// Squared colour errors of held-out pixels.
#[derive(Clone, Debug)]
pub(super) struct JudgedErrors {
    pub(super) all: SquaredError,
    /// By label: dense index + 1, or 0.
    pub(super) of_labels: Vec<SquaredError>,
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

/// Gain of a smaller error, dB.
pub(super) fn gain(without: f64, with: f64) -> f64 {
    10.0 * (without.max(1e-12) / with.max(1e-12)).log10()
}

#[cfg(test)]
mod tests {
    use cif_render::synthetic;

    use super::*;

    #[test]
    fn one_pixel_of_sixty_four_is_held_out() {
        let pixels: Vec<usize> = held_out(64, 48).collect();
        assert_eq!(pixels.len(), 64 * 48 / 64);
        assert_eq!(pixels[0], 5 * 64 + 3);
        assert!(held_out(3, 5).next().is_none(), "tiny images have none");
    }

    #[test]
    fn few_of_many_views_are_judged_by() {
        assert_eq!(judged_views(3).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(judged_views(80).collect::<Vec<_>>(), [0, 10, 20, 30, 40, 50, 60, 70]);
        assert_eq!(judged_views(0).count(), 0);
    }

    #[test]
    fn a_smaller_error_is_a_gain() {
        assert!((gain(0.02, 0.01) - 3.0103).abs() < 1e-3);
        assert_eq!(gain(0.0, 0.0), 0.0);
        assert!(gain(0.01, 0.02) < 0.0);
    }

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
