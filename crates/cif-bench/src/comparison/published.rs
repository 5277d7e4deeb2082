//! Published numbers. They were taken against other masks: beside ours they tell the order of systems at most.

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
}

/// The tables of the paper.
pub(super) static PUBLISHED: LazyLock<PublishedTables> =
    LazyLock::new(|| serde_json::from_str(include_str!("published.json")).expect("data of this crate"));

impl PublishedTables {
    /// Scores of a head on a scene that a capture is called after.
    pub(super) fn of_capture(&self, capture: &str, head: &str) -> Option<Published> {
        let plain = |name: &str| name.to_lowercase().replace(['-', '_', ' '], "");
        let scene = self.panoptic.iter().find(|(scene, _)| plain(scene) == plain(capture))?;
        scene.1.get(head).copied()
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
}
