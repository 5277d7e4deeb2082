//! Frames that the curve of a run is measured on.

use cif_dataset::{Dataset, FrameData, Split};

use crate::config::TrainConfig;
use crate::curve::CurveFrames;

/// Least training frames per withheld one.
const FRAMES_PER_WITHHELD: usize = 4;

/// Frames that the curve is measured on, decoded once.
#[derive(Default)]
pub(super) struct MeasuredFrames {
    /// Training frames that are not trained on, as indices of the capture.
    pub(super) withheld: Vec<usize>,
    /// Index in the capture, and what was captured; none before the first point.
    pub(super) decoded: Option<Vec<(usize, FrameData)>>,
}

impl MeasuredFrames {
    /// Takes the frames to withhold out of the training split.
    pub(super) fn withhold(dataset: &mut Dataset, config: &TrainConfig) -> Self {
        let of_split = |dataset: &Dataset| -> Vec<usize> {
            let frames = dataset.frames.iter().enumerate();
            frames.filter(|(_, frame)| frame.split == Split::Train).map(|(index, _)| index).collect()
        };
        let training = of_split(dataset);
        let count = (config.report.withhold as usize).min(training.len() / FRAMES_PER_WITHHELD);
        // Frames with masks show more; where they are few, all of them are needed for training.
        let masked: Vec<usize> =
            training.iter().copied().filter(|index| dataset.frames[*index].mask.is_some()).collect();
        let pool = if masked.len() >= FRAMES_PER_WITHHELD * count { &masked } else { &training };
        let withheld: Vec<usize> = (0..count).map(|k| pool[(2 * k + 1) * pool.len() / (2 * count)]).collect();
        for index in &withheld {
            dataset.frames[*index].split = Split::Val;
        }
        Self { withheld, decoded: None }
    }

    /// True when a frame belongs to the training split of the capture, though it is not trained on.
    pub(super) fn withholds(&self, index: usize) -> bool {
        self.withheld.contains(&index)
    }

    pub(super) fn select(&self, dataset: &Dataset, count: usize) -> (CurveFrames, Vec<usize>) {
        let spread = |pool: Vec<usize>| -> Vec<usize> {
            let count = count.min(pool.len());
            (0..count).map(|k| pool[(2 * k + 1) * pool.len() / (2 * count)]).collect()
        };
        let of = |split| -> Vec<usize> {
            let frames = dataset.frames.iter().enumerate();
            frames.filter(|(_, frame)| frame.split == split).map(|(index, _)| index).collect()
        };
        if !self.withheld.is_empty() {
            return (CurveFrames::Withheld, self.withheld.clone());
        }
        match of(Split::Val) {
            held_out if !held_out.is_empty() => (CurveFrames::HeldOut, spread(held_out)),
            _ => (CurveFrames::Training, spread(of(Split::Train))),
        }
    }
}
