//! Published numbers. They were taken against other masks: next to ours they give the order of systems at most.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;

/// Scores that were published, percent and dB.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub(super) struct Published {
    pub(super) macc_pix: f64,
    pub(super) macc_inst: f64,
    pub(super) miou: f64,
    #[serde(default)]
    pub(super) psnr: Option<f64>,
}

/// Scores of a question in words that were published, percent.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub(super) struct PublishedAnswer {
    pub(super) macc: f64,
    pub(super) miou: f64,
}

/// Where they were published.
#[derive(Debug, Deserialize)]
pub(super) struct Source {
    pub(super) title: String,
    pub(super) arxiv: String,
    pub(super) venue: String,
}

/// Ablations on one scene, by their number.
#[derive(Debug, Deserialize)]
pub(super) struct PublishedAblation {
    pub(super) scene: String,
    pub(super) rows: BTreeMap<String, Published>,
}

/// All of them.
#[derive(Debug, Deserialize)]
pub(super) struct PublishedTables {
    pub(super) source: Source,
    pub(super) note: String,
    /// By scene, then by head.
    pub(super) panoptic: BTreeMap<String, BTreeMap<String, Published>>,
    /// Means over the scenes of a data set, by head.
    pub(super) means: BTreeMap<String, BTreeMap<String, Published>>,
    pub(super) ablation: PublishedAblation,
    /// Questions in words by scene, then by question, then by head.
    pub(super) queries: BTreeMap<String, BTreeMap<String, BTreeMap<String, PublishedAnswer>>>,
    /// Means over all of them, by head.
    pub(super) query_means: BTreeMap<String, PublishedAnswer>,
}

/// The tables of the paper.
pub(super) static PUBLISHED: LazyLock<PublishedTables> =
    LazyLock::new(|| serde_json::from_str(include_str!("published.json")).expect("data of this crate"));

/// Published numbers of the scene that a capture is named after.
fn of_scene<'a, T>(scenes: &'a BTreeMap<String, T>, capture: &str) -> Option<&'a T> {
    let plain = |name: &str| name.to_lowercase().replace(['-', '_', ' '], "");
    scenes.iter().find(|(scene, _)| plain(scene) == plain(capture)).map(|(_, known)| known)
}

impl PublishedTables {
    /// Scores of a head on a scene that a capture is called after.
    pub(super) fn of_capture(&self, capture: &str, head: &str) -> Option<Published> {
        of_scene(&self.panoptic, capture)?.get(head).copied()
    }

    /// Scores of questions, by question and head, on a scene that a capture is called after.
    pub(super) fn queries_of_capture(
        &self,
        capture: &str,
    ) -> Option<&BTreeMap<String, BTreeMap<String, PublishedAnswer>>> {
        of_scene(&self.queries, capture)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_the_scenes() {
        let data_sets = [
            (
                "HyperNeRF",
                ["americano", "split-cookie", "chickchicken", "espresso", "keyboard", "torchocolate"],
            ),
            (
                "Neu3D",
                [
                    "coffee_martini",
                    "cook_spinach",
                    "cut_roasted_beef",
                    "flame_salmon",
                    "flame_steak",
                    "sear_steak",
                ],
            ),
        ];
        for (data_set, scenes) in data_sets {
            for (head, mean) in &PUBLISHED.means[data_set] {
                let of = |scene: &&str| PUBLISHED.of_capture(scene, head).unwrap().miou;
                let expected = scenes.iter().map(of).sum::<f64>() / 6.0;
                assert!((mean.miou - expected).abs() < 2e-3, "{data_set} {head}");
            }
        }
        assert_eq!(PUBLISHED.of_capture("Split_Cookie", "cif").unwrap().macc_pix, 97.93);
        assert!(PUBLISHED.of_capture("tabletop", "cif").is_none());
        assert_eq!(PUBLISHED.ablation.rows["iii"].psnr, Some(26.73));
    }

    #[test]
    fn means_of_questions_are_those_of_all() {
        for (head, mean) in &PUBLISHED.query_means {
            let answers: Vec<&PublishedAnswer> = PUBLISHED
                .queries
                .values()
                .flat_map(BTreeMap::values)
                .filter_map(|heads| heads.get(head))
                .collect();
            let of = |score: fn(&PublishedAnswer) -> f64| {
                answers.iter().map(|answer| score(answer)).sum::<f64>() / answers.len() as f64
            };
            assert_eq!(answers.len(), 4, "{head}");
            assert!((mean.macc - of(|answer| answer.macc)).abs() < 6e-3, "{head}");
            assert!((mean.miou - of(|answer| answer.miou)).abs() < 6e-3, "{head}");
        }
        assert_eq!(PUBLISHED.queries_of_capture("Espresso").unwrap()["coaster"]["4d-langsplat"].miou, 0.43);
    }
}
