//! Remarks that readers of the numbers need.

use super::super::published::PUBLISHED;
use super::super::title;
use super::{Missing, Subject};

impl Subject<'_> {
    /// Notes for readers of the tables.
    #[must_use]
    pub fn notes(&self) -> Vec<String> {
        let mut notes = vec![
            "Means over the held-out frames, and over seeds with the sample standard deviation; the best of a column is \
             marked. Seconds are processor time, all threads together, on top of the one reconstruction that all rows \
             share."
                .to_owned(),
            format!(
                "Published numbers ({}, {}, arXiv {}) were taken against other masks and cannot be compared with ours; \
                 they give the order of systems there. {}",
                PUBLISHED.source.title, PUBLISHED.source.venue, PUBLISHED.source.arxiv, PUBLISHED.note
            ),
        ];
        let has = |name: &str| self.names.iter().any(|other| other == name);
        if has("vlgs") {
            notes.push(
                "VLGS is a re-implementation: there is no public code. Its paper gives the channels (3 + 3), attention \
                 with a residual, the opacity of its own and the weight 1.2 of blended cameras; token width, starts, \
                 learning rates and the range of blending are ours, as the numbers of its authors' comparison are theirs."
                    .to_owned(),
            );
        }
        if has("sa4d") {
            notes.push(match self.camera {
                "" => "SA4D is trained on all cameras; its released code trains on one on Neu3D (cam16), as \
                       --set head.camera=cam16 does."
                    .to_owned(),
                camera => format!("SA4D is trained on the camera {camera} alone."),
            });
        }
        if has("trace3d") {
            notes.push(
                "Trace3D splits and deletes Gaussians and trains colours meanwhile, so that its PSNR and its number of \
                 Gaussians differ; all other heads leave the reconstruction as it is, but for CIF, which trains it on."
                    .to_owned(),
            );
        }
        let of_tables: Vec<&Missing> =
            self.missing.iter().filter(|missing| self.names.contains(&missing.head)).collect();
        notes.extend(missing_note(&of_tables, self.camera));
        notes
    }
}

/// Runs that are not done yet, by capture and head.
pub(in super::super) fn missing_note(missing: &[&Missing], camera: &str) -> Option<String> {
    let mut missing_runs: Vec<String> = Vec::new();
    for (k, first) in missing.iter().enumerate() {
        let same = |other: &&&Missing| (&other.capture, &other.head) == (&first.capture, &first.head);
        if missing[..k].iter().any(|earlier| same(&earlier)) {
            continue;
        }
        let seeds: Vec<String> =
            missing.iter().filter(same).map(|missing| missing.seed.to_string()).collect();
        let name = title(&first.head, camera);
        missing_runs.push(format!("{} with {name} (seed {})", first.capture, seeds.join(", ")));
    }
    (!missing_runs.is_empty()).then(|| {
        format!(
            "Missing, and not in the means: {}. Run the same command again for them.",
            missing_runs.join("; ")
        )
    })
}
