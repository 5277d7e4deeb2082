//! Runs on hard captures, and how they end.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use cif_dataset::Dataset;
use cif_train::metrics::{EvaluationError, EvaluationOptions, evaluate};
use cif_train::{Control, Outcome, Start, Stop, TrainConfig, TrainEvent, Trainer};
use serde::Serialize;

use crate::hard_captures::Demand;

/// Largest loss that scale and place may cost, dB.
pub const MAX_PSNR_LOSS: f64 = 0.3;

/// Largest loss that scale and place may cost, percent of mIoU.
pub const MAX_MIOU_LOSS: f64 = 1.0;

/// Result of a variant.
#[derive(Clone, Debug, Default, Serialize)]
pub struct VariantScores {
    /// Name of the variant.
    pub name: &'static str,
    /// The change, in a few words.
    pub what: &'static str,
    /// `same`, `ok`, `differs`, `failed` or `skipped`.
    pub verdict: &'static str,
    /// Mean PSNR of the held-out frames, dB.
    pub psnr: Option<f64>,
    /// Change from the capture itself.
    pub psnr_change: Option<f64>,
    /// mIoU of the held-out frames, percent.
    pub miou: Option<f64>,
    /// Change from the capture itself.
    pub miou_change: Option<f64>,
    /// Gaussians.
    pub gaussians: usize,
    /// Steps that were rolled back.
    pub rolled_back: u64,
    /// Wall time.
    pub seconds: f64,
    /// Error that stopped the run, data that the capture lacks, and warnings.
    pub notes: Vec<String>,
}

impl VariantScores {
    /// Compares it with the capture itself, which a change that must not matter matches.
    pub fn judge(&mut self, baseline: &Self, demand: Demand) {
        let change = |now: Option<f64>, before: Option<f64>| Some(now? - before?);
        self.psnr_change = change(self.psnr, baseline.psnr);
        self.miou_change = change(self.miou, baseline.miou);
        if demand == Demand::Same && self.verdict == "ok" {
            // Written so that a missing score counts as a difference.
            let within = |change: Option<f64>, known: Option<f64>, limit: f64| {
                known.is_none() || change.is_some_and(|change| change.abs() < limit)
            };
            let same = within(self.psnr_change, baseline.psnr, MAX_PSNR_LOSS)
                && within(self.miou_change, baseline.miou, MAX_MIOU_LOSS);
            self.verdict = if same { "same" } else { "differs" };
        }
    }
}

/// Mean scores of runs that differ in their seed, with a note of their range; the rest is that of the first.
#[must_use]
pub fn mean_of(runs: &[VariantScores]) -> VariantScores {
    let mut mean = runs[0].clone();
    let mut ranges = Vec::new();
    let mut score = |name: &str, unit: &str, of: fn(&VariantScores) -> Option<f64>| {
        let values: Vec<f64> = runs.iter().filter_map(of).collect();
        if values.is_empty() {
            return None;
        }
        let range = values.iter().fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(*v), high.max(*v)));
        ranges.push(format!("{name} {:.2} to {:.2} {unit}", range.0, range.1));
        Some(values.iter().sum::<f64>() / values.len() as f64)
    };
    (mean.psnr, mean.miou) = (score("PSNR", "dB", |row| row.psnr), score("mIoU", "%", |row| row.miou));
    mean.notes.push(format!("mean of {} seeds: {}", runs.len(), ranges.join(", ")));
    mean
}

/// Trains and scores one capture; whatever goes wrong is noted.
pub fn measure(row: &mut VariantScores, dataset: &Dataset, config: &TrainConfig, stop: &Stop) {
    let start = Instant::now();
    // A panic is a finding here, not an end.
    let result = catch_unwind(AssertUnwindSafe(|| train_and_score(row, dataset, config, stop)));
    row.seconds = start.elapsed().as_secs_f64();
    match result {
        Ok(Ok(())) => {}
        Ok(Err(message)) => {
            row.verdict = "failed";
            row.notes.push(message);
        }
        Err(_) => {
            row.verdict = "failed";
            row.notes.push("panicked".to_owned());
        }
    }
}

fn train_and_score(
    row: &mut VariantScores,
    dataset: &Dataset,
    config: &TrainConfig,
    stop: &Stop,
) -> Result<(), String> {
    let start = Start { dataset: dataset.clone(), phases: stop.clone().into() };
    let mut trainer = Trainer::new(start, config.clone()).map_err(|error| error.to_string())?;
    let mut notes = Vec::new();
    let outcome = trainer.run(&mut |event, _| {
        if let TrainEvent::Warning { message } = event {
            notes.push(message.clone());
        }
        Control::Continue
    });
    row.rolled_back = trainer.rolled_back();
    row.notes.append(&mut notes);
    match outcome {
        Ok(Outcome::Finished) => {}
        Ok(Outcome::Interrupted) => return Ok(()),
        Err(error) => return Err(error.to_string()),
    }
    let field = trainer.into_field();
    row.gaussians = field.len();
    field.validate().map_err(|error| error.to_string())?;
    let options = EvaluationOptions::held_out(&field);
    let scores =
        evaluate::<EvaluationError>(&field, dataset, &options, |_| Ok(())).map_err(|e| e.to_string())?;
    (row.psnr, row.miou) = (scores.overall.psnr, scores.overall.instance.miou);
    if row.psnr.is_some_and(|psnr| !psnr.is_finite()) {
        return Err("a held-out view has values that are not finite".to_owned());
    }
    Ok(())
}

/// A score as text.
#[must_use]
pub fn number(value: Option<f64>) -> String {
    value.map_or("n/a".to_owned(), |value| format!("{value:.2}"))
}

/// A change as text, with its sign.
#[must_use]
pub fn signed(value: Option<f64>) -> String {
    // What rounds to nothing has no sign.
    value.map_or(
        String::new(),
        |value| if value.abs() < 0.005 { "0.00".to_owned() } else { format!("{value:+.2}") },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_capture_itself_is_the_mean_of_its_seeds() {
        let run = |psnr: f64, miou: Option<f64>| VariantScores {
            psnr: Some(psnr),
            miou,
            gaussians: 7,
            ..VariantScores::default()
        };
        let mean = mean_of(&[run(28.0, Some(96.0)), run(28.5, Some(97.5)), run(29.0, Some(96.0))]);
        assert_eq!((mean.psnr, mean.miou, mean.gaussians), (Some(28.5), Some(96.5), 7));
        assert_eq!(mean.notes, ["mean of 3 seeds: PSNR 28.00 to 29.00 dB, mIoU 96.00 to 97.50 %"]);
        let colour_only = mean_of(&[run(28.0, None), run(29.0, None)]);
        assert_eq!((colour_only.psnr, colour_only.miou), (Some(28.5), None));
        assert_eq!(colour_only.notes, ["mean of 2 seeds: PSNR 28.00 to 29.00 dB"]);
    }

    #[test]
    fn changes_have_a_sign_unless_they_round_to_nothing() {
        let texts = [-0.004, 0.0, 0.004, -0.006, 0.16].map(|value| signed(Some(value)));
        assert_eq!(texts, ["0.00", "0.00", "0.00", "-0.01", "+0.16"]);
    }
}
