//! Panoptic scores: pixels without a label are background, and what an object spills onto them counts against it.
//! Source: Kirillov et al. 2019, with the ids of masks for segments.
//!
//! The paper's protocol ([`super::instance`]) looks at labelled pixels alone, where an object that is alone is right
//! wherever it is drawn at all. Here an instance has those of its pixels whose expected intersection over union is
//! largest, by the probability that what they show is an instance's
//! ([`cif_render::InstanceImage::foreground`]): about those above one half, and more of what is thinner than the Gaussians
//! that draw it, of which no pixel may be certain.

use std::collections::BTreeMap;

use cif_geometry::stats::mean;
use cif_geometry::{PixelGrid, overlap};
use serde::Serialize;

use super::instance::FrameConfusion;

/// Intersection over union from which on a predicted segment is the true one.
const MATCHES: f64 = 0.5;

/// Foreground below which no pixel is an instance's.
const LEAST: f64 = 0.2;

/// Panoptic scores of a set of frames, percent.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PanopticMetrics {
    /// Panoptic quality: [`Self::segmentation`] times [`Self::recognition`].
    pub quality: Option<f64>,
    /// Mean intersection over union of the segments that match, over the whole image.
    pub segmentation: Option<f64>,
    /// Matches over the mean of the segments that there are and those that are predicted.
    pub recognition: Option<f64>,
    /// Mean over pairs (instance, frame showing it) of the intersection over union, over the whole image.
    pub iou: Option<f64>,
    /// The same per instance, by mask id.
    pub instances: BTreeMap<u16, f64>,
}

/// Mask ids of the pixels that are an instance's rather than the background's, and 0 elsewhere; see [`overlap::bound`].
#[must_use]
pub fn with_background(predicted: &PixelGrid<u16>, foreground: &PixelGrid<f32>) -> PixelGrid<u16> {
    let mut by_id: BTreeMap<u16, Vec<(f64, f64)>> = BTreeMap::new();
    let pixels = || predicted.pixels.iter().zip(&foreground.pixels);
    for (id, foreground) in pixels() {
        by_id.entry(*id).or_default().push((1.0, f64::from(*foreground)));
    }
    let bounds: BTreeMap<u16, f64> =
        by_id.iter().map(|(id, own)| (*id, overlap::bound(own).max(LEAST))).collect();
    let is_own = |id: u16, foreground: f32| f64::from(foreground) > bounds[&id];
    let ids = pixels().map(|(id, foreground)| if is_own(*id, *foreground) { *id } else { 0 }).collect();
    PixelGrid::from_pixels(predicted.width, predicted.height, ids)
}

/// Scores of frames whose predictions are those of [`with_background`].
#[must_use]
pub fn panoptic_metrics(frames: &[FrameConfusion]) -> PanopticMetrics {
    let (mut matched, mut there, mut predicted, mut overlap) = (0, 0, 0, 0.0);
    let mut overlaps: BTreeMap<u16, Vec<f64>> = BTreeMap::new();
    for frame in frames {
        // Per id: pixels in the truth, predicted, both.
        let mut sums: BTreeMap<u16, [u64; 3]> = BTreeMap::new();
        for (&(truth, prediction), &count) in &frame.counts {
            for (id, slot) in [(truth, 0), (prediction, 1)] {
                sums.entry(id).or_default()[slot] += count;
            }
            if truth == prediction {
                sums.entry(truth).or_default()[2] += count;
            }
        }
        sums.remove(&0);
        for (id, [of_truth, of_prediction, both]) in sums {
            let iou = both as f64 / (of_truth + of_prediction - both) as f64;
            there += usize::from(of_truth > 0);
            predicted += usize::from(of_prediction > 0);
            if iou > MATCHES {
                matched += 1;
                overlap += iou;
            }
            if of_truth > 0 {
                overlaps.entry(id).or_default().push(iou);
            }
        }
    }
    if there == 0 {
        return PanopticMetrics::default();
    }
    let percent = |values: &[f64]| mean(values).map(|mean| 100.0 * mean);
    let all: Vec<f64> = overlaps.values().flatten().copied().collect();
    let segments = (there + predicted) as f64 / 2.0;
    PanopticMetrics {
        quality: Some(100.0 * overlap / segments),
        segmentation: (matched > 0).then(|| 100.0 * overlap / f64::from(matched)),
        recognition: Some(100.0 * f64::from(matched) / segments),
        iou: percent(&all),
        instances: overlaps.iter().filter_map(|(id, overlaps)| Some((*id, percent(overlaps)?))).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(truth: [u16; 12], predicted: [u16; 12]) -> FrameConfusion {
        let grid = |ids: [u16; 12]| PixelGrid::from_pixels(4, 3, ids.to_vec());
        FrameConfusion::new("cam", 0, &grid(truth), &grid(predicted))
    }

    #[test]
    fn what_spills_onto_the_background_counts() {
        let truth = [0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1];
        // All of the image, which is right on every labelled pixel.
        let scores = panoptic_metrics(&[frame(truth, [1; 12])]);
        assert_eq!(scores.iou, Some(100.0 * (8.0 / 12.0)));
        assert_eq!((scores.recognition, scores.quality), (Some(100.0), scores.segmentation));
        let exact = panoptic_metrics(&[frame(truth, truth)]);
        assert_eq!((exact.quality, exact.iou), (Some(100.0), Some(100.0)));
    }

    #[test]
    fn segments_that_are_missed_and_made_up_count_half_each() {
        let truth = [1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0];
        let predicted = [1, 1, 1, 1, 0, 0, 0, 0, 3, 3, 0, 0];
        let scores = panoptic_metrics(&[frame(truth, predicted)]);
        // One match of two that are there and two that are predicted.
        assert_eq!(
            (scores.recognition, scores.quality, scores.segmentation),
            (Some(50.0), Some(50.0), Some(100.0))
        );
        assert_eq!(scores.iou, Some(50.0));
        assert_eq!(scores.instances, BTreeMap::from([(1, 100.0), (2, 0.0)]));
    }

    #[test]
    fn without_truth_there_is_nothing_to_score() {
        assert_eq!(panoptic_metrics(&[frame([0; 12], [1; 12])]), PanopticMetrics::default());
        assert_eq!(panoptic_metrics(&[]), PanopticMetrics::default());
    }

    #[test]
    fn the_background_takes_what_is_more_likely_its_own() {
        // An object that is seen well, and one so thin that none of its pixels shows it alone.
        let predicted = PixelGrid::from_pixels(9, 1, vec![4, 4, 4, 4, 4, 7, 7, 7, 7]);
        let foreground = PixelGrid::from_pixels(9, 1, vec![1.0, 1.0, 1.0, 0.4, 0.1, 0.45, 0.4, 0.1, 0.1]);
        assert_eq!(with_background(&predicted, &foreground).pixels, [4, 4, 4, 0, 0, 7, 7, 0, 0]);
        // Of nothing but traces, nothing is left.
        let traces = PixelGrid::from_pixels(9, 1, vec![0.1; 9]);
        assert_eq!(with_background(&predicted, &traces).pixels, [0; 9]);
    }
}
