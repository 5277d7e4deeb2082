//! Steps for measuring: one at a time, from any stage, with the instance pass on or off.

use cif_dataset::Dataset;
use cif_field::parameters::LOG_CALIBRATIONS;
use cif_field::{Field, Identities, Instance};
use cif_render::Gradients;

use super::measured_frames::MeasuredFrames;
use super::resume::check_instances;
use super::{Trainer, initialize};
use crate::config::TrainConfig;
use crate::density::with_copies;
use crate::error::TrainError;
use crate::random::{Purpose, stream};
use crate::stage::Stage;
use crate::step::InstancePass;
use crate::times::StepTimes;

impl Trainer {
    /// A run inside `stage`, for measuring its steps; the optimiser starts there. Without `scene` it begins
    /// with the points of the capture: its fine stage with a fresh deformation, its instance stage after
    /// `warm_up` fine steps and an estimation of identities. A scene keeps what it has and `stage` uses, and
    /// gets what is missing. All steps see whole images.
    ///
    /// # Errors
    /// As [`Trainer::new`]; when the scene has other instances than the capture; when the instance stage is
    /// asked of a capture without labels.
    ///
    /// # Panics
    /// When `stage` is none that has steps.
    pub fn for_measuring(
        mut dataset: Dataset,
        mut config: TrainConfig,
        scene: Option<Field>,
        stage: Stage,
        warm_up: u32,
    ) -> Result<Self, TrainError> {
        assert!(stage.has_steps(), "the {stage} stage has no steps");
        config.validate()?;
        // Steps like those at the end of their stage.
        (config.stages.half_size, config.stages.reduction) = (0.0, 1);
        let measured_frames = MeasuredFrames::withhold(&mut dataset, &config);
        let is_trained = scene.is_some();
        let mut field = match scene {
            Some(field) => field,
            None => initialize::initial_field(&dataset, &config)?,
        };
        if field.identities.is_some() && stage == Stage::Instance {
            check_instances(&field, &dataset)?;
        } else {
            field.replace_instances(initialize::instances(&dataset));
        }
        if stage == Stage::Coarse {
            field.deformation = None;
        } else if field.deformation.is_none() && dataset.times.len() > 1 && config.effects.motion {
            field.deformation = Some(initialize::initial_deformation(&dataset, &config)?);
        }
        let mut trainer = Self::assemble(dataset.into(), measured_frames, config, field, None)?;
        if stage == Stage::Instance {
            if !trainer.stages.has_instances {
                return Err(TrainError::NoLabels { root: trainer.state.dataset.root.clone() });
            }
            if trainer.state.field.identities.is_none() {
                trainer.begin(Stage::Fine);
                for _ in 0..if is_trained { 0 } else { warm_up } {
                    trainer.measure_step(InstancePass::Off)?;
                }
                trainer.estimate_identities(true)?;
            } else {
                trainer.state.unseen = vec![false; trainer.state.field.gaussians.len()];
                trainer.state.label_pixels = trainer.count_label_pixels()?;
            }
        }
        trainer.prepare_head(stage)?;
        trainer.begin(stage);
        Ok(trainer)
    }

    /// One step of the present stage, also past its end; reports where its time went.
    ///
    /// # Errors
    /// As [`Trainer::run`].
    pub fn measure_step(&mut self, pass: InstancePass) -> Result<StepTimes, TrainError> {
        self.instance_pass = pass;
        self.reset_times();
        let result = self.step(&mut Vec::new());
        self.instance_pass = InstancePass::On;
        result.map(|_| self.times())
    }

    /// Splits Gaussians, as densification does, until there are so many, and lets all but a share of them stand still:
    /// steps like those that most of the fine stage consists of.
    ///
    /// # Panics
    /// When the share is not in [0, 1].
    pub fn fill(&mut self, most: usize, moving: f64) {
        assert!((0.0..=1.0).contains(&moving), "{moving} of the Gaussians cannot move");
        let mut rng = stream(self.state.config.seed, Purpose::Split, 0);
        loop {
            let count = self.state.field.gaussians.len();
            let more = most.saturating_sub(count).min(count);
            if more == 0 {
                break;
            }
            let rows: Vec<u32> = (0..more).map(|k| (k * count / more) as u32).collect();
            let change = with_copies(&self.state.field.gaussians, &[], &rows, &mut rng);
            self.rearrange(change);
        }
        let count = self.state.field.gaussians.len();
        if let Some(deformation) = &mut self.state.field.deformation {
            // Spread evenly over the rows.
            let before = |row: usize| (moving * row as f64).floor();
            deformation.still = (0..count).map(|row| before(row + 1) == before(row)).collect();
            self.state.gradients = Gradients::zeros(&self.state.field);
        }
    }

    /// Makes the next step take the views of the last one again.
    pub fn repeat_views(&mut self) {
        self.state.progress.iteration = self.state.progress.iteration.saturating_sub(1);
    }

