//! Instance metrics from per-frame confusion counts. Source: methods reference 9.
//!
//! Notation: truth G, prediction Q, V = pixels with G != 0. All values are percent (0 to 100) unless said
//! otherwise; everything is computed in one pass over the counts, primary definitions and variants alike.

use std::collections::{BTreeMap, BTreeSet};

use cif_geometry::PixelGrid;
use serde::Serialize;

/// Pixels that an instance must occupy in both of two consecutive frames to be watched for switches.
const MIN_SWITCH_PIXELS: u64 = 100;

/// Confusion counts of one frame: pixels of each (truth, prediction) pair of mask ids.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameConfusion {
    /// View that the frame belongs to; consecutive frames of one view are compared for switches.
    pub view: String,
    /// Position in the capture's times.
    pub time_index: usize,
    /// Pixels per (truth id, predicted id); 0 = unlabelled, absent pairs do not occur.
    pub counts: BTreeMap<(u16, u16), u64>,
}

impl FrameConfusion {
    /// Counts the pairs of two id maps of the same size.
    ///
    /// # Panics
    /// When the sizes differ.
    #[must_use]
    pub fn new(view: &str, time_index: usize, truth: &PixelGrid<u16>, predicted: &PixelGrid<u16>) -> Self {
        assert_eq!(
            (truth.width, truth.height),
            (predicted.width, predicted.height),
            "masks are compared with a prediction of another size"
        );
        let mut counts = BTreeMap::new();
        let mut pairs = truth.pixels.iter().copied().zip(predicted.pixels.iter().copied()).peekable();
        // Neighbours mostly agree: one map access per run.
        while let Some(pair) = pairs.next() {
            let mut run = 1;
            while pairs.next_if_eq(&pair).is_some() {
                run += 1;
            }
            *counts.entry(pair).or_insert(0) += run;
        }
        Self { view: view.to_owned(), time_index, counts }
    }

    /// Pixels of V, and those of them where the prediction is right.
    #[must_use]
    pub fn labelled(&self) -> (u64, u64) {
        self.counts
            .iter()
            .filter(|((truth, _), _)| *truth != 0)
            .fold((0, 0), |sum, ((g, q), n)| (sum.0 + n, sum.1 + if g == q { *n } else { 0 }))
    }

    /// Fraction of V predicted right (0 to 1); `None` when V is empty.
    #[must_use]
    pub fn pixel_accuracy(&self) -> Option<f64> {
        let (labelled, right) = self.labelled();
        (labelled > 0).then(|| right as f64 / labelled as f64)
    }
}

/// Scores of one instance; `None` where it occurs in no frame's truth.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct InstanceScore {
    /// Mask id.
    pub id: u16,
    /// Frames whose truth shows the instance.
    pub frames: usize,
    /// Mean over those frames of the intersection over union on V.
    pub iou: Option<f64>,
    /// Mean over those frames of the fraction of its pixels predicted right.
    pub accuracy: Option<f64>,
    /// Summed intersections over summed unions on V, all frames.
    pub tube_iou: Option<f64>,
    /// Association quality of its tube.
    pub association_quality: Option<f64>,
    /// Changes of the majority prediction inside it.
    pub id_switches: usize,
}

