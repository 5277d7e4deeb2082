//! Gain of each effect: small captures that call for it and that do not, trained with and without it.
//!
//! Prints the table of `tests/README.md`: quality on held-out frames, and processor time.

#[path = "../tests/support/mod.rs"]
mod support;

use cif_dataset::Dataset;
use cif_train::EffectPlan;
use cif_train::metrics::{EvaluationError, EvaluationOptions, evaluate};
use support::{Scene, capture, small_config, train, with_known_points};

/// An effect, what switches it, and captures that call for it and that do not.
struct Row {
    effect: &'static str,
    with: &'static str,
    without: &'static str,
    scenes: [(&'static str, Scene); 2],
}

/// Quality and cost of a run.
struct Score {
    psnr: f64,
    miou: Option<f64>,
    cpu_s: f64,
}

impl std::fmt::Display for Score {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let miou = self.miou.map_or_else(|| "-".to_owned(), |miou| format!("{miou:.1}"));
        write!(f, "{:.2} / {miou} / {:.1}", self.psnr, self.cpu_s)
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("| effect | capture | with it | without it | `auto` |\n|---|---|---|---|---|");
    for row in &rows() {
        for (words, scene) in row.scenes {
            let folder = tempfile::tempdir()?;
            let dataset = with_known_points(capture(folder.path(), scene));
            let [with, without, auto] =
                [row.with, row.without, "auto"].map(|choice| score(&dataset, choice, scene.disagree));
            println!("| {} | {words} | {} | {} | {} |", row.effect, with?, without?, auto?);
        }
    }
    Ok(())
}

fn rows() -> [Row; 8] {
    let balls = Scene::default();
    let frozen = Scene { frozen: true, ..balls };
    let rolling = Scene { times: 12, views: 12, rolls: Some(1.5), one_camera: true, ..balls };
    let row = |effect, [with, without]: [&'static str; 2], scenes| Row { effect, with, without, scenes };
    let moving = ("a ball moves", balls);
    [
        row("motion", ["auto,+motion", "auto,-motion"], [moving, ("none moves", frozen)]),
        row(
            "motion everywhere",
            ["auto,+motion", "auto"],
            [("a ball rolls past one camera", rolling), ("two of three balls stand still", balls)],
        ),
        row(
            "moving shape",
            ["auto,+shape", "auto,-shape"],
            [("a ball rolls past one camera", rolling), moving],
        ),
        row(
            "view-dependent colour",
            ["auto,+view-dependence", "auto,-view-dependence"],
            [("shiny balls", Scene { shiny: true, ..frozen }), ("dull balls", frozen)],
        ),
        row(
            "instances",
            ["auto,+instances", "auto,-instances"],
            [("masks", balls), ("no masks", Scene { masks: false, ..balls })],
        ),
        row(
            "guidance",
            ["auto,+guidance", "auto,-guidance"],
            [("a ball rolls past one camera", rolling), ("a ball moves, four cameras", balls)],
        ),
        row(
            "appearing",
            ["auto,+appearing", "auto,-appearing"],
            [("a ball appears", Scene { times: 6, appears: true, ..balls }), moving],
        ),
        row(
            "exposure",
            ["auto,+exposure", "auto,-exposure"],
            [
                ("cameras disagree", Scene { times: 2, disagree: true, ..balls }),
                ("cameras agree", Scene { times: 2, ..balls }),
            ],
        ),
    ]
}

fn score(dataset: &Dataset, choice: &str, is_dark: bool) -> Result<Score, Box<dyn std::error::Error>> {
    let mut config = small_config();
    config.stages.fine = 600;
    if is_dark {
        config.background = Some([0.0; 3]);
    }
    EffectPlan::new(dataset, &config, &choice.parse()?)?.apply(&mut config);
    if config.effects.still_every > 0 {
        // Often enough for a run as short as this.
        config.effects.still_every = 60;
    }
    let trainer = train(dataset.clone(), config);
    let field = trainer.field();
    let options = EvaluationOptions::held_out(field);
    let scores = evaluate::<EvaluationError>(field, trainer.dataset(), &options, |_| Ok(()))?.overall;
    let cpu_s = field.record.run.as_ref().and_then(|run| run.cpu_s).unwrap_or_default();
    Ok(Score { psnr: scores.psnr.unwrap_or_default(), miou: scores.instance.miou, cpu_s })
}
