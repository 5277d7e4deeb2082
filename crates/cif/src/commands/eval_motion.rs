//! Motion in `cif eval`: the scene graph as `cif export` would write it, against followed points.

use std::time::Instant;

use cif_dataset::{Dataset, MotionTruth};
use cif_field::Field;
use cif_scene::motion_scores::{MotionErrors, MotionScores, motion_scores};
use cif_scene::{SceneError, SceneOptions};
use serde::Serialize;

use super::eval::number;
use crate::error::Error;

/// Measured motion of a scene.
#[derive(Debug, Serialize)]
pub(super) struct Motion {
    #[serde(flatten)]
    scores: MotionScores,
    /// Wall-clock time of building the scene graph and measuring it.
    seconds: f64,
}

/// Builds the scene graph of a field and measures its motion; `None`, with a warning, where there is nothing to
/// export.
///
/// # Errors
/// When a mask cannot be decoded, or the field is inconsistent.
pub(super) fn measure(
    field: &Field,
    dataset: &Dataset,
    truth: &MotionTruth,
) -> Result<Option<Motion>, Error> {
    let start = Instant::now();
    // Stand-ins and colliders are not measured.
    let options = SceneOptions { proxy_points: 0, hulls_per_instance: 0, ..SceneOptions::default() };
    let graph = match cif_scene::build(field, &options) {
        Ok(graph) => graph,
        Err(error @ SceneError::NoGaussians { .. }) => {
            eprintln!("warning: motion is not measured: {error}");
            return Ok(None);
        }
        Err(error) => return Err(Error::plain(error)),
    };
    let seen = truth.seen_steps(dataset).map_err(Error::plain)?;
    let scores = motion_scores(&graph, truth, &seen);
    if scores.moving.is_none() && scores.resting.is_none() {
        eprintln!(
            "warning: motion is not measured: no instance with followed points is in the scene and seen at two times"
        );
        return Ok(None);
    }
    Ok(Some(Motion { scores, seconds: start.elapsed().as_secs_f64() }))
}

/// Headings of [`Motion::rows`].
pub(super) const HEADINGS: [&str; 13] = [
    "id",
    "instance",
    "motion",
    "exported",
    "times",
    "error, mm",
    "unmoved, mm",
    "< 10 mm",
    "< 20 mm",
    "< 50 mm",
    "rotation error, deg",
    "rotation, deg",
    "box IoU",
];

impl Motion {
    /// A row per instance, then the means.
    pub(super) fn rows(&self) -> Vec<Vec<String>> {
        let mut rows = Vec::new();
        for instance in &self.scores.instances {
            let about = [
                instance.id.to_string(),
                instance.label.clone(),
                instance.truth.clone(),
                instance.model.map_or("none".to_owned(), |model| model.to_string()),
                instance.times.to_string(),
            ];
            let cells = cells(&instance.errors, number(instance.turned_deg, 1));
            rows.push(about.into_iter().chain(cells).collect());
        }
        for (name, mean) in [("moving", &self.scores.moving), ("resting", &self.scores.resting)] {
            let Some(mean) = mean else { continue };
            let about = [String::new(), format!("{name}, mean of {}", mean.instances)];
            let about = about.into_iter().chain(std::iter::repeat_n(String::new(), 3));
            rows.push(about.chain(cells(&mean.errors, String::new())).collect());
        }
        rows
    }

    /// Prints the rows.
    pub(super) fn print(&self) {
        let mut table = super::table(HEADINGS);
        table.add_rows(self.rows());
        println!("{table}");
        println!("motion of followed points, as exported by default; measured in {:.1} s", self.seconds);
    }
}

fn cells(errors: &MotionErrors, turned: String) -> [String; 8] {
    [
        number(errors.error_mm, 1),
        number(errors.rest_mm, 1),
        number(errors.within_10_mm, 1),
        number(errors.within_20_mm, 1),
        number(errors.within_50_mm, 1),
        number(errors.rotation_deg, 1),
        turned,
        number(errors.box_iou, 1),
    ]
}