/// All instance metrics of a set of frames, percent.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct InstanceMetrics {
    /// mAcc-pix: mean over frames with non-empty V of the fraction of V predicted right.
    pub macc_pix: Option<f64>,
    /// mAcc-inst: per instance the mean over its frames of its accuracy, then the mean over instances.
    pub macc_inst: Option<f64>,
    /// mIoU: mean over pairs (instance, frame showing it) of the intersection over union on V.
    pub miou: Option<f64>,
    /// mAcc-pix, ratio of summed counts.
    pub macc_pix_pooled: Option<f64>,
    /// mAcc-inst, each instance's accuracy from summed counts.
    pub macc_inst_pooled: Option<f64>,
    /// mIoU, mean over frames per instance first, then over instances.
    pub miou_per_instance_first: Option<f64>,
    /// mIoU, where instances predicted on V of a frame that does not show them count as 0.
    pub miou_with_fp: Option<f64>,
    /// mIoU with unions over the whole image instead of V.
    pub miou_all_pixels: Option<f64>,
    /// Mean over instances of summed intersections over summed unions on V.
    pub tube_iou: Option<f64>,
    /// Changes of the majority prediction inside an instance of at least 100 pixels, per 100 pairs of
    /// consecutive frames of one view.
    pub id_switches_per_100: Option<f64>,
    /// Mean over instances of the association quality on V, predicted ids taken as tracks.
    pub association_quality: Option<f64>,
    /// Scores per instance that occurs in the truth, ascending id.
    pub instances: Vec<InstanceScore>,
}

/// Mean of what was added; `None` when nothing was.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: f64,
    count: usize,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    fn fraction(self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }

    fn percent(self) -> Option<f64> {
        self.fraction().map(|value| value * 100.0)
    }
}

/// Sums of one instance over the frames.
#[derive(Default)]
struct Tally {
    iou: Mean,
    accuracy: Mean,
    right: u64,
    truth: u64,
    /// Pixels of V predicted as this instance, all frames.
    predicted: u64,
    /// Truth pixels per predicted id (TPA), all frames.
    by_prediction: BTreeMap<u16, u64>,
    switches: usize,
}

/// Computes every metric of a set of frames.
#[must_use]
pub fn instance_metrics(frames: &[FrameConfusion]) -> InstanceMetrics {
    let mut tallies: BTreeMap<u16, Tally> = BTreeMap::new();
    let (mut pixel_accuracy, mut all_pairs, mut with_fp, mut all_pixels) =
        (Mean::default(), Mean::default(), Mean::default(), Mean::default());
    let (mut labelled, mut right) = (0, 0);
    for frame in frames {
        if let Some(accuracy) = frame.pixel_accuracy() {
            pixel_accuracy.add(accuracy);
        }
        let (frame_labelled, frame_right) = frame.labelled();
        labelled += frame_labelled;
        right += frame_right;

        // Per id: pixels in the truth, predicted on V, predicted on void, both.
        let mut sums: BTreeMap<u16, [u64; 4]> = BTreeMap::new();
        for (&(truth, predicted), &count) in &frame.counts {
            if truth != 0 {
                sums.entry(truth).or_default()[0] += count;
                *tallies.entry(truth).or_default().by_prediction.entry(predicted).or_default() += count;
            }
            if predicted != 0 {
                let sum = sums.entry(predicted).or_default();
                sum[if truth != 0 { 1 } else { 2 }] += count;
                if truth == predicted {
                    sum[3] += count;
                }
            }
        }
        for (&id, &[truth, on_labelled, on_void, both]) in &sums {
            let tally = tallies.entry(id).or_default();
            tally.truth += truth;
            tally.predicted += on_labelled;
            tally.right += both;
            if truth > 0 {
                let union = truth + on_labelled - both;
                let iou = both as f64 / union as f64;
                tally.iou.add(iou);
                tally.accuracy.add(both as f64 / truth as f64);
                all_pairs.add(iou);
                with_fp.add(iou);
                all_pixels.add(both as f64 / (union + on_void) as f64);
            } else if on_labelled > 0 {
                with_fp.add(0.0);
            }
        }
    }
    let watched_pairs = count_switches(frames, &mut tallies);
    let switches: usize = tallies.values().map(|tally| tally.switches).sum();
    let predicted: BTreeMap<u16, u64> = tallies.iter().map(|(&id, tally)| (id, tally.predicted)).collect();

    let instances: Vec<InstanceScore> = tallies
        .iter()
        .filter(|(_, tally)| tally.truth > 0)
        .map(|(&id, tally)| InstanceScore {
            id,
            frames: tally.iou.count,
            iou: tally.iou.percent(),
            accuracy: tally.accuracy.percent(),
            tube_iou: Some(100.0 * tally.right as f64 / (tally.truth + tally.predicted - tally.right) as f64),
            association_quality: Some(100.0 * association_quality(tally, &predicted)),
            id_switches: tally.switches,
        })
        .collect();
    let over_instances = |value: &dyn Fn(&InstanceScore) -> Option<f64>| {
        let mut mean = Mean::default();
        instances.iter().filter_map(value).for_each(|value| mean.add(value));
        mean.fraction()
    };
    let mut pooled = Mean::default();
    tallies
        .values()
        .filter(|tally| tally.truth > 0)
        .for_each(|tally| pooled.add(tally.right as f64 / tally.truth as f64));
    // Pairs that are false positives alone measure nothing: no truth, no score.
    let any_truth = labelled > 0;
    InstanceMetrics {
        macc_pix: pixel_accuracy.percent(),
        macc_inst: over_instances(&|score| score.accuracy),
        miou: all_pairs.percent(),
        macc_pix_pooled: any_truth.then(|| 100.0 * right as f64 / labelled as f64),
        macc_inst_pooled: pooled.percent(),
        miou_per_instance_first: over_instances(&|score| score.iou),
        miou_with_fp: with_fp.percent().filter(|_| any_truth),
        miou_all_pixels: all_pixels.percent(),
        tube_iou: over_instances(&|score| score.tube_iou),
        id_switches_per_100: (watched_pairs > 0).then(|| 100.0 * switches as f64 / watched_pairs as f64),
        association_quality: over_instances(&|score| score.association_quality),
        instances,
    }
}