    /// Pads the table of instances to `count` and spreads the labels over it by a fixed permutation; the
    /// labels added occur in no mask and no row, so that the scene stays the same.
    ///
    /// # Panics
    /// When the table is longer than `count`, or `count` leaves the labels of masks.
    pub fn spread_instances(&mut self, count: usize) {
        let present = self.state.field.instances.len();
        assert!((present..=usize::from(u16::MAX) - 1).contains(&count), "{count} labels for {present}");
        let mut taken: Vec<u16> = self.state.field.instances.iter().map(|instance| instance.id).collect();
        taken.sort_unstable();
        let free = (1..=u16::MAX).filter(|id| taken.binary_search(id).is_err());
        let new_label = |label: u16| spread(usize::from(label), count);
        let padding = free.take(count - present).map(|id| {
            let label = format!("padding_{id}");
            Instance { id, category: label.clone(), label, taxonomies: Default::default() }
        });
        let old: Vec<Instance> = self.state.field.instances.drain(..).chain(padding).collect();
        let mut table: Vec<(u16, Instance)> =
            old.into_iter().enumerate().map(|(label, one)| (new_label(label as u16), one)).collect();
        table.sort_by_key(|(label, _)| *label);
        self.state.field.instances = table.into_iter().map(|(_, instance)| instance).collect();
        if let Some(rows) = &mut self.state.field.identities {
            let origins = relabel(rows, new_label);
            self.state.optimiser.of(&LOG_CALIBRATIONS).gather(&origins);
        }
        if !self.state.label_pixels.is_empty() {
            let mut pixels = vec![0.0; count];
            for (label, number) in self.state.label_pixels.iter().enumerate() {
                pixels[usize::from(new_label(label as u16))] = *number;
            }
            self.state.label_pixels = pixels;
        }
        self.state.frames.relabel(new_label);
    }

    /// Labelled pixels per instance, over all training frames.
    fn count_label_pixels(&self) -> Result<Vec<f64>, TrainError> {
        let state = &self.state;
        let mut pixels = vec![0.0; state.field.instances.len()];
        for table in state.frames.masks(&state.dataset, &state.phases)?.iter().flatten() {
            for (label, row) in &table.rows {
                pixels[usize::from(*label) - 1] += f64::from(row.pixels);
            }
        }
        Ok(pixels)
    }
}

/// A permutation of `0..count`: steps of about the golden section, which leave no two small labels close.
fn spread(label: usize, count: usize) -> u16 {
    let coprime = |step: &usize| {
        let (mut a, mut b) = (*step, count);
        while b != 0 {
            (a, b) = (b, a % b);
        }
        a == 1
    };
    let first = ((count as f64 * 0.618) as usize).max(1);
    let step = (first..=count).find(coprime).unwrap_or(1);
    ((label * step + count / 3) % count) as u16
}

/// Renames labels, keeping rows ascending; returns where each entry was before.
fn relabel(rows: &mut Identities, new_label: impl Fn(u16) -> u16) -> Vec<Option<u32>> {
    let mut order: Vec<u32> = Vec::with_capacity(rows.labels.len());
    for row in 0..rows.len() {
        let start = order.len();
        order.extend(rows.range(row).map(|entry| entry as u32));
        order[start..].sort_by_key(|entry| new_label(rows.labels[*entry as usize]));
    }
    let at = |entry: &u32| *entry as usize;
    rows.labels = order.iter().map(|entry| new_label(rows.labels[at(entry)])).collect();
    rows.log_estimates = order.iter().map(|entry| rows.log_estimates[at(entry)]).collect();
    rows.log_calibrations = order.iter().map(|entry| rows.log_calibrations[at(entry)]).collect();
    order.into_iter().map(Some).collect()
}

#[cfg(test)]
mod tests {
    use super::super::guard_tests::support::{Scene, capture, small_config};
    use super::*;

    #[test]
    fn a_full_set_has_as_many_as_there_may_be_and_a_share_of_them_moves() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
        let mut trainer = Trainer::for_measuring(dataset, small_config(), None, Stage::Fine, 0).unwrap();
        let initial = trainer.field().gaussians.len();
        let most = 5 * initial + 3;
        trainer.fill(most, 0.3);
        let moving = |trainer: &Trainer| {
            let field = trainer.field();
            field.deformation.as_ref().unwrap().moving_rows(field.gaussians.len()).count()
        };
        assert_eq!(trainer.field().gaussians.len(), most);
        assert_eq!(moving(&trainer), (0.3 * most as f64).floor() as usize);
        trainer.measure_step(InstancePass::Off).unwrap();
        // A set that is full already stays.
        trainer.fill(most, 1.0);
        assert_eq!((trainer.field().gaussians.len(), moving(&trainer)), (most, most));
    }

    #[test]
    fn spreading_is_a_permutation_of_any_size() {
        for count in [1, 2, 3, 8, 12, 255, 256, 1000] {
            let mut seen = vec![false; count];
            (0..count).for_each(|label| seen[usize::from(spread(label, count))] = true);
            assert!(seen.iter().all(|seen| *seen), "{count}");
        }
        let far = usize::from(spread(0, 256)).abs_diff(usize::from(spread(1, 256)));
        assert!(far > 16, "{far}");
    }

    #[test]
    fn relabelled_rows_stay_ascending_and_keep_their_values() {
        let mut rows = Identities {
            row_offsets: vec![0, 3, 4],
            labels: vec![0, 1, 2, 1],
            log_estimates: vec![0.1, 0.2, 0.3, 0.4],
            log_calibrations: vec![1.0, 2.0, 3.0, 4.0],
            owners: Vec::new(),
        };
        let origins = relabel(&mut rows, |label| [7, 2, 5][usize::from(label)]);
        assert_eq!(rows.labels, [2, 5, 7, 2]);
        assert_eq!(rows.log_estimates, [0.2, 0.3, 0.1, 0.4]);
        assert_eq!(rows.log_calibrations, [2.0, 3.0, 1.0, 4.0]);
        assert_eq!(origins, [Some(1), Some(2), Some(0), Some(3)]);
    }
}
