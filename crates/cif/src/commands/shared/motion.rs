//! Motion of a scene, measured: the scene graph as `cif export` would write it, against followed points.

use cif_dataset::{Dataset, MotionTruth};
use cif_field::Field;
use cif_scene::motion_scores::MotionErrors;

use super::table::number;
use crate::error::Error;
use crate::evaluation::{Motion, motion_of};

/// Measures the motion of a scene; `None`, with a warning, where there is nothing to measure.
///
/// # Errors
/// When a mask cannot be decoded, or the field is inconsistent.
pub(in crate::commands) fn measure(
    field: &Field,
    dataset: &Dataset,
    truth: &MotionTruth,
) -> Result<Option<Motion>, Error> {
    let measured = motion_of(field, dataset, truth)?;
    Ok(measured.inspect_err(|reason| crate::messages::warning!("motion is not measured: {reason}")).ok())
}

/// Headings of [`Motion::rows`].
pub(in crate::commands) const HEADINGS: [&str; 15] = [
    "id",
    "instance",
    "motion",
    "exported",
    "times",
    "error, mm",
    "of size, %",
    "unmoved, mm",
    "< 10 mm",
    "< 20 mm",
    "< 50 mm",
    "rotation error, deg",
    "rotation, deg",
    "claim",
    "box IoU",
];

impl Motion {
    /// A row per instance, then the means.
    pub(in crate::commands) fn rows(&self) -> Vec<Vec<String>> {
        let mut rows = Vec::new();
        for instance in &self.scores.instances {
            let about = [
                instance.id.to_string(),
                instance.label.clone(),
                instance.truth.clone(),
                instance.model.map_or("none".to_owned(), |model| model.to_string()),
                instance.times.to_string(),
            ];
            let claim = instance.claim.map_or("none".to_owned(), |claim| claim.to_string());
            let cells = cells(&instance.errors, number(instance.turned_deg, 1), claim);
            rows.push(about.into_iter().chain(cells).collect());
        }
        for (name, mean) in [("moving", &self.scores.moving), ("resting", &self.scores.resting)] {
            let Some(mean) = mean else { continue };
            let about = [String::new(), format!("{name}, mean of {}", mean.instances)];
            let about = about.into_iter().chain(std::iter::repeat_n(String::new(), 3));
            rows.push(about.chain(cells(&mean.errors, String::new(), String::new())).collect());
        }
        rows
    }

    /// Prints the rows.
    pub(in crate::commands) fn print(&self) {
        let mut table = crate::commands::shared::table(HEADINGS);
        table.add_rows(self.rows());
        println!("{table}");
        let claims = &self.scores.claims;
        let claims = [("observed", claims.observed), ("assumed", claims.assumed), ("none", claims.none)];
        let mut table =
            crate::commands::shared::table(["claim", "rotation right, objects", "rotation wrong, objects"]);
        table.add_rows(
            claims.map(|(claim, count)| [claim.to_owned(), count.right.to_string(), count.wrong.to_string()]),
        );
        println!("{table}");
        println!("motion of followed points, as exported by default; measured in {:.1} s", self.seconds);
    }
}

fn cells(errors: &MotionErrors, turned: String, claim: String) -> [String; 10] {
    [
        number(errors.error_mm, 1),
        number(errors.error_of_size, 1),
        number(errors.rest_mm, 1),
        number(errors.within_10_mm, 1),
        number(errors.within_20_mm, 1),
        number(errors.within_50_mm, 1),
        number(errors.rotation_deg, 1),
        turned,
        claim,
        number(errors.box_iou, 1),
    ]
}