/// `sum_j TPA(j) / |k| x TPA(j) / (|j| + |k| - TPA(j))` over predicted ids j (0 is no track), as a fraction.
fn association_quality(tally: &Tally, predicted: &BTreeMap<u16, u64>) -> f64 {
    tally
        .by_prediction
        .iter()
        .filter(|(id, _)| **id != 0)
        .map(|(id, &shared)| {
            let track = predicted.get(id).copied().unwrap_or(0);
            shared as f64 / tally.truth as f64 * shared as f64 / (track + tally.truth - shared) as f64
        })
        .sum()
}

/// Counts majority changes into the tallies; returns the number of (instance, frame pair) watched.
fn count_switches(frames: &[FrameConfusion], tallies: &mut BTreeMap<u16, Tally>) -> usize {
    let mut order: Vec<&FrameConfusion> = frames.iter().collect();
    order.sort_by(|a, b| (&a.view, a.time_index).cmp(&(&b.view, b.time_index)));
    let mut watched = 0;
    for pair in order.windows(2).filter(|pair| pair[0].view == pair[1].view) {
        let (before, after) = (majorities(pair[0]), majorities(pair[1]));
        for (id, majority) in &before {
            if let Some(next) = after.get(id) {
                watched += 1;
                if next != majority {
                    tallies.entry(*id).or_default().switches += 1;
                }
            }
        }
    }
    watched
}

/// Majority prediction inside every instance of at least 100 pixels; ties go to the lowest id.
fn majorities(frame: &FrameConfusion) -> BTreeMap<u16, u16> {
    let truths: BTreeSet<u16> = frame.counts.keys().map(|(truth, _)| *truth).filter(|id| *id != 0).collect();
    truths
        .into_iter()
        .filter_map(|id| {
            let mut total = 0;
            let mut best = (0, 0);
            for (&(_, predicted), &count) in frame.counts.range((id, 0)..=(id, u16::MAX)) {
                total += count;
                if count > best.1 {
                    best = (predicted, count);
                }
            }
            (total >= MIN_SWITCH_PIXELS).then_some((id, best.0))
        })
        .collect()
}

#[cfg(test)]
mod tests;
